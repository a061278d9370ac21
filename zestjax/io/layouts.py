"""What a folder in one of the supported layouts holds, before any picture is decoded.

Each layout has a module with a function that recognises it and one that reads it to a `Record`; `zestjax.io.scenes`
lists them and does the rest, the same way for all.

    native size   (height, width) in which the record's cameras count pixels; pictures may be stored in another
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from zestjax.base.types import FilePath
from zestjax.cameras import Camera
from zestjax.io.lens import Lens
from zestjax.io.pictures import SUFFIXES
from zestjax.io.reading import in_order, numbers_of, visible

MOST_DEPTH = 1e30  # of a bound: float32 holds its product with a pixel
MOST_SIDE = 10**6  # pixels of a picture's side, or of a focal length: more is no camera's


@dataclass(frozen=True)
class HeldOut:
    """A picture of another camera than the one that took the frame of its time.

    time: int. camera_name: str. camera: `Camera` of numpy arrays at native size. image: its file. mask: file of the
    moving pixels, or None. truth: npz file with any of `depth` (H, W) and `flow` (H, W, 2), or None. lens: what bends
    the picture in its file, or None; the camera is that of the picture without it.
    """

    time: int
    camera_name: str
    camera: Camera
    image: Path
    mask: Path | None = None
    truth: Path | None = None
    lens: Lens | None = None


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
    lenses: by frame index, what bends the picture in its file; cameras are of the pictures without it. transparent:
    colours under transparent pixels are the scene's all the same.
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
    lenses: Mapping[int, Lens] = field(default_factory=dict)
    transparent: bool = False

    def first(self, count: int) -> "Record":
        """The record of the first frames alone."""
        early = lambda files: {time: path for time, path in files.items() if time < count}
        maps = ("motion_masks", "disparity", "flow_forward", "flow_backward", "truth", "lenses")
        held = self.held_out
        return replace(
            self, images=self.images[:count], cameras=select(self.cameras, slice(count)),
            held_out=Later(lambda: [entry for entry in held if entry.time < count]),
            reserved=tuple(time for time in self.reserved if time < count),
            **{name: early(getattr(self, name)) for name in maps},
        )  # fmt: skip


def bounds_from_frames(bounds: np.ndarray, *, where: FilePath = "bounds_from_frames") -> tuple[float, float]:
    """Depth bounds of a scene from those of its frames: (N, 2) -> (near, far).

    near is 0.9 times the 5th percentile of the nears, far the 95th percentile of the fars divided by 0.9: structure
    from motion leaves single points almost inside the lens, and one of them would waste every plane.

    Source: ZeST-NeRF's scale, 0.9 times the 5th percentile of the nears.

    Args:
      bounds: of each frame.
      where: the file that they are of, for the message.

    Raises:
      ValueError: not (N, 2), not finite, or no frame with 0 < near < far.
    """
    bounds = np.asarray(bounds, np.float64)
    if bounds.ndim != 2 or bounds.shape[1] != 2 or not np.isfinite(bounds).all():
        raise ValueError(f"{where}: `bounds` should be finite (N, 2) nears and fars, got {bounds.shape}.")
    bounds = bounds[(bounds[:, 0] > 0) & (bounds[:, 0] < bounds[:, 1]) & (bounds[:, 1] < MOST_DEPTH)]
    if not len(bounds):
        raise ValueError(f"{where}: no frame has 0 < near < far; the depth bounds of the scene are wrong.")
    return 0.9 * float(np.percentile(bounds[:, 0], 5)), float(np.percentile(bounds[:, 1], 95)) / 0.9


def every_eighth(count: int) -> tuple[int, ...]:
    """The frames that LLFF's convention holds out of `count` photographs."""
    return tuple(range(0, count, 8))


def pictures_in(folder: FilePath) -> tuple[Path, ...]:
    """Picture files of a folder (not of folders in it), by number or name; empty when there is no such folder."""
    return files_in(folder, SUFFIXES)


