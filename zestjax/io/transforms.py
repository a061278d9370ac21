"""nerfstudio's and instant-ngp's layout: `transforms.json`, which names the pictures and has their cameras.

    frames[i]          file_path, under the folder; transform_matrix (4, 4): world_from_camera in OpenGL's axes (x
                       right, y up, z backward); time, of any unit, where the frames have one
    w h                size of the pictures, pixels; that of the first one where it is not said
    fl_x fl_y cx cy    pixels, counted from the corner: the centre of the first one is (0.5, 0.5). fl_x may follow from
                       camera_angle_x (radians), fl_y from camera_angle_y or fl_x, cx and cy from the middle
    k1 k2 p1 p2 k3     OpenCV's distortion
    near far           depth bounds: zestjax's own, as the layout has none; or those of `scene.json`

Cameras are said once for all frames, or in a frame for that one. Frames are in the order of their times, or, where none
has one, of their names: by number if these differ in digits only. Two of one time are refused: a video has one camera.
Held out are the frames of `val_filenames` and `test_filenames`, or, where neither is there, every eighth.
"""

import json
import math
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from zestjax.base.types import FilePath
from zestjax.io.files import replaced_folder
from zestjax.io.layouts import Record, every_eighth
from zestjax.io.lens import COEFFICIENTS, UNDISTORT
from zestjax.io.pictures import SUFFIXES, image_size, write_image
from zestjax.io.posed import NO_BOUNDS, Posed, about_of, file_inside, intrinsics_of, near_far, record_of, write_about
from zestjax.io.reading import FileWarning, in_order, json_numbers, read_json
from zestjax.video import Video

MARKER = "transforms.json"
PINHOLES = (None, "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE", "perspective")
UNREAD = ("mask_path", "depth_file_path")
SPLITS = ("val_filenames", "test_filenames")
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # of OpenGL's y and z axis


def is_transforms(path: Path) -> bool:
    """Whether a folder is in this layout."""
    return (path / MARKER).is_file()


def read_transforms(path: Path) -> Record:
    """Read the folder to a `Record`.

    Raises:
      ValueError: the file is not what it should be, a camera is none or of a fisheye, a picture is missing or not under
        the folder, two frames have one time, or the depth bounds are not said.

    Warns:
      FileWarning: masks or depths of frames, which are not read.
    """
    source = path / MARKER
    found = read_json(source)
    frames = found.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise ValueError(f"{source}: should hold `frames`, a list of objects; export it again.")
    name, bounds = about_of(path)
    bounds = near_far(source, found) or bounds
    if bounds is None:
        raise ValueError(f"{source}: has no `near` and `far`; add them, or {NO_BOUNDS}")
    if left := [key for key in UNREAD if any(key in frame for frame in frames)]:
        warnings.warn(f"{source}: names files by {' and '.join(left)}, which are not read.", FileWarning, stacklevel=3)
    files = [_picture(path, source, frame) for frame in frames]
    places = _in_time(source, frames, files)
    size = (
        image_size(files[places[0]]) if os.path.exists(files[places[0]]) else (0, 0)
    )  # a missing one is refused by name
    posed = [_posed(source, found | frames[i], files[i], size) for i in places]
    held = _held_out(path, source, found)
    reserved = every_eighth(len(posed)) if held is None else [i for i, shot in enumerate(posed) if shot.image in held]
    return record_of(path, "transforms", source, posed, bounds, name=name, reserved=reserved)


def _picture(path, source, frame):
    """The file of a frame, whose suffix may be left out."""
    file = file_inside(path, frame.get("file_path"), source)
    if file.suffix.lower() not in SUFFIXES and not os.path.exists(file):
        file = next((there for s in SUFFIXES if os.path.exists(there := file.with_name(file.name + s))), file)
    return file


def _in_time(source, frames, files):
    """Places of the frames in the list, in the order of time."""
    timed = ["time" in frame for frame in frames]
    if not any(timed):
        if len(set(files)) < len(files):
            twice = next(file for i, file in enumerate(files) if file in files[:i])
            raise ValueError(f"{source}: lists {twice.name} twice; keep one of its cameras.")
        if len({file.parent for file in files}) > 1:
            raise ValueError(
                f"{source}: frames lie in several folders and have no `time`, so no order; give them times."
            )
        place = {file: i for i, file in enumerate(files)}
        return [place[file] for file in in_order(files)]
    if not all(timed):
        raise ValueError(
            f"{source}: {timed.count(False)} of {len(timed)} frames have no `time`; give it to all or none."
        )
    times = [float(json_numbers(source, frame, "time", shape=())) for frame in frames]
    places = sorted(range(len(times)), key=lambda i: times[i])
    for i, j in zip(places, places[1:], strict=False):
        if times[i] == times[j]:
            raise ValueError(
                f"{source}: {files[i].name} and {files[j].name} are both of time {times[i]:g}; several cameras at one "
                "time are not read: keep one."
            )
    return places


