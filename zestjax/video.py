"""A posed video: what every stage above takes as its input.

N        frames; a frame's time is its index
H W      rows and columns of every frame
"""

from typing import NamedTuple

import jax
import numpy as np

from zestjax.cameras import Camera, check_bounds, check_camera
from zestjax.checks import check_shapes


class Video(NamedTuple):
    """images: (N, H, W, 3) RGB in [0, 1]. cameras: `Camera` with (N, ...) leaves. near, far: () depth bounds
    of the whole scene, world units, 0 < near < far."""

    images: jax.Array
    cameras: Camera
    near: jax.Array
    far: jax.Array


def check_video(where, video):
    """Refuse a video that no later stage could use. For arrays with values: call it before `jax.jit`, not inside.

    Args:
      where: name of the calling function, used in the message.
      video: `Video`.

    Raises:
      ValueError: if shapes disagree, a colour is outside [0, 1] or not finite (bytes must be divided by 255), a camera
        is degenerate, or the depth bounds are not 0 < near < far.
    """
    check_shapes(
        where,
        images=(video.images, "N H W 3"),
        intrinsics=(video.cameras.intrinsics, "N 3 3"),
        camera_from_world=(video.cameras.camera_from_world, "N 4 4"),
    )
    images = np.asarray(video.images)
    if images.size == 0 or images.dtype.kind != "f" or not (images.min() >= 0 and images.max() <= 1):
        raise ValueError(f"{where}: `images` should be floats in [0, 1], got {_described(images)}.")
    check_camera(where, video.cameras)
    check_bounds(where, video.near, video.far)


def _described(images):
    values = f" from {images.min()} to {images.max()}" if images.size else ""
    return f"{images.dtype} of shape {images.shape}{values}"
