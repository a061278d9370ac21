"""Where the folds of a cross-validation are, told by files alone: who works on one, how far it is, what became of it.

    OUT/folds/VARIANT/SCENE/  a finished fold, which appears by one renaming: metrics.json, pictures/, train/, fold.json
    OUT/work/000/             fold 0's work: fold/ (what is renamed), lock, beat.json, failed.json, log.txt

lock   held by the process that works on a fold; the system lets go when it dies
beat   a counter that such a process raises: where locks do not reach another host, it tells that the fold is alive.
       Nobody compares clocks.
"""

import contextlib
import fcntl
import json
import os
import socket
import threading
import time
from pathlib import Path
from typing import NamedTuple

from zestjax.apps.log import read_log
from zestjax.apps.results import read_record
from zestjax.io.files import write_bytes

BEAT_SECONDS = 2.0  # small beside a fold, and what is written is a line
STATES = ("done", "failed", "running", "stopped", "waiting")
SCORING_SHARE = 0.1  # of a fold's training, about


class Place:
    """The paths of one fold's work and result."""

    def __init__(self, out, fold):
        self.work, self.result = (
            Path(out) / "work" / f"{fold.index:03d}",
            Path(out) / "folds" / fold.variant / fold.name,
        )
        self.lock, self.beat, self.failed = (self.work / name for name in ("lock", "beat.json", "failed.json"))
        self.fold, self.log = self.work / "fold", self.work / "log.txt"


class State(NamedTuple):
    """state: of `STATES`. stage: `train`, `finetune` or `evaluate`, of one that has begun. step, steps: of training, of
    how many at most. seconds: worked on so far. pace: seconds of a step, of late. reason: why it failed."""

    state: str
    stage: str | None = None
    step: int = 0
    steps: int = 0
    seconds: float = 0.0
    pace: float | None = None
    reason: str | None = None


def finished(out, plan, fold):
    """What a finished fold tells of itself, the dict of its fold.json; None while it is not finished.

    Raises:
      ValueError: its folder holds another fold's result, or something else.
    """
    result = Place(out, fold).result
    if not result.exists():
        return None
    told = read_record(result / "fold.json")
    spec, other = plan.spec(fold), told.get("spec")
    if other == spec:
        return told
    names = [n for n in spec if n not in other or other[n] != spec[n]] if isinstance(other, dict) else ["contents"]
    raise ValueError(f"{result}: holds a result of another fold or recipe (other {', '.join(names)}); move it away.")


def state_of(out, plan, fold):
    """The `State` of a fold.

    Raises:
      ValueError: see `finished`.
    """
    place = Place(out, fold)
    beat = read_record(place.beat)
    if told := finished(out, plan, fold):
        return State("done", steps=plan.steps, step=plan.steps, seconds=told["seconds"])
    if (failed := read_record(place.failed)).get("reason"):
        return State("failed", failed.get("stage"), seconds=failed.get("seconds", 0.0), reason=failed["reason"])
    if not place.fold.exists():
        return State("waiting", steps=plan.steps)
    with locked(place.lock) as held:
        alive = worked_on(place, held)
    logged = read_log(place.fold / "train/log.jsonl")[0] if place.fold.exists() else []
    last, state = logged[-1] if logged else {}, "running" if alive else "stopped"
    step, pace, steps = last.get("step", 0), last.get("seconds_per_step"), plan.steps
    if plan.minutes and pace:
        steps = min(steps, step + max(0, round((60 * plan.minutes - last["seconds"]) / pace)))
    return State(state, beat.get("stage"), step, steps, beat.get("seconds", 0.0), pace)


@contextlib.contextmanager
def locked(path, *, patience=0.0):
    """Context: whether this process holds the lock (True), or another does (False); None where there are no locks.

    patience: seconds that it waits for one which only looks.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    last = time.monotonic() + patience
    with path.open("a") as file:
        while (held := _lock(file)) is False and time.monotonic() < last:
            time.sleep(0.02)
        yield held


def _lock(file):
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def worked_on(place, held):
    """Whether another process works on a fold whose lock was tried: where locks do not reach, its counter moves, for
    which this waits."""
    beat = read_record(place.beat)
    here = held is not None and beat.get("host") == socket.gethostname()
    if held is False or not beat or beat.get("ended") or here:
        return held is False
    time.sleep(2.5 * BEAT_SECONDS)
    return read_record(place.beat).get("count") != beat.get("count")


class Heart:
    """Context: raises a fold's counter, from a thread of its own. stage: to be told. seconds: of work, all parts."""

    def __init__(self, path):
        before = read_record(path)
        self.path, self.stage, self.count = path, "train", int(before.get("count", 0))
        self.before, self.start, self.over = float(before.get("seconds", 0.0)), time.monotonic(), threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)

    @property
    def seconds(self):
        return self.before + time.monotonic() - self.start

    def _run(self):
        while not self.over.wait(BEAT_SECONDS):
            self._tell(ended=False)

    def _tell(self, *, ended):
        self.count += 1
        told = {"count": self.count, "host": socket.gethostname(), "process": os.getpid(), "stage": self.stage,
                "seconds": round(self.seconds, 1), "ended": ended}  # fmt: skip
        with contextlib.suppress(OSError):  # a full disk: the fold's own files will tell
            write_bytes(self.path, json.dumps(told).encode())

    def __enter__(self):
        self._tell(ended=False)
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.over.set()
        self.thread.join()
        self._tell(ended=True)


def seconds_left(states, expected):
    """About how long the folds that have not ended will take, with as many at once as run now; None: not known.

    Args:
      states: list of `State`.
      expected: seconds of a fold, by estimate; None: not known. Folds that are done are a better one.
    """
    done = [state.seconds for state in states if state.state == "done" and state.seconds]
    expected = sum(done) / len(done) if done else expected
    known = [_left(state, expected) for state in states if state.state not in ("done", "failed")]
    left = [seconds for seconds in known if seconds is not None]
    running = sum(state.state == "running" for state in states)
    return None if len(left) < len(known) else max(sum(left) / max(1, running), max(left, default=0.0))


def _left(state, expected):
    """Seconds left of one fold: by the pace of its steps if it trains, else by what was expected."""
    if state.stage == "train" and state.pace:
        rest = (state.steps - state.step) * state.pace
        return rest + SCORING_SHARE * (state.seconds + rest)
    return None if expected is None else max(0.0, expected - state.seconds)
