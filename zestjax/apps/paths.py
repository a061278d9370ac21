"""Camera paths through a video: what `zestjax render` shows.

    T        frames of the path
    s        place on the path in [0, 1)
    base     the video's own camera at a time, smoothed: a rig that jumps from camera to camera gives its middle
    share    of the video in [0, 1]: a time

Offsets are in the base camera's axes, in units of the path's radius; the camera keeps looking at the middle depth.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.apps.path_files import CameraPath, path_from_file
from zestjax.cameras import Camera, look_at, rigid_inverse
from zestjax.io.layouts import select

CIRCLE = lambda s: np.stack([np.sin(2 * np.pi * s), np.cos(2 * np.pi * s), 0 * s], -1)
NOWHERE = lambda s: np.zeros((len(s), 3))
RUNS, STANDS = (lambda s: s), (lambda s: np.full(len(s), 0.5))
CLOSER = 0.25  # of the way to the middle depth that a dolly zoom goes: the background grows visibly, nothing is passed


class Kind(NamedTuple):
    """What a path does at a place s, (T,). offset: (T, 3). time: (T,) share that is shown. base: (T,) share whose
    camera it starts from, None: the one shown. nearer: (T,) share of the way to the middle depth that it goes, while
    what is there keeps its size. rounds: of the video's frames that it has by default."""

    offset: Callable
    time: Callable = RUNS
    base: Callable | None = None
    nearer: Callable | None = None
    rounds: int = 2


PATHS = {
    "orbit": Kind(lambda s: CIRCLE(2 * s)),
    "spiral": Kind(lambda s: CIRCLE(3 * s) * (1 - 0.6 * s)[:, None] + np.stack([0 * s, 0 * s, 2 * s], -1)),
    "wander": Kind(
        lambda s: np.stack([1.4 * np.sin(2 * np.pi * s), 0.5 * np.sin(4 * np.pi * s), 0.7 * np.cos(2 * np.pi * s)], -1)
    ),
    "freeze": Kind(CIRCLE, STANDS),
    "fixed": Kind(NOWHERE, base=STANDS, rounds=1),
    "stabilised": Kind(NOWHERE, rounds=1),
    "space-time": Kind(
        lambda s: CIRCLE(np.clip(3 * s - 1, 0, 1)) - CIRCLE(0 * s),
        lambda s: np.where(s < 1 / 3, 1.5 * s, np.where(s < 2 / 3, 0.5, 1.5 * s - 0.5)),
        rounds=3,
    ),  # fmt: skip
    "dolly": Kind(NOWHERE, base=STANDS, nearer=lambda s: CLOSER * np.sin(np.pi * s) ** 2),
    "frames": None,
}
"""By name. Time stands still in `freeze`, and for a third of `space-time`; the camera does in `fixed`; `stabilised` is
the video's own without its jumps; `dolly` comes nearer and zooms out; `frames`: the input cameras."""


def camera_path(name, video, *, count=None):
    """A path by name or from a file, see `path_files.path_from_file`.

    Args:
      name: one of `PATHS`, or an .npz or .json file; its cameras are of the video's size.
      video: `Video`.
      count: T of a named path; None: twice the video's frames or as `PATHS` says, and the video's own of `frames`.

    Returns:
      `CameraPath`.

    Raises:
      ValueError: an unknown path, a file without those arrays, a singular camera, or a time the video does not have.
    """
    frames = len(video.images)
    if name not in PATHS:
        if not Path(name).suffix:
            raise ValueError(f"{name}: is no path; give one of {', '.join(PATHS)}, or an .npz or .json file.")
        return path_from_file(Path(name), video)
    kind = PATHS[name]
    if kind is None:
        index = np.round(np.linspace(0, frames - 1, count or frames)).astype(int)
        return CameraPath(select(video.cameras, index), index)
    count = kind.rounds * frames if count is None else count
    s = np.arange(count) / count
    shares = kind.time(s)
    base = _smoothed(video, (shares if kind.base is None else kind.base(s)) * (frames - 1))
    nearer = np.zeros(count) if kind.nearer is None else kind.nearer(s)
    times = np.minimum(shares * frames + 1e-9, frames - 1).astype(int)  # a third of a video is not always below itself
    return CameraPath(_moved(base, kind.offset(s), nearer, video), times)


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


def _moved(base, offsets, nearer, video):
    """The base cameras (poses, intrinsics) moved by (T, 3) offsets and (T,) shares of the way, still looking at the
    middle depth, which keeps its size."""
    poses, intrinsics = base
    rotation, position = poses[:, :3, :3], poses[:, :3, 3]
    inwards = np.array([0, 0, _middle(video)])
    inside = offsets * _radius(video) + nearer[:, None] * inwards
    moved = position + np.einsum("tij,tj->ti", rotation, inside)
    intrinsics = intrinsics.copy()
    intrinsics[:, [0, 1], [0, 1]] *= 1 - nearer[:, None]
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
