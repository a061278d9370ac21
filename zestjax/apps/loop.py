"""The loop around pure training steps: clock, progress, log, curve, checkpoints, signals.

A folder holds `log.jsonl` (a line per few steps: mean of every scalar the step reports), `curve.png`, `checkpoints/`
and `weights.safetensors`. A checkpoint is a whole `TrainState`; the log is cut back to it when a run resumes.
"""

import contextlib
import dataclasses
import json
import signal
import sys
import time
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from zestjax.apps import run_folder
from zestjax.apps.hosts import anywhere, begun_by_first
from zestjax.apps.log import Recorder, draw_curve, read_log
from zestjax.apps.progress import Estimate
from zestjax.io.files import append_bytes
from zestjax.train.training import TrainState, training_steps

STEPS_TOLD = 8  # after which the steps' time is told: they differ by what their batches wait for
MOST_FAULTS = 5  # explained in one call: each costs as much as a step


@dataclasses.dataclass(frozen=True)
class LoopOptions:
    """When a loop stops and how often it writes.

    out: folder. steps: int, total. seconds: of stepping, the first step (which compiles) left out; None: no limit.
    resume: continue from the folder's newest checkpoint. checkpoint_seconds, log_steps: intervals. quiet: no progress.
    label: what the estimate of all its steps calls it; where `seconds` end it that is known.
    """

    out: Path
    steps: int
    seconds: float | None = None
    resume: bool = False
    checkpoint_seconds: float = 300.0
    log_steps: int = 10
    quiet: bool = False
    label: str = "train"


class LoopResult(NamedTuple):
    """state: the last `TrainState`. seconds: spent stepping, over all resumed parts. compile_seconds: of this call's
    first step. report: the last logged means. finished: whether the steps or the time were used up, not a signal.
    steps: taken by this call."""

    state: TrainState
    seconds: float
    compile_seconds: float
    report: dict
    finished: bool
    steps: int


def run_loop(step_fn, start, batch_at, options, *, metadata, explain=None):
    """Train until the steps, the seconds or a signal ends it; every file is complete whenever the process dies.

    An error that ends it, but that of a loss that stays non-finite, saves the state on its way out.

    Args:
      step_fn: (params, opt_state, batch) -> (params, opt_state, info), may donate.
      start: fresh `TrainState`; also the template that a checkpoint is read into.
      batch_at: step -> batch, a pure function of the step.
      options: `LoopOptions`.
      explain: (params, batch) -> what to say of a step that the solver skipped, or None.
      metadata: dict stored with every checkpoint and the weights: the full configuration and the run's seed.

    Returns:
      `LoopResult`.

    Raises:
      ValueError: another process trains into the folder.
      WeightsError: the folder holds another run, or a checkpoint cannot be read or written.
      FloatingPointError: the loss stays non-finite.
    """
    out = Path(options.out)
    with run_folder.held(out):
        restore = lambda: run_folder.restore(start, out, metadata)
        begun = begun_by_first(restore if options.resume else lambda: run_folder.begin(start, out))
        out_of_time = options.seconds is not None and begun.seconds >= options.seconds
        if begun.state.step >= options.steps or out_of_time:
            return _ended(out, begun)
        return _run(step_fn, begun, batch_at, options, metadata, explain)


def _ended(out, begun):
    """The result of a run that had already ended, its curve drawn in case it ended before that."""
    draw_curve(out / "log.jsonl", out / "curve.png")
    logged = read_log(out / "log.jsonl")[0]
    return LoopResult(begun.state, begun.seconds, 0.0, logged[-1] if logged else {}, True, 0)


