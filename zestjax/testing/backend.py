"""Does JAX compute what it should on this machine? Known miscompilations, tried.

check   one known fault: a small program, compiled and compared with NumPy in float64
"""

import functools
import os
import subprocess
import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.backend import FLAG, LARGEST_ERROR, REMEDY, sum_error

SECONDS = 120  # a program that hangs is a fault, too; a sound one takes two
HIGH_RANK = """
import jax, jax.numpy as jnp, numpy as np, sys
rng = np.random.default_rng(int(sys.argv[1]))
draw = lambda *shape: rng.normal(size=shape).astype(np.float32)
def error(fn, *args):
    exact = fn(np, *(a.astype(np.float64) for a in args))
    return float(np.abs(np.asarray(jax.jit(lambda *a: fn(jnp, *a))(*args)) - exact).max() / np.abs(exact).max())
thin = error(lambda np, a, b: np.sum(a * b, axis=3), draw(3, 1, 2, 2, 8, 8, 8), draw(3, 1, 2, 2, 8, 8, 8))
wide = error(lambda np, a, b: np.sum(a[..., None, None, None, None, None] * b, axis=2),
             draw(10, 4, 6), draw(10, 4, 6, 4, 4, 4, 4, 4))
print(max(thin, wide))
"""  # the shapes of jax-ml/jax#40412 and #39257


class Check(NamedTuple):
    """name. ok. detail: the error found, or how it ended, and what to do where it is not ok."""

    name: str
    ok: bool
    detail: str


def backend_checks(*, seed: int = 0) -> tuple[Check, ...]:
    """Try every known miscompilation; takes a few seconds.

    Args:
      seed: of the numbers that are tried.

    Returns:
      `Check` of each: `mapped sum` (jax-ml/jax#39103: wrong from 32,769 rows on), `gradient of a batched product`
      (a cotangent that is one number repeated), `sum at rank 7 and 8` (in a process of its own, which it may crash).
    """
    return (
        _judged("mapped sum", max(sum_error(rows=rows, seed=seed) for rows in (40_000, 100_000))),
        _judged("gradient of a batched product", batched_gradient_error(seed=seed)),
        _high_rank(seed),
    )


def check_backend(*, seed: int = 0) -> None:
    """Refuse to go on where JAX computes wrongly: one line for a test suite's `conftest.py`.

    Raises:
      AssertionError: naming every known miscompilation that this machine has, and the remedy.
    """
    wrong = [f"{check.name}: {check.detail}" for check in backend_checks(seed=seed) if not check.ok]
    if wrong:
        raise AssertionError(f"check_backend: {'; '.join(wrong)}")


def batched_gradient_error(*, seed: int = 0) -> float:
    """Largest relative error of the gradients of sums over a batched product, by several shapes and sums."""
    rng = np.random.default_rng(seed)
    worst = 0.0
    for batch, i, j, k in ((2, 3, 3, 3), (64, 4, 4, 4), (1000, 3, 3, 1), (8, 16, 32, 8), (5, 7, 1, 9)):
        a, b = (rng.normal(size=shape).astype(np.float32) for shape in ((batch, i, j), (batch, j, k)))
        for over in ("bik", "ik", "k", "i"):
            worst = max(worst, _gradient_error(a, b, over, rng))
    return worst


def _gradient_error(a, b, over, rng):
    """Of sum(weights * (a @ b)), weights repeated over the axes `over` of the product."""
    kept = "".join(axis for axis in "bik" if axis not in over)
    sizes = dict(b=len(a), i=a.shape[1], k=b.shape[2])
    weights = rng.normal(size=[sizes[axis] for axis in kept]).astype(np.float32)
    total = lambda a, b: jnp.sum(weights * jnp.einsum(f"bik->{kept}", a @ b))
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        found = jax.jit(jax.grad(total, argnums=(0, 1)))(a, b)
    wide = functools.partial(np.asarray, dtype=np.float64)
    repeated = np.broadcast_to(np.expand_dims(weights, ["bik".index(axis) for axis in over]), [sizes[x] for x in "bik"])
    exact = wide(repeated) @ wide(b).swapaxes(1, 2), wide(a).swapaxes(1, 2) @ wide(repeated)
    return max(float(np.abs(wide(x) - y).max() / np.abs(y).max()) for x, y in zip(found, exact, strict=True))


def _judged(name, error):
    ok = bool(error <= LARGEST_ERROR)
    return Check(name, ok, f"relative error {error:.1e}" + ("" if ok else f"; {_remedy()}"))


def _remedy():
    """What to do; a flag that the user has set is not zestjax's to change."""
    given = [flag for flag in os.environ.get("XLA_FLAGS", "").split() if flag.startswith(f"{FLAG}=")]
    return REMEDY if not given or given[-1] == f"{FLAG}=" else f"take {given[-1]} out of XLA_FLAGS"


def _high_rank(seed):
    name, environment = "sum at rank 7 and 8", os.environ | {"JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", HIGH_RANK, str(seed)]
    try:
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return Check(name, False, f"did not end in {SECONDS} s; {_remedy()}")
    if ended.returncode < 0:
        return Check(name, False, f"the process died of signal {-ended.returncode}; {_remedy()}")
    if ended.returncode:
        return Check(name, False, f"the process failed: {ended.stderr.strip().splitlines()[-1:]}")
    return _judged(name, float(ended.stdout))
