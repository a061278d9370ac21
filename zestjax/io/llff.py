"""LLFF's layout: photographs of a scene that stands still, as its own scenes and many captures since come.

`poses_bounds.npy` and `images/` (or `images_<factor>/`, smaller) as in NSFF's layout, which grew out of it, with none
of the folders in which NSFF keeps what it knows of a video. Every eighth photograph, from the first, is held out.
"""

import dataclasses
from pathlib import Path

from zestjax.io.layouts import Record, every_eighth
from zestjax.io.nsff import is_nsff, read_nsff

OF_A_VIDEO = ("dense", "mv_images", "motion_masks", "disp", "flow_i1", "truth", "scene.json")


def is_llff(path: Path) -> bool:
    """Whether a folder is in this layout."""
    photographs = (path / "sparse").is_dir() or any(path.glob("images_[0-9]*"))
    return photographs and is_nsff(path) and not any((path / name).exists() for name in OF_A_VIDEO)


def read_llff(path: Path) -> Record:
    """Read the folder to a `Record`; raises as `nsff.read_nsff`."""
    record = read_nsff(path)
    return dataclasses.replace(record, layout="llff", reserved=every_eighth(len(record.images)))
