"""Camera paths from files: zestjax's own (`.npz`, `.json`) and nerfstudio's `camera_path.json`.

T        frames of the path
unit     a time of nerfstudio's file, in [0, 1] over the video
"""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from zestjax.cameras import Camera, camera_from_opengl_pose, check_camera
from zestjax.io.layouts import as_float32
from zestjax.io.reading import FileWarning, json_numbers, read_arrays, read_json
from zestjax.video import Video

SHAPES = {"intrinsics": (3, 3), "camera_from_world": (4, 4)}
STUDIO = "camera_path"  # the key by which nerfstudio's file is known
PLACED = "dataparser_transforms.json"  # nerfstudio writes it beside a trained model: its world from the data's
FLAT = 180.0  # degrees of a field of view that has no focal length


class CameraPath(NamedTuple):
    """cameras: `Camera` (T, ...) of numpy arrays. times: (T,) int frame times."""

    cameras: Camera
    times: np.ndarray


def path_from_file(path: Path, video: Video) -> CameraPath:
    """A path from a file.

    Args:
      path: `.npz` or `.json` with `intrinsics` (T, 3, 3), `camera_from_world` (T, 4, 4) and `times` (T,); or
        nerfstudio's `camera_path.json`, whose time runs through the video where it has no `render_time`.
      video: `Video`; cameras of a file are of its size.

    Returns:
      `CameraPath`.

    Raises:
      ValueError: another file, a singular camera, or a time the video does not have.
    """
    if path.suffix not in (".npz", ".json") or not path.is_file():
        raise ValueError(f"{path}: is no camera path; give a name of one, or an .npz or .json file.")
    names = (*Camera._fields, "times")
    stored: Any = read_json(path) if path.suffix == ".json" else read_arrays(path, names=names)
    if isinstance(stored, dict) and STUDIO in stored:
        return _of_nerfstudio(path, stored[STUDIO], video)
    if missing := [name for name in names if name not in stored]:
        raise ValueError(
            f"{path}: should hold `intrinsics`, `camera_from_world` and `times`, has no {missing}; write it again."
        )
    leaves = (json_numbers(path, stored, name, shape=(None, *shape)) for name, shape in SHAPES.items())
    camera = Camera(*(as_float32(path, leaf) for leaf in leaves))
    times = json_numbers(path, stored, "times", shape=(None,))
    if (times != np.round(times)).any():
        raise ValueError(f"{path}: `times` should be whole numbers, got {times[times != np.round(times)][0]:g}.")
    count, frames = len(times), len(video.images)
    if camera.intrinsics.shape != (count, 3, 3) or camera.camera_from_world.shape != (count, 4, 4):
        shapes = [leaf.shape for leaf in camera]
        raise ValueError(f"{path}: expected ({count}, 3, 3) and ({count}, 4, 4) for {count} times, got {shapes}.")
    if count == 0 or times.min() < 0 or times.max() >= frames:
        raise ValueError(f"{path}: `times` should lie in 0 to {frames - 1}, the frames of the video.")
    check_camera(str(path), camera)
    return CameraPath(camera, times.astype(int))


def _of_nerfstudio(path, poses, video):
    """`CameraPath` of nerfstudio's list of poses: OpenGL's axes, a vertical field of view in degrees."""
    if not isinstance(poses, list) or not poses or not all(isinstance(pose, dict) for pose in poses):
        raise ValueError(f"{path}: `{STUDIO}` should be a list of objects, one for each frame; export it again.")
    frames, (height, width) = len(video.images), video.images.shape[1:3]
    matrices = np.stack([_matrix(path, pose) for pose in poses])
    angles = np.array([float(json_numbers(path, pose, "fov", shape=())) for pose in poses])
    if not ((angles > 0) & (angles < FLAT)).all():
        raise ValueError(
            f"{path}: `fov` should be degrees between 0 and 180, got {angles.min():g} to {angles.max():g}."
        )
    focal = 0.5 * height / np.tan(0.5 * np.radians(angles))
    world = _in_scene(path, matrices).astype(np.float32)
    cameras = [
        camera_from_opengl_pose(pose, height, width, np.float32(f)) for pose, f in zip(world, focal, strict=True)
    ]
    camera = Camera(*(np.stack([np.asarray(leaf) for leaf in leaves]) for leaves in zip(*cameras, strict=True)))
    check_camera(str(path), camera)
    return CameraPath(camera, np.minimum(_units(path, poses) * frames, frames - 1).astype(int))


def _matrix(path, pose):
    """(3, 4) world_from_camera of one pose, which nerfstudio writes as sixteen numbers in a row."""
    numbers = json_numbers(path, pose, "camera_to_world")
    if numbers.size != 16:
        raise ValueError(f"{path}: `camera_to_world` should be 16 numbers, got {numbers.size}; export it again.")
    return numbers.reshape(4, 4)[:3]


def _units(path, poses):
    """(T,) times in [0, 1]."""
    told = [pose["render_time"] for pose in poses if "render_time" in pose]
    if not told:
        return np.arange(len(poses)) / len(poses)
    times = json_numbers(path, {"render_time": told}, "render_time", shape=(len(poses),))
    if times.min() < 0 or times.max() > 1:
        raise ValueError(f"{path}: `render_time` should lie in 0 to 1, got {times.min():g} to {times.max():g}.")
    return times


def _in_scene(path, matrices):
    """(T, 3, 4) poses in the scene's world: nerfstudio turns and scales the data's, and writes by how much."""
    placed = path.with_name(PLACED)
    if not placed.is_file():
        warnings.warn(
            f"{path}: its poses are taken to be in the scene's own units and axes; put nerfstudio's {PLACED} beside it "
            "if it was drawn in a trained model's viewer.", FileWarning, stacklevel=2,
        )  # fmt: skip
        return matrices
    said: Any = read_json(placed)
    transform, scale = (
        json_numbers(placed, said, "transform", shape=(3, 4)),
        json_numbers(placed, said, "scale", shape=()),
    )
    if not scale > 0 or not np.allclose(transform[:, :3] @ transform[:, :3].T, np.eye(3), atol=1e-3):
        raise ValueError(f"{placed}: should hold a rotation in `transform` and a positive `scale`; export it again.")
    rotation = transform[:, :3].T
    turned, places = rotation @ matrices[:, :, :3], matrices[:, :, 3] / scale - transform[:, 3]
    return np.concatenate([turned, (places @ rotation.T)[..., None]], -1)
