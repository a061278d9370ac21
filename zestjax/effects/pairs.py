"""Frames of a video compared two by two, by optical flow there and back: what every effect is looked for in.

h w      rows and columns of half-resolution pixels
near     pairs of a frame and its neighbours in time
again    the pair of a frame and one taken from the same place, or nearly, some time before or after
wide     the pair of a frame and a later one, farther away
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from zestjax.cameras import Camera
from zestjax.frames.assembly import Footage, positions, taken
from zestjax.frames.optical_flow import agreement, as_bytes, dense_flow

MOST_LOOKED = 8  # frames of a video that are looked at, evenly: each takes a tenth of a second
APART = 3  # frames at least between the two of `again`: what is slow has moved by then
WIDE = 2  # frames between the two of `wide`


class Pair(NamedTuple):
    """first, second: frames. flow: (h, w, 2) image pixels from the first to the second. sure: (h, w) in [0, 1]."""

    first: int
    second: int
    flow: np.ndarray
    sure: np.ndarray


class Looked(NamedTuple):
    """What was compared. frames: those looked at. near: of each, one or two `Pair`. again, wide: of each, a `Pair` or
    None. images: (N, h, w, 3) half resolution, of one exposure. cameras: `Camera` (N, ...) of full-size images, on
    the host. size: (H, W) of the images."""

    frames: list[int]
    near: list[list[Pair]]
    again: list[Pair | None]
    wide: list[Pair | None]
    images: np.ndarray
    cameras: Camera
    size: tuple[int, int]


def look(seen: Footage, cameras: Camera, size: tuple[int, int], *, excluded: frozenset[int] = frozenset()) -> Looked:
    """Compare the frames of a video.

    Args:
      seen: `Footage`, of one exposure.
      cameras: `Camera` (N, ...) on the host, of full-size images.
      size: (H, W) of the images.
      excluded: frames that are not read; some frame must be left beside its neighbour, see `beside_another`.
    """
    images = np.asarray(seen.half)
    there = [i for i in range(len(images)) if i not in excluded]
    usable = beside_another(there)
    chosen = np.unique(np.linspace(0, len(usable) - 1, min(MOST_LOOKED, len(usable))).round()).astype(int)
    frames = [usable[k] for k in chosen]
    places, shown = positions(cameras), as_bytes(images)
    flow, sure = seen.flow
    near = [[Pair(i, j, flow[i, s], sure[i, s]) for s, j in ((0, i + 1), (1, i - 1)) if j in there] for i in frames]
    again = [_compared(shown, i, _same_place(places, i, there)) for i in frames]
    wide = [_compared(shown, i, i + WIDE if i + WIDE in there else None) for i in frames]
    return Looked(frames, near, again, wide, images, taken(cameras, np.arange(len(images))), size)


def beside_another(frames: Collection[int]) -> list[int]:
    """Those of the frames whose neighbour in time is among them."""
    return [i for i in frames if i - 1 in frames or i + 1 in frames]


def _same_place(places, frame, there):
    """The frame taken nearest to one's place, `APART` or more from its time; None in a video too short."""
    others = [j for j in there if abs(j - frame) >= APART]
    if not others:
        return None
    away = np.linalg.norm(places[others] - places[frame], axis=-1)
    return others[int(np.lexsort((np.abs(np.array(others) - frame), np.round(away / max(away.max(), 1e-12), 4)))[0])]


def _compared(shown, first, second):
    """`Pair` of two frames, by their half-resolution pictures (bytes)."""
    if second is None:
        return None
    there, back = dense_flow(shown[first], shown[second]), dense_flow(shown[second], shown[first])
    return Pair(first, second, 2 * there, agreement(there, back))


def camera_of(cameras: Camera, frame: int) -> Camera:
    """One `Camera` of many."""
    return Camera(*(np.asarray(leaf)[frame] for leaf in cameras))


def image_pixels(height: int, width: int) -> np.ndarray:
    """(h, w, 3) homogeneous image pixels of the centres of half-resolution pixels."""
    v, u = np.mgrid[:height, :width].astype(np.float64)
    return np.stack([2 * u + 0.5, 2 * v + 0.5, np.ones_like(u)], -1)