def files_in(folder: FilePath, suffixes: Collection[str]) -> tuple[Path, ...]:
    """The files of a folder with one of some suffixes, hidden ones left out, as `zestjax.io.reading.in_order`."""
    return in_order(p for p in visible(folder) if p.suffix.lower() in suffixes)


def check_order(images: Sequence[Path], source: Path) -> None:
    """Refuse pictures whose order by name is not that of their numbers: it is not known which one the poses have.

    Raises:
      ValueError: naming both orders; `source` is the file of the poses.
    """
    by_name = sorted(images, key=lambda path: path.name)
    if list(images) != by_name:
        place = next(i for i, pair in enumerate(zip(images, by_name, strict=True)) if pair[0] != pair[1])
        shown = lambda files: ", ".join(p.name for p in files[max(place - 1, 0) : place + 2])
        raise ValueError(
            f"{images[0].parent}: by number its pictures are {shown(images)}, by name {shown(by_name)}, and "
            f"{source.name} may have either order; rename them with as many zeros as make both the same."
        )


def one_each(folder: FilePath, files: Sequence[Path], images: Sequence[Path]) -> dict[int, Path]:
    """{frame: file} with a file for every frame: that of its name, else of its number, else of its place.

    Raises:
      ValueError: there are some, but not as many as frames.
    """
    if files and len(files) != len(images):
        raise ValueError(
            f"{folder}: has {len(files)} files for {len(images)} frames; complete it, or remove the folder."
        )
    for key in (lambda paths: [path.stem for path in paths], lambda paths: numbers_of(paths) or ()):
        theirs, ours = dict(zip(key(files), files, strict=False)), key(images)
        if len(theirs) == len(images) and set(theirs) == set(ours):
            return {i: theirs[k] for i, k in enumerate(ours)}
    return dict(enumerate(files))


def check_sizes(source: FilePath, sizes: np.ndarray) -> tuple[tuple[int, int], np.ndarray]:
    """(height, width) and focal lengths of poses' columns (N, 3), once they are those of one video.

    Raises:
      ValueError: several sizes, or any of them not above 0; `source` is the file of the poses.
    """
    if not np.allclose(sizes[:, :2], sizes[0, :2]):
        raise ValueError(f"{source}: frames of several sizes are not one video; resize them to one.")
    if not (sizes > 0).all() or sizes.max() > MOST_SIDE:
        raise ValueError(
            f"{source}: the poses' height, width and focal length should lie between 0 and {MOST_SIDE:,}, "
            f"got {sizes.min(0).tolist()} to {sizes.max(0).tolist()}; export it again."
        )
    return (max(round(sizes[0, 0]), 1), max(round(sizes[0, 1]), 1)), sizes[:, 2]


def as_float32(source: FilePath, poses: np.ndarray) -> np.ndarray:
    """Poses as float32.

    Raises:
      ValueError: a number that float32 does not hold; `source` is their file.
    """
    with np.errstate(over="ignore"):
        poses = np.asarray(poses).astype(np.float32)
    if not np.isfinite(poses).all():
        raise ValueError(f"{source}: holds numbers that are too large for a pose; export it again.")
    return poses


def frames_by_number(
    images: Sequence[Path], numbers: Iterable[int], *, fits: Callable[[dict[int, int]], bool]
) -> dict[int, int] | None:
    """Which frames some numbers in names mean: {number: frame}, or None if neither reading fits.

    They are the numbers in the frames' names where all of them are there, else places from 0.

    Args:
      images: files of the frames.
      numbers: those to read.
      fits: function of {number: frame} that refuses an impossible reading.
    """
    named = {number: i for i, number in enumerate(numbers_of(images) or ())}
    for reading in (named, {i: i for i in range(len(images))}):
        if set(numbers) <= reading.keys() and fits(reading):
            return reading
    return None


def select(cameras: Camera, index: int | slice | Sequence[int] | np.ndarray) -> Camera:
    """The camera, or cameras, at an index of the leading axis."""
    return Camera(*(np.asarray(leaf)[index] for leaf in cameras))
