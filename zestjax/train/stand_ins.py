"""Training with frames that stand in for those that a clip lacks, as they do where a view is rendered
(`frames.between`).

N      frames of the clip
M      times whose frame is stood in for
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from zestjax.cameras import Camera
from zestjax.frames.assembly import Footage, video_evidence
from zestjax.frames.between import with_camera, with_stand_in
from zestjax.frames.evidence import Evidence
from zestjax.frames.exposure import Exposure, evened
from zestjax.systems.system import System
from zestjax.systems.targets import asks_for_own_time
from zestjax.video import Video

REACH = 2  # frames on either side of a time that are kept: as far as `Slots` look by default


class StandIns(NamedTuple):
    """times: (M,) int. images: (M, H, W, 3) uint8. intrinsics: (M, 3, 3). camera_from_world: (M, 4, 4). evidence:
    `Evidence` (M, 2 REACH + 1, ...) of the frames around each time, the one that stands in among them."""

    times: np.ndarray | np.integer
    images: np.ndarray
    intrinsics: np.ndarray
    camera_from_world: np.ndarray
    evidence: Evidence


class Standing(NamedTuple):
    """A clip in which one frame stands in for another. images: (N, H, W, 3) uint8. cameras: `Camera` (N, ...). row: of
    the `StandIns`. time: frame index."""

    images: np.ndarray
    cameras: Camera
    row: int
    time: int


def find_stand_ins(
    video: Video, seen: Footage, holes: Sequence[int], *, planes: int, exposure: Exposure | None = None
) -> StandIns | None:
    """Those of a video's holes for which a frame can stand in, and what the frames around them then show.

    Args:
      video: `Video` on the host, of uint8 images.
      seen: its `Footage`.
      holes: frames that serve nothing, and are not read.
      planes: of the evidence.
      exposure: `Exposure` without the holes, or None.

    Returns:
      `StandIns`, or None where there are none.
    """
    found = [_stand_in(video, seen, time, holes, planes, exposure) for time in holes]
    found = [one for one in found if one is not None]
    return jax.tree.map(lambda *rows: np.stack(rows), *found) if found else None


def _stand_in(video, seen, time, holes, planes, exposure):
    """A row of `StandIns`, or None."""
    between = with_stand_in(video, seen, time, exclude=holes)
    if between is None:
        return None
    shown, around = between
    frames = np.clip(np.arange(time - REACH, time + REACH + 1), 0, len(video.images) - 1)
    used, place = np.unique(frames, return_inverse=True)
    evidence = video_evidence(
        evened(around, exposure), shown.cameras, video.near, video.far, planes=planes, frames=used,
        exclude=[hole for hole in holes if hole != time],
    )  # fmt: skip
    pose = {name: np.asarray(leaf)[time] for name, leaf in shown.cameras._asdict().items()}
    of_all = jax.tree.map(lambda x: x[place], evidence)
    return StandIns(times=np.int64(time), images=np.asarray(shown.images)[time], evidence=of_all, **pose)


def looks(system: System) -> bool:
    """Whether a system would look at a frame that stands in, and at no frame farther off than are kept."""
    field = system.dynamic
    return field is not None and asks_for_own_time(system) and max(map(abs, field.frames.offsets)) <= REACH


def stand_in_at(
    found: StandIns | None, time: int, images: np.ndarray, cameras: Camera, *, system: System
) -> Standing | None:
    """`Standing` for a target's time, or None: nothing stands in there, or the system does not look so far or at all.

    Args:
      found: `StandIns`, or None.
      time: of the target.
      images: (N, H, W, 3) uint8.
      cameras: `Camera` (N, ...).
      system: `System`.
    """
    if found is None or not np.any(found.times == time) or not looks(system):
        return None
    row = int(np.argmax(found.times == time))
    images = np.array(images)
    images[time] = found.images[row]
    camera = Camera(found.intrinsics[row], found.camera_from_world[row])
    return Standing(images, with_camera(cameras, time, camera), row, time)


def slots_evidence(found: StandIns, standing: Standing, frames: np.ndarray) -> Evidence:
    """`Evidence` of slots, by their frames; one too far off, which only fills a place, has that of the time itself."""
    offsets = np.asarray(frames) - standing.time
    places = np.where(np.abs(offsets) <= REACH, offsets, 0) + REACH
    return jax.tree.map(lambda x: x[standing.row][places], found.evidence)
