"""One fold of a cross-validation, from wherever it was left to its result: train, adapt, score.

Whatever process runs it, and however often: what is done is not done again, a training goes on from its newest
checkpoint, and only one process works on it at a time. It may be killed at any moment.
"""

import contextlib
import errno
import importlib.metadata
import math
import os
import platform
import signal
import socket
import time
import traceback
from pathlib import Path

import zestjax
from zestjax.apps import evaluate, finetune, run_folder, train
from zestjax.apps.clips import code_digest
from zestjax.apps.fold_state import Heart, Place, finished, locked, worked_on
from zestjax.apps.folds import read_plan
from zestjax.apps.memory import peak_megabytes, reset_peak
from zestjax.apps.results import read_record, write_record
from zestjax.apps.scenes import open_scene
from zestjax.apps.weights import open_weights, shipped_weights
from zestjax.base.parts import to_stored
from zestjax.io.files import remove_parts
from zestjax.train.recipes import recipe_of

OUT_OF_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)  # of the place: no fold's fault, and every other's end too
LOOKERS = 1.0  # seconds to wait for a lock that only a `status` may hold for a moment


class Stop(KeyboardInterrupt):
    """The system asks the process to end."""


def run_fold(out, plan, fold, *, failed=False, quiet=False):
    """Run one fold, or what is left of it.

    Args:
      out: the cross-validation's folder.
      plan: its `Plan`.
      fold: one of the plan's.
      failed: run it even if it failed before.
      quiet: no progress.

    Returns:
      `done`, `failed` (its folder says why), `stopped` (by a signal, after saving: run it again), or `running`:
      another process works on it.

    Raises:
      ValueError: the folder holds a result of another fold, or meanwhile another plan.
      OSError, WeightsError: no room is left; run it again with room, and it goes on.
    """
    place = Place(out, fold)
    if finished(out, plan, fold):
        return "done"
    with locked(place.lock, patience=LOOKERS) as held:
        if worked_on(place, held):
            return "running"
        if finished(out, plan, fold):
            return "done"
        if (stored := read_plan(out)) != plan:
            raise ValueError(f"{out}: holds another plan meanwhile ({stored and stored.digest}); choose another --out.")
        if read_record(place.failed).get("reason") and not failed:
            return "failed"
        place.failed.unlink(missing_ok=True)
        for folder in (place.work, place.fold, place.fold / "pictures"):
            remove_parts(folder)
        with stopped_by_signals():
            try:
                with Heart(place.beat) as heart:
                    return _worked(place, plan, fold, heart, quiet)
            except KeyboardInterrupt:
                return "stopped"


def _worked(place, plan, fold, heart, quiet):
    """`run_fold` of a fold that is held and not finished."""
    try:
        code_digest("**/*.py")  # kept, as it is while the fold runs
        reset_peak()
        _check_scored(plan, fold)
        weights = _weights(place, plan, fold, heart, quiet)
        heart.stage = "evaluate"
        _score(place, plan, fold, weights, quiet)
        _finish(place, plan, fold, weights, heart)
        return "done"
    except Exception as error:
        if _out_of_room(error):
            raise
        told = {
            "reason": f"{type(error).__name__}: {' '.join(str(error).split())}", "stage": heart.stage,
            "seconds": round(heart.seconds, 1), "host": socket.gethostname(), "written": _now(),
            "traceback": traceback.format_exc(),
        }  # fmt: skip
        write_record(place.failed, told)
        return "failed"


def _out_of_room(error):
    """Whether an error is, or comes from, the place having no room."""
    while error is not None and not (isinstance(error, OSError) and error.errno in OUT_OF_ROOM):
        error = error.__cause__ or error.__context__
    return error is not None


def _check_scored(plan, fold):
    """Refuse a scene that cannot be scored before anything is trained for it; those of zest-bench always can."""
    if not fold.scene.startswith("bench:"):
        recipe = recipe_of(plan.preset, system=fold.system)
        open_scene(fold.scene, recipe, size=plan.size, protocol=plan.protocol, targets=plan.targets)


