"""Which sums the CPU compiler may fuse, decided at `import zestjax`, before JAX compiles anything.

YNN      kernels to which XLA hands whole products and sums on a CPU. In jaxlib 0.10.2 a mapped product that is summed
         comes out wrong from 32,769 rows on (jax-ml/jax#39103); in every version sums by them are 50 to 100 times
         less exact than XLA's own, and our programs are slower
flag     `XLA_FLAGS` is read once, when JAX first needs a device; what is written there later changes nothing
option   one of a single program's, which `jax.jit(..., compiler_options=...)` takes at any time
"""

import importlib.metadata
import os
import sys
import warnings
from typing import NamedTuple

FLAG = "--xla_cpu_experimental_ynn_fusion_type"  # of the fusion that sums wrongly
KNOWN = ((0, 10), (0, 13))  # jaxlib from, to: tried on 0.10.0 to 0.12.0; XLA stops the process at a flag that is gone
LEAST_ROWS = 40_000  # above the 32,768 up to which jaxlib 0.10.2 is right
LARGEST_ERROR = 1e-4  # relative: the wrong sums are off by 1, right ones by 1e-7
LAST_WITH_TWO_EMITTERS = (0, 10)  # of jaxlib: later ones generate code in one way, and know no option of it
REMEDY = (
    f"set XLA_FLAGS={FLAG}= (nothing after the equals sign) before Python starts, or import zestjax before "
    "anything computes with JAX."
)


class CompilerWarning(UserWarning):
    """What is compiled in this process may be wrong."""


class Decision(NamedTuple):
    """state: `off` (the fusion is, by us), `user` (the flag was set before), `running` (JAX runs already: nothing was
    changed), `file` (XLA_FLAGS names a file, which is left alone) or `unknown` (a jaxlib that may lack the flag).
    flags: `XLA_FLAGS` as it is now."""

    state: str
    flags: str


def decide() -> Decision:
    """Switch the fusion off where that is still possible; where it is not, try it and warn if sums are wrong.

    No other flag is touched, and this one is not where the user has set it.

    Warns:
      CompilerWarning: JAX runs already and returns a wrong sum.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if FLAG in flags:
        return Decision("user", flags)
    if _cpu_runs():
        _warn_if_wrong()
        return Decision("running", flags)
    if flags.strip() and not flags.lstrip().startswith("-"):
        return Decision("file", flags)
    if not KNOWN[0] <= _jaxlib_version() < KNOWN[1]:
        return Decision("unknown", flags)
    os.environ["XLA_FLAGS"] = f"{flags} {FLAG}=".lstrip()
    return Decision("off", os.environ["XLA_FLAGS"])


def quick() -> dict[str, bool | int]:
    """Compiler options for a program that runs a few times, as a gradient that is checked: `jax.jit(f,
    compiler_options=quick())`.

    The gradient of a whole system's objective compiles in a third of the time and takes two to four times as long to
    run (README, "Compiling"); values differ by roundings. JAX takes options where a program is compiled, not in a
    function that another `jit` or `grad` traces. Empty where the default device is no CPU.
    """
    import jax

    if jax.default_backend() != "cpu":
        return {}
    options: dict[str, bool | int] = {"xla_backend_optimization_level": 0}
    if _jaxlib_version() <= LAST_WITH_TWO_EMITTERS:
        options["xla_cpu_use_fusion_emitters"] = False
    return options


def sum_error(*, rows: int = LEAST_ROWS, seed: int = 0) -> float:
    """Largest error of a compiled, mapped product and sum on the CPU, relative to the largest value."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    rng = np.random.default_rng(seed)
    matrix, points = (rng.normal(size=shape).astype(np.float32) for shape in ((3, 3), (rows, 3)))
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        found = jax.jit(jax.vmap(lambda point: jnp.sum((matrix @ point) ** 2)))(points)
    exact = np.sum((points.astype(np.float64) @ matrix.T.astype(np.float64)) ** 2, axis=1)
    return float(np.abs(np.asarray(found, np.float64) - exact).max() / exact.max())


def _warn_if_wrong() -> None:
    error = sum_error()
    if not error <= LARGEST_ERROR:
        message = f"zestjax: JAX's CPU compiler returns wrong sums here (off by {error:.1g} of their size); {REMEDY}"
        warnings.warn(message, CompilerWarning, stacklevel=4)  # of the line that imports zestjax


def _cpu_runs() -> bool:
    """Whether JAX has a CPU device already; JAX is not imported to find out."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and "cpu" in getattr(bridge, "_backends", {})


def _jaxlib_version() -> tuple[int, ...]:
    try:
        numbers = importlib.metadata.version("jaxlib").split(".")[:2]
        return tuple(int(number) for number in numbers)
    except (importlib.metadata.PackageNotFoundError, ValueError):
        return (0,)
