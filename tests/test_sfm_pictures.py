"""From pictures to cameras: features, tracks, movers, and what kind of camera took them."""

import numpy as np
import pytest
from planes import PLANES, path, pictures, texture

from zestjax.sfm.choice import chosen_frames, sharpness
from zestjax.sfm.estimate import estimate_cameras
from zestjax.sfm.features import Features, find_features
from zestjax.sfm.gauge import pose_errors
from zestjax.sfm.matching import Pair, frame_pairs, mutual_matches, verified_pair
from zestjax.sfm.movers import cleaned, epipolar_distance, fundamental_matrix, moving_pixels, turning_distance
from zestjax.sfm.rotations import rotation_from_turn
from zestjax.sfm.tracks import join_matches

WIDE = ((6.0, (-14.0, 14.0, -12.0, 12.0)),)  # one plane that fills every picture


def shifted(u, v):
    whole = np.round(texture(180, 220)).astype(np.uint8)
    return whole[20 + v : 116 + v, 20 + u : 148 + u]


def test_features_of_a_shifted_picture_match_at_the_shift():
    a, b = (find_features(image) for image in (shifted(0, 0), shifted(7, -4)))
    matches = mutual_matches(a, b)
    found = b.pixels[matches[:, 1]] - a.pixels[matches[:, 0]]
    assert len(matches) > 100
    np.testing.assert_allclose(np.median(found, axis=0), [-7, 4], atol=0.05)
    assert (np.linalg.norm(found - [-7, 4], axis=1) < 0.5).mean() > 0.9
    np.testing.assert_allclose(np.linalg.norm(a.descriptors, axis=1), 1, atol=1e-5)


def test_no_feature_is_taken_where_none_is_wanted_or_nothing_is():
    image, avoid = shifted(0, 0), np.zeros((96, 128), bool)
    avoid[:, :64] = True
    assert find_features(image, avoid=avoid).pixels[:, 0].min() > 60
    for flat in (np.zeros((40, 40, 3), np.uint8), np.full((40, 40, 3), 0.5, np.float32)):
        assert find_features(flat).pixels.shape == (0, 2)
    nothing = find_features(np.zeros((40, 40, 3), np.uint8))
    assert len(mutual_matches(nothing, find_features(image))) == 0


def test_matches_of_unlike_pictures_are_no_pair():
    other = np.round(texture(96, 128, seed=9)).astype(np.uint8)
    assert verified_pair(0, 1, [find_features(shifted(0, 0)), find_features(other)]) is None


def test_a_pair_says_how_far_and_whether_a_plane_explains_it():
    features = [find_features(image) for image in pictures(path(6)[[0, 5]])]
    pair = verified_pair(0, 1, features)
    assert pair is not None and pair.shift > 10 and pair.parallax > 1.5
    flat = verified_pair(0, 1, [find_features(image) for image in (shifted(0, 0), shifted(7, -4))])
    assert flat is not None and flat.parallax < 0.3 and abs(flat.shift - np.hypot(7, 4)) < 0.2


def test_pairs_are_all_of_a_short_video_and_ever_rarer_of_a_long_one():
    assert len(frame_pairs(24)) == 24 * 23 // 2
    long = frame_pairs(200)
    assert {(0, 1), (0, 8), (0, 16), (71, 199)} <= set(long) and (0, 9) not in long and len(long) < 200 * 13
    assert all(0 <= a < b < 200 for a, b in long)


def test_tracks_join_matches_and_drop_a_frame_that_contradicts_itself():
    features = [Features(np.arange(8.0).reshape(4, 2) + i, np.zeros((4, 128), np.float32)) for i in range(3)]
    matches = lambda *pairs: np.array(pairs)
    tracks = join_matches(
        features, [Pair(0, 1, matches((0, 0), (1, 1)), 0, 0), Pair(1, 2, matches((0, 2), (1, 3)), 0, 0)]
    )
    assert tracks.total == 2
    np.testing.assert_array_equal(tracks.frame, [0, 1, 2, 0, 1, 2])
    np.testing.assert_array_equal(tracks.pixels[2], features[2].pixels[2])
    torn = [*[Pair(0, 1, matches((0, 0)), 0, 0), Pair(1, 2, matches((0, 2)), 0, 0)], Pair(0, 2, matches((0, 3)), 0, 0)]
    np.testing.assert_array_equal(join_matches(features, torn).frame, [0, 1])
    assert join_matches(features, []).total == 0


@pytest.fixture(scope="module")
def moving():
    poses = path(10)
    return pictures(poses), poses


def test_a_moving_camera_is_found(moving):
    images, poses = moving
    found = estimate_cameras(images)
    assert found.kind == "moving" and found.registered.all()
    error = pose_errors(found.poses, poses)
    assert error.degrees.mean() < 0.3 and error.share.mean() < 0.02
    assert abs(found.focal / 120 - 1) < 0.15 and found.focal_error < 0.1
    assert found.near == 1 and 1.5 < found.far < 6 and np.nanmedian(found.errors) < 0.5
    np.testing.assert_allclose(found.poses[5], np.eye(4), atol=1e-9)


