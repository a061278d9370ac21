"""Pictures of a `SimulatedScene`: its input video, and any other camera at any time with its exact answers.

N        frames
T        targets
H W      rows and columns
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.types import Array
from zestjax.cameras import Camera
from zestjax.simulate.bench import bench_scene
from zestjax.simulate.clips import shots, take_camera, without_noise
from zestjax.simulate.render import seen_surface
from zestjax.simulate.truth import correspond
from zestjax.simulate.types import SimulatedScene
from zestjax.video import Video


class Answers(NamedTuple):
    """What views show, and the truth behind them. Host arrays.

    images: (T, H, W, 3) float32, without sensor noise. depth: (T, H, W). moving: (T, H, W) bool.
    scene_flow: (T, 2, H, W, 3) world displacement to the next and to the previous time.
    flow: (T, 2, H, W, 2) pixels to where the point is in the next and in the previous input frame; visible:
      (T, 2, H, W) bool, that frame sees it. At the ends of the video not visible, and the flow without meaning.
    cameras: (T,) `Camera`. times: (T,) int.
    """

    images: Array
    depth: Array
    moving: Array
    scene_flow: Array
    flow: Array
    visible: Array
    cameras: Camera
    times: Array


def input_video(simulated: SimulatedScene, *, noise: jax.Array | None = None) -> Video:
    """The `Video` a user would have: frame i by camera `taken[i]`, with the sensor's noise (drawn from the JAX
    key `noise`)."""
    key = jax.random.key(0) if noise is None else noise
    cameras = jax.tree.map(lambda leaf: leaf[simulated.taken], simulated.rig)
    scene = jax.tree.map(jnp.asarray, simulated.scene)
    taken = shots(key, scene, cameras, range(simulated.frames), height=simulated.height, width=simulated.width)
    images = jnp.asarray(taken.image, jnp.float32) / 255
    bounds = jnp.float32(simulated.near), jnp.float32(simulated.far)
    return Video(images, jax.tree.map(jnp.asarray, cameras), *bounds)


def answers(
    simulated: SimulatedScene, times: Sequence[int] | np.ndarray, cameras: Sequence[int] | np.ndarray | Camera
) -> Answers:
    """Views and the truth behind them.

    Args:
      simulated: `SimulatedScene`.
      times: (T,) frame indices.
      cameras: (T,) indices into the rig, or a (T,) `Camera` of any places.

    Returns:
      `Answers`.
    """
    times = np.asarray(times)
    views = (
        cameras if isinstance(cameras, Camera) else jax.tree.map(lambda leaf: leaf[np.asarray(cameras)], simulated.rig)
    )
    scene = without_noise(jax.tree.map(jnp.asarray, simulated.scene))
    size = dict(height=simulated.height, width=simulated.width)
    seen = shots(jax.random.key(0), scene, views, times, **size)
    links = [
        [_link(scene, simulated, take_camera(views, i), time, step, size) for step in (1, -1)]
        for i, time in enumerate(times)
    ]
    flow = np.stack([[np.asarray(link.flow) for link in row] for row in links])
    visible = np.stack([[np.asarray(link.visible) for link in row] for row in links])
    moved = np.stack([[np.asarray(link.scene_flow) for link in row] for row in links])
    images = seen.image.astype(np.float32) / 255
    return Answers(images, seen.depth, seen.moving, moved, flow, visible, views, times)


@partial(jax.jit, static_argnames=("height", "width"))
def _correspondence(scene, camera, time, camera_there, time_there, *, height, width):
    frame = seen_surface(scene, camera, time, height=height, width=width)
    return correspond(scene, frame, camera, time, camera_there, time_there)


def _link(scene, simulated, camera, time, step, size):
    """`Correspondence` of a view with the input frame `step` later."""
    there = int(time) + step
    exists = 0 <= there < simulated.frames
    other = take_camera(simulated.rig, simulated.taken[there if exists else int(time)])
    link = _correspondence(scene, camera, jnp.float32(time), other, jnp.float32(there), **size)
    return link if exists else link._replace(visible=jnp.zeros_like(link.visible))


def held_out(simulated: SimulatedScene, time: int) -> np.ndarray:
    """Indices of the rig's cameras that did not take the frame of a time."""
    return np.setdiff1d(np.arange(len(simulated.rig.intrinsics)), simulated.taken[time])


def bench_video(name: str, *, height: int = 144, width: int = 256) -> Video:
    """Input `Video` of a scene of zest-bench; see `bench_scene`."""
    return input_video(bench_scene(name, height=height, width=width))


def bench_targets(
    name: str,
    times: Sequence[int] | np.ndarray,
    cameras: Sequence[int] | np.ndarray,
    *,
    height: int = 144,
    width: int = 256,
) -> Answers:
    """`Answers` of held-out views of a scene of zest-bench: (T,) times and (T,) cameras of the rig."""
    return answers(bench_scene(name, height=height, width=width), times, cameras)
