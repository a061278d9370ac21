"""Which frames of a longer video are kept: sharp ones, evenly in time."""

from collections.abc import Sequence

import cv2
import numpy as np

from zestjax.base.types import Array
from zestjax.frames.optical_flow import as_bytes

CENTRAL = 0.5  # share of a window, about its middle, from which its frame is taken: the steps in time stay even


def sharpness(image: Array) -> float:
    """Variance of the Laplacian of an image's grey values: less where it is blurred, 0 where it has no texture.

    Args:
      image: (H, W, 3) uint8, or float in [0, 1]. Values of one size of image compare, no others.
    """
    return float(cv2.Laplacian(cv2.cvtColor(as_bytes(image), cv2.COLOR_RGB2GRAY), cv2.CV_64F).var())


def chosen_frames(sharp: Sequence[float], *, most: int) -> tuple[int, ...]:
    """Indices of the frames to keep: all if there are no more than `most`, else the sharpest in each of `most` windows.

    Args:
      sharp: `sharpness` of every frame, in the order of time.
      most: frames, at least 1.

    Raises:
      ValueError: `most` is below 1.
    """
    if most < 1:
        raise ValueError(f"chosen_frames: `most` is {most}, expected at least 1.")
    if len(sharp) <= most:
        return tuple(range(len(sharp)))
    edges = np.linspace(0, len(sharp), most + 1)
    chosen = []
    for start, end in zip(edges[:-1], edges[1:], strict=True):
        margin = (1 - CENTRAL) / 2 * (end - start)
        window = range(int(np.ceil(start + margin - 0.5)), int(np.floor(end - margin - 0.5)) + 1)
        window = window or range(int((start + end) / 2), int((start + end) / 2) + 1)
        chosen.append(max(window, key=lambda i: sharp[i]))
    return tuple(chosen)
