"""Rotations, projection and its slopes, bundle adjustment, triangulation: against exact answers."""

import cv2
import numpy as np
import pytest

from zestjax.sfm.adjust import adjust, robust_weights
from zestjax.sfm.bundle import Bundle, Seen, in_cameras, moved, residuals, slopes
from zestjax.sfm.gauge import (
    Similarity,
    align_poses,
    camera_poses,
    depth_bounds,
    middle_world,
    pose_errors,
    transformed_poses,
)
from zestjax.sfm.rotations import cross_matrix, nearest_rotation, rotation_angle, rotation_from_turn
from zestjax.sfm.triangulate import sound, triangulated, widest_angles

CENTRE = np.array([127.5, 71.5])


def scene(frames=8, points=60, *, noise=0.0, seed=0):
    """A `Bundle`, and `Seen` by all of its cameras with noise in pixels."""
    chance = np.random.default_rng(seed)
    turns = 0.05 * chance.normal(size=(frames, 3))
    places = np.stack([np.linspace(-1, 1, frames), *0.1 * chance.normal(size=(2, frames))], -1)
    rotations = rotation_from_turn(turns)
    around = np.stack([chance.uniform(-2, 2, points), chance.uniform(-1, 1, points), chance.uniform(3, 9, points)], -1)
    bundle = Bundle(rotations, -np.einsum("nij,nj->ni", rotations, places), 250.0, around)
    frame, point = (x.ravel() for x in np.meshgrid(np.arange(frames), np.arange(points), indexing="ij"))
    seen = Seen(frame, point, np.zeros((frames * points, 2)))
    pixels = residuals(bundle, seen, centre=CENTRE) + noise * chance.normal(size=(frames * points, 2))
    return bundle, seen._replace(pixels=pixels)


def disturbed(bundle, *, pose=0.02, focal=0.1, point=0.1, seed=1):
    chance = np.random.default_rng(seed)
    shapes = (len(bundle.rotations), 6), bundle.points.shape
    return moved(bundle, pose * chance.normal(size=shapes[0]), focal, point * chance.normal(size=shapes[1]))


def errors(bundle, true):
    return pose_errors(camera_poses(bundle), camera_poses(true))


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 1.0, 3.1])
def test_rotations_are_those_of_opencv(size):
    turn = size * np.array([0.48, -0.6, 0.64])
    rotation = rotation_from_turn(turn)
    np.testing.assert_allclose(rotation, cv2.Rodrigues(turn)[0], atol=1e-12)
    np.testing.assert_allclose(rotation_angle(rotation), size, atol=1e-12)
    np.testing.assert_allclose(nearest_rotation(2.5 * rotation), rotation, atol=1e-12)


