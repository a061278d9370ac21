"""A posed video: what every stage above takes as its input.

N        frames; a frame's time is its index
H W      rows and columns of every frame
"""

from typing import NamedTuple

import jax
import numpy as np

from zestjax.base.checks import check_known, check_shapes, check_types
from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera, check_bounds, check_camera

ROUNDING = 1e-4  # by which a colour may leave [0, 1]: a resize exceeds it by its sums' rounding, and no eye sees it


class Video(NamedTuple):
    """images: (N, H, W, 3) RGB in [0, 1]. cameras: `Camera` with (N, ...) leaves. near, far: () depth bounds
    of the whole scene, world units, 0 < near < far."""

    images: Array
    cameras: Camera
    near: Scalar
    far: Scalar


class Frames(NamedTuple):
    """Frames of a video that serve a target. images: (V, H, W, 3). cameras: `Camera` (V, ...). valid: (V,) 1, or 0 of
    what is not there and only fills its place. times: (V,) frame times."""

    images: Array
    cameras: Camera
    valid: Array
    times: Array


class Inputs(NamedTuple):
    """All that a view is predicted from. key, slots: `Frames` of the static and of the dynamic field, slots None where
    there is no dynamic field. camera: the target's `Camera`, of the images' size. time: () target frame time.
    duration: () frames of the video. near, far: () world units."""

    key: Frames
    slots: Frames | None
    camera: Camera
    time: Array | np.floating
    duration: Array | np.floating
    near: Array | np.floating
    far: Array | np.floating


def check_video(where: str, video: Video, *, quantised: bool = False) -> Video:
    """Refuse a video that no later stage could use. For arrays with values: call it before `jax.jit`, not inside.

    Args:
      where: name of the calling function, used in the message.
      video: `Video`.
      quantised: uint8 images will do as well, 255 being 1.

    Returns:
      `Video` with images and cameras on the host.

    Raises:
      ValueError: if it is no `Video` of a `Camera`, is traced, shapes disagree, a colour is outside [0, 1] or not
        finite (bytes must be divided by 255), a camera is degenerate, or the depth bounds are not 0 < near < far.
    """
    check_types(where, video=(video, Video))
    check_types(where, cameras=(video.cameras, Camera))
    check_known(where, video=video)
    video = video._replace(images=np.asarray(video.images), cameras=jax.tree.map(np.asarray, video.cameras))
    check_shapes(
        where,
        images=(video.images, "N H W 3"),
        intrinsics=(video.cameras.intrinsics, "N 3 3"),
        camera_from_world=(video.cameras.camera_from_world, "N 4 4"),
        near=(video.near, ""),
        far=(video.far, ""),
    )
    _check_colours(where, video.images, quantised)
    check_camera(where, video.cameras)
    check_bounds(where, video.near, video.far)
    return video


def _check_colours(where, images, quantised):
    if quantised and images.dtype == np.uint8 and images.size:
        return
    low, high = (images.min(), images.max()) if images.size else (1, 0)
    if images.dtype.kind != "f" or not -ROUNDING <= low <= high <= 1 + ROUNDING:
        values = f" from {low:.6g} to {high:.6g}" if images.size else ""
        bytes_ = images.size and (images.dtype.kind in "iu" or high > 1)
        raise ValueError(
            f"{where}: `images` should be floats in [0, 1], got {images.dtype} of shape {images.shape}{values}"
            f"{'; divide bytes by 255' if bytes_ else ''}."
        )
