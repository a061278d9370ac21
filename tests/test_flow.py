"""Points followed through time, and the optical flow of a known motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match, normal, uniform

from zestjax import flow
from zestjax.cameras import Camera

seen_by = jax.jit(flow.induced_flow, static_argnames="normalise")


def camera(*, focal=(100.0, 120.0), translation=(0.0, 0.0, 0.0), dtype=jnp.float32):
    pose = np.eye(4)
    pose[:3, 3] = translation
    return Camera(jnp.array([[focal[0], 0, 32], [0, focal[1], 24], [0, 0, 1]], dtype), jnp.array(pose, dtype))


def landed(weights, points, motion, start):
    """What of an optical flow has a gradient."""
    return flow.induced_flow(weights, points, motion, camera(), start)[:2]


def test_a_constant_flow_moves_points_by_its_multiples():
    start, step = normal(0, 2, 5, 3)
    path = flow.follow(lambda points, k: step, start, jnp.array([True, True]))
    np.testing.assert_allclose(path.points, jnp.stack([start + step, start + 2 * step]), rtol=1e-6)
    np.testing.assert_array_equal(path.flows, jnp.stack([step, step]))


def test_each_step_uses_the_flow_where_the_last_one_ended():
    path = flow.follow(lambda points, k: points * (k + 1), jnp.ones((1, 3)), jnp.array([True, True]))
    np.testing.assert_array_equal(path.points[:, 0, 0], [2.0, 6.0])


def test_nothing_is_valid_beyond_a_missing_frame():
    still = lambda points, k: jnp.zeros_like(points)
    path = flow.follow(still, jnp.ones((4, 3)), jnp.array([True, False, True]))
    np.testing.assert_array_equal(path.valid, [True, False, False])


def test_there_and_back_in_another_frames_coordinates_is_where_it_was():
    points, step = uniform(1, 2, 6, 3)
    to_world, back = lambda x: 1 / (1 + x), lambda x: 1 / x - 1
    moved = flow.advance(points, step, world_from_points=to_world, points_from_world=back)
    np.testing.assert_allclose(moved, points + step, rtol=1e-4)
    displaced = flow.world_flow(to_world, points, step)
    np.testing.assert_allclose(to_world(points) + displaced, to_world(points + step), rtol=1e-6)


def test_a_sideways_motion_moves_the_pixel_by_focal_times_step_over_depth():
    weights = jnp.array([[0.0, 1.0]])
    points = jnp.array([[[0.0, 0.0, 1.0], [0.1, 0.2, 4.0]]])
    motion = jnp.broadcast_to(jnp.array([0.3, 0.2, 0.0]), (1, 2, 3))
    start = jnp.array([[32 + 100 * 0.1 / 4, 24 + 120 * 0.2 / 4]])
    seen = seen_by(weights, points, motion, camera(), start)
    np.testing.assert_allclose(seen.flow, [[100 * 0.3 / 4, 120 * 0.2 / 4]], rtol=1e-4)
    assert seen.visible.all()


def test_a_still_point_flows_against_the_cameras_motion():
    start = jnp.array([[32.0, 24.0]])
    seen = seen_by(
        jnp.ones((1, 1)), jnp.array([[[0.0, 0.0, 2.0]]]), jnp.zeros((1, 1, 3)), camera(translation=(0.1, 0, 0)), start
    )
    np.testing.assert_allclose(seen.flow, [[100 * 0.1 / 2, 0]], atol=1e-4)


def test_a_half_transparent_ray_flows_like_an_opaque_one():
    """The paper's unnormalised mean draws the expected point to the world's origin."""
    points, motion = jnp.array([[[0.4, 0.2, 2.0]]]), jnp.array([[[0.1, 0.0, 0.0]]])
    start, view = jnp.array([[52.0, 36.0]]), camera(translation=(1.0, 0.0, 1.0))
    shown = lambda opacity, **k: seen_by(jnp.full((1, 1), opacity), points, motion, view, start, **k).flow
    np.testing.assert_allclose(shown(0.5), shown(1.0), rtol=1e-5)
    assert np.abs(shown(0.5, normalise=False) - shown(1.0, normalise=False)).max() > 1


@pytest.mark.parametrize("z", [-1.0, 0.0, 1e-8, 1e8])
@pytest.mark.parametrize("opacity", [0.0, 1e-30, 1.0])
def test_optical_flow_is_finite_behind_the_camera_and_on_empty_rays(z, opacity):
    points, motion = jnp.array([[[0.1, 0.2, z]]]), jnp.full((1, 1, 3), 0.0)
    weights, start = jnp.full((1, 1), opacity), jnp.array([[3.0, 4.0]])
    assert_finite(landed, weights, points, motion, start)
    seen = seen_by(weights, points, motion, camera(), start)
    assert seen.visible.all() == (opacity == 1.0 and z > 1e-6)
    if not seen.visible.all():
        np.testing.assert_array_equal(seen.flow, 0)


def test_gradients_match_finite_differences(x64):
    weights, *axes = uniform(2, 4, 2, 3, dtype=jnp.float64)
    points = jnp.stack(axes, -1) + jnp.array([0, 0, 2.0]).reshape(1, 1, 3)
    view, start = camera(dtype=jnp.float64), jnp.zeros((2, 2), jnp.float64)
    fn = lambda w, p, m: flow.induced_flow(w, p, m, view, start).flow / 100
    assert_grads_match(fn, weights, points, 0.1 * points)


def test_a_flow_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="follow: `flow_at` gave shape"):
        flow.follow(lambda points, k: points[..., :2], jnp.ones((4, 3)), jnp.array([True]))
