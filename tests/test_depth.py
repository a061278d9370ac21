"""Depths of rays, and scale-and-shift alignment, at and away from the cases that divide by zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match, normal, uniform

from zestjax import depth


def test_an_opaque_sample_has_its_own_depth():
    weights = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.5, 0.0]])
    np.testing.assert_allclose(depth.expected_depth(weights, jnp.array([1.0, 2.0, 4.0])), 2, rtol=1e-5)


def test_background_depth_shows_through_what_opacity_leaves():
    seen = depth.expected_depth(jnp.array([0.25, 0.25]), jnp.array([1.0, 3.0]), background=10.0)
    np.testing.assert_allclose(seen, 0.25 + 0.75 + 0.5 * 10)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-8, 1.0])
def test_expected_depth_is_finite_and_between_the_samples(scale):
    depths = jnp.array([1.0, 2.0, 50.0])
    weights = scale * jnp.array([0.2, 0.3, 0.1])
    assert 1 <= depth.expected_depth(weights, depths) <= 50
    assert_finite(depth.expected_depth, weights, depths)


def test_expected_depth_scales_with_the_world(x64):
    weights, depths = uniform(0, 2, 3, 6, dtype=jnp.float64)
    depths = jnp.asarray(np.sort(depths)) + 1
    np.testing.assert_allclose(depth.expected_depth(weights, 7 * depths), 7 * depth.expected_depth(weights, depths))
    assert_grads_match(depth.expected_depth, weights, depths)


def test_median_depth_is_one_of_the_samples_and_not_their_mean():
    weights, depths = jnp.array([[0.45, 0.0, 0.55], [0.6, 0.0, 0.1], [0.0, 0.0, 0.0]]), jnp.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(depth.median_depth(weights, depths), [3.0, 1.0, 3.0])


def test_disparity_is_finite_at_depth_zero_and_infinity():
    np.testing.assert_array_equal(depth.disparity_from_depth(jnp.array([2.0, jnp.inf])), [0.5, 0.0])
    assert_finite(depth.disparity_from_depth, jnp.array([0.0, 1e-30, -1.0, 1e30]))


@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_masked_median_is_the_lower_middle_of_what_is_valid(count):
    values = jnp.where(jnp.arange(9) < count, normal(count, 9), jnp.nan)
    expected = np.sort(values[:count])[(count - 1) // 2]
    assert jax.jit(depth.masked_median)(values, jnp.arange(9) < count) == expected


def test_alignment_recovers_a_scale_and_shift():
    values = 1 + uniform(1, 2, 40)
    target = (3 * values + 0.5).at[:, :4].set(jnp.nan)
    mask = jnp.ones((2, 40)).at[:, :4].set(0)
    for align in (depth.align_least_squares, depth.align_robust):
        found = jax.jit(align)(values, target, mask)
        np.testing.assert_allclose(found.scale, 3, rtol=1e-4)
        np.testing.assert_allclose(depth.aligned(found, values)[:, 4:], target[:, 4:], rtol=1e-4)


def test_least_squares_alignment_equals_lstsq():
    values, target, weight = uniform(2, 3, 30)
    root = np.sqrt(np.asarray(weight, np.float64))
    columns = np.stack([np.asarray(values, np.float64), np.ones(30)], -1) * root[:, None]
    expected = np.linalg.lstsq(columns, np.asarray(target, np.float64) * root, rcond=None)[0]
    np.testing.assert_allclose(
        jax.jit(depth.align_least_squares)(values, target, weight), expected, rtol=1e-4, atol=1e-5
    )


def test_outliers_move_the_robust_alignment_less():
    values = jnp.linspace(1, 2, 50)
    target = (2 * values).at[::10].set(40.0)
    centre = lambda align: align(values, target, jnp.ones(50))
    middle = lambda found: float(depth.aligned(found, jnp.array([1.5]))[0])
    robust, squares = jax.jit(centre, static_argnums=0)(depth.align_robust), centre(depth.align_least_squares)
    assert abs(middle(robust) - 3) < 0.5 < abs(middle(squares) - 3)


def every_alignment(values, target, mask):
    """All that is computed from a scale and a shift, floating point only."""
    plain = depth.whitened(values, mask)
    return plain[:3], depth.align_least_squares(values, target, mask), depth.align_robust(values, target, mask)


@pytest.mark.parametrize("case", ["flat", "empty", "tiny", "huge", "zero"])
def test_alignment_and_whitening_are_finite_where_the_naive_forms_divide_by_zero(case):
    values = {"flat": jnp.full(6, 3.0), "zero": jnp.zeros(6)}.get(case, jnp.linspace(1, 2, 6))
    values = values * {"tiny": 1e-15, "huge": 1e15}.get(case, 1.0)
    mask = jnp.zeros(6) if case == "empty" else jnp.ones(6)
    target = jnp.linspace(1, 3, 6)
    assert_finite(every_alignment, values, target, mask)
    assert bool(jax.jit(depth.whitened)(values, mask).usable) == (case in ("tiny", "huge"))


def test_whitening_forgets_scale_and_shift():
    values, mask = uniform(4, 20), jnp.ones(20)
    white = jax.jit(depth.whitened)
    here, there = white(values + 1, mask), white(5 * values + 2, mask)
    np.testing.assert_allclose(here.values, there.values, atol=1e-4)


def test_mismatched_axes_are_named():
    with pytest.raises(ValueError, match="align_least_squares: axis P of `mask` is 3, expected 4"):
        depth.align_least_squares(jnp.ones(4), jnp.ones(4), jnp.ones(3))
