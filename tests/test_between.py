"""The frame between two frames: motion whose middle is known, cameras whose middle is known, and nothing read twice."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.cameras import Camera, look_at
from zestjax.frames import between
from zestjax.frames.assembly import footage
from zestjax.frames.optical_flow import video_flow
from zestjax.video import Video

HEIGHT, WIDTH, SPEED = 48, 64, 2.0  # pixels a frame: four frames' are less than half a wave


def moved(pixels):
    """A smooth texture, moved to the right by so many pixels; uint8 (H, W, 3)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    waves = [np.sin(0.31 * (u - pixels) + 0.2 * v), np.sin(0.27 * v - 0.22 * (u - pixels)), np.cos(0.4 * (u - pixels))]
    return np.round(127.5 * (np.stack(waves, -1) + 1)).astype(np.uint8)


def film(frames=6):
    return np.stack([moved(SPEED * i) for i in range(frames)])


def inner_error(found, expected):
    """Mean absolute difference, away from the edges that nothing has seen."""
    inner = np.s_[8:-8, 12:-12]
    return float(np.abs(found[inner] - expected[inner] / 255).mean())


@pytest.mark.parametrize(
    "time, exclude, ends",
    [(2, (2,), (1, 3)), (2, (), (1, 3)), (2, (1,), (0, 3)), (3, (4, 2), (1, 5)), (4, (3,), (2, 5))],
)
def test_an_even_motion_is_met_in_the_middle_and_elsewhere(time, exclude, ends):
    found = between.flow_interpolation(film(), time, exclude=exclude)
    assert (found.before, found.after) == ends and found.share == (time - ends[0]) / (ends[1] - ends[0])
    nearest = inner_error(film()[ends[0]] / 255, film()[time])
    assert inner_error(found.image, film()[time]) < min(0.02, 0.15 * nearest)


def test_frames_that_do_not_differ_are_their_own_middle():
    still = np.stack([moved(0.0)] * 3)
    np.testing.assert_allclose(between.flow_interpolation(still, 1).image, still[1] / 255, atol=1e-6)


def test_at_the_ends_there_is_none():
    assert between.flow_interpolation(film(), 0) is None and between.flow_interpolation(film(), 5) is None
    assert between.flow_interpolation(film(), 1, exclude=(0,)) is None
    assert between.flow_interpolation(film(2), 1) is None


def test_bytes_and_floats_say_the_same_and_what_is_taken_away_is_not_read():
    plain, spoilt = film(), film()
    spoilt[2], spoilt[4] = 255, 0
    first = between.flow_interpolation(plain, 2, exclude=(4,)).image
    np.testing.assert_array_equal(between.flow_interpolation(spoilt, 2, exclude=(4,)).image, first)
    np.testing.assert_allclose(between.flow_interpolation(plain.astype(np.float32) / 255, 2).image, first, atol=1e-6)


@pytest.mark.parametrize("fill", [0, 255])
def test_frames_without_texture_give_a_finite_picture(fill):
    found = between.flow_interpolation(np.full((3, 20, 24, 3), fill, np.uint8), 1)
    np.testing.assert_allclose(found.image, fill / 255, atol=1e-6)


def camera(angle, x):
    intrinsics = np.array([[50.0 + x, 0, 31.5], [0, 50.0 + x, 23.5], [0, 0, 1]], np.float32)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
    pose[:3, 3] = -pose[:3, :3] @ np.array([x, 0.0, 0.0])
    return Camera(intrinsics, pose.astype(np.float32))


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 1.0])
def test_the_camera_between_turns_and_moves_evenly(share):
    found = between.camera_between(camera(0.2, 1.0), camera(0.6, 3.0), share)
    expected = camera(0.2 + 0.4 * share, 1.0 + 2.0 * share)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6), found, expected)
    rotation = found.camera_from_world[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)


def posed(images):
    at = [
        look_at(jnp.array([0.1 * i, 0.0, 0]), jnp.array([0.1 * i, 0, 1]), up=jnp.array([0.0, -1, 0])) for i in range(6)
    ]
    intrinsics = np.tile(camera(0.0, 0.0).intrinsics, (len(images), 1, 1))
    poses = np.stack([np.asarray(pose) for pose in at])
    poses[3, :3, 3] += 0.05  # not between its neighbours
    return Video(images, Camera(intrinsics, poses), np.float32(1), np.float32(9))


def test_the_stand_in_takes_the_frames_place_with_all_that_is_found_from_it():
    video, seen = posed(film()), footage(film())
    stood, anew = between.with_stand_in(video, seen, 3, exclude=(3,))
    frame = between.flow_interpolation(video.images, 3)
    np.testing.assert_array_equal(stood.images[3], np.round(255 * frame.image).astype(np.uint8))
    even = (video.cameras.camera_from_world[2] + video.cameras.camera_from_world[4]) / 2
    np.testing.assert_allclose(stood.cameras.camera_from_world[3], even, atol=1e-6)
    whole = footage(stood.images)  # found from nothing: what is replaced is all that differs
    np.testing.assert_array_equal(anew.half, whole.half)
    jax.tree.map(np.testing.assert_array_equal, anew.flow, whole.flow)
    np.testing.assert_array_equal(video.images, film())
    jax.tree.map(np.testing.assert_array_equal, seen.flow, video_flow(film()))


def test_the_frame_that_is_stood_in_for_is_not_read():
    spoilt = film()
    spoilt[3] = 255
    clean = between.with_stand_in(posed(film()), footage(film()), 3, exclude=(3,))
    other = between.with_stand_in(posed(spoilt), footage(spoilt), 3, exclude=(3,))
    jax.tree.map(np.testing.assert_array_equal, clean, other)


def test_where_nothing_can_stand_in_there_is_none():
    assert between.with_stand_in(posed(film()), footage(film()), 0, exclude=(0,)) is None


def test_frames_that_have_little_in_common_make_no_stand_in():
    """Photographs from far apart: their flow is a guess, which a view must not believe."""
    noise = np.random.default_rng(0).integers(0, 256, (6, HEIGHT, WIDTH, 3), np.uint8)
    images = np.stack([cv2.GaussianBlur(image, (0, 0), 2) for image in noise])
    far, near = (between.flow_interpolation(x, 2).sure for x in (images, film()))
    assert far < 0.5 < between.LEAST_SURE < near
    assert between.with_stand_in(posed(images), footage(images), 2, exclude=(2,)) is None
