"""The folder of a training run: held by one process at a time, restored and saved as a whole.

identity  what makes one run's numbers differ from another's: the names in `IDENTITY`, of the metadata
threads  the cores that XLA shares a sum between: the last bits of a run depend on their number

The newest whole checkpoint is the run's state; log, weights and curve are made to agree with it when a run resumes.
"""

import contextlib
import fcntl
import os
import socket
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from zestjax.apps.log import cut_log
from zestjax.base.parts import from_stored, to_stored
from zestjax.io.checkpoints import latest_checkpoint, save_checkpoint
from zestjax.io.files import remove_parts
from zestjax.io.weights import WeightsError, load_weights, save_weights
from zestjax.train.recipes import PARTS
from zestjax.train.training import TrainState

IDENTITY = ("recipe", "seed", "data", "start", "analysis")  # what a run that resumes must share
LOCK = ".lock"


class Restored(NamedTuple):
    """state: `TrainState`. seconds: of stepping that it took."""

    state: TrainState
    seconds: float


@contextlib.contextmanager
def held(out, *, doing="training"):
    """Context: this process alone works on the folder, which is made. The system lets go when the process dies.

    Raises:
      ValueError: another process works on it; `doing` is what the message says it does.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    path = out / LOCK
    file = _locked(path, doing)
    try:
        for folder in (out, out / "checkpoints"):
            remove_parts(folder)
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()


def _locked(path, doing):
    """The lock's open file; it says who holds it."""
    while True:
        file = path.open("a+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            who = file.read().strip() or "another process"
            file.close()
            raise ValueError(
                f"{path.parent}: {who} is {doing} into it; wait for its end, or choose another --out."
            ) from error
        except OSError:  # a file system without locks: nothing can be held there
            return file
        if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
            file.flush()
            return file
        file.close()  # its holder removed it between our opening and our locking it


def begin(state, out):
    """The start of a new run in a folder that holds no other.

    Raises:
      WeightsError: it holds the checkpoints of an earlier run.
    """
    if any((out / "checkpoints").glob("step_*.safetensors")):
        raise WeightsError(
            f"{out}: holds the checkpoints of an earlier run; continue it with --resume or choose another --out."
        )
    for name in ("log.jsonl", "faults.jsonl"):
        (out / name).unlink(missing_ok=True)
    return Restored(state, 0.0)


def restore(state, out, metadata):
    """The newest readable checkpoint of this same run, or the fresh state when there is none yet.

    Log and weights are brought to its step: a run may have ended between two files.

    Raises:
      WeightsError: its checkpoints are of another run, or none can be read.
    """
    found = latest_checkpoint(out / "checkpoints", (state.params, state.opt_state))
    if found is None:
        _cut_logs(out, 0)
        return Restored(state, 0.0)
    if differing := list(_differing(found.metadata["run"], metadata)):
        raise WeightsError(
            f"{out}: its checkpoints are of a run with another {' and '.join(differing)}; resume it with the same "
            "command, or choose another --out."
        )
    for warning in found.warnings:
        _warn(f"{warning} Going on from step {found.step}.")
    if (before := found.metadata.get("threads", threads())) != threads():
        _warn(f"{out}: ran on {before} threads, now on {threads()}: the last bits will differ from an unbroken run's.")
    state, seconds = TrainState(found.tree[0], found.tree[1], found.step), found.metadata["seconds"]
    _cut_logs(out, found.step)
    if not _holds(out / "weights.safetensors", state):
        save_final(out, state, metadata, seconds)
    return Restored(state, seconds)


def save(out, state, metadata, seconds):
    """Write a checkpoint, then the weights."""
    tree = (state.params, state.opt_state)
    told = {"run": metadata, "seconds": seconds, "threads": threads()}
    save_checkpoint(out / "checkpoints", state.step, tree, told)
    save_final(out, state, metadata, seconds)


def save_final(out, state, metadata, seconds):
    """Write the weights of a state."""
    told = metadata | {"step": state.step, "seconds": round(seconds, 1)}
    save_weights(out / "weights.safetensors", state.params, metadata=told)


def threads():
    """How many threads XLA's CPU programs run on."""
    asked = os.environ.get("PJRT_NPROC", "")
    if asked.isdigit() and int(asked):
        return int(asked)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _holds(path, state):
    """Whether a file is whole and holds the weights of this state."""
    try:
        params, metadata = load_weights(path, like=state.params)
    except WeightsError:
        return False
    same = jax.tree.map(lambda a, b: np.array_equal(a, b, equal_nan=True), params, state.params)
    return metadata.get("step") == state.step and all(jax.tree.leaves(same))


def _cut_logs(out, step):
    """Forget what was logged after a step."""
    for name in ("log.jsonl", "faults.jsonl"):
        if (out / name).exists() and (dropped := cut_log(out / name, step)):
            lines = "line is" if dropped == 1 else "lines are"
            _warn(f"{out / name}: {dropped} {lines} no record of a step and left out.")


def _differing(before, now):
    """Names of `IDENTITY` that two runs do not share; of a dict, also of its entries."""
    for name in IDENTITY:
        old, new = _completed(before.get(name)), _completed(now.get(name))
        if isinstance(old, dict) and isinstance(new, dict):
            entries = sorted(key for key in old | new if old.get(key) != new.get(key))
            yield from [f"{name} ({', '.join(entries)})"] if entries else []
        elif old != new:
            yield name


def _completed(value):
    """A stored part with the choices that were added since it was written, at their defaults; all else as it is."""
    try:
        return to_stored(from_stored(value, PARTS)) if isinstance(value, dict) and "part" in value else value
    except ValueError:
        return value


def _warn(text):
    tqdm.write(f"warning: {text}", file=sys.stderr)
