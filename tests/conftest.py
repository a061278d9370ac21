"""The suite runs stricter than users do, and in their precision."""

import jax
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture
def x64():
    """float64 for one test; the suite otherwise runs in the float32 users get."""
    with jax.enable_x64(True):
        yield
