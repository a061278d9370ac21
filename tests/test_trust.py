"""Which views may be trusted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match

from zestjax import cameras
from zestjax.cameras import Camera
from zestjax.frames import trust
from zestjax.frames.trust import Trust

trusted_at, unproject = jax.jit(trust.trusted_at), jax.jit(cameras.unproject)


def test_trust_is_the_printed_formula():
    rng = np.random.default_rng(0)
    static, surface, tolerance, point = (rng.uniform(low, 1, 50).astype("f") for low in (0, 0.1, 0.2, 0))
    expected = static * np.exp(-((np.maximum(surface - point, 0) / tolerance) ** 2))
    np.testing.assert_allclose(trust.trusted(static, surface, tolerance, point), expected, rtol=1e-5)
    np.testing.assert_allclose(
        trust.agreement(surface, tolerance, point), np.exp(-(((surface - point) / tolerance) ** 2)), rtol=1e-5
    )


def test_a_point_on_or_in_front_of_the_surface_is_not_hidden():
    point = jnp.asarray([0.5, 0.7, 9.0])
    np.testing.assert_array_equal(
        trust.trusted(jnp.full(3, 0.8), jnp.full(3, 0.5), jnp.full(3, 0.1), point), np.float32(0.8)
    )


def test_a_farther_point_is_trusted_less_and_less():
    weights = trust.trusted(jnp.ones(9), jnp.full(9, 0.5), jnp.full(9, 0.1), jnp.linspace(0.5, 0.0, 9))
    assert weights[0] == 1 and (jnp.diff(weights) < 0).all() and weights[-1] < 1e-8


@pytest.mark.parametrize("tolerance", [1e-20, 1e-3, 1.0, 1e20])
@pytest.mark.parametrize("point", [0.0, 1e-6, 0.5, 1e10])
def test_weights_are_finite_and_bounded(point, tolerance):
    args = jnp.float32(0.7), jnp.float32(0.5), jnp.float32(tolerance), jnp.float32(point)
    assert 0 <= trust.trusted(*args) <= 1 and 0 <= trust.agreement(*args[1:]) <= 1
    assert_finite(lambda *a: (trust.trusted(*a), trust.agreement(*a[1:])), *args)


def test_gradients_match_finite_differences(x64):
    args = (jnp.asarray([0.7, 0.3]), jnp.asarray([0.5, 0.5]), jnp.asarray([0.2, 0.3]), jnp.asarray([0.41, 0.7]))
    assert_grads_match(trust.trusted, *args)
    assert_grads_match(trust.agreement, *args[1:])


def wall():
    """A static wall at depth 4 whose left half is covered by something moving at depth 2."""
    camera = Camera(jnp.asarray([[10.0, 0, 7.5], [0, 10, 5.5], [0, 0, 1]]), jnp.eye(4))
    left = jnp.broadcast_to(jnp.arange(16) < 8, (12, 16))
    ones = jnp.ones((12, 16))
    return camera, Trust(jnp.where(left, 0.1, 1.0), jnp.where(left, 0.5, 0.25), 0.02 * ones)


def test_a_covered_wall_is_trusted_only_where_it_is_seen():
    camera, maps = wall()
    pixels = jnp.asarray([[2.0, 5.0], [13.0, 5.0], [13.0, 5.0]])
    points = unproject(camera, pixels, jnp.asarray([4.0, 4.0, 8.0]))
    weights = trusted_at(maps, camera, points)
    np.testing.assert_allclose(weights, [0, 1, 0], atol=1e-6)


def test_nothing_outside_or_behind_the_camera_is_trusted():
    camera, maps = wall()
    points = jnp.asarray([[0.0, 0, -3], [0, 0, 0], [50, 0, 4]])
    np.testing.assert_array_equal(trusted_at(maps, camera, points), 0)
    assert_finite(lambda p: trust.trusted_at(maps, camera, p), points)


def test_points_of_any_leading_shape():
    camera, maps = wall()
    points = jax.random.uniform(jax.random.key(0), (2, 5, 3)) + jnp.asarray([0.0, 0, 3])[None, None]
    assert trusted_at(maps, camera, points).shape == (2, 5)
    with pytest.raises(ValueError, match="trusted_at"):
        trust.trusted_at(maps, camera, jnp.ones(2))


@pytest.mark.parametrize("tolerance", [0.0, 1e-30, 1e-3])
def test_a_gap_too_large_for_a_float_still_has_a_finite_pull(tolerance):
    fn = lambda surface: trust.agreement(surface, jnp.full_like(surface, tolerance), jnp.zeros_like(surface))
    assert_finite(fn, jnp.asarray([1e30, 3e38], jnp.float32))
