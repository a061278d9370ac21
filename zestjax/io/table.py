"""A plain folder of pictures with `cameras.csv`, a table that is easily written by hand or by a script: zestjax's own.

The first line names the columns, in any order; every other line is a picture. It is UTF-8 with commas.

    file                 of the picture, under the folder
    time                 a whole number; frames are in its order
    width height         pixels of the picture that the intrinsics are of; its file may be resized, never cropped
    fx fy cx cy          intrinsics in pixels; the centre of the first pixel is (0, 0): where a program counts from the
                         corner, subtract 0.5 from cx and cy
    qw qx qy qz tx ty tz camera_from_world as quaternion and translation, or
    m00 m01 ... m23      its 3 x 4 matrix, row by row; axes are OpenCV's: x right, y down, z forward
    near far             depth bounds of what the picture sees; the scene's are the least near and the greatest far
    role                 `input` (also where there is no such column), or `target` for a picture of another camera than
                         the one that took the frame of its time, which is held out
    camera               name of the camera of a target; may be missing

Pictures are undistorted. Each time has one input. Without any target every eighth input is held out, as LLFF's are.
"""

import contextlib
import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from zestjax.base.types import FilePath
from zestjax.io.files import replaced_folder
from zestjax.io.layouts import MOST_DEPTH, Record, every_eighth, select
from zestjax.io.pictures import write_image
from zestjax.io.posed import (
    Posed,
    about_of,
    file_inside,
    intrinsics_of,
    quaternion_of,
    record_of,
    rigid,
    rotation_of,
    write_about,
)
from zestjax.io.reading import MOST_JSON, explained, read_regular
from zestjax.video import Video

MARKER = "cameras.csv"
QUATERNION = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
MATRIX = tuple(f"m{row}{column}" for row in range(3) for column in range(4))
NUMBERS = ("time", "width", "height", "fx", "fy", "cx", "cy", "near", "far")
ROLES = ("input", "target")


def is_table(path: Path) -> bool:
    """Whether a folder is in this layout."""
    return (path / MARKER).is_file()


def read_table(path: Path) -> Record:
    """Read the folder to a `Record`.

    Raises:
      ValueError: a missing column, a cell that is no number, two inputs or none of one time, a pose or bounds that are
        none, or a picture that is missing or not under the folder.
    """
    source = path / MARKER
    rows = _rows(source)
    inputs = sorted((row for row in rows if row["role"] == "input"), key=lambda row: row["time"])
    times = {row["time"]: i for i, row in enumerate(inputs)}
    if len(times) < len(inputs):
        both = next(row["time"] for row, other in zip(inputs, inputs[1:], strict=False) if row["time"] == other["time"])
        raise ValueError(f"{source}: has two inputs of time {both:g}; make one a `target`, or leave it out.")
    targets = [row for row in rows if row["role"] == "target"]
    if alone := [row["time"] for row in targets if row["time"] not in times]:
        raise ValueError(f"{source}: the target of time {alone[0]:g} has no input of its time; leave it out.")
    near, far = min(row["near"] for row in rows), max(row["far"] for row in rows)
    posed = [_posed(path, source, row, times[row["time"]]) for row in inputs]
    name, _ = about_of(path)
    return record_of(
        path, "table", source, posed, (near, far), name=name,
        held_out=[_posed(path, source, row, times[row["time"]]) for row in targets],
        reserved=() if targets else every_eighth(len(posed)),
    )  # fmt: skip


def _rows(source) -> list[dict[str, Any]]:
    """One dict a picture: numbers by column, and `file`, `role`, `camera` as text."""
    with explained(source, "is not a table of cameras"):
        text = read_regular(source, most=MOST_JSON).decode("utf-8-sig")
        head, *lines = [[cell.strip() for cell in line] for line in csv.reader(io.StringIO(text), strict=True) if line]
        if len(set(head)) < len(head):
            raise ValueError("two columns have one name")
        poses = next((names for names in (QUATERNION, MATRIX) if set(names) <= set(head)), None)
        if missing := [name for name in ("file", *NUMBERS) if name not in head]:
            raise ValueError(f"it has no column `{missing[0]}`")
        if poses is None:
            raise ValueError(f"it has no columns of poses: {' '.join(QUATERNION)}, or m00 to m23")
        if not lines:
            raise ValueError("it has no pictures")
        return [_row(i, head, line, (*NUMBERS, *poses)) for i, line in enumerate(lines, 2)]


