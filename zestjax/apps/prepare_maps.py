"""What each frame of a scene shows once its camera is known: flow, moving pixels, inverse depth.

N        frames that have a camera
H W      rows and columns
"""

from typing import NamedTuple

import cv2
import jax
import numpy as np

from zestjax import novel_view
from zestjax.apps.weights import open_weights
from zestjax.cameras import Camera
from zestjax.frames.optical_flow import agreement, dense_flow
from zestjax.sfm.movers import cleaned, epipolar_distance, fundamental_matrix, moving_pixels, turning_distance
from zestjax.sfm.two_view import intrinsics
from zestjax.video import Video

MARGIN = 3  # pixels about what moves where no feature is taken: its outline moves too, and its shadow begins there


class Maps(NamedTuple):
    """moving: (N, H, W) bool. disparity: (N, H, W) float32, 1 / world unit; None where nothing tells depth."""

    moving: np.ndarray
    disparity: np.ndarray | None


class FlowPair(NamedTuple):
    """Between two frames: there, back (H, W, 2) pixels; sure_there, sure_back (H, W) in [0, 1]."""

    there: np.ndarray
    back: np.ndarray
    sure_there: np.ndarray
    sure_back: np.ndarray


def flow_between(image, other):
    """`FlowPair` of two (H, W, 3) uint8 images."""
    there, back = dense_flow(image, other), dense_flow(other, image)
    return FlowPair(there, back, agreement(there, back), agreement(back, there))


def scene_video(images, cameras):
    """The `Video` of the frames that `sfm.estimate.Estimated` has a camera for."""
    index = np.flatnonzero(cameras.registered)
    height, width = images.shape[1:3]
    centre = np.array([width - 1, height - 1]) / 2
    matrix = np.tile(intrinsics(cameras.focal, centre), (len(index), 1, 1))
    pose = np.linalg.inv(cameras.poses[index])
    posed = Camera(matrix.astype(np.float32), pose.astype(np.float32))
    return Video(images[index].astype(np.float32) / 255, posed, np.float32(cameras.near), np.float32(cameras.far))


def frame_maps(video, cameras, flows):
    """`Maps` of a video: what moves by the flow's own geometry, and by the shipped weights' analysis of single frames,
    which tells depth too.

    Args:
      video: `Video` of the registered frames.
      cameras: `Estimated`.
      flows: `FlowPair` from each frame to the next, one fewer than frames.
    """
    poses, centre = np.asarray(video.cameras.camera_from_world, np.float64), video.cameras.intrinsics[0, :2, 2]
    moving = []
    for i in range(len(poses)):
        near = [(i + 1, flows[i].there, flows[i].sure_there)] if i + 1 < len(poses) else []
        near += [(i - 1, flows[i - 1].back, flows[i - 1].sure_back)] if i else []
        apart = [_apart(flow, poses[j] @ np.linalg.inv(poses[i]), cameras, centre) for j, flow, _ in near]
        moving.append(moving_pixels(np.stack(apart), np.stack([sure for _, _, sure in near])))
    if cameras.kind != "moving":
        return Maps(np.stack(moving), None)
    model = open_weights()
    maps = jax.tree.map(np.asarray, novel_view.prepare(model.params, video, system=model.system).maps)
    size = video.images.shape[1:3]
    learned = np.stack([_grown(logit, size, 2) > 0 for logit in maps.moving_logits])
    coordinate = np.stack([_grown(own, size, 4) for own in maps.coordinate])
    disparity = 1 / video.near + coordinate * (1 / video.far - 1 / video.near)
    both = np.stack([cleaned(a | b) for a, b in zip(moving, learned, strict=True)])
    return Maps(both, disparity.astype(np.float32))


def avoided(moving):
    """(N, H, W) bool where no feature is taken."""
    kernel = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
    return np.stack([cv2.dilate(mask.astype(np.uint8), kernel) > 0 for mask in moving])


def _apart(flow, relative, cameras, centre):
    if cameras.kind == "moving":
        return epipolar_distance(flow, fundamental_matrix(relative, cameras.focal, centre))
    return turning_distance(flow, relative[:3, :3], cameras.focal, centre)


def _grown(values, size, factor):
    """(H, W) of maps whose pixels are `factor` of the image's: enlarged, without what the image lacks."""
    height, width = (factor * n for n in values.shape)
    large = cv2.resize(values.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return large[: size[0], : size[1]]