def test_a_known_focal_length_is_held_and_the_same_call_gives_the_same_cameras(moving):
    images, poses = moving
    one, two = (estimate_cameras(images, focal=120.0) for _ in "ab")
    assert one.focal == 120.0 and one.focal_error is None
    np.testing.assert_array_equal(one.poses, two.poses)
    assert pose_errors(one.poses, poses).share.mean() < 0.02


def test_a_camera_that_stands_still_is_told_from_one_that_turns(moving):
    still = estimate_cameras(np.concatenate([pictures(path(1))] * 5))
    assert still.kind == "still" and still.registered.all() and still.points == 0
    np.testing.assert_array_equal(still.poses, np.tile(np.eye(4), (5, 1, 1)))
    turns = path(6, reach=0.0, turns=0.4)
    turning = estimate_cameras(pictures(turns), focal=120.0)
    assert turning.kind == "turning"
    np.testing.assert_array_equal(turning.poses[:, :3, 3], 0)
    assert pose_errors(turning.poses, turns).degrees.max() < 0.3


def test_a_plane_and_pictures_without_texture_are_named():
    assert estimate_cameras(pictures(path(6), planes=WIDE)).kind == "turning"
    with pytest.raises(ValueError, match="no texture"):
        estimate_cameras(np.full((4, 64, 64, 3), 90, np.uint8))
    unlike = np.stack([texture(64, 96, seed) for seed in range(4)]).round().astype(np.uint8)
    with pytest.raises(ValueError, match="pairs of frames show the same"):
        estimate_cameras(unlike)


def still_flow(relative, focal, centre, depth, shape):
    """(H, W, 2) of points at one depth in a camera that moves by `relative`."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    points = depth * np.stack([(u - centre[0]) / focal, (v - centre[1]) / focal, np.ones_like(u)], -1)
    there = points @ relative[:3, :3].T + relative[:3, 3]
    return focal * there[..., :2] / there[..., 2:] + centre - np.stack([u, v], -1)


def test_what_stands_still_is_on_its_epipolar_line_and_what_moves_off_it():
    relative, centre = np.eye(4), np.array([31.5, 23.5])
    relative[:3, :3], relative[:3, 3] = rotation_from_turn(np.array([0.01, -0.03, 0.02])), [-0.3, 0.0, 0.0]
    matrix = fundamental_matrix(relative, 60.0, centre)
    for depth in (2.0, 5.0, 50.0):
        flow = still_flow(relative, 60.0, centre, depth, (48, 64))
        assert epipolar_distance(flow, matrix).max() < 1e-9
    flow[10:30, 10:30, 1] += 6.0
    distance = epipolar_distance(flow, matrix)
    np.testing.assert_allclose(distance[10:30, 10:30], 6 / np.sqrt(2), rtol=0.05)  # both ends move half of the way
    mask = moving_pixels(distance[None], np.ones((1, 48, 64)))
    expected = np.zeros((48, 64), bool)
    expected[10:30, 10:30] = True
    assert (mask & expected).sum() / (mask | expected).sum() > 0.9
    assert not moving_pixels(distance[None], np.zeros((1, 48, 64))).any()
    assert (epipolar_distance(flow, np.zeros((3, 3))) == 0).all()


def test_a_turn_explains_its_own_flow():
    relative, centre = np.eye(4), np.array([31.5, 23.5])
    relative[:3, :3] = rotation_from_turn(np.array([0.05, -0.03, 0.1]))
    flow = still_flow(relative, 60.0, centre, 3.0, (48, 64))
    assert turning_distance(flow, relative[:3, :3], 60.0, centre).max() < 1e-9


def test_specks_and_pinholes_go():
    mask = np.zeros((60, 80), bool)
    mask[20:40, 20:40] = True
    noisy = mask.copy()
    noisy[5, 5], noisy[30, 30] = True, False
    np.testing.assert_array_equal(cleaned(noisy)[18:42, 22:38], mask[18:42, 22:38])
    assert not cleaned(noisy)[:10, :10].any()


def test_the_sharpest_of_every_window_is_chosen():
    assert chosen_frames([1.0] * 5, most=9) == (0, 1, 2, 3, 4)
    sharp = np.ones(100)
    sharp[[5, 14, 27]] = 2
    chosen = chosen_frames(sharp, most=10)
    assert len(chosen) == 10 and {5, 14, 27} <= set(chosen)
    assert max(np.diff(chosen)) <= 15
    assert len(set(chosen_frames(np.arange(25.0), most=24))) == 24
    with pytest.raises(ValueError, match="`most` is 0"):
        chosen_frames([1.0], most=0)
    image = pictures(path(1), planes=PLANES)[0]
    blurred = np.round(np.stack([np.roll(image.astype(float), k, 1) for k in range(6)]).mean(0)).astype(np.uint8)
    assert sharpness(image) > 2 * sharpness(blurred) and sharpness(np.zeros((8, 8, 3), np.uint8)) == 0
