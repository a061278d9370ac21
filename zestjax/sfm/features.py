"""Places of an image that are found again in others.

F        features of an image
pixels   (F, 2) columns and rows; a pixel's centre is at its integer coordinates
"""

from typing import NamedTuple

import cv2
import numpy as np

from zestjax.base.types import Array
from zestjax.frames.optical_flow import as_bytes

MOST = 2000  # of either kind in an image: more cost time and no longer change the poses
CONTRAST = 0.003  # a tenth of OpenCV's: small pictures have few features, and what is weak is checked by geometry
CORNER_SHARE = 0.005  # of the best corner's strength: weaker ones are not found again
CORNER_GAP, CORNER_WINDOW = 4.0, 5  # pixels between two corners, and about one
CORNER_SIZE = 7.0  # pixels: the scale at which a corner is described, that of SIFT's smaller features
EVENED, PARTS = 3.0, (4, 4)  # contrast is raised by so much, part by part of the picture: dark ones have features too


class Features(NamedTuple):
    """pixels: (F, 2) float64. descriptors: (F, 128) float32 of length 1."""

    pixels: np.ndarray
    descriptors: np.ndarray


def find_features(image: Array, *, avoid: Array | None = None, most: int = MOST) -> Features:
    """SIFT's features of an image (Lowe 2004) and its corners (Shi and Tomasi 1994), described alike.

    Corners double what small pictures have. Descriptors are upright, as a video's cameras do not roll far from frame to
    frame, and are roots (Arandjelovic and Zisserman 2012).

    Args:
      image: (H, W, 3) uint8, or float in [0, 1].
      avoid: (H, W) bool, pixels where none is wanted, or None.
      most: of either kind; the strongest stay.

    Returns:
      `Features`, at most one at a place; of an image without texture none.
    """
    grey = cv2.cvtColor(as_bytes(image), cv2.COLOR_RGB2GRAY)
    if grey.min() == grey.max():
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    grey = cv2.createCLAHE(clipLimit=EVENED, tileGridSize=PARTS).apply(grey)
    mask = None if avoid is None else np.where(avoid, 0, 255).astype(np.uint8)
    # Without the precise enlargement OpenCV's places are off by a quarter of a pixel.
    search = cv2.SIFT.create(nfeatures=most, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    points = [*search.detect(grey, mask), *_corners(grey, mask, most)]
    for point in points:
        point.angle = 0.0
    points, described = search.compute(grey, points)
    if described is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    pixels = np.array([point.pt for point in points], np.float64).reshape(-1, 2)
    _, first = np.unique(pixels.round(2), axis=0, return_index=True)  # one place may have had several orientations
    described = described[first]
    return Features(pixels[first], np.sqrt(described / np.maximum(described.sum(1, keepdims=True), 1e-9)))


def _corners(grey, mask, most):
    """Corners as OpenCV's key points, to a fraction of a pixel."""
    found = cv2.goodFeaturesToTrack(grey, most, CORNER_SHARE, CORNER_GAP, mask=mask, blockSize=CORNER_WINDOW)
    if found is None:
        return []
    fine = cv2.cornerSubPix(grey, found, (3, 3), (-1, -1), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01))
    inside = ((fine >= 0) & (fine <= np.array(grey.shape[::-1]) - 1)).all(-1).ravel()
    return [cv2.KeyPoint(float(x), float(y), CORNER_SIZE, 0.0, 1.0, 0) for x, y in fine.reshape(-1, 2)[inside]]
