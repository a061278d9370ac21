"""Training clips: a short posed video of a random scene and views to predict, with exact answers.

N        input frames
T        targets
H W      rows and columns
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera
from zestjax.simulate.motion import all_bodies
from zestjax.simulate.random import RandomScene, generator, random_scene
from zestjax.simulate.render import render, with_noise
from zestjax.simulate.truth import motion_mask, moving_bodies, scene_flow, without_movers
from zestjax.simulate.types import Scene


class Clip(NamedTuple):
    """Host arrays, ready to train on. Depths are z in world units; bounds hold every depth of the clip.

    images: (N, H, W, 3) uint8. depth: (N, H, W) float32. moving: (N, H, W) bool motion mask.
    intrinsics: (N, 3, 3). camera_from_world: (N, 4, 4). near, far: () float32.
    target_images: (T, H, W, 3) uint8, without sensor noise. target_depth: (T, H, W). target_moving: (T, H, W) bool.
    target_scene_flow: (T, 2, H, W, 3) float16 world displacement to the next and to the previous time.
    target_static_images: (T, H, W, 3) uint8 the same view with all that moves taken away, target_static_depth:
      (T, H, W) likewise. target_static_valid: (T, H, W) bool, false where even what is left moves.
    target_intrinsics: (T, 3, 3). target_camera_from_world: (T, 4, 4). target_time: (T,) int32.
    """

    images: Array
    depth: Array
    moving: Array
    intrinsics: Array
    camera_from_world: Array
    near: np.floating
    far: np.floating
    target_images: Array
    target_depth: Array
    target_moving: Array
    target_scene_flow: Array
    target_static_images: Array
    target_static_depth: Array
    target_static_valid: Array
    target_intrinsics: Array
    target_camera_from_world: Array
    target_time: Array


class Shot(NamedTuple):
    """One view with its answers: image (H, W, 3) uint8, depth (H, W), moving (H, W) bool, still (H, W) bool (the body
    never moves), flow (2, H, W, 3) float16 world displacement to the next and to the previous time."""

    image: Array
    depth: Array
    moving: Array
    still: Array
    flow: Array


@partial(jax.jit, static_argnames=("height", "width", "samples"))
def shot(
    key: jax.Array, scene: Scene, camera: Camera, time: Scalar, *, height: int, width: int, samples: int = 2
) -> Shot:
    """`Shot` of a scene by one camera at a time; `key` draws the sensor's noise."""
    frame = render(scene, camera, time, height=height, width=width, samples=samples)
    still = ~moving_bodies(all_bodies(scene))[jnp.maximum(frame.body, 0)]
    flow = jnp.stack([scene_flow(scene, frame, time, time + step) for step in (1, -1)])
    image = jnp.round(with_noise(key, frame.image, scene.effects) * 255).astype(jnp.uint8)
    return Shot(image, frame.depth, motion_mask(scene, frame, time), still, flow.astype(jnp.float16))


def without_noise(scene: Scene) -> Scene:
    """The scene with the sensor's noise at 0, in the same program."""
    noise = scene.effects.noise
    return scene._replace(effects=scene.effects._replace(noise=None if noise is None else jnp.zeros_like(noise)))


def take_camera(cameras: Camera, index: int | Array) -> Camera:
    """One `Camera` of a batch."""
    return Camera(*(jnp.asarray(leaf[index]) for leaf in cameras))


def shots(
    key: jax.Array, scene: Scene, cameras: Camera, times: Sequence[float] | Array, *, height: int, width: int
) -> Shot:
    """`Shot` of host arrays with a leading axis: each camera at its time. All are dispatched before any is awaited."""
    keys = jax.random.split(key, len(times))
    taken = [
        shot(keys[i], scene, take_camera(cameras, i), jnp.asarray(time, jnp.float32), height=height, width=width)
        for i, time in enumerate(times)
    ]
    return jax.tree.map(lambda *rows: np.stack([np.asarray(row) for row in rows]), *taken)


def clip(
    key: jax.Array, drawn: RandomScene, *, height: int, width: int, slack: Sequence[float] | np.ndarray = (0.0, 0.0)
) -> Clip:
    """The `Clip` of a drawn scene.

    Args:
      key: draws the noise.
      drawn: `RandomScene`.
      height: of all images.
      width: of all images.
      slack: shares by which near is brought nearer and far is moved away.
    """
    scene = jax.tree.map(jnp.asarray, drawn.scene)
    size = dict(height=height, width=width)
    video = shots(key, scene, drawn.cameras, range(len(drawn.cameras.intrinsics)), **size)
    clean = without_noise(scene)
    truth = shots(key, clean, drawn.targets, drawn.target_times, **size)
    static = shots(key, jax.jit(without_movers)(clean), drawn.targets, drawn.target_times, **size)
    depths = [video.depth, truth.depth, static.depth]
    near, far = min(d.min() for d in depths), max(d.max() for d in depths)
    return Clip(
        images=video.image, depth=video.depth, moving=video.moving,
        intrinsics=drawn.cameras.intrinsics, camera_from_world=drawn.cameras.camera_from_world,
        near=np.float32(near * (1 - slack[0])), far=np.float32(far * (1 + slack[1])),
        target_images=truth.image, target_depth=truth.depth, target_moving=truth.moving,
        target_scene_flow=truth.flow,
        target_static_images=static.image, target_static_depth=static.depth, target_static_valid=static.still,
        target_intrinsics=drawn.targets.intrinsics, target_camera_from_world=drawn.targets.camera_from_world,
        target_time=np.asarray(drawn.target_times, np.int32),
    )  # fmt: skip


def training_clip(key: jax.Array, *, height: int = 144, width: int = 256, frames: int = 16, targets: int = 8) -> Clip:
    """A clip of a random scene.

    Args:
      key: JAX random key; the clip is a function of it.
      height: of all images.
      width: of all images.
      frames: N >= 2.
      targets: T.

    Returns:
      `Clip`. The bounds are the true ones with a random slack of 0-25 % each.

    Raises:
      ValueError: fewer than two frames.
    """
    if frames < 2:
        raise ValueError(f"training_clip: `frames` is {frames}, expected at least 2.")
    draw, noise, slack = jax.random.split(key, 3)
    drawn = random_scene(draw, height=height, width=width, frames=frames, targets=targets)
    return clip(noise, drawn, height=height, width=width, slack=generator(slack).uniform(0, 0.25, 2))
