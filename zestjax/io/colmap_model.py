"""COLMAP's sparse models as files, binary and text: cameras, images and points; all other files of a model are left.

    cameras.bin, .txt     size, kind (`KINDS`) and parameters of every camera
    images.bin, .txt      quaternion w x y z and translation of camera_from_world, camera and name of every picture
    points3D.bin, .txt    points in the world

Version 4 writes rigs and frames beside them, and says the same of a picture in images.bin as version 3. Numbers are
little-endian; a count is compared with what is left of the file before anything is made for it. Parameters count pixels
from the picture's corner: the centre of the first one is (0.5, 0.5).
"""

import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.io.reading import explained, open_regular, read_regular

KINDS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
}
"""Kinds of cameras that are read: number in binary files, and names of the parameters in their order."""

BY_NUMBER = {number: kind for kind, (number, _) in KINDS.items()}
OTHERS = {5: "OPENCV_FISHEYE", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE"}
POINT = 51  # bytes of a point without its track


class StoredCamera(NamedTuple):
    """kind: of `KINDS`. size: (height, width). parameters: by name, pixels; k and p have none."""

    kind: str
    size: tuple[int, int]
    parameters: dict[str, float]


class StoredImage(NamedTuple):
    """name: of the picture's file. camera: its camera's number. quaternion: (4,) w x y z. translation: (3,)."""

    name: str
    camera: int
    quaternion: np.ndarray
    translation: np.ndarray


class Model(NamedTuple):
    """cameras: `StoredCamera` by number. images: `StoredImage` in the file's order. points: (P, 3). source: the file
    of the images."""

    cameras: dict[int, StoredCamera]
    images: tuple[StoredImage, ...]
    points: np.ndarray
    source: Path


def model_in(folder: Path) -> tuple[Path, Path] | None:
    """The files of a folder's (cameras, images), binary ones where both are there; None where it holds no model."""
    for suffix in (".bin", ".txt"):
        files = folder / f"cameras{suffix}", folder / f"images{suffix}"
        if all(file.is_file() for file in files):
            return files
    return None


def count_images(folder: Path) -> int:
    """How many pictures the model in a folder says it has: its header is taken at its word.

    Raises:
      ValueError: the file cannot be read, or has no header.
    """
    files = model_in(folder)
    if files is None:
        return 0
    if files[1].suffix == ".txt":
        with explained(files[1], "is not COLMAP's list of images"):
            return len(_image_rows(read_regular(files[1]).decode("utf-8")))
    with open_regular(files[1]) as (file, _), explained(files[1], "is not COLMAP's list of images"):
        return _Bytes(file.read(8)).take("Q")[0]


def read_model(folder: Path) -> Model:
    """Read a model; points may be missing.

    Raises:
      ValueError: a file that cannot be read, is damaged, claims more than it has, or has a camera of none of `KINDS`.
    """
    files = model_in(folder)
    if files is None:
        raise ValueError(f"{folder}: holds no model of COLMAP (cameras and images, .bin or .txt); export it again.")
    cameras, images, points = (*files, folder / f"points3D{files[0].suffix}")
    parts = (_cameras_bin, _images_bin, _points_bin) if cameras.suffix == ".bin" else (_cameras, _images, _points)
    read = []
    for file, part, what in zip((cameras, images, points), parts, ("cameras", "images", "points"), strict=True):
        if what == "points" and not file.exists():
            read.append(np.zeros((0, 3)))
            continue
        content = read_regular(file)
        with explained(file, f"is not COLMAP's list of {what}"):
            read.append(part(content))
    return Model(*read, source=images)


class _Bytes:
    """Bytes of a binary file, taken from the front."""

    def __init__(self, content):
        self.content, self.at = content, 0

    def take(self, form):
        """Numbers by `struct`'s letters."""
        if self.at + struct.calcsize(f"<{form}") > len(self.content):
            raise ValueError("it ends too early")
        found = struct.unpack_from(f"<{form}", self.content, self.at)
        self.at += struct.calcsize(f"<{form}")
        return found

    def count(self, least):
        """A count of entries of so many bytes at least, that are all there."""
        (count,) = self.take("Q")
        if count * least > len(self.content) - self.at:
            raise ValueError(f"it claims {count:,} entries, more than {len(self.content) - self.at:,} bytes can hold")
        return count

    def skip(self, size):
        """Pass over a count and its entries of so many bytes."""
        count = self.count(size)
        self.at += count * size

    def text(self):
        """A text up to the next zero."""
        end = self.content.index(b"\0", self.at)
        found = os.fsdecode(self.content[self.at : end])
        self.at = end + 1
        return found


def _cameras_bin(content):
    stored, found = _Bytes(content), {}
    for _ in range(stored.count(24)):
        number, kind, width, height = stored.take("IiQQ")
        if kind not in BY_NUMBER:
            raise ValueError(_unknown(OTHERS.get(kind, f"number {kind}")))
        names = KINDS[BY_NUMBER[kind]][1].split()
        _add(found, number, _camera(BY_NUMBER[kind], width, height, stored.take(f"{len(names)}d")))
    return found


def _images_bin(content):
    stored, found = _Bytes(content), []
    for _ in range(stored.count(73)):
        _, *pose, camera = stored.take("I7dI")
        found.append(_image(stored.text(), camera, pose))
        stored.skip(24)  # what it sees: the points are asked instead
    return tuple(found)


def _points_bin(content):
    stored = _Bytes(content)
    points = np.zeros((stored.count(POINT), 3))
    for i in range(len(points)):
        _, *points[i], _, _, _, _ = stored.take("Q3d3Bd")
        stored.skip(8)
    return _finite(points)


def _cameras(content):
    found = {}
    for row in _rows(content.decode("utf-8")):
        number, kind, width, height, *parameters = row.split()
        if kind not in KINDS:
            raise ValueError(_unknown(kind))
        _add(found, int(number), _camera(kind, int(width), int(height), [float(value) for value in parameters]))
    return found


def _images(content):
    found = []
    for row in _image_rows(os.fsdecode(content)):
        _, *pose, camera, name = row.split(maxsplit=9)
        found.append(_image(name.rstrip(), int(camera), [float(value) for value in pose]))
    return tuple(found)


def _points(content):
    return _finite(
        np.array([row.split(maxsplit=4)[1:4] for row in _rows(content.decode("utf-8"))], float).reshape(-1, 3)
    )


def _rows(text):
    return [row for line in text.splitlines() if (row := line.strip()) and not row.startswith("#")]


def _image_rows(text):
    """The first line of every image: the second, of what it sees, may be empty."""
    rows, lines = [], iter(text.splitlines())
    for line in lines:
        if (row := line.strip()) and not row.startswith("#"):
            rows.append(row)
            next(lines, None)
    return rows


def _camera(kind, width, height, parameters):
    names = KINDS[kind][1].split()
    if len(parameters) != len(names) or not np.isfinite(parameters).all():
        raise ValueError(f"a camera of kind {kind} should have the finite numbers {', '.join(names)}")
    return StoredCamera(kind, (height, width), dict(zip(names, map(float, parameters), strict=True)))


def _image(name, camera, pose):
    if len(pose) != 7:
        raise ValueError(f"the pose of {name[:80]!r} has {len(pose)} numbers, expected 7")
    if not np.isfinite(pose).all() or not np.any(pose[:4]):
        raise ValueError(f"the pose of {name[:80]!r} is {pose}: its quaternion is no rotation, or it is not finite")
    return StoredImage(name, camera, np.array(pose[:4]), np.array(pose[4:]))


def _add(found, number, camera):
    if number in found:
        raise ValueError(f"it has two cameras of number {number}")
    found[number] = camera


def _finite(points):
    if not np.isfinite(points).all():
        raise ValueError("a point has coordinates that are not finite")
    return points


def _unknown(kind):
    return (
        f"its camera is of kind {kind}, none of {', '.join(KINDS)}: undistort it with COLMAP's image_undistorter first"
    )


def write_model(folder: Path, model: Model, *, binary: bool = True) -> None:
    """Write the three files of a model into a folder that is there; no image sees a point, as none is matched.

    Args:
      folder: of the files.
      model: `Model`.
      binary: .bin files, else .txt.
    """
    write = _write_bin if binary else _write_text
    for name, content in write(model).items():
        (folder / f"{name}.{'bin' if binary else 'txt'}").write_bytes(content)


def _write_bin(model):
    counted = lambda entries: struct.pack("<Q", len(entries)) + b"".join(entries)
    cameras = [
        struct.pack(f"<IiQQ{len(c.parameters)}d", i, KINDS[c.kind][0], *c.size[::-1], *c.parameters.values())
        for i, c in model.cameras.items()
    ]
    images = [
        struct.pack("<I7dI", i, *image.quaternion, *image.translation, image.camera)
        + os.fsencode(image.name)
        + struct.pack("<xQ", 0)
        for i, image in enumerate(model.images, 1)
    ]
    points = [struct.pack("<Q3d3BdQ", i, *point, 128, 128, 128, 0, 0) for i, point in enumerate(model.points, 1)]
    return dict(cameras=counted(cameras), images=counted(images), points3D=counted(points))


def _write_text(model):
    said = lambda *values: " ".join(repr(float(x)) if isinstance(x, float) else str(x) for x in values)
    cameras = [said(i, c.kind, *c.size[::-1], *c.parameters.values()) for i, c in model.cameras.items()]
    images = [
        said(i, *image.quaternion.tolist(), *image.translation.tolist(), image.camera, image.name) + "\n"
        for i, image in enumerate(model.images, 1)
    ]
    points = [said(i, *point, 128, 128, 128, 0.0) for i, point in enumerate(model.points.tolist(), 1)]
    heads = dict(
        cameras="# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]",
        images="# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)",
        points3D="# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    )
    rows = dict(cameras=cameras, images=images, points3D=points)
    return {name: os.fsencode("\n".join([heads[name], *rows[name]]) + "\n") for name in rows}
