"""The frame between two frames of one video, by their optical flow: on the host; nothing is learned.

It is the third floor of `evaluate`, and stands in for the frame of a target's time where that may not be read.

before, after   the nearest frames on either side of the time that may be used
share           of the way from the one before to the one after, in (0, 1)
flow            (H, W, 2) pixels, column and row, from one of the two to the other
"""

from collections.abc import Collection
from typing import Any, NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np

from zestjax.base.types import Array
from zestjax.cameras import Camera
from zestjax.frames.assembly import Footage, footage, taken
from zestjax.frames.optical_flow import VideoFlow, agreement, as_bytes, dense_flow
from zestjax.video import Video

LEAST_SURE = 0.6
"""Of a frame that may stand in for another: there and back, the flow of a video agrees over 0.63 to 0.98 of a frame, of
photographs from far apart over 0.02 to 0.49, and what it makes of those cost 1.4 to 5.6 dB (fern, DTU). Between them,
thin bars (zest-bench's lattice, 0.35 to 0.57), which are better without it too."""


class Interpolated(NamedTuple):
    """The frame between. image: (H, W, 3) float32 in [0, 1]. before, after: which frames it is between. share: see the
    header. sure: in [0, 1], over how much of them the flow there and the flow back agree."""

    image: np.ndarray
    before: int
    after: int
    share: float
    sure: float


def flow_interpolation(images: Array, time: int, *, exclude: Collection[int] = ()) -> Interpolated | None:
    """The frame at a time, of the nearest frames before and after it, carried there by their flow and averaged.

    It knows nothing of cameras: it predicts what the video's own camera showed at that time. Each pixel looks back and
    ahead along the flow that crosses it: both flows, there and back, turned and shortened to the time, the nearer
    frame's counting the more.

    Source: zestjax, accuracy floor 3. Super SloMo (Jiang et al. 2018) eq. 4 for the flows; without its networks.

    Args:
      images: (N, H, W, 3) uint8, or float in [0, 1].
      time: frame index; that frame is never used.
      exclude: indices of frames that may not be used.

    Returns:
      `Interpolated`, or None at the ends of the video, where there is no frame on one side.
    """
    usable = [i for i in range(len(images)) if i != time and i not in exclude]
    before = max((i for i in usable if i < time), default=None)
    after = min((i for i in usable if i > time), default=None)
    if before is None or after is None:
        return None
    ends = as_bytes(np.stack([np.asarray(images[before]), np.asarray(images[after])]))
    share = (time - before) / (after - before)
    there, back = dense_flow(ends[0], ends[1]), dense_flow(ends[1], ends[0])
    sure = float(np.mean([agreement(there, back), agreement(back, there)]))
    to_before = share * (share * back - (1 - share) * there)
    to_after = (1 - share) * ((1 - share) * there - share * back)
    shown = (1 - share) * _carried(ends[0], to_before) + share * _carried(ends[1], to_after)
    return Interpolated(np.clip(shown / 255, 0, 1).astype(np.float32), before, after, share, sure)


def _carried(image, flow):
    """The image read where each pixel's flow ends; its edge is repeated outside."""
    rows, columns = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    at = columns + flow[..., 0], rows + flow[..., 1]
    return cv2.remap(image.astype(np.float32), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def camera_between(first: Camera, second: Camera, share: float) -> Camera:
    """The camera a share of the way from one to another: intrinsics and centre on a line, the turn about one axis."""
    (k, pose), (k_end, pose_end) = (
        [np.asarray(leaf, np.float64) for leaf in (camera.intrinsics, camera.camera_from_world)]
        for camera in (first, second)
    )
    turn, turn_end = pose[:3, :3], pose_end[:3, :3]
    axis, _ = cv2.Rodrigues(turn_end @ turn.T)
    turned: Any = cv2.Rodrigues(share * axis)[0] @ turn
    centre = -(1 - share) * turn.T @ pose[:3, 3] - share * turn_end.T @ pose_end[:3, 3]
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turned, -turned @ centre
    return Camera(((1 - share) * k + share * k_end).astype(np.float32), found.astype(np.float32))


def with_stand_in(
    video: Video, seen: Footage, time: int, *, exclude: Collection[int] = ()
) -> tuple[Video, Footage] | None:
    """The video, and its `Footage`, whose frame at a time is the one between its neighbours; that frame is not read.

    Args:
      video: `Video` on the host.
      seen: its `Footage`.
      time: frame index.
      exclude: indices of frames that may not be used.

    Returns:
      (`Video`, `Footage`), or None where `flow_interpolation` has none, or is not sure: the frames around the time show
      the scene from too far apart.
    """
    found = flow_interpolation(video.images, time, exclude=exclude)
    if found is None or found.sure < LEAST_SURE:
        return None
    camera = camera_between(taken(video.cameras, found.before), taken(video.cameras, found.after), found.share)
    images = np.array(video.images)
    images[time] = as_bytes(found.image) if images.dtype == np.uint8 else found.image
    cameras = with_camera(video.cameras, time, camera)
    return video._replace(images=images, cameras=cameras), _footage_around(images, seen, time)


def _footage_around(images, seen, time):
    """`Footage` found anew for one frame and, at its neighbours, for what they see of it."""
    first, last = max(time - 1, 0), min(time + 1, len(images) - 1)
    near = footage(images[first : last + 1])
    flow, sure = np.array(seen.flow.flow), np.array(seen.flow.sure)
    for frame, way in ((time, 0), (time, 1), (time - 1, 0), (time + 1, 1)):
        if first <= frame <= last:
            flow[frame, way], sure[frame, way] = near.flow.flow[frame - first, way], near.flow.sure[frame - first, way]
    half = jnp.asarray(seen.half).at[time].set(near.half[time - first])
    return Footage(half, VideoFlow(flow, sure))


def with_camera(cameras: Camera, index: int, camera: Camera) -> Camera:
    """`Camera` (N, ...) on the host, one of them replaced."""
    found = Camera(*(np.array(leaf) for leaf in cameras))
    for leaf, new in zip(found, camera, strict=True):
        leaf[index] = new
    return found
