"""The suite runs stricter than users do, and in their precision."""

import importlib.metadata
import os

import pytest

# Code that is compiled for a test runs once: unoptimised, by XLA's older emitters, it takes two fifths of the time to
# compile (20 CPU seconds instead of 51 for a training step).
if os.environ.get("ZESTJAX_FAST_COMPILING"):
    flags = [os.environ.get("XLA_FLAGS", ""), "--xla_backend_optimization_level=0"]
    if importlib.metadata.version("jaxlib").startswith("0.10."):  # later ones lack the older emitters, and the flag
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join(flags).strip()

import jax  # noqa: E402

import zestjax  # noqa: E402  # before anything computes: it decides what the compiler may fuse

assert zestjax.BACKEND.state != "running", "JAX computed before zestjax was imported: the suite's sums may be wrong"
jax.devices()  # from here on no test can change the compiler's flags for the others
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture
def x64():
    """float64 for one test; the suite otherwise runs in the float32 users get."""
    with jax.enable_x64(True):
        yield
