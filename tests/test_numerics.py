"""Each primitive at the point where the naive form breaks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import Tracer
from oracles import assert_finite, assert_grads_match, normal

from zestjax.base import numerics


def test_exclusive_sums_and_products_start_with_nothing():
    x = jnp.asarray([[2.0, 3.0, 5.0], [1.0, 0.0, 4.0]])
    np.testing.assert_array_equal(numerics.exclusive_cumsum(x), [[0, 2, 5], [0, 1, 1]])
    np.testing.assert_array_equal(numerics.exclusive_cumprod(x), [[1, 2, 6], [1, 1, 0]])


def test_a_huge_last_entry_does_not_absorb_the_sum_before_it():
    np.testing.assert_array_equal(numerics.exclusive_cumsum(jnp.asarray([0.25, 0.5, 1e10])), [0, 0.25, 0.75])


@pytest.mark.parametrize("x", [0.0, 1e-30, 1.0, 1e18])
def test_norm_and_its_gradient_are_finite(x):
    vector = jnp.full(3, x)
    assert_finite(numerics.safe_norm, vector)
    if x >= 1:
        np.testing.assert_allclose(numerics.safe_norm(vector), np.sqrt(3) * x, rtol=1e-6)


def test_norm_has_no_gradient_at_the_origin():
    np.testing.assert_array_equal(jax.grad(numerics.safe_norm)(jnp.zeros(3)), 0)


def test_division_by_zero_is_what_was_asked_for_with_no_gradient():
    divide = lambda a, b: numerics.safe_divide(a, b, otherwise=7.0)
    np.testing.assert_array_equal(divide(jnp.asarray([1.0, 3.0]), jnp.asarray([0.0, 2.0])), [7, 1.5])
    assert_finite(divide, jnp.asarray([1.0, 3.0]), jnp.asarray([0.0, 2.0]))


def test_masked_mean_of_nothing_is_zero():
    x, empty = jnp.asarray([np.nan, np.inf]), jnp.zeros(2)
    assert numerics.masked_mean(x, empty) == 0
    np.testing.assert_array_equal(jax.grad(numerics.masked_mean)(jnp.ones(2), empty), 0)


def test_masked_mean_ignores_what_is_not_finite_outside_the_mask():
    x = jnp.asarray([1.0, np.nan, 3.0])
    assert numerics.masked_mean(x, jnp.asarray([True, False, True])) == 2
    assert np.isfinite(jax.grad(numerics.masked_mean)(x, jnp.asarray([1.0, 0.0, 1.0]))).all()


def test_products_broadcast_over_leading_axes():
    a, b = np.random.default_rng(0).normal(size=(2, 4, 3, 3)).astype("f")
    np.testing.assert_allclose(numerics.matmul(a, b), a @ b, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(numerics.matvec(a, b[..., 0]), (a @ b)[..., 0], rtol=1e-5, atol=1e-6)


def test_gradients_match_finite_differences(x64):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(2, 5)))
    assert_grads_match(lambda x: numerics.safe_norm(x) + numerics.exclusive_cumprod(x)[..., -1], x)
    assert_grads_match(lambda x: numerics.masked_mean(x, x > 0) + numerics.exclusive_cumsum(x).sum(), x)


def sums(table, at):
    """What a reader would be tempted to compute twice: rows gathered, and a weighted sum of them."""
    rows = table[at]
    return {"mean": rows.mean(-1), "rows": rows * 2.0, "count": at + 1}


def test_what_is_computed_once_is_the_same_in_value_and_gradient():
    table, at = normal(0, 7, 3), jnp.array([0, 3, 3, 6])
    once = lambda *args: numerics.computed_once(sums, *args)
    mapped = lambda fn: jax.vmap(fn, in_axes=(0, None))
    for wrap, x in ((lambda fn: fn, table), (jax.jit, table), (mapped, jnp.stack([table, -table]))):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), wrap(once)(x, at), wrap(sums)(x, at))
    slope = jax.grad(lambda t: jnp.sum(jnp.sin(numerics.computed_once(sums, t, at)["mean"])))(table)
    np.testing.assert_allclose(slope, jax.grad(lambda t: jnp.sum(jnp.sin(sums(t, at)["mean"])))(table), rtol=1e-6)


def test_its_gradient_is_its_slope():
    loss = lambda t: jnp.sum(jnp.cos(numerics.computed_once(sums, t, jnp.array([1, 4]))["rows"]))
    assert_grads_match(loss, normal(1, 5, 2))


@pytest.mark.parametrize("x", [jnp.arange(3), jnp.zeros((0, 3)), jnp.array([jnp.nan, jnp.inf, 1])])
def test_it_asks_nothing_of_its_arguments(x):
    for wrap in (lambda fn: fn, jax.jit, lambda fn: jax.jit(lambda _: fn(x))):  # the last: a constant of the program
        np.testing.assert_array_equal(wrap(lambda x: numerics.computed_once(lambda x: x + 1, x))(x), x + 1)


def test_uncompiled_it_is_the_function_itself():
    """A `cond` run by itself would be compiled at every call, and kept."""
    kinds = []
    numerics.computed_once(lambda x: kinds.append(isinstance(x, Tracer)), jnp.ones(3))
    jax.jit(lambda x: numerics.computed_once(lambda x: (kinds.append(isinstance(x, Tracer)), x)[1], x))(1.0)
    assert kinds[0] is False and all(kinds[1:]) and len(kinds) > 1


@pytest.mark.parametrize("kind", [jax.sharding.AxisType.Auto, jax.sharding.AxisType.Explicit])
def test_arrays_may_be_spread_over_devices(kind):
    mesh, spec = jax.make_mesh((1,), ("a",), axis_types=(kind,)), jax.sharding.PartitionSpec("a")
    x = jax.device_put(normal(0, 4), jax.sharding.NamedSharding(mesh, spec))
    once = lambda x: numerics.computed_once(jnp.sin, x)
    with jax.set_mesh(mesh):
        found = jax.jit(jax.shard_map(once, mesh=mesh, in_specs=spec, out_specs=spec))(x)
        np.testing.assert_allclose(found, jnp.sin(x), rtol=1e-6)
        np.testing.assert_allclose(jax.jit(once)(x), jnp.sin(x), rtol=1e-6)


def test_the_compiler_leaves_it_alone():
    """Its program keeps the branch, on a CPU; elsewhere there is none to keep."""
    text = jax.jit(lambda x: numerics.computed_once(jnp.sin, x) * 2.0).lower(normal(0, 9)).compile().as_text()
    assert ("conditional(" in text) == (jax.default_backend() == "cpu")
