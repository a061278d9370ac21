"""A posed video: what every stage above takes as its input.

    N        frames; a frame's time is its index
    H W      rows and columns of every frame
"""

from typing import NamedTuple

import jax

from zestjax.cameras import Camera


class Video(NamedTuple):
    """images: (N, H, W, 3) RGB in [0, 1]. cameras: `Camera` with (N, ...) leaves. near, far: () depth bounds
    of the whole scene, world units, 0 < near < far."""

    images: jax.Array
    cameras: Camera
    near: jax.Array
    far: jax.Array
