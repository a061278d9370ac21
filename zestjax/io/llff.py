"""LLFF's layout: photographs of a scene that stands still, as its own scenes and many captures since come.

`poses_bounds.npy` and `images/` (or `images_<factor>/`, smaller) as in NSFF's layout, which grew out of it, with none
of the folders in which NSFF keeps what it knows of a video. Every eighth photograph, from the first, is held out.
"""

import dataclasses
from pathlib import Path

import numpy as np

from zestjax.base.types import FilePath
from zestjax.io.files import replaced_folder
from zestjax.io.layouts import Record, every_eighth
from zestjax.io.nsff import MARKER, is_nsff, poses_bounds, read_nsff
from zestjax.io.pictures import write_image
from zestjax.video import Video

OF_A_VIDEO = ("dense", "mv_images", "motion_masks", "disp", "flow_i1", "truth", "scene.json")


def is_llff(path: Path) -> bool:
    """Whether a folder is in this layout."""
    photographs = (path / "sparse").is_dir() or any(path.glob("images_[0-9]*"))
    return photographs and is_nsff(path) and not any((path / name).exists() for name in OF_A_VIDEO)


def read_llff(path: Path) -> Record:
    """Read the folder to a `Record`; raises as `nsff.read_nsff`."""
    record = read_nsff(path)
    return dataclasses.replace(record, layout="llff", reserved=every_eighth(len(record.images)))


def write_llff(folder: FilePath, video: Video) -> None:
    """Write photographs in this layout, all or nothing, as images_1; a scene is called as its folder.

    The bounds of a photograph are near / 0.9 and 0.9 far, from which those of the scene are made at reading.

    Args:
      folder: the destination: absent, empty, or an earlier scene of this layout, which is replaced.
      video: `Video`; one focal length a frame, principal point in the middle. Its images may be uint8.

    Raises:
      ValueError: a camera the layout cannot hold, bounds nearer than 0.81 to each other, or a folder with something
        else in it, which is left alone.
      OSError: the disk is full or the place not writable; nothing half-written is left.
    """
    rows, bounds = poses_bounds(video), (float(video.near) / 0.9, float(video.far) * 0.9)
    if bounds[0] >= bounds[1]:
        raise ValueError(
            f"write_llff: near {bounds[0] * 0.9:g} and far {bounds[1] / 0.9:g} are too near to each other."
        )
    rows[:, 15:] = bounds
    with replaced_folder(folder, marker=MARKER) as root:
        np.save(root / MARKER, rows)
        for i, image in enumerate(video.images):
            write_image(root / f"images_1/{i:05d}.png", image)
