"""Optical flow between the frames of a video, by OpenCV's dense inverse search: host arrays, found once a video.

N        frames
flow     (2, ..., 2) image pixels, to the next frame and to the previous one, in this order
sure     in [0, 1], how well the flow there and the flow back cancel
"""

from typing import NamedTuple

import cv2
import numpy as np

from zestjax.base.types import Array

LEAST_SIDE = 16  # pixels; smaller images are enlarged for the search


class VideoFlow(NamedTuple):
    """Of every frame. flow: (N, 2, 2h, 2w, 2) float32 image pixels, at half resolution. sure: (N, 2, 2h, 2w) float32;
    0 at the ends of the video, where there is no such neighbour."""

    flow: np.ndarray
    sure: np.ndarray


def video_flow(images: Array) -> VideoFlow:
    """Optical flow from every frame to its two neighbours in time.

    Args:
      images: (N, H, W, 3) uint8, or float in [0, 1].

    Returns:
      `VideoFlow`; rows and columns are half the images', rounded up to an even number.
    """
    images = as_bytes(images)
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    size = tuple(2 * -(-n // 4) for n in images.shape[1:3])
    flow = np.zeros((len(images), 2, *size, 2), np.float32)
    sure = np.zeros((len(images), 2, *size), np.float32)
    search = _search()
    for i in range(len(images) - 1):
        there, back = _dense_flow(search, grey[i], grey[i + 1]), _dense_flow(search, grey[i + 1], grey[i])
        flow[i, 0], sure[i, 0] = _halved(there, agreement(there, back), size)
        flow[i + 1, 1], sure[i + 1, 1] = _halved(back, agreement(back, there), size)
    return VideoFlow(flow, sure)


def as_bytes(images: Array) -> np.ndarray:
    """Images as uint8; floats are of [0, 1]."""
    images = np.asarray(images)
    return images if images.dtype == np.uint8 else np.round(255 * np.clip(images, 0, 1)).astype(np.uint8)


def dense_flow(image: Array, other: Array) -> np.ndarray:
    """(H, W, 2) pixels from one (H, W, 3) uint8 image to another."""
    grey = (cv2.cvtColor(np.asarray(x), cv2.COLOR_RGB2GRAY) for x in (image, other))
    return _dense_flow(_search(), *grey)


def _search():
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)  # full resolution: half the error for three times the 5 ms
    return search


def _dense_flow(search, image, other):
    """(H, W, 2) pixels from one grey image to another."""
    height, width = image.shape
    scale = max(1, -(-LEAST_SIDE // min(height, width)))
    if scale > 1:
        grown = [cv2.resize(x, (scale * width, scale * height), interpolation=cv2.INTER_LINEAR) for x in (image, other)]
        return cv2.resize(search.calc(*grown, None), (width, height), interpolation=cv2.INTER_AREA) / scale
    return search.calc(image, other, None)


def agreement(there: np.ndarray, back: np.ndarray) -> np.ndarray:
    """(H, W) exp(-(|there + back| / 1.5 pixels)^2) of flows (H, W, 2), 0 where the flow there leaves the image."""
    height, width = there.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float32)
    x, y = u + there[..., 0], v + there[..., 1]
    returned = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    # There and back, sound flow is off by less than a pixel and a half: a guess that was never varied.
    return inside * np.exp(-np.sum((there + returned) ** 2, -1) / 1.5**2)


def _halved(flow, sure, size):
    """At half resolution, means of 2 x 2 pixels; the remainder at the right and bottom repeats the edge."""
    both = np.concatenate([flow, sure[..., None]], -1)
    height, width = both.shape[:2]
    both = np.pad(both, [(0, 2 * size[0] - height), (0, 2 * size[1] - width), (0, 0)], mode="edge")
    both = both.reshape(size[0], 2, size[1], 2, 3).mean((1, 3))
    return both[..., :2], both[..., 2]