def _row(number, head, line, names):
    if len(line) != len(head):
        raise ValueError(f"picture {number - 1} has {len(line)} cells for {len(head)} columns")
    cells = dict(zip(head, line, strict=True))
    row = {name: _number(number, name, cells[name]) for name in names}
    role = cells.get("role") or "input"
    if role not in ROLES:
        raise ValueError(f"picture {number - 1} has the role {role[:40]!r}, expected input or target")
    if not 0 < row["near"] < row["far"] < MOST_DEPTH:
        raise ValueError(
            f"picture {number - 1} has near {row['near']:g} and far {row['far']:g}, expected 0 < near < far"
        )
    if bad := [name for name in ("time", "width", "height") if row[name] != round(row[name])]:
        raise ValueError(f"picture {number - 1} has `{bad[0]}` {row[bad[0]]:g}, expected a whole number")
    return row | dict(file=cells["file"], role=role, camera=cells.get("camera", ""))


def _number(number, name, cell):
    with contextlib.suppress(ValueError):
        if np.isfinite(value := float(cell)):
            return value
    raise ValueError(f"picture {number - 1} has {cell[:40]!r} as `{name}`, expected a number")


def _posed(path, source, row, time):
    if "qw" in row:
        quaternion, translation = (np.array([row[name] for name in part]) for part in (QUATERNION[:4], QUATERNION[4:]))
        pose = rigid(rotation_of(source, quaternion), translation)
    else:
        pose = np.array([*(row[name] for name in MATRIX), 0, 0, 0, 1]).reshape(4, 4)
    return Posed(
        file_inside(path, row["file"], source),
        (int(row["height"]), int(row["width"])),
        intrinsics_of(row["fx"], row["fy"], row["cx"], row["cy"]),
        pose,
        time=time,
        camera_name=row["camera"] or "other",
    )


def write_table(folder: FilePath, name: str, video: Video, *, held_out: Iterable = ()) -> None:
    """Write a scene in this layout, all or nothing.

    Args:
      folder: the destination: absent, empty, or an earlier scene of this layout, which is replaced.
      name: of the scene.
      video: `Video`; its images may be uint8.
      held_out: iterable of `zestjax.io.scenes.Target`, read once.

    Raises:
      ValueError: a camera with skew, or a folder with something else in it, which is left alone.
      OSError: the disk is full or the place not writable; nothing half-written is left.
    """
    head = ["file", *NUMBERS, *QUATERNION, "role", "camera"]
    bounds: dict[str, Any] = {"near": float(video.near), "far": float(video.far)}
    with replaced_folder(folder, marker=MARKER) as root:
        lines = []
        for i, image in enumerate(video.images):
            cells = _write_shot(root, f"images/{i:05d}.png", select(video.cameras, i), image)
            lines.append(cells | bounds | dict(time=i, role="input", camera="input"))
        for target in held_out:
            file = f"targets/{target.time:05d}_{target.camera_name}.png"
            cells = _write_shot(root, file, target.camera, target.image)
            lines.append(cells | bounds | dict(time=target.time, role="target", camera=target.camera_name))
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerows([head, *([line[name] for name in head] for line in lines)])
        (root / MARKER).write_text(stream.getvalue(), encoding="utf-8")
        write_about(root, name, None)


def _write_shot(root, file, camera, image):
    """Write a picture; returns its cells of the table."""
    k, pose = (np.asarray(leaf, np.float64) for leaf in camera)
    if k[0, 1]:
        raise ValueError(f"write_table: the camera of {file} has skew, which this layout does not hold.")
    write_image(root / file, image)
    height, width = np.shape(image)[:2]
    numbers = [k[0, 0], k[1, 1], k[0, 2], k[1, 2], *quaternion_of(pose[:3, :3]), *pose[:3, 3]]
    names = ("fx", "fy", "cx", "cy", *QUATERNION)
    return dict(file=file, width=width, height=height) | dict(zip(names, map(float, numbers), strict=True))
