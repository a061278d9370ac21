"""Pictures that each come with a camera of their own: what COLMAP, nerfstudio, Nerfies and tables of cameras share.

A layout's module reads its files to `Posed` pictures, and `record_of` makes a `zestjax.io.layouts.Record` of them.

    posed    a picture's file and its camera as the file says it: axes, pixels and lens, in our conventions
    about    `scene.json` beside a scene: its `name`, and the depth bounds `near` and `far` where no file has them
"""

import json
import os
from collections.abc import Sequence
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

import numpy as np

from zestjax.cameras import Camera, check_camera
from zestjax.io.layouts import MOST_DEPTH, MOST_SIDE, HeldOut, Record, as_float32, select
from zestjax.io.lens import Lens, find_lens
from zestjax.io.reading import json_numbers, read_json

ABOUT = "scene.json"
LONGEST = 255  # bytes of a name in a folder, of all usual file systems
NO_BOUNDS = (
    'write scene.json beside it, {"near": ..., "far": ...}: the least and the greatest depth of all that is '
    "seen, in the units of the poses."
)


class Posed(NamedTuple):
    """image: its file. size: (height, width) that the intrinsics count pixels in. intrinsics: (3, 3), pixel centres
    being integers. camera_from_world: (4, 4). distortion: (8,), see `zestjax.io.lens`. time, camera_name: of a picture
    that is held out."""

    image: Path
    size: tuple[int, int]
    intrinsics: np.ndarray
    camera_from_world: np.ndarray
    distortion: np.ndarray = np.zeros(8)
    time: int = 0
    camera_name: str = ""


def record_of(
    path: Path,
    layout: str,
    source: Path,
    posed: Sequence[Posed],
    bounds: tuple[float, float],
    *,
    name: str | None = None,
    held_out: Sequence[Posed] = (),
    reserved: Sequence[int] = (),
    transparent: bool = False,
) -> Record:
    """A `Record` of pictures in the order of time.

    Args:
      path: the scene's folder.
      layout: its name.
      source: the file of the cameras, for messages.
      posed: the frames' pictures.
      bounds: near and far.
      name: of the scene; the folder's where None.
      held_out: pictures of other cameras, each with the frame of its time.
      reserved: frames that are held out, see `Record`.
      transparent: colours under transparent pixels count, see `Record`.

    Raises:
      ValueError: no picture, one twice, a missing one, several sizes, or cameras that no picture was taken with.
    """
    everything = [*posed, *held_out]
    if not posed:
        raise ValueError(f"{source}: has no pictures with cameras; export it again.")
    _check_pictures(source, everything)
    size = _one_size(source, everything)
    known: dict[bytes, Lens | None] = {}
    lenses = [_lens_of(source, shot, known) for shot in everything]
    cameras = _pinholes(source, everything, lenses)
    count = len(posed)
    others = [
        HeldOut(shot.time, shot.camera_name, select(cameras, count + i), shot.image, lens=lenses[count + i])
        for i, shot in enumerate(held_out)
    ]
    return Record(
        name=name or path.resolve().name,
        layout=layout,
        images=tuple(shot.image for shot in posed),
        cameras=select(cameras, slice(count)),
        size=size,
        near=bounds[0],
        far=bounds[1],
        lenses={i: lens for i, lens in enumerate(lenses[:count]) if lens is not None},
        held_out=tuple(others),
        reserved=tuple(reserved),
        transparent=transparent,
    )


def intrinsics_of(fx: float, fy: float, cx: float, cy: float, *, skew: float = 0.0, centre: float = 0.0) -> np.ndarray:
    """(3, 3) intrinsics; a file's pixel centres lie `centre` from integers: 0.5 where pixels count from the corner."""
    return np.array([[fx, skew, cx - centre], [0, fy, cy - centre], [0, 0, 1]], np.float64)


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(4, 4) transform of a rotation (3, 3) and a translation (3,)."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return transform


