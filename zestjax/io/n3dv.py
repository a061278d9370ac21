"""Neural 3D Video's published layout: recognised, and refused with what to do.

    poses_bounds.npy        (C, 17), as LLFF's, a row for each camera
    cam00.mp4, cam01.mp4    what each camera filmed: all of them at every instant

A `zestjax.video.Video` has one camera at a time.
"""

import re
from pathlib import Path

from zestjax.io.layouts import Record
from zestjax.io.reading import visible

FILMS = re.compile(r"cam\d+\.(mp4|mov|avi|mkv|webm)", re.IGNORECASE)


def is_n3dv(path: Path) -> bool:
    """Whether a folder is in this layout."""
    return (path / "poses_bounds.npy").is_file() and len(_films(path)) > 1


def read_n3dv(path: Path) -> Record:
    """Refuse the folder.

    Raises:
      ValueError: always, naming what to do.
    """
    films = _films(path)
    raise ValueError(
        f"{path}: holds Neural 3D Video's {len(films)} films of several cameras at one time ({films[0].name} to "
        f"{films[-1].name}), which are not read; extract one frame a time into images/, as if one camera had moved, "
        "and give it as `cameras.csv` (`zestjax.io.table`), with other cameras' frames as its targets."
    )


def _films(path):
    return [film for film in visible(path) if FILMS.fullmatch(film.name)]
