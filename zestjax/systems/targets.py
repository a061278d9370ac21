"""The inputs of a target: which frames its system's fields take, in fixed shapes.

N        frames of the video
exclude  frames that must serve nothing: they are what is to be predicted
"""

from collections.abc import Collection

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import traced
from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera
from zestjax.frames.assembly import colours_of, positions, taken
from zestjax.systems.system import System
from zestjax.video import Frames, Inputs


def target_inputs(
    images: Array,
    cameras: Camera,
    near: Scalar,
    far: Scalar,
    camera: Camera,
    time: int | Array,
    *,
    system: System,
    exclude: Collection[int] = (),
    stand_in: bool = False,
) -> tuple[Inputs, Array]:
    """`Inputs` of a target, and which frames they hold. Anything but what to exclude may be traced: frames are then
    chosen by JAX, and their arrays gathered.

    Args:
      images: (N, H, W, 3) uint8 or float32, host or device.
      cameras: `Camera` (N, ...).
      near: world units.
      far: world units.
      camera: the target's `Camera`.
      time: int frame time.
      system: `System`, whose fields choose their frames.
      exclude: see the header.
      stand_in: the frame of the target's time, which is to be excluded, holds another in its place: it may be a slot.

    Returns:
      (`Inputs`, (V,) int frames: those of the static field, then those of the dynamic one).
    """
    places, now = positions(cameras), _number(time)
    centre = positions(jax.tree.map(lambda leaf: (leaf if traced(leaf) else np.asarray(leaf))[None], camera))[0]

    def pack(c, times):
        shown = jnp.asarray(images)[c.frames] if traced(c.frames) else jnp.asarray(images[c.frames])
        return Frames(colours_of(shown), taken(cameras, c.frames), c.valid, times)

    chosen = system.static.frames.choose(places, target=centre, time=time, exclude=exclude)
    key, slots, frames = pack(chosen, chosen.frames.astype(now.dtype)), None, [chosen.frames]
    if system.dynamic is not None:
        missing = [i for i in exclude if not (stand_in and i == time)]
        around = system.dynamic.frames.choose(places, time=time, exclude=missing)
        slots = pack(around, now + np.asarray(system.dynamic.frames.offsets, now.dtype))
        frames.append(around.frames)
    bounds = (_number(x) for x in (len(images), near, far))
    wide = lambda x: x if traced(x) else jnp.asarray(x, jnp.float32)
    inputs = Inputs(key, slots, Camera(*map(wide, camera)), now, *bounds)
    return inputs, (jnp if traced(frames) else np).concatenate(frames)


def asks_for_own_time(system: System) -> bool:
    """Whether a system has a slot for the frame of the target's own time."""
    return system.dynamic is not None and 0 in getattr(system.dynamic.frames, "offsets", ())


def _number(x):
    """() float32 of what is known, and of what is traced as JAX has it."""
    return jnp.asarray(x).astype(jnp.float32) if traced(x) else np.float32(x)
