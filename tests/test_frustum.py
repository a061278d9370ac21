"""Frustum coordinates and their inverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match

from zestjax import cameras, frustum
from zestjax.cameras import Camera
from zestjax.frustum import Frustum
from zestjax.rays import SPACINGS

H, W = 24, 32
look_at, project, unproject = jax.jit(cameras.look_at), jax.jit(cameras.project), jax.jit(cameras.unproject)
K = np.array([[30.0, 0, 15.5], [0, 28, 11.5], [0, 0, 1]], "f")


def scene(dtype=jnp.float32, height=H, width=W):
    pose = look_at(jnp.asarray([1.0, -0.5, 0.2]), jnp.asarray([0.0, 0, 5]), up=jnp.asarray([0.0, -1, 0]))
    camera = Camera(jnp.asarray(K, dtype), pose.astype(dtype))
    return Frustum(camera, jnp.asarray(1.5, dtype), jnp.asarray(20.0, dtype), height, width)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_the_image_corners_at_near_and_far_are_the_cubes(spacing):
    pixels = jnp.asarray([[0.0, 0], [W - 1, 0], [0, H - 1], [W - 1, H - 1]])
    for z, depth in ((0, 1.5), (1, 20.0)):
        points = unproject(scene().camera, pixels, jnp.full(4, depth))
        coords = frustum.frustum_from_world(scene(), points, spacing=spacing)
        np.testing.assert_allclose(coords, [[0, 0, z], [1, 0, z], [0, 1, z], [1, 1, z]], atol=2e-5)


@pytest.mark.parametrize("size", [(H, W), (1, W), (H, 1)])
@pytest.mark.parametrize("spacing", SPACINGS)
def test_world_from_frustum_inverts_frustum_from_world(spacing, size):
    place = scene(height=size[0], width=size[1])
    coords = jax.random.uniform(jax.random.key(0), (40, 3), minval=-0.2, maxval=1.02)
    coords = coords.at[:, 2].set(jnp.maximum(coords[:, 2], -0.05))  # in front of the camera
    there = frustum.world_from_frustum(place, coords, spacing=spacing)
    np.testing.assert_allclose(frustum.frustum_from_world(place, there, spacing=spacing), coords, atol=1e-3)


def test_inverse_spacing_is_linear_in_inverse_depth():
    coords = jnp.asarray([[0.3, 0.6, z] for z in (0.0, 0.25, 0.5, 1.0)])
    points = frustum.world_from_frustum(scene(), coords, spacing="inverse")
    depth = project(scene().camera, points).depth
    np.testing.assert_allclose(1 / depth, 1 / 1.5 + np.array([0, 0.25, 0.5, 1]) * (1 / 20 - 1 / 1.5), rtol=1e-4)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_points_behind_and_on_the_camera_are_outside_and_finite(spacing):
    in_camera = jnp.asarray([[0.0, 0, -4], [0.1, 0, 0], [0, 0, -1e-8], [0.2, 0.3, -1e6]])
    points = cameras.transformed(cameras.rigid_inverse(scene().camera.camera_from_world), in_camera)
    to_frustum = lambda p: frustum.frustum_from_world(scene(), p, spacing=spacing)
    assert (to_frustum(points)[:, 2] < 0).all()
    assert_finite(to_frustum, points)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_coordinates_beyond_infinity_stay_finite(spacing):
    coords = jnp.asarray([[0.5, 0.5, z] for z in (-3.0, 1 / (1 - 1.5 / 20), 1.1, 50.0)])
    assert_finite(lambda c: frustum.world_from_frustum(scene(), c, spacing=spacing), coords)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_gradients_match_finite_differences(x64, spacing):
    place, coords = scene(jnp.float64), jax.random.uniform(jax.random.key(0), (4, 3), jnp.float64)
    points = frustum.world_from_frustum(place, coords, spacing=spacing)
    assert_grads_match(lambda c: frustum.world_from_frustum(place, c, spacing=spacing), coords)
    assert_grads_match(lambda p: frustum.frustum_from_world(place, p, spacing=spacing), points)


def test_cells_of_the_scaled_camera_are_feature_pixels():
    """A feature map of stride 4 of an image whose width is no multiple of 4: cell j is image pixel 4 j, exactly."""
    full = scene()
    h, w, planes = 7, 9, 5
    small = Frustum(cameras.scaled(full.camera, 0.25, 0.25), full.near, full.far, h, w)
    pixels, depth = jnp.asarray([[12.0, 20.0], [0, 4]]), jnp.asarray([1.5, 20.0])
    coords = frustum.frustum_from_world(small, unproject(full.camera, pixels, depth))
    np.testing.assert_allclose(frustum.cells_from_frustum(coords, planes, h, w), [[0, 5, 3], [4, 1, 0]], atol=1e-4)


def test_frustums_pass_through_jit():
    coords = jnp.asarray([[0.1, 0.2, 0.3]])
    np.testing.assert_allclose(
        jax.jit(frustum.world_from_frustum)(scene(), coords), frustum.world_from_frustum(scene(), coords), rtol=1e-5
    )


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="`spacing` is 'disparity'"):
        frustum.frustum_from_world(scene(), jnp.ones(3), spacing="disparity")
    with pytest.raises(ValueError, match="`coords`"):
        frustum.world_from_frustum(scene(), jnp.ones(2))


@pytest.mark.parametrize("z", [1.125, 1.4, 50.0])
def test_beyond_infinity_is_held_at_a_thousand_times_far(z):
    camera = Camera(jnp.asarray([[10.0, 0, 0], [0, 10, 0], [0, 0, 1]]), jnp.eye(4))
    place = Frustum(camera, jnp.float32(1), jnp.float32(9), 5, 5)
    point = frustum.world_from_frustum(place, jnp.asarray([0.0, 0.0, z]), spacing="inverse")
    np.testing.assert_allclose(point[2], 9000, rtol=1e-4)
