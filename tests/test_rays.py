"""Rays and the depths along them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite

from zestjax import cameras, rays
from zestjax.cameras import Camera

K = jnp.asarray([[50.0, 0, 31.5], [0, 48, 23.5], [0, 0, 1]])
UP = jnp.asarray([0.0, -1.0, 0.0])
look_at, project, unproject = jax.jit(cameras.look_at), jax.jit(cameras.project), jax.jit(cameras.unproject)


def camera():
    return Camera(K, look_at(jnp.asarray([1.0, -0.5, 0.2]), jnp.asarray([0.0, 0, 5]), up=UP))


def test_a_point_of_the_ray_projects_back_to_its_pixel_at_its_depth():
    pixels = rays.pixel_grid(5, 7) * 8
    drawn = rays.rays_from_pixels(camera(), pixels)
    depth = 1 + jax.random.uniform(jax.random.key(0), (5, 7)) * 9
    points = drawn.origins + depth[..., None] * drawn.directions
    np.testing.assert_allclose(points, unproject(camera(), pixels, depth), atol=1e-5)
    projected = project(camera(), points)
    np.testing.assert_allclose(projected.pixels, pixels, atol=1e-3)
    np.testing.assert_allclose(projected.depth, depth, rtol=1e-5)


def test_the_grid_is_column_then_row():
    grid = rays.pixel_grid(3, 5)
    assert grid.shape == (3, 5, 2)
    np.testing.assert_array_equal(grid[2, 4], [4, 2])


@pytest.mark.parametrize("spacing, even_in", [("depth", lambda d: d), ("inverse", lambda d: 1 / d)])
def test_regular_depths_are_even_in_what_was_asked_for(spacing, even_in):
    depths = rays.regular_depths(0.5, 12.0, 9, spacing=spacing)
    np.testing.assert_allclose(depths[jnp.asarray([0, -1])], [0.5, 12], rtol=1e-6)
    np.testing.assert_allclose(even_in(np.asarray(depths)), np.linspace(even_in(0.5), even_in(12.0), 9), rtol=1e-5)


def test_one_regular_depth_is_the_middle_one():
    np.testing.assert_allclose(rays.regular_depths(2.0, 4.0, 1), [3.0])
    np.testing.assert_allclose(rays.regular_depths(2.0, 4.0, 1, spacing="inverse"), [8 / 3], rtol=1e-6)
    with pytest.raises(ValueError, match="`count` is 0"):
        rays.regular_depths(2.0, 4.0, 0)


@pytest.mark.parametrize("spacing", rays.SPACINGS)
def test_one_sample_falls_in_every_stratum(spacing):
    near, far, count = 0.7, 30.0, 16
    depths = np.asarray(rays.stratified_depths(jax.random.key(0), near, far, count, 50, spacing=spacing))
    assert depths.shape == (50, count) and (np.diff(depths) > 0).all()
    f = (lambda d: d) if spacing == "depth" else (lambda d: 1 / d)
    fractions = (f(depths) - f(near)) / (f(far) - f(near))
    np.testing.assert_array_equal(
        np.floor(np.clip(fractions * count, 0, count - 1e-6)), np.tile(np.arange(count), (50, 1))
    )


@pytest.mark.parametrize("count", [1, 2, 9])
def test_intervals_tile_the_ray(count):
    depths = rays.stratified_depths(jax.random.key(1), 2.0, 9.0, count, 4)
    lengths = rays.interval_lengths(depths, 2.0, 9.0)
    assert lengths.shape == depths.shape and (lengths >= 0).all()
    np.testing.assert_allclose(lengths.sum(-1), 7, rtol=1e-6)
    assert_finite(lambda d: rays.interval_lengths(d, 2.0, 9.0) ** 2, depths)


def test_an_interval_ends_half_way_to_its_neighbours():
    lengths = rays.interval_lengths(jnp.asarray([1.0, 2.0, 4.0]), 0.5, 5.0)
    np.testing.assert_allclose(lengths, [1.0, 1.5, 2.0])


def test_pixels_are_drawn_only_from_the_mask_and_evenly():
    mask = jnp.zeros((6, 8), bool).at[1, 2].set(True).at[5, 7].set(True).at[0, 0].set(True)
    drawn = jax.jit(rays.sample_pixels, static_argnums=2)(jax.random.key(0), mask, 3000)
    found, counts = np.unique(drawn.pixels, axis=0, return_counts=True)
    np.testing.assert_array_equal(found, [[0, 0], [2, 1], [7, 5]])
    assert drawn.valid.all() and drawn.available == 3 and (abs(counts - 1000) < 5 * np.sqrt(3000 * 2 / 9)).all()


def test_an_empty_mask_yields_nothing_valid():
    drawn = rays.sample_pixels(jax.random.key(0), jnp.zeros((3, 4)), 5)
    assert not drawn.valid.any() and drawn.available == 0
    np.testing.assert_array_equal(drawn.pixels, 0)


def test_a_full_mask_reaches_its_last_pixel():
    drawn = rays.sample_pixels(jax.random.key(0), jnp.ones((2, 3)), 500)
    assert len(np.unique(drawn.pixels, axis=0)) == 6


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="`spacing` is 'log'"):
        rays.regular_depths(1.0, 2.0, 3, spacing="log")
    with pytest.raises(ValueError, match="`pixels`"):
        rays.rays_from_pixels(camera(), jnp.zeros(3))
    with pytest.raises(ValueError, match="`mask`"):
        rays.sample_pixels(jax.random.key(0), jnp.zeros(3), 2)
