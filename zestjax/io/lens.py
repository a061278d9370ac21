"""Lens distortion, taken out where pictures are read, by OpenCV: every camera behind the readers is a pinhole.

stored     of the picture as its file has it, bent by the lens
pinhole    of the picture that it becomes: the same size, cut so that no pixel lies outside the stored one
distortion OpenCV's coefficients k1 k2 p1 p2 k3 k4 k5 k6; the higher k are those of the rational model
"""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from zestjax.base.types import FilePath

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
NODES = 65  # of the grid, across and down, at which a lens is tried
OUTSIDE = 0.5  # pixels by which the undistorted picture may look past the stored one, whose edge is repeated there
ZOOMS = (1, 1.002, 1.005, 1.01, 1.02, 1.05)  # tried in turn until it does not: OpenCV's own cut is by 9 points a side
UNDISTORT = "undistort the pictures with the program that made it (COLMAP: image_undistorter), and read those."


class Lens(NamedTuple):
    """What a lens does to a picture. stored, pinhole: (3, 3) intrinsics in pixels at the cameras' size. distortion:
    (8,)."""

    stored: np.ndarray
    distortion: np.ndarray
    pinhole: np.ndarray


def find_lens(source: FilePath, intrinsics: np.ndarray, distortion: np.ndarray, size: tuple[int, int]) -> Lens | None:
    """The lens of a camera; None of one that bends nothing.

    Args:
      source: file that the camera is of, for the message.
      intrinsics: (3, 3) pixels, whose centres are integers.
      distortion: (8,), see above.
      size: (height, width) that the intrinsics count pixels in.

    Returns:
      `Lens` or None.

    Raises:
      ValueError: skew besides distortion, or a distortion that folds the picture or leaves nothing of it.
    """
    if not distortion.any():
        return None
    if intrinsics[0, 1]:
        raise ValueError(f"{source}: a camera has skew besides distortion, which is not read; {UNDISTORT}")
    height, width = size
    with np.errstate(all="ignore"):
        cut, _ = cv2.getOptimalNewCameraMatrix(intrinsics, distortion, (width, height), 0)
        for zoom in ZOOMS:
            pinhole = _zoomed(cut, zoom, size)
            if _covers(intrinsics, distortion, pinhole, size):
                return Lens(intrinsics, distortion, pinhole)
    said = ", ".join(f"{name} {value:g}" for name, value in zip(COEFFICIENTS, distortion, strict=True) if value)
    raise ValueError(f"{source}: distortion by {said} folds pictures of {height}x{width} (HxW); {UNDISTORT}")


def undistorted(picture: np.ndarray, lens: Lens | None, native: tuple[int, int]) -> np.ndarray:
    """A float picture (H, W, 3) in [0, 1] without its lens's distortion, same size; `native` is the cameras' size."""
    if lens is None:
        return picture
    height, width = picture.shape[:2]
    rows = [tuple(x.ravel()) for x in (_at_size(lens.stored, native, picture), lens.distortion)]
    maps = _maps(*rows, tuple(_at_size(lens.pinhole, native, picture).ravel()), height, width)
    bent = cv2.remap(picture, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(bent, 0, 1)  # cubic weights exceed 1


@lru_cache(maxsize=1)  # most videos have one lens; a map of 1080p has 17 MB
def _maps(stored, distortion, pinhole, height, width):
    """(columns, rows), each (height, width), of the stored picture that every pixel of the undistorted one shows."""
    k, new = (np.reshape(matrix, (3, 3)) for matrix in (stored, pinhole))
    return cv2.initUndistortRectifyMap(k, np.array(distortion), None, new, (width, height), cv2.CV_32FC1)  # pyright: ignore[reportArgumentType, reportCallIssue]


def _covers(k, distortion, pinhole, size):
    """Whether every pixel of the undistorted picture is one of the stored picture, in the same order."""
    if not np.isfinite(pinhole).all() or min(pinhole[0, 0], pinhole[1, 1]) <= 0:
        return False
    height, width = size
    steps = np.array([(NODES - 1) / max(side - 1, 1) for side in (width, height)])
    grid = np.diag([*steps, 1]) @ pinhole
    columns, rows = _maps.__wrapped__(tuple(k.ravel()), tuple(distortion), tuple(grid.ravel()), NODES, NODES)
    inside = lambda x, side: np.isfinite(x).all() and x.min() >= -OUTSIDE and x.max() <= side - 1 + OUTSIDE
    ordered = (np.diff(columns, axis=1) > 0).all() and (np.diff(rows, axis=0) > 0).all()
    return bool(inside(columns, width) and inside(rows, height) and ordered)


def _zoomed(pinhole, zoom, size):
    """The intrinsics of a picture enlarged about its middle."""
    middle = (np.array(size[::-1]) - 1) / 2
    enlarged = np.eye(3)
    enlarged[0, 0] = enlarged[1, 1] = zoom
    enlarged[:2, 2] = middle * (1 - zoom)
    return enlarged @ pinhole


def _at_size(intrinsics, native, picture):
    """Intrinsics of pictures of a size, for one that was resized: pixels' corners keep their place."""
    scale = np.array([have / was for have, was in zip(picture.shape[1::-1], native[::-1], strict=True)])
    resize = np.diag([*scale, 1])
    resize[:2, 2] = (scale - 1) / 2
    return resize @ intrinsics
