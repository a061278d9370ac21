"""The cameras of a video: whether its camera moved at all, and where it was at every frame.

N        frames
poses    (N, 4, 4) world_from_camera
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from zestjax.base.types import Array
from zestjax.sfm.bundle import Seen, residuals
from zestjax.sfm.features import find_features
from zestjax.sfm.gauge import camera_poses, depth_bounds, middle_world, transformed_poses
from zestjax.sfm.matching import Pair, frame_pairs, verified_pair
from zestjax.sfm.movers import fundamental_matrix
from zestjax.sfm.reconstruct import Reconstruction, reconstruct
from zestjax.sfm.rotations import nearest_rotation
from zestjax.sfm.tracks import join_matches
from zestjax.sfm.triangulate import widest_angles

USUAL_FOCAL = 0.9  # of a picture's longer side: 58 degrees across, between a telephone's and a camera's
OTHER_FOCALS = (0.6, 1.5)  # tried where the usual one registers too few frames: 80 and 37 degrees
ENOUGH = 0.9  # share of the frames that a start must register for no other one to be tried
STILL = 0.5  # pixels: features are found to half of one, so that a camera that shifts them less stands still
FLAT = 1.0  # pixels that a homography may leave of a camera that only turned, or of a scene that is a plane
STILL_BOUNDS = (1.0, 100.0)  # of a camera without parallax, whose depths nobody knows: any would do
ROUNDS = 10  # of weighting: wrong matches have lost their say after three or four
FEW_PAIRS = 2  # pairs a frame, below which a video does not hang together

Watch = Callable[[Iterable, str], Iterable]  # what shows the progress of a loop: (items, label) -> items


class Estimated(NamedTuple):
    """kind: "moving", "turning" or "still". poses: (N, 4, 4), of frames that are not registered the identity.
    registered: (N,) bool. focal: pixels. focal_error: standard error as a share, or None. near, far: depth bounds.
    features, observations: (N,) int. errors: (N,) median pixels of reprojection, NaN where there is none. points: int.
    angle: degrees, median of the widest angle between a point's rays. near_gap, far_gap: pixels, median epipolar
    distance of matches between frames near in time, and far apart: they differ where the path drifts."""

    kind: str
    poses: np.ndarray
    registered: np.ndarray
    focal: float
    focal_error: float | None
    near: float
    far: float
    features: np.ndarray
    observations: np.ndarray
    errors: np.ndarray
    points: int
    angle: float
    near_gap: float
    far_gap: float


def estimate_cameras(
    images: Sequence[Array],
    *,
    avoid: Sequence[Array | None] | None = None,
    focal: float | None = None,
    start: float | None = None,
    free_focal: bool = True,
    seed: int = 0,
    watch: Watch = lambda items, label: items,
) -> Estimated:
    """The cameras of a video's frames: one pinhole with the principal point in the middle, that moves.

    Args:
      images: N frames (H, W, 3), uint8 or float in [0, 1].
      avoid: (H, W) bool masks of pixels that move, or None, by frame.
      focal: pixels, where it is known; else it is estimated.
      start: pixels, where the estimation begins; by default `USUAL_FOCAL` of the longer side.
      free_focal: estimate the focal length, where it is not known; else it stays where it starts. What moves can bend
        it far, so that a first pass, which does not know what moves, had better hold it.
      seed: of the samples of robust fits.
      watch: shows progress.

    Returns:
      `Estimated`, in the axes of the middle frame and with the near bound at 1.

    Raises:
      ValueError: too few features, or too few of them match, or no two frames fix a scene.
    """
    height, width = images[0].shape[:2]
    centre, masks = np.array([width - 1, height - 1]) / 2, avoid if avoid is not None else [None] * len(images)
    features = [find_features(x, avoid=m) for x, m in zip(watch(images, "features"), masks, strict=True)]
    tried = watch(frame_pairs(len(images)), "matches")
    pairs = [pair for a, b in tried if (pair := verified_pair(a, b, features, seed=seed)) is not None]
    _check_pairs(features, pairs)
    guess = focal or start or USUAL_FOCAL * max(height, width)
    kind = camera_motion(pairs)
    if kind != "moving":
        return _without_parallax(kind, features, pairs, guess, centre)
    tracks = join_matches(features, pairs)
    free, count = focal is None and free_focal, len(images)
    begun = lambda f: reconstruct(tracks, pairs, count, focal=f, centre=centre, free_focal=free, seed=seed)
    best = begun(guess)
    if focal is None and start is None and (best is None or best.registered.mean() < ENOUGH):
        others = [begun(share * max(height, width)) for share in OTHER_FOCALS]
        best = max([best, *others], key=lambda r: (0, 0) if r is None else (r.registered.sum(), r.used.sum()))
    if best is None:
        raise ValueError(
            "estimate_cameras: no two frames fix a common scene: expected a camera that moves sideways past things at "
            "several distances; give a video of one, or a part of this one."
        )
    return _estimated(best, Seen(tracks.frame, tracks.track, tracks.pixels), features, pairs, centre)


def camera_motion(pairs: Sequence[Pair]) -> str:
    """ "still", "turning" (or before a plane: nothing tells how far anything is) or "moving", by what matches show."""
    if np.quantile([pair.shift for pair in pairs], 0.9) < STILL:
        return "still"
    return "turning" if np.quantile([pair.parallax for pair in pairs], 0.9) < FLAT else "moving"


def _check_pairs(features, pairs):
    counts = [len(f.pixels) for f in features]
    if not any(counts):
        raise ValueError("estimate_cameras: the frames have no texture: 0 features in all of them; give other ones.")
    if len(pairs) < min(FEW_PAIRS * len(features), len(features) * (len(features) - 1) // 2):
        raise ValueError(
            f"estimate_cameras: only {len(pairs)} pairs of frames show the same things, with {int(np.median(counts))} "
            "features a frame; give sharper, larger or nearer frames of one scene."
        )


def _without_parallax(kind, features, pairs, focal, centre):
    """A camera that stands still, or turns: its directions, all at one place."""
    count = len(features)
    poses, registered = np.tile(np.eye(4), (count, 1, 1)), np.ones(count, bool)
    if kind == "turning":
        poses[:, :3, :3], registered = _turned(features, pairs, count, focal, centre)
    seen = np.zeros(count, int)
    np.add.at(
        seen, [i for pair in pairs for i in (pair.first, pair.second)], [len(p.matches) for p in pairs for _ in "ab"]
    )
    return Estimated(
        kind, poses, registered, focal, None, *STILL_BOUNDS, _counts(features), seen, np.full(count, np.nan), 0, 0.0,
        0.0, 0.0,
    )  # fmt: skip


def _turned(features, pairs, count, focal, centre):
    """((N, 3, 3) world_from_camera, registered), each frame joined to those before by its most numerous matches."""
    rotations, known = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)
    known[count // 2] = True
    left = sorted(pairs, key=lambda pair: -len(pair.matches))
    while joining := [pair for pair in left if known[pair.first] != known[pair.second]]:
        pair = joining[0]
        ours, theirs = (
            _rays(features[frame].pixels[pair.matches[:, side]], focal, centre)
            for side, frame in enumerate((pair.first, pair.second))
        )
        turn = _turn_between(ours, theirs)  # second from first
        if known[pair.first]:
            rotations[pair.second] = rotations[pair.first] @ turn.T
        else:
            rotations[pair.first] = rotations[pair.second] @ turn
        known[[pair.first, pair.second]] = True
    return rotations, known


def _turn_between(ours, theirs):
    """The rotation that brings most of our rays (M, 3) to theirs: Kabsch's, by what it leaves small."""
    turn = nearest_rotation(theirs.T @ ours)
    for _ in range(ROUNDS):
        gap = np.linalg.norm(theirs - ours @ turn.T, axis=1)
        weights = 1 / (1 + (gap / max(np.median(gap), 1e-12)) ** 2) ** 2
        turn = nearest_rotation((theirs * weights[:, None]).T @ ours)
    return turn


