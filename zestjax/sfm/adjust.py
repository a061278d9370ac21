"""Bundle adjustment: cameras, focal length and points at once, by Levenberg's and Marquardt's method.

The points' part of the normal equations is block-diagonal, so that a step solves for the cameras alone (Schur's
complement) and then for each point: a step of 24 frames and 1,500 points takes some ten milliseconds. `zestjax.solve`
has jaxopt's solver of small problems, whose Jacobian, of 10,000 rows and 4,500 columns here, would be held whole.
Residuals weigh by Cauchy's function, which what moves, or was matched wrongly, can hardly pull at.

C        unknowns of the cameras, 6 N + 1; the rest as in `zestjax.sfm.bundle`
"""

from typing import NamedTuple

import numpy as np

from zestjax.sfm.bundle import Bundle, Seen, moved, residuals, slopes

SCALE = 1.0  # pixels at which a residual's weight is halved
GAUGE = 1e-10  # of an unknown's own weight
BLOCK = 2000  # points whose share of the cameras' equations is held at a time: 3 * 2000 * C numbers
START, CALMEST, WILDEST = 1e-4, 1e-9, 1e9  # damping: at first; as good as none; a step that is as good as none


class Adjusted(NamedTuple):
    """bundle: `Bundle`. cost: () sum of the robust squares, pixels^2. residuals: (M, 2). focal_error: () standard error
    of the focal length as a share of it; None where it was held. steps: taken. converged: the cost no longer fell."""

    bundle: Bundle
    cost: float
    residuals: np.ndarray
    focal_error: float | None
    steps: int
    converged: bool


class _Equations(NamedTuple):
    """cameras (C, C), points (P, 3, 3), and between them (3, C, P); right-hand sides (C,), (P, 3)."""

    cameras: np.ndarray
    points: np.ndarray
    between: np.ndarray
    by_camera: np.ndarray
    by_point: np.ndarray


def adjust(
    bundle: Bundle,
    seen: Seen,
    *,
    centre: np.ndarray,
    free_focal: bool = True,
    free_poses: bool = True,
    scale: float = SCALE,
    max_steps: int = 50,
    tol: float = 1e-6,
) -> Adjusted:
    """Move cameras and points to where the robust reprojection error is least.

    Args:
      bundle: where to start.
      seen: observations of it; frames and points that nobody sees stay.
      centre: (2,) principal point, pixels.
      free_focal: the focal length may change.
      free_poses: the cameras may move; else only the points, and the focal length if that is free.
      scale: pixels at which a residual's weight is halved.
      max_steps: tried at most.
      tol: stop when a step lowers the cost by a smaller share.

    Returns:
      `Adjusted`. Place, direction and size of the whole are as free as before: damping keeps them near the start.
    """
    free = np.zeros(6 * len(bundle.rotations) + 1, bool)
    free[:-1] = np.repeat(np.isin(np.arange(len(bundle.rotations)), seen.frame), 6) & free_poses
    free[-1] = free_focal and len(seen.frame) > 0
    error = residuals(bundle, seen, centre=centre)
    cost, damping, step, converged = _cost(error, scale), START, 0, len(error) == 0
    equations = _equations(bundle, seen, error, scale)
    while step < max_steps and not converged:
        step += 1
        tried = _points_settled(moved(bundle, *_solved(equations, damping, free)), seen, centre, scale)
        their_error = residuals(tried, seen, centre=centre)
        lower = cost - _cost(their_error, scale)
        if lower > 0:
            bundle, error, cost = tried, their_error, cost - lower
            damping, converged = max(damping / 100, CALMEST), lower < tol * cost
            equations = equations if converged else _equations(bundle, seen, error, scale)
        else:
            damping *= 10
            converged = damping > WILDEST
    focal_error = _focal_error(bundle, seen, error, scale, free) if free[-1] else None
    return Adjusted(bundle, float(cost), error, focal_error, step, bool(converged))


def _points_settled(bundle, seen, centre, scale):
    """The bundle with each point moved by a step of its own, where that lowers its cost.

    Depths answer to a change of the cameras by a curve; without this a step is cut to where that curve is straight."""
    error = residuals(bundle, seen, centre=centre)
    root = np.sqrt(robust_weights(error, scale=scale))[:, None]
    by, count = slopes(bundle, seen).point * root[..., None], len(bundle.points)
    own = _summed(seen.point, np.swapaxes(by, 1, 2) @ by, count)
    right = _summed(seen.point, np.einsum("mka,mk->ma", by, error * root), count)
    diagonal = np.trace(own, axis1=1, axis2=2)[:, None, None]
    step = -np.linalg.solve(own + (CALMEST * diagonal + 1e-12) * np.eye(3), right[..., None])[..., 0]
    tried = bundle._replace(points=bundle.points + step)
    costs = lambda error: np.bincount(seen.point, np.log1p(np.sum(error**2, -1) / scale**2), count)
    better = costs(residuals(tried, seen, centre=centre)) < costs(error)
    return bundle._replace(points=np.where(better[:, None], tried.points, bundle.points))


