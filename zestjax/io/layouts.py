"""What a folder in one of the supported layouts holds, before any picture is decoded.

Each layout has a module with a function that recognises it and one that reads it to a `Record`; `zestjax.io.scenes`
lists them and does the rest, the same way for all.

    native size   (height, width) in which the record's cameras count pixels; pictures may be stored in another
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from zestjax.cameras import Camera
from zestjax.io.pictures import SUFFIXES


@dataclass(frozen=True)
class HeldOut:
    """A picture of another camera than the one that took the frame of its time.

    time: int. camera_name: str. camera: `Camera` of numpy arrays at native size. image: its file. mask: file of the
    moving pixels, or None. truth: npz file with any of `depth` (H, W) and `flow` (H, W, 2), or None.
    """

    time: int
    camera_name: str
    camera: Camera
    image: Path
    mask: Path | None = None
    truth: Path | None = None


class Later(Sequence):
    """Held-out pictures that are looked for when they are first asked for: only one protocol needs them."""

    def __init__(self, find: Callable[[], Iterable[HeldOut]]):
        self._found = cache(lambda: tuple(find()))

    def __len__(self):
        return len(self._found())

    def __getitem__(self, index):
        return self._found()[index]


@dataclass(frozen=True)
class Record:
    """A scene on disk.

    name, layout: str. images: N files in the order of time. cameras: `Camera` with (N, ...) numpy leaves at native
    size. size: (height, width) native. near, far: depth bounds, world units. motion_masks, disparity, flow_forward,
    flow_backward, truth: file by frame index, for the frames that have one. held_out: pictures of other cameras.
    reserved: frames that the held-out protocol predicts, and keeps from all inputs, where photographs are all there is.
    """

    name: str
    layout: str
    images: tuple[Path, ...]
    cameras: Camera
    size: tuple[int, int]
    near: float
    far: float
    motion_masks: Mapping[int, Path] = field(default_factory=dict)
    disparity: Mapping[int, Path] = field(default_factory=dict)
    flow_forward: Mapping[int, Path] = field(default_factory=dict)
    flow_backward: Mapping[int, Path] = field(default_factory=dict)
    truth: Mapping[int, Path] = field(default_factory=dict)
    held_out: Sequence[HeldOut] = ()
    reserved: tuple[int, ...] = ()


def bounds_from_frames(bounds):
    """Depth bounds of a scene from those of its frames: (N, 2) -> (near, far).

    near is 0.9 times the 5th percentile of the nears, far the 95th percentile of the fars divided by 0.9: structure
    from motion leaves single points almost inside the lens, and one of them would waste every plane.

    Source: ZeST-NeRF's scale, 0.9 times the 5th percentile of the nears.

    Raises:
      ValueError: not (N, 2), not finite, or no frame with 0 < near < far.
    """
    bounds = np.asarray(bounds, np.float64)
    if bounds.ndim != 2 or bounds.shape[1] != 2 or not np.isfinite(bounds).all():
        raise ValueError(f"bounds_from_frames: `bounds` should be finite (N, 2) nears and fars, got {bounds.shape}.")
    bounds = bounds[(bounds[:, 0] > 0) & (bounds[:, 0] < bounds[:, 1])]
    if not len(bounds):
        raise ValueError("bounds_from_frames: no frame has 0 < near < far; the depth bounds of the scene are wrong.")
    return 0.9 * float(np.percentile(bounds[:, 0], 5)), float(np.percentile(bounds[:, 1], 95)) / 0.9


def every_eighth(count):
    """The frames that LLFF's convention holds out of `count` photographs."""
    return tuple(range(0, count, 8))


def pictures_in(folder):
    """Picture files of a folder (not of folders in it), sorted by name; empty when there is no such folder."""
    if not folder.is_dir():
        return ()
    return tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith(".")))


def select(cameras, index):
    """The camera, or cameras, at an index of the leading axis."""
    return Camera._make(np.asarray(leaf)[index] for leaf in cameras)
