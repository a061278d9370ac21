import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.nets.positional import positional_encoding


def test_first_entries_by_hand():
    x = np.array([0.5, -1.0], np.float32)
    expected = [0.5, -1, *np.sin([0.5, -1]), *np.cos([0.5, -1]), *np.sin([1.0, -2]), *np.cos([1.0, -2])]
    np.testing.assert_allclose(positional_encoding(x, levels=2), expected, rtol=1e-6)
    octaves_last = [0.5, -1, *np.sin([0.5, -1, 1, -2]), *np.cos([0.5, -1, 1, -2])]
    np.testing.assert_allclose(positional_encoding(x, levels=2, order="mvsnerf"), octaves_last, rtol=1e-6)


def test_no_level_is_the_identity():
    x = jnp.ones((2, 3))
    np.testing.assert_array_equal(positional_encoding(x, levels=0), x)


def test_highest_level_is_as_accurate_as_the_sine():
    x = np.random.default_rng(0).uniform(-2, 2, (500, 3)).astype(np.float32)
    ours = positional_encoding(x, levels=10)[:, -6:-3]
    np.testing.assert_allclose(ours, np.sin(512 * x.astype(np.float64)), atol=3e-7)


def test_low_precision_is_raised_to_single():
    assert positional_encoding(jnp.ones((2, 3), jnp.bfloat16), levels=4).dtype == jnp.float32


def test_double_precision_is_kept(x64):
    assert positional_encoding(jnp.ones((2, 3), jnp.float64), levels=4).dtype == jnp.float64


def test_gradient_is_finite_and_of_the_highest_frequency():
    slope = jax.jacobian(lambda x: positional_encoding(x, levels=10))(jnp.zeros(1))
    assert jnp.all(jnp.isfinite(slope))
    np.testing.assert_allclose(slope[-2, 0], 512)


def test_an_unknown_order_is_refused():
    with pytest.raises(ValueError, match="positional_encoding: `order` is 'nerf'"):
        positional_encoding(jnp.ones(3), levels=2, order="nerf")
