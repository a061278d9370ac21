"""Cameras and points that explain where features were seen, and how the error changes with them.

N P M     frames, points, observations
focal     () pixels, one for all frames; square pixels, no distortion
centre    (2,) principal point, pixels
residual  (M, 2) projected less observed, pixels

A longer focal length and a scene that is deeper by the same share look nearly alike. They are therefore changed
together: where `moved` multiplies the focal length, it stretches the scene along the cameras' mean viewing direction.
Without it, an adjustment follows that curved valley in steps of a few percent.
"""

from typing import NamedTuple

import numpy as np

from zestjax.sfm.rotations import cross_matrix, rotation_from_turn

NEAREST = 1e-6  # of a depth: nearer points, and those behind, project as if there, far outside of the image


class Bundle(NamedTuple):
    """rotations: (N, 3, 3), translations: (N, 3), camera from world. focal: (). points: (P, 3) world."""

    rotations: np.ndarray
    translations: np.ndarray
    focal: float
    points: np.ndarray


class Seen(NamedTuple):
    """frame, point: (M,) int, a pair at most once. pixels: (M, 2)."""

    frame: np.ndarray
    point: np.ndarray
    pixels: np.ndarray


class Slopes(NamedTuple):
    """Derivatives of the residual. pose: (M, 2, 6) by a turn and a shift in the camera's axes. focal: (M, 2) by its
    logarithm, the scene being stretched with it. point: (M, 2, 3)."""

    pose: np.ndarray
    focal: np.ndarray
    point: np.ndarray


def in_cameras(bundle: Bundle, seen: Seen) -> np.ndarray:
    """(M, 3) observed points in the axes of the cameras that see them."""
    turned = np.einsum("mij,mj->mi", bundle.rotations[seen.frame], bundle.points[seen.point])
    return turned + bundle.translations[seen.frame]


def residuals(bundle: Bundle, seen: Seen, *, centre: np.ndarray) -> np.ndarray:
    """(M, 2) pixels between where the points project and where they were seen."""
    local = in_cameras(bundle, seen)
    return bundle.focal * local[:, :2] / np.maximum(local[:, 2:], NEAREST) + centre - seen.pixels


def slopes(bundle: Bundle, seen: Seen) -> Slopes:
    """The derivatives of `residuals` by what `moved` takes."""
    local = in_cameras(bundle, seen)
    depth = np.maximum(local[:, 2], NEAREST)
    image = local[:, :2] / depth[:, None]
    by_local = np.zeros((len(local), 2, 3))
    by_local[:, 0, 0] = by_local[:, 1, 1] = bundle.focal / depth
    by_local[:, :, 2] = -bundle.focal * image / depth[:, None] * (local[:, 2] > NEAREST)[:, None]
    by_turn = -by_local @ cross_matrix(local - bundle.translations[seen.frame])
    by_point = by_local @ bundle.rotations[seen.frame]
    along = (bundle.rotations @ viewing_direction(bundle))[seen.frame]
    stretched = along * np.sum(along * local, -1, keepdims=True)
    by_focal = bundle.focal * image + (by_local @ stretched[..., None])[..., 0]
    return Slopes(np.concatenate([by_turn, by_local], -1), by_focal, by_point)


def viewing_direction(bundle: Bundle) -> np.ndarray:
    """(3,) mean of the cameras' viewing directions, world, of length 1."""
    mean = bundle.rotations[:, 2].mean(0)
    length = np.linalg.norm(mean)
    return mean / length if length > 1e-6 else bundle.rotations[0, 2]  # they look all around: any direction will do


def moved(bundle: Bundle, pose: np.ndarray, log_focal: float, point: np.ndarray) -> Bundle:
    """A bundle a step further: `pose` (N, 6) turns and shifts in the cameras' axes, `point` (P, 3) shifts; the focal
    length and the scene's depth grow by a factor exp(`log_focal`)."""
    axis, factor = viewing_direction(bundle), float(np.exp(log_focal))
    stretch = np.eye(3) + (factor - 1) * np.outer(axis, axis)
    places = -np.einsum("nji,nj->ni", bundle.rotations, bundle.translations) @ stretch
    translations = -np.einsum("nij,nj->ni", bundle.rotations, places) + pose[:, 3:]
    turn = rotation_from_turn(pose[:, :3])
    return Bundle(turn @ bundle.rotations, translations, bundle.focal * factor, bundle.points @ stretch + point)
