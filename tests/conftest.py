"""The suite runs stricter than users do, and in their precision."""

import jax
import pytest

import zestjax  # before anything computes: it decides what the compiler may fuse

assert zestjax.BACKEND.state != "running", "JAX computed before zestjax was imported: the suite's sums may be wrong"
jax.devices()  # from here on no test can change the compiler's flags for the others
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture
def x64():
    """float64 for one test; the suite otherwise runs in the float32 users get."""
    with jax.enable_x64(True):
        yield