def robust_weights(error: np.ndarray, *, scale: float = SCALE) -> np.ndarray:
    """(M,) weights in (0, 1] of residuals (M, 2): 1 / (1 + |r|^2 / scale^2)."""
    return 1 / (1 + np.sum(error**2, -1) / scale**2)


def _cost(error, scale):
    return float(np.sum(scale**2 * np.log1p(np.sum(error**2, -1) / scale**2)))


def _equations(bundle, seen, error, scale):
    """The normal equations of the weighted residuals."""
    count, points = len(bundle.rotations), len(bundle.points)
    root = np.sqrt(robust_weights(error, scale=scale))[:, None]
    by, error = slopes(bundle, seen), error * root
    pose, focal, point = by.pose * root[..., None], by.focal * root, by.point * root[..., None]
    cameras = np.zeros((6 * count + 1, 6 * count + 1))
    blocks = _summed(seen.frame, np.einsum("mka,mkb->mab", pose, pose), count)
    border = _summed(seen.frame, np.einsum("mka,mk->ma", pose, focal), count).ravel()
    for i, block in enumerate(blocks):
        cameras[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = block
    cameras[-1, :-1] = cameras[:-1, -1] = border
    cameras[-1, -1] = np.sum(focal**2)
    between = np.zeros((3, 6 * count + 1, points))
    shared = np.swapaxes(pose, 1, 2) @ point
    between[:, :-1].reshape(3, count, 6, points)[:, seen.frame, :, seen.point] = np.moveaxis(shared, 2, 1)
    between[:, -1] = _summed(seen.point, np.einsum("mk,mkb->mb", focal, point), points).T
    by_camera = np.append(
        _summed(seen.frame, np.einsum("mka,mk->ma", pose, error), count).ravel(), np.sum(focal * error)
    )
    own = _summed(seen.point, np.einsum("mka,mkb->mab", point, point), points)
    by_point = _summed(seen.point, np.einsum("mka,mk->ma", point, error), points)
    return _Equations(cameras, own, between, by_camera, by_point)


def _summed(index, values, count):
    """(count, ...) sums of the values (M, ...) of each index."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    sums = np.stack([np.bincount(index, column, count) for column in flat.T], -1)
    return sums.reshape(count, *values.shape[1:])


def _solved(equations, damping, free):
    """(pose (N, 6), log focal, point (P, 3)) of a damped step."""
    reduced, right, inverse = _reduced(equations, damping)
    step = np.zeros(len(free))
    if free.any():
        step[free] = np.linalg.solve(reduced[np.ix_(free, free)], -right[free])
    carried = equations.by_point + (step @ equations.between).T
    return step[:-1].reshape(-1, 6), step[-1], -np.einsum("pij,pj->pi", inverse, carried)


def _reduced(equations, damping):
    """The cameras' equations without the points, their right-hand side, and the points' inverse (P, 3, 3)."""
    grown = lambda diagonal: damping * np.maximum(diagonal, 1e-12 * (1 + diagonal.max(initial=0)))
    diagonal = np.einsum("pii->pi", equations.points)
    inverse = np.linalg.inv(equations.points + grown(diagonal)[..., None] * np.eye(3) + 1e-12 * np.eye(3))
    reduced = equations.cameras + np.diag(grown(np.diag(equations.cameras)) + 1e-12)
    right = equations.by_camera.copy()
    for start in range(0, len(inverse), BLOCK):
        part = slice(start, start + BLOCK)
        between = equations.between[..., part]
        for j in range(3):
            halfway = sum(between[i] * inverse[part, i, j] for i in range(3))
            reduced = reduced - halfway @ between[j].T
            right = right - halfway @ equations.by_point[part, j]
    return reduced, right, inverse


def _focal_error(bundle, seen, error, scale, free):
    """Standard error of the focal length's logarithm, from the noise that the residuals show."""
    reduced, _, _ = _reduced(_equations(bundle, seen, error, scale), CALMEST)
    part = reduced[np.ix_(free, free)]
    size = np.sqrt(np.diag(part))
    # A trace of damping: place, direction and size of the whole are not determined, but do not touch the focal length.
    scaled = part / size / size[:, None] + GAUGE * np.eye(len(part))
    variance = np.linalg.solve(scaled, np.eye(len(part))[-1])[-1] / size[-1] ** 2
    weights = robust_weights(error, scale=scale)
    noise = np.sum(weights * np.sum(error**2, -1)) / max(2 * np.sum(weights), 1)
    return float(np.sqrt(max(variance, 0) * noise))
