"""NR-NeRF's layout: `precomputed.json` with one camera per frame, and `images/`.

Poses are in OpenGL's axes with (height, width, focal) as a fifth column; one camera films, so that there is no second
picture of any instant.
"""

import re
from pathlib import Path

import numpy as np

from zestjax.cameras import Camera, camera_from_opengl_pose
from zestjax.io.layouts import Record, as_float32, bounds_from_frames, check_sizes, pictures_in
from zestjax.io.reading import json_numbers, read_json


def is_nrnerf(path: Path) -> bool:
    """Whether a folder is in this layout."""
    return (path / "precomputed.json").is_file()


def read_nrnerf(path: Path) -> Record:
    """Read the folder to a `Record`.

    A picture belongs to the pose that its number says, counted from the lowest number present when there are as many
    pictures as poses, else from 1 (0 when there is a picture 0); pictures without a pose and poses without a picture
    are left out.

    Raises:
      ValueError: the file is not what it should be, or fewer than two pictures have a pose.
    """
    source = path / "precomputed.json"
    content = read_json(source)
    if missing := [key for key in ("poses", "bds") if key not in content]:
        raise ValueError(
            f"{source}: should hold `poses` (N, 3, 5) and `bds` (N, 2), has no {missing}. Export it again."
        )
    poses = json_numbers(source, content, "poses", shape=(None, 3, 5))
    bounds = json_numbers(source, content, "bds", shape=(len(poses), 2))
    images = _matched(path / "images", len(poses))
    if len(images) < 2:
        raise ValueError(
            f"{path / 'images'}: {len(images)} pictures have a pose, a video needs two; check their names."
        )
    kept = sorted(images)
    (height, width), focal = check_sizes(source, poses[kept][..., 4])
    opengl = as_float32(source, poses[kept][..., :4])
    cameras = camera_from_opengl_pose(opengl, poses[kept][0, 0, 4], poses[kept][0, 1, 4], focal.astype(np.float32))
    near, far = bounds_from_frames(bounds[kept], where=str(source))
    return Record(
        name=path.resolve().name,
        layout="nrnerf",
        images=tuple(images[index] for index in kept),
        cameras=Camera(*map(np.asarray, cameras)),
        size=(height, width),
        near=near,
        far=far,
    )


def _matched(folder, count):
    """{pose index: file}."""
    numbered = {}
    for file in pictures_in(folder):
        digits = re.findall(r"\d+", file.stem)
        if digits:
            first = numbered.setdefault(int(digits[-1]), file)
            if first != file:
                raise ValueError(f"{file}: has the number of {first.name}, {digits[-1]}; remove or rename one.")
    first = min(numbered, default=0) if len(numbered) == count else min(1, min(numbered, default=0))
    return {number - first: file for number, file in numbered.items() if number - first < count}