def _run(step_fn, begun, batch_at, options, metadata, explain):
    """`run_loop` from a state on, in a folder that is held."""
    out, state, first = Path(options.out), begun.state, begun.state.step
    recorder, clock = Recorder(out / "log.jsonl", options.log_steps), _Clock(begun.seconds, options)
    faults, asked = _Faults(out, state, explain), False
    untold = options.quiet or options.seconds is not None
    estimate = Estimate(options.label, "step", after=STEPS_TOLD, quiet=untold)
    with _StopOnSignal() as stop, _bar(first, options) as bar:
        try:
            for state, info in training_steps(step_fn, begun.state, batch_at, steps=options.steps):
                clock.tick()
                recorder.add(state.step, info, clock)
                faults.see(state, batch_at)
                _show(bar, recorder, clock)
                estimate.tick(options.steps - state.step)
                asked, over = anywhere(stop.asked, clock.over())
                done = asked or over or state.step == options.steps
                if done or clock.checkpoint_due():
                    recorder.flush()
                    run_folder.save(out, state, metadata, clock.seconds)
                    recorder.draw(out / "curve.png")
                if done:
                    break
        except FloatingPointError:
            raise
        except Exception:
            if state.step > first:
                _rescue(out, recorder, state, metadata, clock.seconds)
            raise
    recorder.draw(out / "curve.png", least_seconds=0)
    finished = state.step == options.steps or not asked
    return LoopResult(state, clock.seconds, clock.compile_seconds, recorder.last, finished, state.step - first)


def _rescue(out, recorder, state, metadata, seconds):
    """Save what can be saved while an error is on its way out, which is the one to be told."""
    with contextlib.suppress(OSError):
        recorder.flush()
    with contextlib.suppress(Exception):  # the next step may have taken the arrays; the disk may be gone
        run_folder.save(out, state, metadata, seconds)


class _Faults:
    """Reports a step that the solver skipped: what was not finite, on standard error and in `faults.jsonl`."""

    def __init__(self, out, start, explain):
        self.path, self.explain, self.left = out / "faults.jsonl", explain, MOST_FAULTS
        self.count = int(getattr(start.opt_state, "skipped", 0))

    def see(self, state, batch_at):
        count = int(getattr(state.opt_state, "skipped", 0))
        if count == self.count:
            return
        self.count = count
        if self.explain is None or self.left == 0:
            return
        self.left -= 1
        said = str(self.explain(state.params, batch_at(state.step - 1)))
        tqdm.write(f"warning: step {state.step} was skipped; {said}", file=sys.stderr)
        append_bytes(self.path, (json.dumps({"step": state.step, "fault": said}) + "\n").encode())


class _Clock:
    """Seconds of stepping so far, without the first step of this process, which compiles."""

    def __init__(self, seconds, options):
        self.seconds, self.options, self.compile_seconds = seconds, options, 0.0
        self.start = self.last = self.saved = time.perf_counter()

    def tick(self):
        now = time.perf_counter()
        if self.compile_seconds:
            self.seconds += now - self.last
        else:
            self.compile_seconds = now - self.last
        self.last = now

    def over(self):
        return self.options.seconds is not None and self.seconds >= self.options.seconds

    def checkpoint_due(self):
        due = self.last - self.saved >= self.options.checkpoint_seconds
        self.saved = self.last if due else self.saved
        return due


class _StopOnSignal:
    """Turns Ctrl-C and SIGTERM into a wish that the loop grants after its step; a second Ctrl-C ends it at once."""

    def __enter__(self):
        self.asked, self.before = False, {}
        with contextlib.suppress(ValueError):  # not the main thread: no signals to catch
            for number in (signal.SIGINT, signal.SIGTERM):
                self.before[number] = signal.signal(number, self._ask)
        return self

    def _ask(self, number, frame):
        if self.asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.asked = True

    def __exit__(self, *_):
        for number, handler in self.before.items():
            signal.signal(number, handler)


def _bar(step, options):
    return tqdm(total=options.steps, initial=step, disable=options.quiet, unit="step", file=sys.stderr, mininterval=1.0)


def _show(bar, recorder, clock):
    if clock.options.seconds is not None:
        left = max(0.0, clock.options.seconds - clock.seconds)
        bar.set_description(f"at most {left / 60:.0f} min left", refresh=False)
    loss = recorder.last.get("total")
    if loss is not None:
        bar.set_postfix(loss=f"{loss:.4f}", refresh=False)
    bar.update(1)