def rotation_of(source: Path, quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of a quaternion w x y z of any length but 0.

    Raises:
      ValueError: it has no length, or is not finite; `source` is its file.
    """
    with np.errstate(all="ignore"):
        scaled = quaternion / np.abs(quaternion).max()
        w, x, y, z = scaled / np.linalg.norm(scaled)
    if not np.isfinite([w, x, y, z]).all():
        raise ValueError(f"{source}: the quaternion {quaternion.tolist()} is no rotation; export it again.")
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """The quaternion w x y z, w >= 0, of a rotation (3, 3)."""
    r = np.asarray(rotation, np.float64)
    outer = np.array(  # 4 q q^T, but for the diagonal: its largest column is q, and far from 0
        [
            [1 + r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2]],
        ]
    )
    column = outer[:, np.diag(outer).argmax()]
    return column / np.linalg.norm(column) * (1 if column[0] >= 0 else -1)


def file_inside(folder: Path, name: Any, source: Path) -> Path:
    """The file of a name that stands in another file, if it lies in a folder.

    Raises:
      ValueError: no text, a place outside the folder ("../x", "/x", "C:x"), or no name that a file can have; `source`
        is the file that it stands in.
    """
    parts = PureWindowsPath(name).parts if isinstance(name, str) else ()  # it takes / and \\ as separators
    if not parts or PureWindowsPath(name).anchor or ".." in parts:
        raise ValueError(
            f"{source}: names {_shown(name)} as a picture's file, expected one in {folder.name}; correct the name."
        )
    try:
        if not name.isprintable() or max(len(os.fsencode(part)) for part in parts) > LONGEST:
            raise ValueError("no file is called so")
    except ValueError as error:
        raise ValueError(f"{source}: names {_shown(name)} as a picture's file; correct the name.") from error
    return folder.joinpath(*parts)


def about_of(folder: Path) -> tuple[str | None, tuple[float, float] | None]:
    """(name or None, (near, far) or None) that `scene.json` of a folder tells, if there is one.

    Raises:
      ValueError: the file is damaged, its name is no text, or its bounds are none.
    """
    path = folder / ABOUT
    about = read_json(path) if path.exists() else {}
    name = about.get("name")
    if name is not None and not isinstance(name, str):
        raise ValueError(f"{path}: `name` is a {type(name).__name__}, expected text; write it again.")
    return name, near_far(path, about)


def write_about(folder: Path, name: str, bounds: tuple[float, float] | None) -> None:
    """Write `scene.json` into a folder: a scene's name, and its near and far if it has to have them."""
    known = {"name": name} if bounds is None else {"name": name, "near": float(bounds[0]), "far": float(bounds[1])}
    (folder / ABOUT).write_text(json.dumps(known, indent=1))


def near_far(path: Path, about: dict[str, Any]) -> tuple[float, float] | None:
    """`near` and `far` of an object of JSON; None where it has no `near`.

    Raises:
      ValueError: they are not 0 < near < far; `path` is the object's file.
    """
    if "near" not in about:
        return None
    near, far = (float(json_numbers(path, about, key, shape=())) for key in ("near", "far"))
    if not 0 < near < far < MOST_DEPTH:
        raise ValueError(f"{path}: expected 0 < `near` < `far`, got {near:g} and {far:g}; write it again.")
    return near, far


def _check_pictures(source, everything):
    """Refuse a picture that is listed twice, or is not there."""
    seen: set[Path] = set()
    for shot in everything:
        if shot.image in seen:
            raise ValueError(f"{source}: lists {shot.image.name} twice; keep one of its cameras.")
        seen.add(shot.image)
        if not os.path.exists(shot.image):  # Path's raises where a folder may not be entered
            raise ValueError(
                f"{shot.image}: is missing, but {source.name} has its camera; put it there, or take the camera out."
            )


def _one_size(source, everything):
    """(height, width) of all pictures."""
    sizes = {shot.size for shot in everything}
    if len(sizes) > 1:
        said = " and ".join(f"{height}x{width}" for height, width in sorted(sizes)[:2])
        raise ValueError(f"{source}: frames of several sizes ({said}, HxW) are not one video; resize them to one.")
    (size,) = sizes
    if not (0 < min(size) and max(size) <= MOST_SIDE):
        raise ValueError(f"{source}: says pictures of {size[0]}x{size[1]} pixels (HxW); export it again.")
    for shot in everything:
        _check_numbers(f"{source}: the camera of {shot.image.name}", shot, size)
    return size


def _check_numbers(where, shot, size):
    """Refuse numbers that are none, and intrinsics that are of another picture."""
    k = shot.intrinsics
    if not all(np.isfinite(array).all() for array in (k, shot.camera_from_world, shot.distortion)):
        raise ValueError(f"{where} has numbers that are not finite; export it again.")
    if not 0 < min(k[0, 0], k[1, 1]) <= max(k[0, 0], k[1, 1]) <= MOST_SIDE:
        raise ValueError(
            f"{where} has focal lengths {k[0, 0]:g} and {k[1, 1]:g}, expected more than 0 and at most {MOST_SIDE:,} "
            "pixels; export it again."
        )
    if not (-0.5 <= k[0, 2] <= size[1] - 0.5 and -0.5 <= k[1, 2] <= size[0] - 0.5):
        raise ValueError(
            f"{where} looks at pixel ({k[0, 2]:g}, {k[1, 2]:g}), column and row, outside pictures of "
            f"{size[0]}x{size[1]} (HxW); give intrinsics of the size that it says."
        )


def _pinholes(source, everything, lenses):
    """`Camera` of the pictures without their lenses."""
    each = [shot.intrinsics if lens is None else lens.pinhole for shot, lens in zip(everything, lenses, strict=True)]
    poses = np.stack([shot.camera_from_world for shot in everything])
    cameras = Camera(as_float32(source, np.stack(each)), as_float32(source, poses))
    check_camera(str(source), cameras)
    return cameras


def _lens_of(source, shot, known):
    key = shot.intrinsics.tobytes() + shot.distortion.tobytes()
    if key not in known:
        known[key] = find_lens(source, shot.intrinsics, shot.distortion, shot.size)
    return known[key]


def _shown(name):
    return repr(name if isinstance(name, str) else type(name).__name__)[:80]
