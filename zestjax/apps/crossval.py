"""`zestjax crossval`: each scene held out in turn, for every system, seed and setting; and the same as a function.

RUN_AGAIN  the exit code of a run whose folds have not all ended: the same command goes on
"""

import dataclasses
import json
import math
import statistics
import sys
from pathlib import Path

from zestjax.apps.cache import keep_compiled
from zestjax.apps.crossval_flags import CHOICES
from zestjax.apps.crossval_table import write_tables
from zestjax.apps.fold_run import run_fold
from zestjax.apps.fold_state import STATES, finished, seconds_left, state_of
from zestjax.apps.folds import agreed_plan
from zestjax.apps.launchers import LAUNCHERS, RUN_AGAIN
from zestjax.apps.tables import counted
from zestjax.base.checks import check_option

COSTS = {"tiny": (0.05, 100.0, 2.4), "small": (0.9, 240.0, 3.0), "paper": (54.0, 600.0, 11.1)}
"""By preset: seconds of a step, seconds beside (compiling, scoring), GB; of `zest` on two cores. Finished folds tell
better."""


def crossval(out, *, launcher="inline", jobs=None, failed=False, quiet=True, slurm=(), **choices):
    """Run a cross-validation, or go on with one, and return its table.

    Args:
      out: folder.
      launcher: `inline`, `process` or `slurm`.
      jobs: folds at a time.
      failed: run folds that failed again.
      quiet: no progress.
      slurm: (name, value) of sbatch's options.
      **choices: of `folds.Plan`, as scenes, systems, preset, steps, settings; by default those of the folder's plan.

    Returns:
      dict, see `crossval_table.write_tables`; `finished` of its `folds` are in it.

    Raises:
      ValueError: choices that cannot be, or others than the folder's plan has.
      OSError, WeightsError: no room is left.
    """
    check_option("crossval", launcher=(launcher, tuple(LAUNCHERS)))
    keep_compiled()
    plan = agreed_plan(out, choices)
    states = {fold: state_of(out, plan, fold).state for fold in plan.folds}
    folds = [fold for fold, state in states.items() if state in ("stopped", "waiting", *["failed"] * failed)]
    LAUNCHERS[launcher](out, plan, folds, jobs=jobs, failed=failed, quiet=quiet, options=slurm)
    return write_tables(out, plan)


def command(options):
    """Run `zestjax crossval` from the flags that were given.

    Returns:
      (the summary line, True or an exit code).
    """
    out, action = Path(options["out"]), options["action"]
    choices = {name: options[name] for name in ("seed", *CHOICES) if name in options}
    plan = agreed_plan(out, choices, resume=options["resume"] or action in ("status", "table"))
    if action is None or action == "run" and options["fold"] is None:
        table = crossval(out, launcher=options["launcher"], jobs=options["jobs"], failed=options["failed"],
                         quiet=options["quiet"], slurm=options["slurm"])  # fmt: skip
        return _summary(out, plan, table)
    return {"plan": _plan, "run": _run, "status": _status, "table": _table}[action](out, plan, options)


def _run(out, plan, options):
    """`run --fold K`."""
    if options["fold"] >= len(plan.folds):
        raise ValueError(f"crossval: no fold {options['fold']}; the plan of {out} has 0 to {len(plan.folds) - 1}.")
    fold = plan.folds[options["fold"]]
    outcome = run_fold(out, plan, fold, failed=options["failed"], quiet=options["quiet"])
    state = state_of(out, plan, fold)
    why = {"failed": f": {str(state.reason).rstrip('.')}; once that is mended, run it with --failed",
           "stopped": ": run it again, and it goes on", "running": " in another process"}.get(outcome, "")  # fmt: skip
    line = f"crossval: fold {fold.index} {fold.label} {outcome}{why}"
    if outcome == "failed":
        print(f"error: {line}", file=sys.stderr)
    return line, {"done": True, "failed": 1}.get(outcome, RUN_AGAIN)


