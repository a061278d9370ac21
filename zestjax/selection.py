"""Which frames of a video serve a target: host-side integer choices, made before anything is traced.

N          frames of the video; a frame's time is its index
positions  (N, 3) optical centres, world units
valid      1.0 where the slot holds a frame, 0.0 where the video has none
"""

from typing import NamedTuple

import numpy as np

from zestjax.checks import check_option

RANKS = (0, 1, 2, 3, 4, 6, 8, 11)


class Chosen(NamedTuple):
    """frames: (K,) int indices into the video; an empty slot repeats a real frame. valid: (K,) float32."""

    frames: np.ndarray
    valid: np.ndarray


def _filled(frames, count):
    frames = list(frames)[:count]
    valid = np.zeros(count, np.float32)
    valid[: len(frames)] = 1
    return Chosen(np.array(frames + [frames[0]] * (count - len(frames)), np.int32), valid)


def _spread_ranks(count, available):
    """`count` ranks among the nearest: the very nearest all, then ever sparser, so that baselines vary."""
    ranks = [r for r in RANKS[:count] if r < available]
    ranks += [r for r in range(available) if r not in ranks]
    return sorted(ranks[:count])


def key_frames(positions, count, *, target=None, time=0, choice="nearest", exclude=()):
    """The key-frames of a target.

    Source: ZeST-NeRF section 3.1 (`spread`).

    Args:
      positions: (N, 3) camera centres.
      count: K; a shorter video leaves slots empty.
      target: (3,) the target's centre; needed by `nearest`.
      time: the target's time, which settles ties.
      choice: `nearest` to the target (ranks `RANKS`) or `spread`, a rounded linspace over the video.
      exclude: frames that must not be used: the answer is never among the inputs.

    Returns:
      `Chosen`, nearest first or in order of time.

    Raises:
      ValueError: for an unknown choice, or when every frame is excluded.
    """
    check_option("key_frames", choice=(choice, ("nearest", "spread")))
    usable = np.array([i for i in range(len(positions)) if i not in set(exclude)], int)
    if not len(usable):
        raise ValueError(f"key_frames: `exclude` leaves none of the {len(positions)} frames; leave at least one.")
    if choice == "spread":
        places = np.unique(np.round(np.linspace(0, len(usable) - 1, count)).astype(int))
        return _filled(usable[places], count)
    distance = np.linalg.norm(np.asarray(positions)[usable] - np.asarray(target), axis=-1)
    scale = max(float(distance.max()), 1e-12)
    order = np.lexsort((np.abs(usable - time), np.round(distance / scale, 4)))
    return _filled(usable[order][_spread_ranks(count, len(usable))], count)


def slots(frames, time, *, offsets, exclude=()):
    """The neighbours of a time: frames time + offsets, each with a validity bit.

    Source: ZeST-NeRF section 3.1 (M neighbours of the target frame).
    Differs from the reference: it repeats the end frames, the target's own among them, as if they were neighbours.

    Args:
      frames: N.
      time: int target time.
      offsets: the slots, for example (-2, -1, 0, 1, 2).
      exclude: frames that must not be used (the target frame itself).

    Returns:
      `Chosen` in the order of `offsets`; a missing slot repeats the nearest usable frame with validity 0.
    """
    wanted = [time + o for o in offsets]
    usable = [i for i in range(frames) if i not in set(exclude)]
    valid = np.array([float(i in usable) for i in wanted], np.float32)
    chosen = [i if i in usable else min(usable, key=lambda u: abs(u - i)) for i in wanted]
    return Chosen(np.array(chosen, np.int32), valid)
