"""`zestjax finetune`: weights adapted to one scene by predicting what stands still in its frames from other frames.

A frame that is held back has no picture of its own time to be predicted from, as the views asked for later have: what
moves would learn to fade. It is therefore left out, as far as the frames' own analysis finds it.

judges   frames that no step learns from: what stands still in them is predicted at the start and at the end, and where
         the end is worse the start's weights are what is returned
"""

import dataclasses
import functools
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from zestjax import novel_view
from zestjax.apps.budget import Budget
from zestjax.apps.effects import check_choice, choose, with_effects
from zestjax.apps.loop import LoopOptions, run_loop
from zestjax.apps.own_frames import known_of, own_frame_batches
from zestjax.apps.pilot import Pilot
from zestjax.apps.results import write_record
from zestjax.apps.scenes import digest, open_scene, place_of
from zestjax.apps.settings import TRAINED
from zestjax.apps.train import run_name, summarise
from zestjax.apps.weights import arithmetic, open_weights
from zestjax.base.parts import to_stored
from zestjax.effects import priors_for
from zestjax.frames.assembly import colours_of, positions
from zestjax.frames.known import answers_of
from zestjax.io.weights import save_weights
from zestjax.train.adversary import Opponents
from zestjax.train.batches import step_batches
from zestjax.train.learn import find_fault
from zestjax.train.recipes import Cosine
from zestjax.train.training import TrainState

RATE = Cosine(1e-3, 1e-3, 5)
STILL_WEIGHTS = dict(static_rec=20.0)
MOVING = 0.3  # probability of moving from which a pixel is left out, and its surroundings with it
LEAST_STILL = 0.01  # share of the pixels that must stand still: with less a run would learn from nothing, at loss 0
FOREVER = 1_000_000
JUDGES = 2  # frames: each costs two renderings
LEAST_FRAMES = 8  # of a video that can spare them
CHECKPOINT_SECONDS = 60.0  # the default budget: a run that asks for more loses at most this much to a kill


@dataclasses.dataclass(frozen=True)
class FinetuneOptions:
    """The flags of `zestjax finetune`; see the command's help. steps: in all; the budget usually ends it first."""

    scene: str
    out: Path
    weights: Path | None = None
    system: str | None = None
    budget: float = 60.0
    exclude: tuple = ()
    size: tuple | None = None
    format: str | None = None
    resume: bool = False
    steps: int = FOREVER
    budget_seconds: float | None = None
    frame_ms: float | None = None
    at_least_db: float | None = None
    memory: float | None = None
    effects: str = "all"
    seed: int = 0
    quiet: bool = False


@arithmetic()
def finetune(options):
    """Run `zestjax finetune`.

    Returns:
      `train.Summary`.

    Raises:
      ValueError, WeightsError: a scene or weights that cannot be used, or no frame left to learn from.
    """
    check_choice(options.effects)
    model = open_weights(options.weights, system=options.system)
    if getattr(model.system.static, "statistics", "batch") != "batch":
        raise ValueError("finetune: norms with stored statistics do not learn; import them with --statistics batch.")
    opened = open_scene(
        options.scene, model.recipe, size=options.size, protocol=None, layout=options.format, exclude=options.exclude
    )
    video = opened.scene.video
    if len(video.images) - len(set(options.exclude)) < 3:
        raise ValueError(f"finetune: --exclude leaves too few of {len(video.images)} frames; leave at least 3.")
    chosen = choose(options.effects, opened.scene, exclude=options.exclude, quiet=options.quiet)
    model = with_effects(model, chosen.on)
    prepared = novel_view.prepare(model.params, video, system=model.system, exclude=options.exclude)
    moving = moving_pixels(prepared)
    judges = () if moving is None else judging_frames(video, moving, options.exclude)
    options, pilot = within_budget(options, model, video, judges)
    known = priors_for(known_of(opened.scene), chosen.on)._replace(moving=moving)
    recipe = dataclasses.replace(model.recipe, rate=RATE)
    recipe = recipe.of(model.system, known=answers_of(known)) if moving is None else recipe.weighted(STILL_WEIGHTS)
    (init, step_fn), explain = recipe.trainer(steps=FOREVER), functools.partial(find_fault, recipe.objective())
    params = jax.tree.map(jnp.array, model.trained)  # copies: the step donates
    loop = LoopOptions(
        options.out, options.steps, options.budget, options.resume, CHECKPOINT_SECONDS, quiet=options.quiet,
        label="finetune",
    )  # fmt: skip
    metadata = model.metadata | {
        "recipe": to_stored(recipe), "seed": options.seed, "start": run_name(model.path),
        "scene": place_of(options.scene), "effects": list(chosen.on),
        "data": {"frames": digest(video), "exclude": list(options.exclude)},
    }  # fmt: skip
    one_at = own_frame_batches(known, recipe, seed=options.seed, exclude=options.exclude, kept=judges)
    batch_at = step_batches(one_at, recipe.clips)
    step_fn = jax.jit(step_fn, donate_argnums=(0, 1))
    result = run_loop(step_fn, TrainState(params, init(params), 0), batch_at, loop, metadata=metadata, explain=explain)
    summary = _with_setting(summarise(result, options.out, "finetune"), pilot)
    if not result.finished or not judges:
        return summary
    verdict = judged(model, result.state.params, prepared, moving, judges, options.exclude)
    return _told(summary, verdict, model, metadata)


