"""The frames of a video file or of a folder of pictures, measured and chosen."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.apps.progress import progress
from zestjax.io.layouts import pictures_in
from zestjax.io.pictures import SUFFIXES, read_image, resize_area, to_bytes
from zestjax.io.video import video_frames
from zestjax.sfm.choice import chosen_frames, sharpness

LEAST_FRAMES = 2
LEAST_SIDE = 32  # pixels: smaller pictures have too few features for any camera


class Source(NamedTuple):
    """path: as given. files: its pictures, or none of a video file."""

    path: Path
    files: tuple


class Measured(NamedTuple):
    """sharp: variance of the Laplacian of every frame at the working size. same: whether it repeats the one before.
    stored: (height, width) of the frames. size: the same at work."""

    sharp: list
    same: list
    stored: tuple
    size: tuple


def find_source(path):
    """What a user names: a video file, or a folder of pictures.

    Raises:
      ValueError: there is nothing, or a folder without pictures.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"{path}: is neither a file nor a folder; give a video, or a folder of pictures.")
    if not path.is_dir():
        return Source(path, ())
    files = pictures_in(path) or pictures_in(path / "images")
    if not files:
        raise ValueError(f"{path}: holds no pictures ({', '.join(SUFFIXES)}); give a video, or a folder of pictures.")
    return Source(path, files)


def each_frame(source):
    """The frames one after the other, (H, W, 3) uint8, as they are stored.

    Raises:
      ValueError: one cannot be read, or is of another size than the first.
    """
    first = None
    frames = (to_bytes(read_image(file)) for file in source.files) if source.files else video_frames(source.path)
    for i, frame in enumerate(frames):
        name = source.files[i] if source.files else f"{source.path}, frame {i}"
        first = first or (frame.shape, name)
        if frame.shape != first[0]:
            raise ValueError(
                f"{name}: has {frame.shape[0]}x{frame.shape[1]} pixels (HxW), but {Path(first[1]).name} has "
                f"{first[0][0]}x{first[0][1]}; give frames of one size."
            )
        yield frame


def measured(source, height, *, quiet=False):
    """`Measured` of all frames, brought to `height` rows if they have more.

    Raises:
      ValueError: fewer than two frames, all black, or too small.
    """
    sharp, same, before, brightest, stored, size = [], [], None, 0, (0, 0), (0, 0)
    for frame in progress(each_frame(source), "frames", quiet=quiet):
        stored = frame.shape[:2]
        size = working_size(stored, height)
        small = shrunk(frame, size)
        sharp.append(sharpness(small))
        same.append(before is not None and np.array_equal(small, before))
        before, brightest = small, max(brightest, int(small.max()))
    if not brightest:
        raise ValueError(f"{source.path}: all its frames are black; give ones that show something.")
    different = len(same) - sum(same)
    if different < LEAST_FRAMES:
        said = f"{len(sharp)} equal frames are" if len(sharp) > 1 else "one frame is"
        raise ValueError(f"{source.path}: {said} no video; give {LEAST_FRAMES} different frames or more.")
    if min(size) < LEAST_SIDE:
        raise ValueError(
            f"{source.path}: has {stored[0]}x{stored[1]} pixels (HxW); give frames of {LEAST_SIDE} or more either way."
        )
    return Measured(sharp, same, stored, size)


def pick(found, most):
    """Indices of the frames to keep of `Measured`: none that repeats the one before, at most `most`."""
    new = [i for i, same in enumerate(found.same) if not same]
    return [new[i] for i in chosen_frames([found.sharp[i] for i in new], most=most)]


def working_size(stored, height):
    """(height, width) of frames brought to at most `height` rows."""
    if stored[0] <= height:
        return stored
    return height, max(1, round(stored[1] * height / stored[0]))


def shrunk(frame, size):
    """A uint8 frame resized by area."""
    if frame.shape[:2] == size:
        return np.ascontiguousarray(frame)
    return to_bytes(resize_area(frame.astype(np.float32) / 255, *size))
