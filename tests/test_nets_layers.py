import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match, normal

from zestjax.nets.layers import Dense, Norm, dense, init_dense, init_norm, norm_act


def naive_norm_act(scale, offset, x, slope=0.01, epsilon=1e-5):
    mean, variance = x.mean((0, 1)), x.var((0, 1))
    out = (x - mean[None, None]) / jnp.sqrt(variance + epsilon)[None, None] * scale[None, None] + offset[None, None]
    return jnp.where(out > 0, out, slope * out)


def sample(*shape, dtype: type = np.float32):
    return jnp.asarray(np.random.default_rng(0).normal(size=shape).astype(dtype))


def test_dense_is_affine_whatever_the_batch_axes():
    params = Dense(sample(3, 2), jnp.array([1, -1], jnp.float32))
    for shape in ((3,), (4, 3), (2, 4, 3), (0, 3)):
        x = sample(*shape)
        expected = np.asarray(x) @ np.asarray(params.kernel) + np.asarray(params.bias)
        np.testing.assert_allclose(dense(params, x), expected, rtol=1e-6, atol=1e-6)


def test_dense_gradients_are_sums_over_the_batch():
    params, x = Dense(sample(3, 2), jnp.array([1, -1], jnp.float32)), sample(5, 4, 3)
    grads = jax.grad(lambda p: jnp.sum(dense(p, x)))(params)
    np.testing.assert_allclose(grads.bias, [20, 20], rtol=1e-6)
    np.testing.assert_allclose(grads.kernel, jnp.repeat(x.sum((0, 1))[:, None], 2, axis=1), rtol=1e-4, atol=1e-5)


def test_initial_dense_has_the_stated_variance():
    params = init_dense(jax.random.key(1), 128, 64, scale=0.5)
    np.testing.assert_allclose(jnp.std(params.kernel), 0.5 * (2 / 128) ** 0.5, rtol=0.05)
    assert not jnp.any(params.bias)


def test_norm_act_standardises_each_channel():
    x = 5 + 3 * sample(2, 7, 4, 3)
    out = norm_act(init_norm(3), x, slope=1.0)
    np.testing.assert_allclose(out.mean((0, 1, 2)), 0, atol=1e-6)
    np.testing.assert_allclose(out.var((0, 1, 2)), 1, rtol=1e-4)


@pytest.mark.parametrize("shift", [0.0, 1e3])
def test_norm_act_and_its_gradient_are_the_naive_ones_in_float64(x64, shift):
    x, scale, offset = sample(4, 5, 3, dtype=np.float64) + shift, np.array([0.5, -1, 2]), np.array([0.1, 0.2, -0.3])
    weights = np.cos(np.arange(x.size)).reshape(x.shape)
    ours = lambda scale, offset, x: jnp.sum(weights * norm_act(Norm(scale, offset), x))
    naive = lambda scale, offset, x: jnp.sum(weights * naive_norm_act(scale, offset, x))
    ours, theirs = (jax.value_and_grad(f, (0, 1, 2))(scale, offset, x) for f in (ours, naive))
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_norm_act_gradient_is_the_slope_of_finite_differences(x64):
    x, direction, params = sample(3, 4, 2, dtype=np.float64), np.cos(np.arange(24.0)).reshape(3, 4, 2), init_norm(2)
    loss = lambda x: jnp.sum(norm_act(params, x) ** 3)
    step = 1e-6
    slope = (loss(x + step * direction) - loss(x - step * direction)) / (2 * step)
    np.testing.assert_allclose(jnp.vdot(jax.grad(loss)(x), direction), slope, rtol=1e-6)


@pytest.mark.parametrize("value", [0.0, 1.0, -1e4, 1e15, 1e-30])
@pytest.mark.parametrize("rows", [1, 6])
def test_norm_act_of_a_constant_is_finite_and_so_is_its_gradient(value, rows):
    x = jnp.full((rows, 2), value)
    out, grads = jax.value_and_grad(lambda x: jnp.sum(norm_act(Norm(jnp.ones(2), jnp.ones(2)), x)))(x)
    assert jnp.isfinite(out) and jnp.all(jnp.isfinite(grads))


def test_mean_far_from_zero_does_not_cost_the_variance():
    x = 1e4 + sample(64, 2)
    np.testing.assert_allclose(norm_act(init_norm(2), x, slope=1.0).std(0), 1, rtol=2e-3)


@pytest.mark.parametrize("rows", [1 << 12, 1 << 19])
def test_statistics_of_many_rows_are_those_of_float64(rows):
    """A volume's cells; added one to the next in float32 they are 1e-4 off and more."""
    x = 2 + np.square(sample(rows, 3))
    wide = np.asarray(x, np.float64)
    expected = (wide - wide.mean(0)) / np.sqrt(wide.var(0) + 1e-5)
    np.testing.assert_allclose(norm_act(init_norm(3), x, slope=1.0), expected, rtol=1e-5, atol=1e-5)


def test_instance_statistics_are_each_elements_own():
    x, params = sample(3, 4, 5, 2), Norm(jnp.array([1, 2], jnp.float32), jnp.array([0, 1], jnp.float32))
    alone = jnp.concatenate([norm_act(params, x[i : i + 1]) for i in range(3)])
    np.testing.assert_allclose(norm_act(params, x, over="element"), alone, rtol=1e-5, atol=1e-6)


def test_channel_statistics_are_each_places_own():
    x, params = sample(3, 4, 5, 6), Norm(jnp.arange(1.0, 7), jnp.linspace(-1, 1, 6))
    wide = np.asarray(x, np.float64)
    unit = (wide - wide.mean(-1, keepdims=True)) / np.sqrt(wide.var(-1, keepdims=True) + 1e-5)
    expected = unit * np.arange(1.0, 7) + np.linspace(-1, 1, 6)
    expected = np.where(expected > 0, expected, 0.01 * expected)
    np.testing.assert_allclose(norm_act(params, x, over="channels"), expected, rtol=1e-4, atol=1e-5)


def test_channel_statistics_match_finite_differences(x64):
    params = Norm(1 + normal(1, 5, dtype=jnp.float64) / 4, normal(2, 5, dtype=jnp.float64))
    assert_grads_match(lambda p, x: norm_act(p, x, over="channels"), params, normal(0, 3, 5, dtype=jnp.float64))


@pytest.mark.parametrize("value", [0.0, 1e-20, 1e6])
def test_channel_statistics_of_a_flat_place_are_finite(value):
    assert_finite(lambda x: norm_act(init_norm(4), x, over="channels"), jnp.full((2, 4), value))


def test_legacy_scale_is_the_absolute_value_plus_epsilon():
    x, offset = sample(6, 2), jnp.zeros(2)
    legacy = norm_act(Norm(jnp.array([-2, 0], jnp.float32), offset), x, legacy_abs=True)
    np.testing.assert_allclose(legacy, norm_act(Norm(jnp.array([2 + 1e-5, 1e-5], jnp.float32), offset), x), rtol=1e-5)


def test_faults_are_named():
    with pytest.raises(ValueError, match="norm_act: axis C of `x` is 3, expected 2"):
        norm_act(init_norm(2), jnp.zeros((4, 3)))
    with pytest.raises(ValueError, match="dense: axis in of `x` is 2, expected 3"):
        dense(Dense(jnp.zeros((3, 1)), jnp.zeros(1)), jnp.zeros((4, 2)))