def _rays(pixels, focal, centre):
    rays = np.c_[(pixels - centre) / focal, np.ones(len(pixels))]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _counts(features):
    return np.array([len(f.pixels) for f in features])


def _estimated(found: Reconstruction, seen, features, pairs, centre):
    """What was found, brought to the middle camera's axes."""
    part = Seen(*(leaf[found.used] for leaf in seen))
    near, far = depth_bounds(found.bundle, part)
    poses, index = camera_poses(found.bundle), np.flatnonzero(found.registered)
    world = middle_world(poses[index], 1 / near)
    poses = np.where(found.registered[:, None, None], transformed_poses(world, poses), np.eye(4))
    error = np.linalg.norm(residuals(found.bundle, part, centre=centre), axis=1)
    medians = [np.median(error[part.frame == i]) if (part.frame == i).any() else np.nan for i in range(len(poses))]
    angles = np.degrees(widest_angles(found.bundle, part)[found.known])
    gaps = _gaps(features, pairs, poses, found, centre)
    return Estimated(
        "moving", poses, found.registered, float(found.bundle.focal), found.focal_error, 1.0, far / near,
        _counts(features), np.bincount(part.frame, minlength=len(poses)), np.array(medians), int(found.known.sum()),
        float(np.median(angles)), *gaps,
    )  # fmt: skip


def _gaps(features, pairs, poses, found, centre):
    """Median epipolar distances of matches between frames near in time and far apart, pixels."""
    near, far, reach = [], [], max(len(poses) // 3, 2)
    for pair in (p for p in pairs if found.registered[[p.first, p.second]].all()):
        matrix = fundamental_matrix(
            np.linalg.inv(poses[pair.second]) @ poses[pair.first], found.bundle.focal, centre
        )  # fmt: skip
        here, there = (
            np.c_[features[frame].pixels[pair.matches[:, side]], np.ones(len(pair.matches))]
            for side, frame in enumerate((pair.first, pair.second))
        )
        line = here @ matrix.T
        distance = np.abs(np.sum(line * there, 1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12)
        (near if abs(pair.second - pair.first) < reach else far).append(np.median(distance))
    return tuple(float(np.median(gaps)) if gaps else 0.0 for gaps in (near, far))
