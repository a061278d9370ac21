"""Cameras of all frames from tracks: two frames first, then the ones that see most of what is known.

N M P    frames, observations, tracks
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zestjax.sfm.adjust import SCALE, adjust
from zestjax.sfm.bundle import Bundle, Seen, residuals
from zestjax.sfm.matching import Pair
from zestjax.sfm.tracks import Tracks
from zestjax.sfm.triangulate import sound, triangulated, widest_angles
from zestjax.sfm.two_view import relative_pose, resected

LEAST_ANGLE = np.radians(1.0)  # between a point's rays: below, a pixel moves its depth by a third and more
START_ANGLE = np.radians(4.0)  # between the rays of the first two frames: as wide as most of them still overlap
LEAST_SEEN = 15  # known points that a frame must see to be added: chance agrees with six or seven
LOOSE = 4.0  # pixels of error that an observation may have while cameras are rough
TIGHT = (0.5, 2.0)  # pixels, between which the same lies at the end
FIRM, SCALES = 2.0, (0.1, 1.0)  # medians at which a weight is halved at the end, within these pixels
SPREAD = 5.0  # medians of the error that noise stays within: of two normal coordinates all but 1e-7
STARTS = 12  # pairs of frames that are tried as the first one
GROWN = 3  # of them that are grown to all frames: one may start on what moves
TOGETHER = 0.7  # frames that see so large a share of what the best one sees are added with it


class Reconstruction(NamedTuple):
    """bundle: `Bundle` of all frames and tracks. registered: (N,) bool, frames whose camera is known. known: (P,) bool,
    tracks whose point is. used: (M,) bool, observations that agree. focal_error: () as a share, or None."""

    bundle: Bundle
    registered: np.ndarray
    known: np.ndarray
    used: np.ndarray
    focal_error: float | None


class _Task(NamedTuple):
    """What does not change: tracks, their observations as `Seen`, (2,) centre, whether the focal length may, seed."""

    tracks: Tracks
    seen: Seen
    centre: np.ndarray
    free_focal: bool
    seed: int


def reconstruct(
    tracks: Tracks,
    pairs: Sequence[Pair],
    count: int,
    *,
    focal: float,
    centre: np.ndarray,
    free_focal: bool = True,
    seed: int = 0,
) -> Reconstruction | None:
    """Cameras and points of a video.

    Args:
      tracks: of its features.
      pairs: verified matches, from which the first two frames are chosen.
      count: N.
      focal: pixels, to start from.
      centre: (2,) principal point, pixels.
      free_focal: adjust the focal length too.
      seed: of what is drawn.

    Returns:
      `Reconstruction`, in the first frame's axes and with two cameras at distance 1; None where no two frames see
      enough from places far enough apart.
    """
    task = _Task(tracks, Seen(tracks.frame, tracks.track, tracks.pixels), centre, free_focal, seed)
    grown = [_grown(task, start, count) for start in _starts(task, pairs, count, focal)]
    if not grown:
        return None
    # What moves alike makes a world of its own; the one that explains most is the still one, where that is larger.
    state = max(grown, key=lambda state: (state.registered.sum(), state.used.sum()))
    state = _refined(task, _with_points(task, state, LOOSE), LOOSE, steps=40)
    for free_focal in (False, task.free_focal, task.free_focal):
        noise = _noise(task, state)
        most, scale = float(np.clip(SPREAD * noise, *TIGHT)), float(np.clip(FIRM * noise, *SCALES))
        state = _with_points(task, state, most)
        state = _refined(task, state, most, steps=40, free_focal=free_focal, scale=scale)
    return state


def _noise(task, state):
    """Pixels: the median error of the observations that are used."""
    error = np.linalg.norm(residuals(state.bundle, _part(task.seen, state.used), centre=task.centre), axis=1)
    return float(np.median(error)) if len(error) else 1.0


def _grown(task, state, count):
    """The state with every frame that sees enough of what is known by then."""
    refused = np.zeros(count, bool)
    while (joining := _joining(task, state, refused)).size:
        before = state.registered.sum()
        for frame in joining:
            state, refused = _with_frame(task, state, int(frame), refused)
        if state.registered.sum() > before:
            state = _refined(task, _with_points(task, state, LOOSE), LOOSE, steps=8)
            refused[:] = False
    return state


def _starts(task, pairs, count, focal):
    """The pairs of frames whose points are many and seen from far enough apart, each alone, the best first."""
    ranked = sorted(pairs, key=lambda pair: -len(pair.matches) * min(pair.parallax, 4.0))[:STARTS]
    found = [start for pair in ranked if (start := _pair_start(task, pair, count, focal)) is not None]
    return [start for _, start in sorted(found, key=lambda start: -start[0])[:GROWN]]


def _pair_start(task, pair, count, focal):
    """(worth, `Reconstruction` of these two frames), or None."""
    ours = _where(task.tracks, pair.first)
    theirs = _where(task.tracks, pair.second)
    shared, a, b = np.intersect1d(task.tracks.track[ours], task.tracks.track[theirs], return_indices=True)
    places = task.tracks.pixels[ours[a]], task.tracks.pixels[theirs[b]]
    pose = relative_pose(*places, focal=focal, centre=task.centre, seed=task.seed)
    if pose is None or pose.inliers.sum() < 2 * LEAST_SEEN:
        return None
    registered = np.zeros(count, bool)
    registered[[pair.first, pair.second]] = True
    rotations, translations = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    rotations[pair.second], translations[pair.second] = pose.rotation, pose.translation
    points = task.tracks.total
    bundle = Bundle(rotations, translations, focal, np.zeros((points, 3)))
    state = Reconstruction(bundle, registered, np.zeros(points, bool), np.zeros(len(task.seen.frame), bool), None)
    state = _with_points(task, state, LOOSE)
    angles = widest_angles(state.bundle, _part(task.seen, state.used))[state.known]
    if len(angles) < 2 * LEAST_SEEN:
        return None
    return len(angles) * min(float(np.median(angles)) / START_ANGLE, 1.0), state


def _where(tracks, frame):
    return np.flatnonzero(tracks.frame == frame)


def _part(seen, mask):
    return Seen(seen.frame[mask], seen.point[mask], seen.pixels[mask])


def _joining(task, state, refused):
    """Frames to add next: the one that sees most known points, and those that see nearly as many."""
    visible = state.known[task.seen.point]
    seen = np.bincount(task.seen.frame[visible], minlength=len(state.registered))
    seen[state.registered | refused] = 0
    if seen.max(initial=0) < LEAST_SEEN:
        return np.zeros(0, int)
    return np.flatnonzero(seen >= max(TOGETHER * seen.max(), LEAST_SEEN))


def _with_frame(task, state, frame, refused):
    """The state with one frame more, or with that frame among the refused."""
    own = np.flatnonzero((task.seen.frame == frame) & state.known[task.seen.point])
    points, bundle = state.bundle.points[task.seen.point[own]], state.bundle
    pose = resected(
        points, task.seen.pixels[own], focal=bundle.focal, centre=task.centre, most=LOOSE, seed=task.seed
    )  # fmt: skip
    if pose is None or pose.inliers.sum() < LEAST_SEEN:
        refused[frame] = True
        return state, refused
    rotations, translations = bundle.rotations.copy(), bundle.translations.copy()
    rotations[frame], translations[frame] = pose.rotation, pose.translation
    registered, used = state.registered.copy(), state.used.copy()
    registered[frame], used[own[pose.inliers]] = True, True
    bundle = bundle._replace(rotations=rotations, translations=translations)
    return state._replace(bundle=bundle, registered=registered, used=used), refused


def _with_points(task, state, most):
    """The state with the points that the registered frames fix: seen soundly by two or more, from apart."""
    there = state.registered[task.seen.frame]
    fresh = there & ~state.known[task.seen.point]
    placed = state.bundle._replace(
        points=triangulated(state.bundle, _part(task.seen, fresh), centre=task.centre)
    )  # fmt: skip
    points = np.where(state.known[:, None], state.bundle.points, placed.points)
    bundle = state.bundle._replace(points=points)
    used = there & sound(bundle, task.seen, centre=task.centre, most=most)
    part = _part(task.seen, used)
    known = np.bincount(part.point, minlength=len(points)) >= 2
    known &= widest_angles(bundle, part) > LEAST_ANGLE
    return state._replace(bundle=bundle, known=known, used=used & known[task.seen.point])


def _refined(task, state, most, *, steps, free_focal=False, scale=SCALE):
    """The state after a bundle adjustment of what is used, without what no longer agrees."""
    columns = np.flatnonzero(state.known)
    index = np.full(len(state.known), -1)
    index[columns] = np.arange(len(columns))
    part = _part(task.seen, state.used)
    part = part._replace(point=index[part.point])
    small = state.bundle._replace(points=state.bundle.points[columns])
    found = adjust(small, part, centre=task.centre, free_focal=free_focal, scale=scale, max_steps=steps)
    points = state.bundle.points.copy()
    points[columns] = found.bundle.points
    bundle = found.bundle._replace(points=points)
    used = state.used & sound(bundle, task.seen, centre=task.centre, most=most)
    return state._replace(bundle=bundle, used=used, focal_error=found.focal_error)