def _weights(place, plan, fold, heart, quiet):
    """The fold's weights, trained and adapted as far as planned; the file.

    Raises:
      Stop: a signal ended it, and all is saved.
    """
    weights = None if plan.weights is None else Path(plan.weights)
    used = weights if weights is not None or plan.steps else shipped_weights()
    for file, digest in ((used, plan.start), (plan.lpips, plan.judge)):
        if train.run_name(file) != digest:
            raise ValueError(f"{file}: is another file than when this was planned; put it back, or plan anew.")
    if plan.steps:
        heart.stage, options = "train", train.TrainOptions(
            place.fold / "train", preset=plan.preset, system=fold.system, steps=plan.steps, minutes=plan.minutes,
            resume=True, seed=fold.seed, weights=weights, scenes=fold.others, settings=fold.settings,
            checkpoint_minutes=plan.checkpoint_minutes, quiet=quiet,
        )  # fmt: skip
        weights = _ended(train.train(options))
    if plan.finetune:
        number, seconds = plan.finetune
        limit = (
            {"budget": float(number), "steps": finetune.FOREVER}
            if seconds
            else {"budget": math.inf, "steps": int(number)}
        )
        heart.stage, options = "finetune", finetune.FinetuneOptions(
            fold.scene, place.fold / "finetune", weights, size=plan.size, resume=True, seed=fold.seed, quiet=quiet,
            **limit,
        )  # fmt: skip
        weights = _ended(finetune.finetune(options))
    return weights


def _ended(summary):
    """The weights of a run that a signal did not end."""
    if not summary.result.finished:
        _stop()
    return summary.weights


def _score(place, plan, fold, weights, quiet):
    """Write the held-out scene's metrics.json and pictures."""
    system = None if plan.steps else fold.system
    evaluate.evaluate(evaluate.EvaluateOptions(
        fold.scene, place.fold, weights, system=system, protocol=plan.protocol, size=plan.size, targets=plan.targets,
        lpips=None if plan.lpips is None else Path(plan.lpips), effects="all", seed=fold.seed, quiet=quiet,
    ))  # fmt: skip


def _finish(place, plan, fold, weights, heart):
    """Say what the result is of, and put it in its place by one renaming."""
    model = open_weights(weights)
    metrics = read_record(place.fold / "metrics.json")
    if weights is not None and weights.is_relative_to(place.fold):
        metrics["weights"] = str(place.result / weights.relative_to(place.fold))
        write_record(place.fold / "metrics.json", metrics)
    told = {
        "spec": plan.spec(fold), "plan": plan.digest, "recipe": to_stored(model.recipe), "seed": fold.seed,
        "seconds": round(heart.seconds, 1), "peak_megabytes": peak_megabytes(), "device": metrics.get("device"),
        "threads": run_folder.threads(), "host": socket.gethostname(), "zestjax": zestjax.__version__,
        "code": code_digest("**/*.py"), "python": platform.python_version(), "libraries": libraries(),
        "written": _now(),
    }  # fmt: skip
    write_record(place.fold / "fold.json", told)
    place.result.parent.mkdir(parents=True, exist_ok=True)
    os.rename(place.fold, place.result)


def libraries():
    """The version of every library that is installed, by name."""
    return dict(sorted((dist.name, dist.version) for dist in importlib.metadata.distributions() if dist.name))


@contextlib.contextmanager
def stopped_by_signals():
    """Context: the first SIGTERM, or SIGUSR2 as schedulers send it, ends what is done by `Stop`; a training saves its
    state first, by a handler of its own."""
    before = {}
    with contextlib.suppress(ValueError):  # not the main thread: no signals to catch
        before[signal.SIGTERM] = signal.signal(signal.SIGTERM, _stop)
        before[signal.SIGUSR2] = signal.signal(signal.SIGUSR2, lambda *_: signal.raise_signal(signal.SIGTERM))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(*_):
    with contextlib.suppress(ValueError):  # not the main thread
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # schedulers send it twice
    raise Stop


def _now():
    return time.strftime("%Y-%m-%dT%H:%M:%S")
