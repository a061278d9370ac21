"""Homographies against projection, and what a warp shows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match

from zestjax import cameras, planesweep
from zestjax.cameras import Camera

H, W = 20, 24
K = np.array([[30.0, 0.2, 11.5], [0, 28, 9.5], [0, 0, 1]], "f")
warp, carry = jax.jit(planesweep.warp), jax.jit(planesweep.carry)
homography_of, homographies_of = jax.jit(planesweep.plane_homography), jax.jit(planesweep.homographies)
look_at, project, unproject = jax.jit(cameras.look_at), jax.jit(cameras.project), jax.jit(cameras.unproject)


def at(x, dtype=jnp.float32):
    return Camera(jnp.asarray(K, dtype), jnp.eye(4, dtype=dtype).at[0, 3].set(-x))


def ring(dtype=jnp.float32):
    """Four views of one place, of different intrinsics."""
    positions = jnp.asarray([[0.0, 0, 0], [0.8, 0.1, 0], [-0.5, 0.4, 0.3], [0.2, -0.6, -0.4]])
    pose = look_at(positions, jnp.tile(jnp.asarray([[0.0, 0, 5]]), (4, 1)), up=jnp.asarray([0.0, -1, 0]))
    intrinsics = np.stack([K * [[scale, 1, 1], [1, scale, 1], [1, 1, 1]] for scale in (1, 1.1, 0.9, 1.2)])
    return Camera(jnp.asarray(intrinsics, dtype), pose.astype(dtype))


def one(views, k):
    return jax.tree.map(lambda x: x[k], views)


@pytest.mark.parametrize("depth", [0.1, 1.0, 50.0])
def test_a_camera_sees_itself_unmoved(depth):
    homography = homography_of(at(0.3), at(0.3), jnp.float32(depth))
    np.testing.assert_allclose(homography @ jnp.asarray([10.0, 5.0, 1.0]), [10, 5, 1], atol=1e-4)


@pytest.mark.parametrize("depth", [0.5, 2.0, 40.0])
def test_a_sideways_step_shifts_a_pixel_by_focal_times_baseline_over_depth(depth):
    u, v, w = homography_of(at(0.0), at(0.3), jnp.float32(depth)) @ jnp.asarray([10.0, 5.0, 1.0])
    np.testing.assert_allclose([u / w, v / w], [10 - 30 * 0.3 / depth, 5], rtol=1e-5, atol=1e-4)


def test_homographies_agree_with_unproject_and_project_in_pixel_and_in_depth():
    """d (H p)_3 is the depth of the plane's point in the source: what the trust test relies on."""
    views, depths = ring(), planesweep.plane_depths(2.0, 9.0, 5, spacing="inverse")
    homographies = homographies_of(one(views, 0), views, depths)
    assert homographies.shape == (5, 4, 3, 3)
    grid = planesweep.sweep_grid(H, W)
    for k, depth in enumerate(depths):
        points = unproject(one(views, 0), grid[..., :2], jnp.full((H, W), depth))
        for v in range(4):
            expected = project(one(views, v), points)
            u, w, share, in_front = carry(homographies[k, v], grid)
            np.testing.assert_allclose(jnp.stack([u, w], -1), expected.pixels, atol=2e-3)
            np.testing.assert_allclose(share * depth, expected.depth, rtol=1e-4)
            assert in_front.all()


def test_a_warp_at_the_true_depth_shows_the_reference_view():
    """A smooth pattern painted on the plane z = 4."""
    paint = lambda points: jnp.stack([jnp.sin(points[..., 0]), jnp.cos(points[..., 1])], -1)
    source, reference = at(0.5), at(0.0)
    grid = planesweep.sweep_grid(H, W)
    seen_by = lambda camera: paint(unproject(camera, grid[..., :2], jnp.full((H, W), 4.0)))
    homography = homography_of(reference, source, jnp.float32(4.0))
    values, visible = warp(seen_by(source), homography, grid)
    assert visible.mean() > 0.8
    np.testing.assert_allclose(values[visible], seen_by(reference)[visible], atol=3e-3)
    np.testing.assert_array_equal(values[~visible], 0)


def test_what_is_behind_the_source_is_not_visible_and_stays_finite():
    turned = Camera(jnp.asarray(K), jnp.diag(jnp.asarray([-1.0, 1, -1, 1])))  # looks the other way, mirrored pixels
    homography = homography_of(at(0.0), turned, jnp.float32(3.0))
    grid = planesweep.sweep_grid(H, W)
    assert not warp(jnp.ones((H, W, 2)), homography, grid).visible.any()
    assert_finite(lambda i, h: planesweep.warp(i, h, grid).values, jnp.ones((H, W, 2)), homography)


def test_a_plane_through_the_source_centre_stays_finite():
    homography = homography_of(at(0.0), at(0.0), jnp.float32(1.0)).at[2].set(0)
    grid = planesweep.sweep_grid(H, W)
    assert not warp(jnp.ones((H, W, 2)), homography, grid).visible.any()
    assert_finite(lambda i, h: planesweep.warp(i, h, grid).values, jnp.ones((H, W, 2)), homography)


def test_gradients_match_finite_differences(x64):
    views, grid = ring(jnp.float64), planesweep.sweep_grid(H, W, dtype=jnp.float64)[1::7, 1::6]
    image = jax.random.normal(jax.random.key(0), (H, W, 1), jnp.float64)
    homography = lambda depth: homography_of(one(views, 0), one(views, 1), depth)
    assert_grads_match(homography, jnp.asarray(3.0))
    assert_grads_match(lambda i, d: planesweep.warp(i, homography(d), grid).values, image, jnp.asarray(3.17))


def test_the_padded_grid_starts_outside_the_image():
    grid = planesweep.sweep_grid(3, 4, padding=2)
    assert grid.shape == (7, 8, 3)
    np.testing.assert_array_equal(grid[0, 0], [-2, -2, 1])
    np.testing.assert_array_equal(grid[-1, -1], [5, 4, 1])


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="plane_homography: `source`"):
        planesweep.plane_homography(at(0.0), ring(), jnp.float32(1.0))
    with pytest.raises(ValueError, match="homographies: `depths`"):
        planesweep.homographies(at(0.0), ring(), jnp.float32(1.0))
    with pytest.raises(ValueError, match="warp: `grid`"):
        planesweep.warp(jnp.ones((2, 2, 1)), jnp.eye(3), jnp.ones((2, 2)))
