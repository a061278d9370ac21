"""Optical flow between frames: whole-pixel shifts are found, and what cannot be is not trusted."""

import cv2
import numpy as np
import pytest

from zestjax.frames.optical_flow import video_flow


def texture(height=48, width=64, seed=0):
    """(H, W, 3) uint8 smooth noise, larger than what is shown of it."""
    noise = np.random.default_rng(seed).uniform(size=(height + 40, width + 40, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return np.round(255 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)


def shifted(pairs, height=48, width=64):
    """Frames that show the same texture from whole-pixel offsets (u, v)."""
    whole = texture(height, width)
    return np.stack([whole[20 + v : 20 + v + height, 20 + u : 20 + u + width] for u, v in pairs])


def test_a_shift_is_found_forward_and_backward():
    flow, sure = video_flow(shifted([(0, 0), (3, -2), (3, 5)]))
    assert flow.shape == (3, 2, 24, 32, 2) and sure.shape == (3, 2, 24, 32)
    middle = np.s_[5:-5, 5:-5]
    for frame, way, expected in ((0, 0, (-3, 2)), (1, 1, (3, -2)), (1, 0, (0, -7)), (2, 1, (0, 7))):
        error = flow[frame, way][middle] - np.float32(expected)
        assert np.median(np.abs(error)) < 0.1
        assert np.median(sure[frame, way][middle]) > 0.95
    assert (sure[0, 1] == 0).all() and (sure[2, 0] == 0).all()


def test_unrelated_images_are_not_trusted():
    _, sure = video_flow(np.stack([texture(seed=0)[:48, :64], texture(seed=9)[:48, :64]]))
    assert sure.mean() < 0.3


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (5, 9), (13, 18), (17, 64)])
def test_any_size_gives_finite_flow_of_whole_cells(size):
    images = np.random.default_rng(1).uniform(size=(2, *size, 3)).astype(np.float32)
    flow, sure = video_flow(images)
    assert flow.shape == (2, 2, *(2 * -(-n // 4) for n in size), 2)
    assert np.isfinite(flow).all() and (sure >= 0).all() and (sure <= 1).all()


def test_bytes_and_floats_agree_and_one_frame_has_no_neighbour():
    images = shifted([(0, 0), (1, 0)])
    for a, b in zip(video_flow(images), video_flow(images.astype(np.float32) / 255), strict=True):
        np.testing.assert_array_equal(a, b)
    flow, sure = video_flow(images[:1])
    assert (flow == 0).all() and (sure == 0).all()
