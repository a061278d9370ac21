"""The ceiling beside every table: what the inputs say about a view when its depth and motion are known.

N        input frames
H W      rows and columns
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.numerics import safe_divide
from zestjax.base.types import Scalar
from zestjax.cameras import Camera
from zestjax.resample import bilinear
from zestjax.simulate.clips import take_camera, without_noise
from zestjax.simulate.render import render
from zestjax.simulate.truth import correspond
from zestjax.simulate.types import SimulatedScene
from zestjax.video import Video


class Ceiling(NamedTuple):
    """image: (H, W, 3). views: (H, W) float, how many inputs see the pixel's surface. unseen: () share of pixels that
    no input sees, which show the truth's local mean."""

    image: jax.Array
    views: jax.Array
    unseen: jax.Array


def ceiling(simulated: SimulatedScene, video: Video, camera: Camera, time: Scalar, *, window: int = 7) -> Ceiling:
    """The mean of the inputs at every pixel's true surface point, moved to their times by the true motion.

    Args:
      simulated: `SimulatedScene`.
      video: its input `Video`.
      camera: the target's `Camera`.
      time: frame index of the target.
      window: side, odd, of the square whose mean of the truth stands where no input sees the surface.

    Returns:
      `Ceiling`. A frame that the target's own camera took at its time counts like any other: targets are held out.
    """
    scene = without_noise(jax.tree.map(jnp.asarray, simulated.scene))
    camera = take_camera(jax.tree.map(lambda leaf: leaf[None], camera), 0)
    return _ceiling(scene, video, camera, jnp.asarray(time, jnp.float32), window=window)


@partial(jax.jit, static_argnames="window")
def _ceiling(scene, video, camera, time, *, window):
    count, height, width = video.images.shape[:3]
    frame = render(scene, camera, time, height=height, width=width)
    v, u = jnp.meshgrid(jnp.arange(height), jnp.arange(width), indexing="ij")
    pixels = jnp.stack([u, v], axis=-1).astype(jnp.float32)

    def add(total, row):
        image, taken_by, there = row
        link = correspond(scene, frame, camera, time, taken_by, there)
        found = bilinear(image, pixels + link.flow)
        seen = (link.visible & found.visible)[..., None].astype(image.dtype)
        return (total[0] + seen * found.values, total[1] + seen), None

    start = jnp.zeros((height, width, 3)), jnp.zeros((height, width, 1))
    times = jnp.arange(count, dtype=jnp.float32)
    (colours, views), _ = jax.lax.scan(add, start, (video.images, video.cameras, times))
    image = jnp.where(
        views > 0, safe_divide(colours, jnp.broadcast_to(views, colours.shape)), _mean(frame.image, window)
    )
    return Ceiling(image, views[..., 0], jnp.mean((views == 0).astype(image.dtype)))


def _mean(image, window):
    """Mean over a square around every pixel, the border's pixels repeated outside."""
    reach = window // 2
    padded = jnp.pad(image, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    return jax.lax.reduce_window(padded, 0.0, jax.lax.add, (window, window, 1), (1, 1, 1), "VALID") / window**2
