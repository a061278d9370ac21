"""Several processes, of one machine or of many, that train one set of weights, each on its own devices.

first    process 0: it alone writes the run's folder. The others take the same steps beside a folder that is removed
"""

import contextlib
import re
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np
from jax.experimental import multihost_utils

from zestjax.apps.run_folder import Restored
from zestjax.train.mesh import mesh_of, shares
from zestjax.train.training import TrainState

HOSTS = re.compile(r"(?P<address>.+:(?P<port>\d{1,5})),(?P<count>\d{1,5}),(?P<index>\d{1,5})")
PATIENCE = 60  # seconds until a process that has died, or left by an error, ends the others: it cannot be slow so long


def join(hosts):
    """Take part in a run of several processes, before anything computes.

    Args:
      hosts: `HOST:PORT,COUNT,INDEX`: where the first process listens, how many there are, and which this one is, from
        0. None: this process is alone, or has called `jax.distributed.initialize` itself.

    Raises:
      ValueError: another form, or an index that is not below the count.
    """
    if hosts is None:
        return
    found = HOSTS.fullmatch(hosts)
    count, index, port = (int(found[name]) for name in ("count", "index", "port")) if found else (0, 0, 0)
    if not (found and 0 <= index < count and 0 < port < 2**16):
        raise ValueError(
            f"train: --hosts is {hosts}, expected HOST:PORT,COUNT,INDEX with INDEX from 0 to COUNT - 1, as "
            "10.0.0.1:5000,2,0 for the first of two processes."
        )
    jax.distributed.initialize(
        found["address"], count, index, heartbeat_timeout_seconds=PATIENCE, shutdown_timeout_seconds=PATIENCE
    )


def is_first():
    """Whether this process writes the run's folder."""
    return jax.process_index() == 0


def run_mesh(recipe, *, quiet):
    """The mesh of the devices that share a recipe's steps: all, or of a process that is alone as many as have equal
    parts, which it says; None of one device.

    Raises:
      ValueError: the devices of several processes have no equal parts.
    """
    devices = jax.devices()
    if devices[0].platform == "cpu":  # one a process: several wait for one another for ever in jax 0.10.2
        devices = list({device.process_index: device for device in reversed(devices)}.values())[::-1]
    if jax.process_count() > 1:
        return mesh_of(recipe, devices)
    most = next(count for count in range(len(devices), 0, -1) if _can_share(recipe, count))
    if most < len(devices) and not quiet:
        print(f"train: uses {most} of {len(devices)} devices: a step has clips={recipe.clips}, blocks={recipe.blocks}",
              file=sys.stderr)  # fmt: skip
    return mesh_of(recipe, devices[:most]) if most > 1 else None


def _can_share(recipe, count):
    with contextlib.suppress(ValueError):
        return bool(shares(recipe, count))
    return False


@contextlib.contextmanager
def run_place(out):
    """Context: the folder that this process writes to, `out` of the first one."""
    if is_first():
        yield Path(out)
    else:
        with tempfile.TemporaryDirectory(prefix="zestjax-") as folder:
            yield Path(folder)


def anywhere(*flags):
    """Of each flag, whether it is set in any process; all must ask at the same step."""
    if jax.process_count() == 1:
        return flags
    return tuple(map(bool, np.any(multihost_utils.process_allgather(np.array(flags)), axis=0)))


def begun_by_first(begin):
    """`begin()`, a `Restored`, of the first process, in all of them.

    Raises:
      ValueError: another process could not begin.
      Exception: what `begin` raised here.
    """
    if jax.process_count() == 1:
        return begin()
    found = error = None
    try:
        found = begin()
    except Exception as raised:
        error = raised
    (failed,) = anywhere(error is not None)
    if found is None or failed:
        raise error or ValueError("train: another process could not begin, and says why.")
    (params, opt_state, step), seconds = multihost_utils.broadcast_one_to_all((tuple(found.state), found.seconds))
    return Restored(TrainState(params, opt_state, int(step)), float(seconds))
