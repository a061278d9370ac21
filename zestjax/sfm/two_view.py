"""Two frames to start from, and one frame more to cameras that are known.

pixels   (M, 2); centre (2,) and focal in pixels
"""

from typing import NamedTuple

import cv2
import numpy as np

from zestjax.sfm.matching import consensus

THRESHOLD = 1.5  # pixels: an essential matrix has a focal length that may be wrong


class Relative(NamedTuple):
    """rotation (3, 3), translation (3,) of length 1: second camera from first. inliers: (M,) bool."""

    rotation: np.ndarray
    translation: np.ndarray
    inliers: np.ndarray


class Resected(NamedTuple):
    """rotation (3, 3), translation (3,): camera from world. inliers: (M,) bool."""

    rotation: np.ndarray
    translation: np.ndarray
    inliers: np.ndarray


def intrinsics(focal: float, centre: np.ndarray) -> np.ndarray:
    """(3, 3) of square pixels without skew."""
    return np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])


def relative_pose(
    ours: np.ndarray, theirs: np.ndarray, *, focal: float, centre: np.ndarray, seed: int = 0
) -> Relative | None:
    """The pose of the second of two cameras from matches (M, 2) each; None where no essential matrix is found."""
    if len(ours) < 8:
        return None
    matrix = intrinsics(focal, centre)
    essential, kept = cv2.findEssentialMat(
        ours, theirs, matrix, matrix, np.zeros(4), np.zeros(4), consensus(THRESHOLD, seed=seed)
    )
    if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
        return None
    inside = kept.ravel() > 0
    if inside.sum() < 8:
        return None
    _, rotation, translation, front = cv2.recoverPose(essential, ours[inside], theirs[inside], matrix)
    inliers = inside.copy()
    inliers[inside] = front.ravel() > 0
    return Relative(rotation, translation.ravel(), inliers)


def resected(
    points: np.ndarray, pixels: np.ndarray, *, focal: float, centre: np.ndarray, most: float, seed: int = 0
) -> Resected | None:
    """The camera that sees world points (M, 3) at pixels (M, 2); None where none is found.

    Args:
      points: of the scene.
      pixels: where they were seen.
      focal: of the camera.
      centre: its principal point.
      most: pixels that an inlier may be off.
      seed: of the samples.
    """
    if len(points) < 6:
        return None
    params = consensus(most, seed=seed)
    params.score, params.final_polisher = cv2.SCORE_METHOD_MSAC, cv2.LSQ_POLISHER
    params.loMethod = cv2.LOCAL_OPTIM_INNER_LO
    try:
        found, _, turn, shift, inliers = cv2.solvePnPRansac(
            points, pixels, intrinsics(focal, centre), np.zeros(4), params=params
        )
    except cv2.error:
        return None
    if not found or inliers is None or not np.isfinite(turn).all() or not np.isfinite(shift).all():
        return None
    kept = np.zeros(len(points), bool)
    kept[np.asarray(inliers, int).ravel()] = True
    return Resected(cv2.Rodrigues(turn)[0], shift.ravel(), kept)
