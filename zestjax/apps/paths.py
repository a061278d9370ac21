"""Camera paths through a video: what `zestjax render` shows.

    T        frames of the path
    s        place on the path in [0, 1)
    base     the video's own camera at a time, smoothed: a rig that jumps from camera to camera gives its middle

Offsets are in the base camera's axes, in units of the path's radius; the camera keeps looking at the middle depth.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.cameras import Camera, check_camera, look_at, rigid_inverse
from zestjax.io.layouts import as_float32, select
from zestjax.io.reading import json_numbers, read_arrays, read_json

CIRCLE = lambda s: np.stack([np.sin(2 * np.pi * s), np.cos(2 * np.pi * s), 0 * s], -1)
PATHS = {
    "orbit": lambda s: CIRCLE(2 * s),
    "spiral": lambda s: CIRCLE(3 * s) * (1 - 0.6 * s)[:, None] + np.stack([0 * s, 0 * s, 2 * s], -1),
    "wander": lambda s: np.stack(
        [1.4 * np.sin(2 * np.pi * s), 0.5 * np.sin(4 * np.pi * s), 0.7 * np.cos(2 * np.pi * s)], -1
    ),
    "freeze": lambda s: CIRCLE(s),
    "frames": None,
}
"""By name: place to offset. Time runs along the path, but stands still in `freeze`; `frames`: the input cameras."""


SHAPES = {"intrinsics": (3, 3), "camera_from_world": (4, 4)}


class CameraPath(NamedTuple):
    """cameras: `Camera` (T, ...) of numpy arrays. times: (T,) int frame times."""

    cameras: Camera
    times: np.ndarray


def camera_path(name, video, *, count=None):
    """A path by name, or from a file with `intrinsics` (T, 3, 3), `camera_from_world` (T, 4, 4) and `times` (T,).

    Args:
      name: one of `PATHS`, or an .npz or .json file; its cameras are of the video's size.
      video: `Video`.
      count: T of a named path; None: twice the video's frames, and the video's own of `frames`.

    Returns:
      `CameraPath`.

    Raises:
      ValueError: an unknown path, a file without those arrays, a singular camera, or a time the video does not have.
    """
    frames = len(video.images)
    if name not in PATHS:
        return _path_from_file(Path(name), frames)
    if name == "frames":
        index = np.round(np.linspace(0, frames - 1, count or frames)).astype(int)
        return CameraPath(select(video.cameras, index), index)
    count = 2 * frames if count is None else count
    s = np.arange(count) / count
    times = np.full(count, frames // 2) if name == "freeze" else np.floor(s * frames).astype(int)
    continuous = np.full(count, frames / 2) if name == "freeze" else s * (frames - 1)
    return CameraPath(_moved(_smoothed(video, continuous), PATHS[name](s), video), times)


def _smoothed(video, times):
    """The video's camera at (T,) real times, averaged over a sixth of the video around them: world poses (T, 4, 4), and
    intrinsics (T, 3, 3)."""
    poses = np.asarray(rigid_inverse(video.cameras.camera_from_world), np.float64)
    frames = len(poses)
    distance = (times[:, None] - np.arange(frames)) / max(frames / 6, 1)
    weights = np.exp(-0.5 * distance**2)
    weights /= weights.sum(1, keepdims=True)
    mean = np.einsum("tn,nij->tij", weights, poses)
    u, _, vt = np.linalg.svd(mean[:, :3, :3])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]  # a rotation, never a mirror
    mean[:, :3, :3] = u @ vt
    intrinsics = np.einsum("tn,nij->tij", weights, np.asarray(video.cameras.intrinsics, np.float64))
    return mean, intrinsics


def _moved(base, offsets, video):
    """The base cameras (poses, intrinsics) moved by (T, 3) offsets, still looking at the middle depth."""
    poses, intrinsics = base
    rotation, position = poses[:, :3, :3], poses[:, :3, 3]
    inwards = np.array([0, 0, _middle(video)])
    moved = position + np.einsum("tij,tj->ti", rotation, offsets * _radius(video))
    pose = look_at(*(x.astype(np.float32) for x in (moved, position + rotation @ inwards)), up=-rotation[:, :, 1])
    return Camera(intrinsics.astype(np.float32), np.asarray(pose))


def _middle(video):
    return 2 / (1 / float(video.near) + 1 / float(video.far))


def _radius(video):
    """How far a path strays: half the spread of the input cameras, within 0.5 % and 6 % of the middle depth."""
    centres = np.asarray(rigid_inverse(video.cameras.camera_from_world))[:, :3, 3]
    middle = _middle(video)
    spread = np.sqrt(((centres - centres.mean(0)) ** 2).sum(-1).mean())
    return float(np.clip(0.5 * spread, 0.005 * middle, 0.06 * middle))


def _path_from_file(path, frames):
    if path.suffix not in (".npz", ".json") or not path.is_file():
        raise ValueError(f"{path}: is no path; give one of {', '.join(PATHS)}, or an .npz or .json file.")
    names = (*Camera._fields, "times")
    stored = read_json(path) if path.suffix == ".json" else read_arrays(path, names=names)
    if missing := [name for name in names if name not in stored]:
        raise ValueError(
            f"{path}: should hold `intrinsics`, `camera_from_world` and `times`, has no {missing}; write it again."
        )
    leaves = (json_numbers(path, stored, name, shape=(None, *shape)) for name, shape in SHAPES.items())
    camera = Camera(*(as_float32(path, leaf) for leaf in leaves))
    times = json_numbers(path, stored, "times", shape=(None,))
    if (times != np.round(times)).any():
        raise ValueError(f"{path}: `times` should be whole numbers, got {times[times != np.round(times)][0]:g}.")
    count = len(times)
    if camera.intrinsics.shape != (count, 3, 3) or camera.camera_from_world.shape != (count, 4, 4):
        shapes = [leaf.shape for leaf in camera]
        raise ValueError(f"{path}: expected ({count}, 3, 3) and ({count}, 4, 4) for {count} times, got {shapes}.")
    if count == 0 or times.min() < 0 or times.max() >= frames:
        raise ValueError(f"{path}: `times` should lie in 0 to {frames - 1}, the frames of the video.")
    check_camera(str(path), camera)
    return CameraPath(camera, times.astype(int))
