"""Moving pictures that a browser plays.

T        frames

OpenCV's native code takes a path for a URL, and dies of names that are not UTF-8: it is only given files of a
temporary folder, by ASCII names.
"""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array, FilePath
from zestjax.io.files import write_bytes
from zestjax.io.pictures import to_bytes
from zestjax.io.reading import open_regular, silenced_stderr

MOST_BYTES = 2**40  # of a video: only a frame of it is ever held


def write_video(path_stem: FilePath, frames: Array, *, fps: float = 24) -> Path:
    """Write a video as VP8 in WebM, or, where this OpenCV cannot, as an animated WebP.

    Args:
      path_stem: the path without its suffix, which is added; the folder is made.
      frames: (T, H, W, 3) RGB, float in [0, 1] or uint8. An odd size is padded by one repeated row or column: the codec
        wants even ones.
      fps: frames per second.

    Returns:
      `Path` of the file.

    Raises:
      ValueError: not frames, no frame, or not finite.
      OSError: the disk is full, the place not writable, or neither format can be encoded; nothing half-written is left.
    """
    check_shapes("write_video", frames=(frames, "T H W 3"))
    pixels = to_bytes(frames)
    if not pixels.size:
        raise ValueError(f"write_video: `frames` is empty, got shape {pixels.shape}.")
    height, width = pixels.shape[1:3]
    padding = ((0, 0), (0, height % 2), (0, width % 2), (0, 0))
    bgr = np.ascontiguousarray(np.pad(pixels, padding, mode="edge")[..., ::-1])
    with _ascii_folder() as folder:
        for suffix, encode in ((".webm", _encode_webm), (".webp", _encode_webp)):
            draft = folder / f"video{suffix}"
            if encode(draft, bgr, fps) and draft.exists() and _whole(draft, len(bgr)):
                path = Path(f"{path_stem}{suffix}")
                write_bytes(path, draft.read_bytes())
                return path
    raise OSError(
        f"{path_stem}: this build of OpenCV encodes neither WebM nor WebP, or {tempfile.gettempdir()} is full; "
        "install its wheel from PyPI, or set TMPDIR."
    )


def read_video(path: FilePath) -> np.ndarray:
    """Frames (T, H, W, 3) uint8 RGB of a video or an animated picture.

    Raises:
      ValueError: the file is missing or not a video that OpenCV reads.
    """
    with _ascii_folder() as folder:
        link = folder / f"video{_suffix(path)}"
        link.symlink_to(os.path.abspath(path))
        frames = _decoded(link)
    if not frames:
        raise ValueError(f"{path}: is not a video that can be read; check the path and the format.")
    return np.stack(frames)


def video_frames(path: FilePath) -> Iterator[np.ndarray]:
    """The frames of a video or an animated picture one after the other, (H, W, 3) uint8 RGB: only one is held.

    Raises:
      ValueError: at the first frame, if the file is missing or not a video that OpenCV reads.
    """
    with open_regular(path, most=MOST_BYTES):  # nothing but a file is handed to OpenCV, which would wait for a pipe
        pass
    with _ascii_folder() as folder:
        link = folder / f"video{_suffix(path)}"
        link.symlink_to(os.path.abspath(path))
        with silenced_stderr():
            frames = _each(link)
            first = next(frames, None)
        if first is None:
            raise ValueError(f"{path}: is not a video that can be read; check the path and the format.")
        yield first
        yield from frames


def _suffix(path):
    """A file's suffix, if it is ASCII."""
    suffix = Path(path).suffix
    return suffix if suffix.isascii() else ""


@contextlib.contextmanager
def _ascii_folder():
    """Context: a temporary folder under an absolute path of ASCII letters."""
    with tempfile.TemporaryDirectory(prefix="zestjax-") as name:
        if name.isascii():
            yield Path(name)
            return
        handle = os.open(name, os.O_RDONLY)
        try:
            yield Path(f"/proc/self/fd/{handle}")
        finally:
            os.close(handle)


def _whole(path, count):
    """Whether an encoder wrote all it was given: on a full disk it says nothing. WebP joins frames that are equal."""
    found = len(_decoded(path))
    return found == count or (found > 0 and path.suffix == ".webp")


def _decoded(path):
    """The frames of a file that OpenCV may be given; none of one that it cannot read."""
    return list(_each(path))


def _each(path):
    """The same one by one."""
    if path.suffix in (".webp", ".gif"):
        done, animation = cv2.imreadanimation(str(path))
        yield from ([frame[..., 2::-1] for frame in animation.frames] if done else [])
        return
    capture = cv2.VideoCapture(str(path))
    try:
        while True:
            done, frame = capture.read()
            if not done:
                return
            yield frame[..., ::-1]
    finally:
        capture.release()


def _encode_webm(path, bgr, fps):
    height, width = bgr.shape[1:3]
    with silenced_stderr():  # FFmpeg's remarks on the codec's tag
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"VP80"), fps, (width, height))
    if not writer.isOpened():
        return False
    for frame in bgr:
        writer.write(frame)
    writer.release()
    return True


def _encode_webp(path, bgr, fps):
    if not hasattr(cv2, "imwriteanimation"):
        return False
    animation = cv2.Animation()
    animation.frames, animation.durations = list(bgr), [round(1000 / fps)] * len(bgr)
    return cv2.imwriteanimation(str(path), animation, [cv2.IMWRITE_WEBP_QUALITY, 90])
