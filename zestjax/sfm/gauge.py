"""Which world the cameras stand in: structure from motion leaves its place, direction and size open.

N        frames
poses    (N, 4, 4) world_from_camera
"""

from typing import NamedTuple

import numpy as np

from zestjax.sfm.bundle import Bundle, Seen, in_cameras
from zestjax.sfm.rotations import nearest_rotation, rotation_angle

NEAR_SHARE, FAR_SHARE = 0.7, 1.3  # of the outermost depths: what moves, and what has no features, lies outside of them
OUTERMOST = 1.0  # percent of the observations that are left out at either end: wrong matches are among them


class Similarity(NamedTuple):
    """new = scale * rotation @ old + offset. rotation: (3, 3). offset: (3,)."""

    scale: float
    rotation: np.ndarray
    offset: np.ndarray


class PoseErrors(NamedTuple):
    """degrees: (N,) by which cameras are turned. share: (N,) by which they are off, of the true path's extent."""

    degrees: np.ndarray
    share: np.ndarray


def camera_poses(bundle: Bundle) -> np.ndarray:
    """(N, 4, 4) world_from_camera of a bundle's cameras."""
    poses = np.tile(np.eye(4), (len(bundle.rotations), 1, 1))
    poses[:, :3, :3] = np.swapaxes(bundle.rotations, 1, 2)
    poses[:, :3, 3] = -np.einsum("nji,nj->ni", bundle.rotations, bundle.translations)
    return poses


def transformed_poses(similarity: Similarity, poses: np.ndarray) -> np.ndarray:
    """(N, 4, 4) the same cameras in the other world."""
    moved = poses.copy()
    moved[:, :3, :3] = similarity.rotation @ poses[:, :3, :3]
    moved[:, :3, 3] = similarity.scale * poses[:, :3, 3] @ similarity.rotation.T + similarity.offset
    return moved


def align_poses(poses: np.ndarray, true: np.ndarray) -> Similarity:
    """The similarity that brings poses nearest to others of the same cameras.

    Directions are aligned first, as a straight path's places leave the turn about it open; then size and place.

    Args:
      poses: (N, 4, 4).
      true: (N, 4, 4).
    """
    rotation = nearest_rotation(np.einsum("nij,nkj->ik", true[:, :3, :3], poses[:, :3, :3]))
    turned = poses[:, :3, 3] @ rotation.T
    ours, theirs = turned - turned.mean(0), true[:, :3, 3] - true[:, :3, 3].mean(0)
    size = np.sum(ours**2)
    scale = float(np.sum(ours * theirs) / size) if size > 0 else 1.0
    return Similarity(scale, rotation, true[:, :3, 3].mean(0) - scale * turned.mean(0))


def pose_errors(poses: np.ndarray, true: np.ndarray) -> PoseErrors:
    """How far poses are from true ones once aligned; the extent is the largest distance of two true cameras."""
    aligned = transformed_poses(align_poses(poses, true), poses)
    relative = np.swapaxes(aligned[:, :3, :3], 1, 2) @ true[:, :3, :3]
    places = true[:, :3, 3]
    extent = np.linalg.norm(places[:, None] - places[None], axis=-1).max()
    apart = np.linalg.norm(aligned[:, :3, 3] - places, axis=1)
    return PoseErrors(np.degrees(rotation_angle(relative)), apart / max(extent, 1e-12))


def depth_bounds(bundle: Bundle, seen: Seen) -> tuple[float, float]:
    """(near, far) that hold all but the outermost of the points seen, with room for what is not among them."""
    near, far = np.percentile(in_cameras(bundle, seen)[:, 2], [OUTERMOST, 100 - OUTERMOST])
    return NEAR_SHARE * float(near), FAR_SHARE * float(far)


def middle_world(poses: np.ndarray, scale: float) -> Similarity:
    """The similarity to the world whose axes are the middle camera's, where lengths are `scale` times as large."""
    middle = poses[len(poses) // 2]
    rotation = middle[:3, :3].T
    return Similarity(scale, rotation, -scale * rotation @ middle[:3, 3])