def _summary(out, plan, table):
    """The line of a run that has come to its end, and its code."""
    states, count = _states(out, plan)
    others = ", ".join(f"{count[name]} {name}" for name in STATES[1:] if count[name])
    psnrs = [(row["row"], row["full"]["psnr"]) for row in table["rows"]]
    scores = "; ".join(f"{row} {psnr['mean']:.2f} dB" for row, psnr in psnrs if psnr)
    line = f"crossval: {count['done']} of {counted(len(states), 'fold')} done{f' ({others})' * bool(others)}"
    line += f": {scores}" * bool(scores) + f": {Path(out) / 'table.md'}"
    if count["done"] == len(states):
        return line, True
    if count["done"] + count["failed"] == len(states):
        return f"{line}; `--failed` runs those that failed again, `crossval status` says why", 1
    return f"{line}; run it again to go on", RUN_AGAIN


def _table(out, plan, options):
    """`table`."""
    table = write_tables(out, plan)
    if options["json"]:
        return json.dumps(table, indent=1), True
    return f"crossval: {table['finished']} of {counted(table['folds'], 'fold')} in {out / 'table.md'}", True


def _status(out, plan, options):
    """`status`: every fold's state, and the time left."""
    states, count = _states(out, plan)
    left = seconds_left(states, _expected(out, plan)[0])
    if options["json"]:
        each = [{"fold": fold.index, "variant": fold.variant, "scene": fold.name, **state._asdict()}
                for fold, state in zip(plan.folds, states, strict=True)]  # fmt: skip
        told = {"plan": plan.digest, "folds": len(states), **count, "seconds_left": left, "each": each}
        return json.dumps(told, indent=1), True
    lines = [_fold_line(fold, state) for fold, state in zip(plan.folds, states, strict=True)]
    counts = ", ".join(f"{count[name]} {name}" for name in STATES if count[name])
    return "\n".join([*lines, f"crossval: {counts} of {counted(len(states), 'fold')}, {_duration(left)} left"]), True


def _states(out, plan):
    """Every fold's `State`, and how many there are of each name."""
    states = [state_of(out, plan, fold) for fold in plan.folds]
    return states, {name: sum(state.state == name for state in states) for name in STATES}


def _fold_line(fold, state):
    where = f" ({state.stage}, step {state.step} of {state.steps})" if state.state in ("running", "stopped") else ""
    spent = f", {_duration(state.seconds)}" if state.seconds else ""
    return f"  {fold.index} {fold.label}: {state.state}{where}{spent}{f': {state.reason}' if state.reason else ''}"


def _plan(out, plan, options):
    """`plan`: the folds, and what they will cost."""
    seconds, gigabytes, known = _expected(out, plan)
    whole, count = seconds * len(plan.folds), len(plan.folds)
    if options["json"]:
        told = {"plan": plan.digest, **plan.stored, "folds": [dataclasses.asdict(fold) for fold in plan.folds],
                "array": f"0-{count - 1}", "seconds_each": seconds, "gigabytes_each": gigabytes,
                "known": known}  # fmt: skip
        return json.dumps(told, indent=1), True
    factors = [("scene", len(plan.scenes)), ("system", len(plan.systems)), ("seed", plan.seeds)]
    factors += [(f"{name} value", len(values)) for name, values in plan.settings]
    product = " x ".join(counted(number, what) for what, number in factors)
    cost = f"each about {_duration(seconds)} and {gigabytes:.1f} GB, {_duration(whole)} in all ({known})"
    lines = [f"  {f.index} {f.label}: seed {f.seed}, learns from {counted(len(f.others), 'scene')}" for f in plan.folds]
    last = f"crossval: plan {plan.digest}: {counted(count, 'fold')} ({product}), array 0-{count - 1}; {cost}"
    return "\n".join([*lines, last]), True


def _expected(out, plan):
    """Seconds and GB of a fold, and what they are from: finished folds, or the preset."""
    ended = [told for fold in plan.folds if (told := finished(out, plan, fold))]
    if ended:
        peaks = [told["peak_megabytes"] or 0.0 for told in ended]
        return statistics.mean(told["seconds"] for told in ended), max(peaks) / 1000, f"as the {len(ended)} that ended"
    step, beside, gigabytes = COSTS[plan.preset]
    stepping = min(plan.steps * step, 60 * (plan.minutes or math.inf))
    tuning = 0 if not plan.finetune else plan.finetune[0] * (1 if plan.finetune[1] else step)
    return stepping + beside + tuning, gigabytes, f"estimate for {plan.preset} on two cores"


def _duration(seconds):
    """Seconds in words."""
    if seconds is None:
        return "an unknown time"
    for size, unit in ((86400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"