def within_budget(options, model, video, judges):
    """The options with the stepping that their budget leaves, and the `Pilot` of rendering what was trained, or None
    where they say nothing of rendering.

    Raises:
      ValueError: preparing and judging alone take the budget.
    """
    budget, pilot = Budget.of(options), None
    rendering = dataclasses.replace(budget, seconds=None)
    if rendering:
        at = judges[0] if judges else next(i for i in range(len(video.images)) if i not in options.exclude)
        first = jax.tree.map(lambda leaf: leaf[at], video.cameras), at, options.exclude
        pilot = Pilot(model, video, rendering, 1, first, quiet=options.quiet)
    if budget.seconds is None:
        return options, pilot
    clock = Pilot.clock_of(model, video)
    other = clock.prepare(TRAINED) + 2 * len(judges) * clock.frame(1.0)  # each judge is rendered by both weights
    if (left := budget.seconds - other) <= 0:
        raise ValueError(
            f"finetune: --budget-seconds {budget.seconds:g} leaves no time to step: preparing and judging take about "
            f"{other:.1f} s; give more."
        )
    return dataclasses.replace(options, budget=min(left, options.budget)), pilot


def _with_setting(summary, pilot):
    """The summary with the setting that the weights are to be rendered by, which is stored beside them."""
    if pilot is None:
        return summary
    write_record(summary.weights.parent / "setting.json", pilot.record)
    return summary._replace(line=f"{summary.line}; to render: {pilot.line}")


def _told(summary, verdict, model, metadata):
    """The summary with the verdict, which is stored beside the weights; these are the start's where it was better."""
    if verdict.worse:
        save_weights(summary.weights, model.trained, metadata=metadata | {"step": 0, "seconds": 0.0})
    write_record(summary.weights.parent / "judged.json", verdict.told)
    return summary._replace(line=f"{summary.line}; {verdict}")


class Verdict(NamedTuple):
    """frames: the judges. before, after: PSNR of what stands still in them, dB."""

    frames: tuple[int, ...]
    before: float
    after: float

    @property
    def worse(self):
        """Whether the start is the better one."""
        return not self.after >= self.before

    @property
    def told(self):
        """As JSON has it."""
        return self._asdict() | {"kept": "start" if self.worse else "trained"}

    def __str__(self):
        ended = ", so that the start's weights are kept" if self.worse else ""
        frames = " and ".join(map(str, self.frames))
        return f"frames {frames}, held back: {self.before:.2f} -> {self.after:.2f} dB{ended}"


def judging_frames(video, moving, exclude):
    """The frames that judge, those whose nearest other camera is farthest, of all in which enough stands still; none of
    a video that cannot spare them."""
    usable = [i for i in range(len(video.images)) if i not in exclude and not moving[i].mean() > 1 - LEAST_STILL]
    if len(usable) < LEAST_FRAMES:
        return ()
    places = positions(video.cameras)[usable]
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    farthest = np.argsort(-apart.min(1), kind="stable")[:JUDGES]
    return tuple(sorted(usable[i] for i in farthest))


def judged(model, trained, prepared, moving, frames, exclude):
    """The `Verdict` on parameters as of `model.trained`."""

    def score(params):
        errors = []
        for i in frames:
            camera = jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i]), prepared.video.cameras)
            view = novel_view.render_view(params, prepared, camera, i, system=model.system, exclude=(*exclude, i))
            error = np.square(np.asarray(view.static) - colours_of(prepared.video.images[i])).mean(-1)
            errors.append(error[~moving[i]])
        return float(-10 * np.log10(max(np.concatenate(errors).mean(), 1e-10)))

    return Verdict(frames, score(model.params), score(trained.model if isinstance(trained, Opponents) else trained))


def moving_pixels(prepared):
    """(N, H, W) bool of what may move, by the frames' own analysis; None where the model has none.

    Raises:
      ValueError: hardly anything stands still.
    """
    maps, video = prepared.maps, prepared.video
    if maps is None:
        return None
    size = video.images.shape[2:0:-1]
    likely = np.asarray(jax.nn.sigmoid(maps.moving_logits), np.float32)
    moving = np.stack([cv2.resize(cv2.dilate(frame, np.ones((3, 3))), size) for frame in likely]) > MOVING
    if (still := 1 - moving.mean()) < LEAST_STILL:
        raise ValueError(
            f"finetune: the weights take all but {still:.1%} of the pixels for moving, which leaves nothing to learn "
            "from; give weights that were trained for longer, or another scene."
        )
    return moving
