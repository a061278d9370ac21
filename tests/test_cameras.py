"""Cameras: conventions as sentences, every map with its inverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import assert_finite, assert_grads_match

from zestjax import cameras
from zestjax.cameras import Camera

K = np.array([[50.0, 0.5, 31.5], [0, 48, 23.5], [0, 0, 1]], "f")
UP = jnp.asarray([0.0, -1.0, 0.0])
project, unproject, look_at = jax.jit(cameras.project), jax.jit(cameras.unproject), jax.jit(cameras.look_at)


def camera_at(x=0.0, y=0.0, z=0.0, dtype=jnp.float32):
    pose = np.eye(4)
    pose[:3, 3] = [-x, -y, -z]
    return Camera(jnp.asarray(K, dtype), jnp.asarray(pose, dtype))


def looking(position, target=(0.0, 0.0, 5.0)):
    pose = look_at(jnp.asarray(position), jnp.asarray(target), up=UP)
    return Camera(jnp.asarray(K), pose)


def project_by_hand(k, pose, point):
    """One point, float64, one multiplication at a time."""
    x = [sum(pose[i][j] * point[j] for j in range(3)) + pose[i][3] for i in range(3)]
    q = [sum(k[i][j] * x[j] for j in range(3)) for i in range(3)]
    return [q[0] / q[2], q[1] / q[2]], x[2]


def test_projection_is_the_textbook_formula():
    camera = looking([1.0, -0.5, 0.2])
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (10, 3))
    projected = project(camera, jnp.asarray(points, jnp.float32))
    for k, point in enumerate(points):
        pixel, depth = project_by_hand(
            *np.float64(camera.intrinsics)[None], np.float64(camera.camera_from_world), point
        )
        np.testing.assert_allclose(projected.pixels[k], pixel, atol=1e-3)
        np.testing.assert_allclose(projected.depth[k], depth, rtol=1e-5)


def test_x_is_right_y_is_down_and_z_is_forward():
    right, down = project(camera_at(), jnp.asarray([[1.0, 0, 5], [0, 1.0, 5]])).pixels
    assert right[0] > K[0, 2] and down[1] > K[1, 2]
    np.testing.assert_array_equal(project(camera_at(), jnp.asarray([0.0, 0, 5])).pixels, K[:2, 2])


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.floats(-50, 120), st.floats(-50, 120), st.floats(0.1, 100))
def test_unproject_inverts_project(position, u, v, depth):
    camera = looking(np.float32(position), (0.1, 0.2, 20.0))
    pixels = jnp.asarray([u, v], jnp.float32)
    back = project(camera, unproject(camera, pixels, jnp.float32(depth)))
    # Rounding of the world point (a few units from the origin) is seen under focal / depth.
    np.testing.assert_allclose(back.pixels, pixels, atol=1e-3 + 3e-4 / depth)
    np.testing.assert_allclose(back.depth, depth, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("batch", [(), (1,), (4, 3)])
def test_leading_axes_broadcast(batch):
    pixels = jax.random.uniform(jax.random.key(0), (*batch, 2)) * 30
    depth = 2 + jax.random.uniform(jax.random.key(1), batch)
    one = camera_at(0.3)
    many = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape)), one)
    points = unproject(one, pixels, depth)
    np.testing.assert_allclose(unproject(many, pixels, depth), points, rtol=1e-6)
    np.testing.assert_allclose(project(many, points).pixels, project(one, points).pixels, atol=1e-4)


@pytest.mark.parametrize("z", [-5.0, -1e-7, 0.0, 1e-7, 1e-3, 1e6])
def test_points_behind_and_on_the_camera_stay_finite(z):
    points = jnp.asarray([[0.5, -0.5, z], [0.0, 0.0, z]])
    assert_finite(lambda p: cameras.project(camera_at(), p)[:2], points)
    assert (project(camera_at(), points).in_front == (z > cameras.NEAREST_DEPTH)).all()


def test_projection_gradients_match_finite_differences(x64):
    camera = camera_at(0.1, dtype=jnp.float64)
    points = jnp.asarray([[0.3, -0.2, 4.0], [-0.5, 0.1, 2.0]])
    assert_grads_match(lambda p: cameras.project(camera, p)[:2], points)
    assert_grads_match(lambda d: cameras.unproject(camera, points[:, :2], d), points[:, 2])


def test_closed_form_inverses_are_the_inverses():
    pose = looking([[1.0, 2, 3], [-1, 0, 1]], [[0.0, 0, 5]] * 2).camera_from_world
    np.testing.assert_allclose(cameras.rigid_inverse(pose), np.linalg.inv(np.float64(pose)), atol=1e-6)
    np.testing.assert_allclose(cameras.intrinsics_inverse(jnp.asarray(K)), np.linalg.inv(np.float64(K)), atol=1e-7)


def test_relative_takes_b_to_a_and_the_centre_is_where_the_camera_stands():
    a, b = looking([1.0, 0, 0]), looking([0.0, 2, -1])
    point = jnp.asarray([0.3, 0.4, 6.0])
    in_b = cameras.transformed(b.camera_from_world, point)
    in_a = cameras.transformed(a.camera_from_world, point)
    np.testing.assert_allclose(cameras.transformed(cameras.relative(a, b), in_b), in_a, atol=1e-5)
    np.testing.assert_allclose(cameras.centre(b), [0, 2, -1], atol=1e-6)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_a_strided_image_samples_every_fourth_pixel(batch):
    camera = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape)), camera_at())
    point = jnp.broadcast_to(jnp.asarray([0.2, 0.1, 3.0]), (*batch, 3))
    full, small = project(camera, point).pixels, project(cameras.scaled(camera, 0.25, 0.25), point).pixels
    np.testing.assert_allclose(small, full / 4, rtol=1e-5)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_a_resized_image_keeps_its_corners(batch):
    camera = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape)), camera_at())
    point = jnp.broadcast_to(jnp.asarray([0.2, 0.1, 3.0]), (*batch, 3))
    full, small = project(camera, point).pixels, project(cameras.resized(camera, 0.5, 0.25), point).pixels
    np.testing.assert_allclose(
        small + 0.5, (full + 0.5) * jnp.broadcast_to(jnp.asarray([0.5, 0.25]), full.shape), rtol=1e-5
    )


def test_looking_at_a_target_puts_it_in_the_middle_upright():
    camera = looking([2.0, -1.0, 0.5])
    np.testing.assert_allclose(project(camera, jnp.asarray([0.0, 0, 5])).pixels, K[:2, 2], atol=1e-4)
    above = project(camera, jnp.asarray([0.0, -0.1, 5])).pixels
    assert above[1] < K[1, 2] and abs(above[0] - K[0, 2]) < 0.2
    cameras.check_camera("test", camera)


def test_looking_straight_up_still_is_a_rotation():
    pose = look_at(jnp.zeros(3), jnp.asarray([0.0, -4.0, 0.0]), up=UP)
    cameras.check_camera("test", Camera(jnp.asarray(K), pose))
    assert_finite(lambda p: cameras.look_at(p, jnp.asarray([0.0, -4.0, 0.0]), up=UP), jnp.zeros(3))


@pytest.mark.parametrize("rows", [3, 4])
def test_opengl_poses_look_down_minus_z_with_y_up(rows):
    pose = np.eye(4, dtype="f")
    pose[:3, 3] = [1, 2, 3]
    camera = cameras.camera_from_opengl_pose(pose[:rows], 48, 64, (50.0, 40.0))
    above = project(camera, jnp.asarray([1.0, 2.5, 1.0]))
    np.testing.assert_allclose(above.depth, 2)
    np.testing.assert_allclose(above.pixels, [31.5, 23.5 - 40 * 0.5 / 2], rtol=1e-6)


def test_llff_poses_are_down_right_backward():
    opengl = np.array(cameras.rigid_inverse(looking([1.0, 0.5, -2]).camera_from_world))[:3]
    right, up, back, position = opengl.T
    llff = np.stack([-up, right, back, position, [48, 64, 50]], axis=-1)
    ours, theirs = (
        cameras.camera_from_llff_pose(llff[None]),
        cameras.camera_from_opengl_pose(opengl[None], 48, 64, 50.0),
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), ours, theirs)


def broken(**changes):
    k, pose = np.tile(K, (3, 1, 1)), np.tile(np.eye(4, dtype="f"), (3, 1, 1))
    for where, value in changes.items():
        array, i, j = {"k": k, "p": pose}[where[0]], int(where[1]), int(where[2])
        array[1, i, j] = value
    return Camera(k, pose)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"k00": np.nan}, "`intrinsics` has an entry that is not finite"),
        ({"p03": np.inf}, "`camera_from_world` has an entry that is not finite"),
        ({"k11": 0}, "singular"),
        ({"k10": 1}, "upper triangular"),
        ({"k22": 2}, "upper triangular"),
        ({"p00": 2}, "not rigid"),
        ({"p00": -1}, "reflection"),
        ({"p33": 2}, "does not end in"),
    ],
)
def test_a_degenerate_camera_is_refused_with_its_fault_and_its_place(changes, words):
    cameras.check_camera("load", broken())
    with pytest.raises(ValueError, match=words) as error:
        cameras.check_camera("load", broken(**changes))
    assert str(error.value).startswith("load: ") and "(camera (1,))" in str(error.value)


@pytest.mark.parametrize("near, far", [(0, 1), (-1, 1), (2, 1), (1, 1), (1, np.inf), (np.nan, 1), (1, np.nan)])
def test_depth_bounds_must_be_positive_and_in_order(near, far):
    cameras.check_bounds("load", 0.1, 10.0)
    with pytest.raises(ValueError, match="load: depth bounds"):
        cameras.check_bounds("load", near, far)


def test_wrong_shapes_are_refused():
    for call in (
        lambda: cameras.project(camera_at(), jnp.zeros(2)),
        lambda: cameras.unproject(camera_at(), jnp.zeros(3), jnp.ones(())),
        lambda: cameras.look_at(jnp.zeros(2), jnp.zeros(3), up=UP),
        lambda: cameras.camera_from_opengl_pose(jnp.zeros((2, 4)), 2, 2, 1.0),
        lambda: cameras.camera_from_llff_pose(jnp.zeros((3, 4))),
        lambda: cameras.check_camera("f", Camera(jnp.zeros((2, 2)), jnp.eye(4))),
    ):
        with pytest.raises(ValueError):
            call()