def test_the_cross_matrix_multiplies_as_the_cross_product():
    a, b = np.random.default_rng(0).normal(size=(2, 5, 3))
    np.testing.assert_allclose((cross_matrix(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-14)


def test_slopes_are_the_finite_differences_of_a_step():
    bundle, seen = scene(3, 5)
    found, step = slopes(bundle, seen), 1e-6
    poses, points = np.zeros((3, 6)), np.zeros((5, 3))
    at = lambda *change: residuals(moved(bundle, *change), seen, centre=CENTRE)
    slope = lambda there, back: (at(*there) - at(*back)) / (2 * step)
    focal = slope((poses, step, points), (poses, -step, points))
    np.testing.assert_allclose(found.focal, focal, atol=1e-5)
    for k in range(6):
        change = step * np.eye(6)[k] * (np.arange(3) == 1)[:, None]
        expected = np.where((seen.frame == 1)[:, None], found.pose[..., k], 0)
        np.testing.assert_allclose(slope((change, 0.0, points), (-change, 0.0, points)), expected, atol=1e-5)
    for k in range(3):
        change = step * np.eye(3)[k] * (np.arange(5) == 2)[:, None]
        expected = np.where((seen.point == 2)[:, None], found.point[..., k], 0)
        np.testing.assert_allclose(slope((poses, 0.0, change), (poses, 0.0, -change)), expected, atol=1e-5)


def test_exact_observations_bring_everything_back():
    true, seen = scene()
    found = adjust(disturbed(true), seen, centre=CENTRE, tol=1e-12)
    assert found.converged and found.cost < 1e-12
    np.testing.assert_allclose(found.bundle.focal, 250, rtol=1e-6)
    assert errors(found.bundle, true).degrees.max() < 1e-4 and errors(found.bundle, true).share.max() < 1e-5


def test_noise_gives_errors_as_large_as_it_says():
    true, seen = scene(10, 200, noise=0.3)
    found = adjust(disturbed(true), seen, centre=CENTRE)
    assert abs(np.log(found.bundle.focal / 250)) < 4 * found.focal_error < 0.2
    assert errors(found.bundle, true).degrees.mean() < 0.1 and errors(found.bundle, true).share.mean() < 0.01
    spread = [adjust(true, scene(10, 200, noise=0.3, seed=0)[1]._replace(
        pixels=seen.pixels + 0.3 * np.random.default_rng(s).normal(size=seen.pixels.shape)), centre=CENTRE)
        for s in range(12)]  # fmt: skip
    measured = np.std([np.log(fit.bundle.focal) for fit in spread])
    assert 0.4 < measured / np.mean([fit.focal_error for fit in spread]) < 1.6


def test_a_fifth_of_wrong_observations_hardly_pulls():
    true, seen = scene(10, 200, noise=0.1)
    wrong = np.random.default_rng(5).uniform(size=len(seen.frame)) < 0.2
    pixels = seen.pixels + wrong[:, None] * np.random.default_rng(6).uniform(-30, 30, seen.pixels.shape)
    found = adjust(disturbed(true, pose=0.005, focal=0.02, point=0.02), seen._replace(pixels=pixels), centre=CENTRE)
    assert errors(found.bundle, true).degrees.mean() < 0.1 and errors(found.bundle, true).share.mean() < 0.01
    np.testing.assert_allclose(robust_weights(np.array([[0.0, 0], [3, 4]])), [1, 1 / 26])


def test_a_focal_length_far_off_is_found_in_few_steps():
    """Along the valley of longer focal lengths and deeper scenes; by unstretched steps this takes hundreds."""
    true, seen = scene(10, 200, noise=0.1)
    start = adjust(
        moved(true, np.zeros((10, 6)), 0.4, np.zeros((200, 3))), seen, centre=CENTRE, free_focal=False
    ).bundle
    found = adjust(start, seen, centre=CENTRE, max_steps=25)
    assert found.converged and abs(found.bundle.focal / 250 - 1) < 0.05


def test_what_is_held_stays_and_the_cost_is_any_worlds():
    true, seen = scene(noise=0.5)
    start = disturbed(true)
    held = adjust(start, seen, centre=CENTRE, free_focal=False, free_poses=False)
    assert held.bundle.focal == start.focal and held.focal_error is None
    np.testing.assert_array_equal(held.bundle.rotations, start.rotations)
    assert held.cost < np.sum(np.log1p(np.sum(residuals(start, seen, centre=CENTRE) ** 2, -1)))
    turn, size, shift = rotation_from_turn(np.array([0.3, 1.0, -0.2])), 7.0, np.array([5.0, -2, 3])
    other = Bundle(
        true.rotations @ turn.T, size * (true.translations - np.einsum("nij,jk,k->ni", true.rotations, turn.T, shift)),
        true.focal, size * (true.points @ turn.T + shift),
    )  # fmt: skip
    np.testing.assert_allclose(
        residuals(other, seen, centre=CENTRE), residuals(true, seen, centre=CENTRE), atol=1e-9
    )  # fmt: skip


def test_frames_and_points_that_nobody_sees_stay():
    true, seen = scene(6, 40)
    some = (seen.frame != 2) & (seen.point != 7)
    part = Seen(*(leaf[some] for leaf in seen))
    start = disturbed(true, pose=0.001, focal=0.0, point=0.01)
    found = adjust(start, part, centre=CENTRE)
    np.testing.assert_array_equal(found.bundle.rotations[2], start.rotations[2])
    assert np.isfinite(found.bundle.points).all() and found.cost < 1e-6
    nothing = adjust(start, Seen(*(leaf[:0] for leaf in seen)), centre=CENTRE)
    assert nothing.converged and nothing.steps == 0


def test_points_are_found_from_their_rays():
    true, seen = scene()
    points = triangulated(true, seen, centre=CENTRE)
    np.testing.assert_allclose(points, true.points, atol=1e-6)
    once = Seen(*(leaf[seen.frame == 0] for leaf in seen))
    np.testing.assert_array_equal(triangulated(true, once, centre=CENTRE), 0)
    assert sound(true, seen, centre=CENTRE, most=0.1).all()
    behind = true._replace(points=true.points - [0, 0, 20])
    assert not sound(behind, seen, centre=CENTRE, most=1e9).any()


def test_the_angle_of_two_rays_is_the_angle_of_two_rays():
    bundle = Bundle(
        np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0, 0], [-1, 0, 0]]), 100.0, np.array([[0.5, 0, 0.5]])
    )
    seen = Seen(np.array([0, 1]), np.array([0, 0]), np.zeros((2, 2)))
    np.testing.assert_allclose(widest_angles(bundle, seen), np.pi / 2)
    np.testing.assert_allclose(widest_angles(bundle, Seen(*(leaf[:1] for leaf in seen))), 0)


def test_a_similarity_is_undone():
    true = camera_poses(scene()[0])
    world = Similarity(3.0, rotation_from_turn(np.array([0.2, -1.0, 0.5])), np.array([1.0, 2, 3]))
    found = pose_errors(transformed_poses(world, true), true)
    assert found.degrees.max() < 1e-6 and found.share.max() < 1e-9
    np.testing.assert_allclose(align_poses(transformed_poses(world, true), true).scale, 1 / 3)
    middle = transformed_poses(middle_world(true, 2.0), true)
    np.testing.assert_allclose(middle[4], np.eye(4), atol=1e-12)
    apart = lambda poses: np.linalg.norm(poses[0, :3, 3] - poses[1, :3, 3])
    np.testing.assert_allclose(apart(middle), 2 * apart(true))


def test_errors_are_degrees_and_shares_of_the_path():
    true = np.tile(np.eye(4), (4, 1, 1))
    true[:, :3, 3] = [[0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0]]
    moved_one = true.copy()
    moved_one[:, :3, :3] = rotation_from_turn(np.radians([[0, 0, 1.0], [0, 0, -1], [0, 0, 1], [0, 0, -1]]))
    found = pose_errors(moved_one, true)
    np.testing.assert_allclose(found.degrees, 1)
    assert found.share.max() < 1e-9


def test_bounds_hold_what_is_seen_but_for_strays():
    true, seen = scene(8, 300)
    points = true.points.copy()
    points[0] = [0, 0, 1e6]
    near, far = depth_bounds(true._replace(points=points), seen)
    depths = in_cameras(true, seen)[:, 2]
    assert 0.5 * depths.min() < near < depths.min() and depths.max() < far < 2 * depths.max()
