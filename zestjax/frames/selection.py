"""Which frames of a video serve a target: integer choices, on the host, or by JAX where a camera or a time is traced.

N          frames of the video; a frame's time is its index
positions  (N, 3) optical centres, world units
valid      1.0 where the slot holds a frame, 0.0 where the video has none
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_counts, check_option, traced
from zestjax.base.parts import part
from zestjax.base.types import Array
from zestjax.video import Frames, Inputs

# The nearest frames, and some further ones that see round corners: a guess that was never varied.
RANKS = (0, 1, 2, 3, 4, 6, 8, 11)
CHOICES = ("nearest", "spread")
MOST_FRAMES = 64  # that serve one target: a file of weights may not ask for more


class Chosen(NamedTuple):
    """frames: (K,) int indices into the video; an empty slot repeats a real frame. valid: (K,) float32."""

    frames: Array
    valid: Array


def _filled(frames, count):
    """`Chosen` of up to `count` frames, the first in the place of what is missing."""
    there = np.arange(count) < len(frames)
    return Chosen(frames[np.where(there, np.arange(count), 0)].astype(np.int32), there.astype(np.float32))


def _spread_ranks(count, available):
    """`count` ranks among the nearest: the very nearest all, then ever sparser, so that baselines vary."""
    ranks = [r for r in RANKS[:count] if r < available]
    ranks += [r for r in range(available) if r not in ranks]
    return sorted(ranks[:count])


def key_frames(
    positions: Array,
    count: int,
    *,
    target: Array | None = None,
    time: int | Array = 0,
    choice: str = "nearest",
    exclude: Collection[int] = (),
) -> Chosen:
    """The key-frames of a target.

    Source: ZeST-NeRF section 3.1 (`spread`).

    Args:
      positions: (N, 3) camera centres.
      count: K; a shorter video leaves slots empty.
      target: (3,) the target's centre; needed by `nearest`. It may be traced, and so may the time and the positions.
      time: the target's time, which settles ties.
      choice: `nearest` to the target (ranks `RANKS`) or `spread`, a rounded linspace over the video.
      exclude: frames that must not be used: the answer is never among the inputs.

    Returns:
      `Chosen`, nearest first or in order of time.

    Raises:
      ValueError: for an unknown choice, or when every frame is excluded.
    """
    check_option("key_frames", choice=(choice, CHOICES))
    usable = np.array([i for i in range(len(positions)) if i not in set(exclude)], int)
    if not len(usable):
        raise ValueError(f"key_frames: `exclude` leaves none of the {len(positions)} frames; leave at least one.")
    if choice == "spread":
        places = np.unique(np.round(np.linspace(0, len(usable) - 1, count)).astype(int))
        return _filled(usable[places], count)
    ranks = np.array(_spread_ranks(count, len(usable)))
    if traced((positions, target, time)):
        positions, target, time = (jax.lax.stop_gradient(jnp.asarray(x)) for x in (positions, target, time))
        away, number = positions[usable].astype(target.dtype) - target[None], jnp.asarray(usable, time.dtype)
        distance, apart = jnp.sqrt(jnp.sum(away**2, -1)), jnp.abs(number - time[None])
        order = jnp.lexsort((apart, jnp.round(distance / jnp.maximum(distance.max(), 1e-12), 4)))
        return _filled(number[order][ranks], count)
    distance = np.linalg.norm(np.asarray(positions)[usable] - np.asarray(target), axis=-1)
    scale = max(float(distance.max()), 1e-12)
    order = np.lexsort((np.abs(usable - time), np.round(distance / scale, 4)))
    return _filled(usable[order][ranks], count)


def neighbours(frames: int, time: int | Array, *, offsets: Sequence[int], exclude: Collection[int] = ()) -> Chosen:
    """The neighbours of a time: frames time + offsets, each with a validity bit.

    Source: ZeST-NeRF section 3.1 (M neighbours of the target frame).
    Differs from the reference: it repeats the end frames, the target's own among them, as if they were neighbours.

    Args:
      frames: N.
      time: int target time; it may be traced.
      offsets: the slots, for example (-2, -1, 0, 1, 2).
      exclude: frames that must not be used (the target frame itself).

    Returns:
      `Chosen` in the order of `offsets`; a missing slot repeats the nearest usable frame with validity 0.
    """
    xp, usable = jnp if traced(time) else np, np.array([i for i in range(frames) if i not in set(exclude)])
    wanted = xp.asarray(time)[None] + xp.asarray(offsets, xp.asarray(time).dtype)
    away = xp.abs(xp.asarray(usable, wanted.dtype)[None] - wanted[:, None])  # the first of two that are equally near
    chosen, valid = xp.asarray(usable)[xp.argmin(away, 1)], xp.min(away, 1) == 0
    return Chosen(chosen.astype(np.int32), valid.astype(np.float32))


@part
class KeyFrames:
    """Serves what stands still: `count` frames by `choice`, see `key_frames`. A view needs at least `least`."""

    count: int = 8
    choice: str = "nearest"
    least: int = 1

    def __post_init__(self):
        check_counts("KeyFrames", count=(self.count, 1, MOST_FRAMES), least=(self.least, 1, self.count))
        check_option("KeyFrames", choice=(self.choice, CHOICES))

    def choose(self, positions: Array, *, target: Array, time: int | Array, exclude: Collection[int] = ()) -> Chosen:
        """Which frames of a video serve a target."""
        if (left := len(set(range(len(positions))) - set(exclude))) < self.least:
            raise ValueError(f"KeyFrames: a view needs {self.least} source frames, {left} are left; give more frames.")
        return key_frames(positions, self.count, target=target, time=time, choice=self.choice, exclude=exclude)

    def of(self, inputs: Inputs) -> Frames:
        """Those of a target's inputs."""
        return inputs.key


@part
class Slots:
    """Serves what moves: the frames at these offsets from the target's time, see `neighbours`."""

    offsets: tuple[int, ...] = (-2, -1, 0, 1, 2)

    def __post_init__(self):
        check_counts("Slots", count=(self.count, 1, MOST_FRAMES))
        if list(self.offsets) != sorted(set(self.offsets)):
            raise ValueError(f"Slots: `offsets` are {self.offsets}, expected different integers in rising order.")

    @property
    def count(self) -> int:
        """How many."""
        return len(self.offsets)

    def choose(self, positions: Array, *, time: int | Array, exclude: Collection[int] = ()) -> Chosen:
        """Which frames of a video serve a target."""
        return neighbours(len(positions), time, offsets=self.offsets, exclude=exclude)

    def of(self, inputs: Inputs) -> Frames:
        """Those of a target's inputs."""
        assert inputs.slots is not None  # of a system with a dynamic field
        return inputs.slots