def _posed(source, said, file, stored):
    """A frame's `Posed`, from what the file says of it and of all frames."""
    kind = said.get("camera_model")
    if kind not in PINHOLES or said.get("is_fisheye"):
        shown = kind if isinstance(kind, str) else "is_fisheye"
        raise ValueError(f"{source}: has a camera of kind {shown[:40]}, which is not read; {UNDISTORT}")
    number = lambda key, other=None: _number(source, said, key, other)
    width, height = number("w", stored[1]), number("h", stored[0])
    if width != round(width) or height != round(height):
        raise ValueError(f"{source}: `w` and `h` are {width:g} and {height:g}, expected whole pixels; export it again.")
    fx = number("fl_x") if "fl_x" in said else _focal(source, said, "camera_angle_x", width)
    fy = fx if "camera_angle_y" not in said else _focal(source, said, "camera_angle_y", height)
    fy = number("fl_y", fy)
    if number("k4", 0):
        raise ValueError(f"{source}: has distortion by k4, which is a fisheye's; {UNDISTORT}")
    pose = json_numbers(source, said, "transform_matrix")
    if pose.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{source}: `transform_matrix` has shape {pose.shape}, expected 4 x 4; export it again.")
    pose = np.concatenate([pose[:3], [[0, 0, 0, 1]]])
    intrinsics = intrinsics_of(fx, fy, number("cx", width / 2), number("cy", height / 2), centre=0.5)
    distortion = np.array([number(key, 0) if key in ("k1", "k2", "k3", "p1", "p2") else 0.0 for key in COEFFICIENTS])
    return Posed(file, (int(height), int(width)), intrinsics, _from_world(source, pose), distortion)


def _from_world(source, pose):
    """camera_from_world of a pose in OpenGL's axes."""
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise ValueError(
            f"{source}: a `transform_matrix` is not rigid: its columns should be of length 1 and at right angles; "
            "export it without scaling."
        )
    return FLIP @ np.linalg.inv(pose)


def _number(source, said: Mapping[str, Any], key, other):
    if key not in said and other is not None:
        return float(other)
    return float(json_numbers(source, said, key, shape=()))


def _focal(source, said, key, side):
    """A focal length in pixels from the angle that a side of the picture covers."""
    if key not in said:
        raise ValueError(f"{source}: has neither `fl_x` nor `camera_angle_x`; export it with its focal length.")
    angle = _number(source, said, key, None)
    if not 0 < angle < math.pi:
        raise ValueError(f"{source}: `{key}` is {angle:g}, expected radians between 0 and pi; export it again.")
    return side / 2 / math.tan(angle / 2)


def _held_out(path, source, found):
    """The files that the splits hold out; None where there are no splits."""
    if not any(split in found for split in SPLITS):
        return None
    held = set()
    for split in SPLITS:
        names = found.get(split, [])
        if not isinstance(names, list):
            raise ValueError(f"{source}: `{split}` should be a list of files; export it again.")
        held |= {file_inside(path, name, source) for name in names}
    return held


def write_transforms(folder: FilePath, name: str, video: Video) -> None:
    """Write a video in this layout, all or nothing, with its depth bounds; times run from 0 to 1.

    Args:
      folder: the destination: absent, empty, or an earlier scene of this layout, which is replaced.
      name: of the scene.
      video: `Video`; its images may be uint8.

    Raises:
      ValueError: a camera with skew, or a folder with something else in it, which is left alone.
      OSError: the disk is full or the place not writable; nothing half-written is left.
    """
    count, height, width = np.shape(video.images)[:3]
    frames = []
    for i, (k, pose) in enumerate(zip(*(np.asarray(leaf, np.float64) for leaf in video.cameras), strict=True)):
        if k[0, 1]:
            raise ValueError(f"write_transforms: camera {i} has skew, which this layout does not hold.")
        has = dict(fl_x=k[0, 0], fl_y=k[1, 1], cx=k[0, 2] + 0.5, cy=k[1, 2] + 0.5)
        opengl = np.linalg.inv(FLIP @ pose)
        frames.append(
            dict(file_path=f"images/{i:05d}.png", time=i / max(count - 1, 1), **has, transform_matrix=opengl.tolist())
        )
    about = dict(camera_model="PINHOLE", w=width, h=height, near=float(video.near), far=float(video.far))
    with replaced_folder(folder, marker=MARKER) as root:
        (root / MARKER).write_text(json.dumps(about | {"frames": frames}, indent=1))
        write_about(root, name, None)
        for frame, picture in zip(frames, video.images, strict=True):
            write_image(root / frame["file_path"], picture)
