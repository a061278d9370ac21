"""NR-NeRF's layout: `precomputed.json` with one camera per frame, and `images/`.

Poses are in OpenGL's axes with (height, width, focal) as a fifth column; one camera films, so that there is no second
picture of any instant.
"""

import json
import re

import numpy as np

from zestjax.cameras import Camera, camera_from_opengl_pose
from zestjax.io.layouts import Record, bounds_from_frames, pictures_in


def is_nrnerf(path):
    """Whether a folder is in this layout."""
    return (path / "precomputed.json").is_file()


def read_nrnerf(path):
    """Read the folder to a `Record`.

    A picture belongs to the pose that its number says, counted from the lowest number present when there are as many
    pictures as poses, else from 1 (0 when there is a picture 0); pictures without a pose and poses without a picture
    are left out.

    Raises:
      ValueError: the file is not what it should be, or fewer than two pictures have a pose.
    """
    source = path / "precomputed.json"
    try:
        content = json.loads(source.read_text())
        poses, bounds = (np.asarray(content[key], np.float64) for key in ("poses", "bds"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{source}: should hold `poses` (N, 3, 5) and `bds` (N, 2); {error!r}. Export it again."
        ) from error
    if poses.ndim != 3 or poses.shape[1:] != (3, 5) or bounds.shape != (len(poses), 2):
        raise ValueError(
            f"{source}: `poses` should be (N, 3, 5) and `bds` (N, 2), got {poses.shape} and {bounds.shape}."
        )
    images = _matched(path / "images", len(poses))
    if len(images) < 2:
        raise ValueError(
            f"{path / 'images'}: {len(images)} pictures have a pose, a video needs two; check their names."
        )
    kept = sorted(images)
    height, width, _ = sizes = poses[kept][0, :, 4]
    if not np.allclose(poses[:, :2, 4], sizes[:2]):
        raise ValueError(f"{source}: frames of several sizes are not one video; resize them to one.")
    cameras = camera_from_opengl_pose(poses[kept][..., :4].astype(np.float32), height, width, _focal(poses[kept]))
    near, far = bounds_from_frames(bounds[kept])
    return Record(
        name=path.resolve().name,
        layout="nrnerf",
        images=tuple(images[index] for index in kept),
        cameras=Camera._make(map(np.asarray, cameras)),
        size=(round(height), round(width)),
        near=near,
        far=far,
    )


def _focal(poses):
    return poses[:, 2, 4].astype(np.float32)


def _matched(folder, count):
    """{pose index: file}."""
    numbered = {}
    for file in pictures_in(folder):
        digits = re.findall(r"\d+", file.stem)
        if digits:
            numbered[int(digits[-1])] = file
    first = min(numbered, default=0) if len(numbered) == count else min(1, min(numbered, default=0))
    return {number - first: file for number, file in numbered.items() if number - first < count}
