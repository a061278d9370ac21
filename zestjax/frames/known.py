"""What is known of a real video beside its frames: priors and masks, each None where nobody says.

N        frames
H W      rows and columns
"""

from typing import NamedTuple

import numpy as np

from zestjax.base.checks import check_shapes
from zestjax.video import Video


class KnownFrames(NamedTuple):
    """Host arrays to learn from. images: (N, H, W, 3) uint8. intrinsics: (N, 3, 3). camera_from_world: (N, 4, 4). near,
    far: () world units. What may be None:

    moving: (N, H, W) bool, what moves, to learn from; also says what stands still. mined: (N, H, W) bool, where rays
    are drawn more often. disparity: (N, H, W) up to a scale and a shift, not finite where unknown. flow:
    (N, 2, H, W, 2) pixels to the next frame and to the previous. flow_valid: (N, 2, H, W) bool, where it is to be
    believed.
    """

    images: np.ndarray
    intrinsics: np.ndarray
    camera_from_world: np.ndarray
    near: np.floating
    far: np.floating
    moving: np.ndarray | None = None
    mined: np.ndarray | None = None
    disparity: np.ndarray | None = None
    flow: np.ndarray | None = None
    flow_valid: np.ndarray | None = None


def known_frames(
    video: Video,
    *,
    moving: np.ndarray | None = None,
    mined: np.ndarray | None = None,
    disparity: np.ndarray | None = None,
    flow: np.ndarray | None = None,
    flow_valid: np.ndarray | None = None,
) -> KnownFrames:
    """`KnownFrames` of a video on the host, and of what else is known; see there.

    Raises:
      ValueError: an array of other frames or another size; a flow without its validity.
    """
    sizes = dict(images=(video.images, "N H W 3"))
    given = dict(moving=(moving, "N H W"), mined=(mined, "N H W"), disparity=(disparity, "N H W"),
                 flow=(flow, "N 2 H W 2"), flow_valid=(flow_valid, "N 2 H W"))  # fmt: skip
    check_shapes("known_frames", **sizes, **{name: pair for name, pair in given.items() if pair[0] is not None})
    if (flow is None) != (flow_valid is None):
        raise ValueError("known_frames: `flow` and `flow_valid` belong together; give both or neither.")
    images = np.asarray(video.images)
    images = images if images.dtype == np.uint8 else np.round(images * 255).astype(np.uint8)
    intrinsics, pose = (np.asarray(leaf) for leaf in video.cameras)
    near, far = np.float32(video.near), np.float32(video.far)
    return KnownFrames(images, intrinsics, pose, near, far, moving, mined, disparity, flow, flow_valid)


def answers_of(known: KnownFrames) -> frozenset[str]:
    """Which of `terms.ANSWERS` targets of these frames have."""
    has = dict(moving=known.moving, static=known.moving, disparity=known.disparity, pixel_flow=known.flow)
    return frozenset(name for name, value in has.items() if value is not None)


def shared(frames: list[KnownFrames]) -> list[KnownFrames]:
    """Several videos with only what is known of all of them, so that one program learns from each."""
    names = ("moving", "mined", "disparity", "flow", "flow_valid")
    lost = [name for name in names if any(getattr(known, name) is None for known in frames)]
    return [known._replace(**dict.fromkeys(lost)) for known in frames]
