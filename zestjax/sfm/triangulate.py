"""Points from where posed cameras saw them, and how well that fixes them; axes as in `zestjax.sfm.bundle`."""

import numpy as np

from zestjax.sfm.bundle import Bundle, Seen, in_cameras, residuals


def triangulated(bundle: Bundle, seen: Seen, *, centre: np.ndarray) -> np.ndarray:
    """(P, 3) world points nearest to the rays that see them, by linear least squares; zeros of those not seen twice.

    Args:
      bundle: the cameras, and as many points as there are to be; where those lie does not matter.
      seen: observations.
      centre: (2,) principal point, pixels.
    """
    image = (seen.pixels - centre) / bundle.focal
    pose = np.concatenate([bundle.rotations, bundle.translations[..., None]], -1)[seen.frame]
    rows = image[..., None] * pose[:, 2:] - pose[:, :2]
    rows = rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True)
    gram = np.zeros((len(bundle.points), 4, 4))
    np.add.at(gram, seen.point, np.einsum("mki,mkj->mij", rows, rows))
    # Solved with the last coordinate at 1; a point at infinity, where that is singular, is put very far away.
    own = gram[:, :3, :3]
    own = own + 1e-12 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-300 * np.eye(3)
    points = np.linalg.solve(own, -gram[:, :3, 3:])[..., 0]
    twice = np.bincount(seen.point, minlength=len(points)) >= 2
    return np.where(twice[:, None], points, 0)


def widest_angles(bundle: Bundle, seen: Seen) -> np.ndarray:
    """(P,) radians: the widest angle between a point's first ray and another one; 0 of points that are seen once."""
    places = -np.einsum("nji,nj->ni", bundle.rotations, bundle.translations)
    rays = bundle.points[seen.point] - places[seen.frame]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    first = np.full(len(bundle.points), len(rays))
    np.minimum.at(first, seen.point, np.arange(len(rays)))
    reference = rays[first[seen.point]] if len(rays) else rays
    angles = np.arctan2(np.linalg.norm(np.cross(reference, rays), axis=1), np.sum(reference * rays, 1))
    widest = np.zeros(len(bundle.points))
    np.maximum.at(widest, seen.point, angles)
    return widest


def sound(bundle: Bundle, seen: Seen, *, centre: np.ndarray, most: float) -> np.ndarray:
    """(M,) bool: the observation's point is in front of the camera and projects to within `most` pixels of it."""
    near = np.linalg.norm(residuals(bundle, seen, centre=centre), axis=1) < most
    return near & (in_cameras(bundle, seen)[:, 2] > 0)
