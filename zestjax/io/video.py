"""Moving pictures that a browser plays.

T        frames
"""

import contextlib
import os
import tempfile
from pathlib import Path

import cv2
import numpy as np

from zestjax.checks import check_shapes
from zestjax.io.files import write_bytes
from zestjax.io.pictures import to_bytes


def write_video(path_stem, frames, *, fps=24):
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
    parent = Path(path_stem).parent
    parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".video.", dir=parent) as folder:
        for suffix, encode in ((".webm", _encode_webm), (".webp", _encode_webp)):
            draft = Path(folder) / f"video{suffix}"
            if encode(draft, bgr, fps) and draft.exists() and draft.stat().st_size:
                path = Path(f"{path_stem}{suffix}")
                write_bytes(path, draft.read_bytes())
                return path
    raise OSError(f"{path_stem}: this build of OpenCV encodes neither WebM nor WebP; install its wheel from PyPI.")


def read_video(path):
    """Frames (T, H, W, 3) uint8 RGB of a video or an animated picture.

    Raises:
      ValueError: the file is missing or not a video that OpenCV reads.
    """
    if str(path).endswith((".webp", ".gif")):
        done, animation = cv2.imreadanimation(str(path))
        frames = [frame[..., 2::-1] for frame in animation.frames] if done else []
    else:
        capture, frames = cv2.VideoCapture(str(path)), []
        while True:
            done, frame = capture.read()
            if not done:
                break
            frames.append(frame[..., ::-1])
        capture.release()
    if not frames:
        raise ValueError(f"{path}: is not a video that can be read; check the path and the format.")
    return np.stack(frames)


def _encode_webm(path, bgr, fps):
    height, width = bgr.shape[1:3]
    with _silenced_stderr():
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


@contextlib.contextmanager
def _silenced_stderr():
    """OpenCV's FFmpeg remarks on the codec tag, straight to file descriptor 2, whatever its log level."""
    saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)
