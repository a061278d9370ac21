"""Picture files, and pictures of numbers: depths and errors as colours.

picture  (H, W, 3) RGB, float in [0, 1] or uint8
T        frames of a video
"""

import math
from pathlib import Path

import cv2
import matplotlib
import numpy as np

from zestjax.checks import check_shapes
from zestjax.io.files import write_bytes

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")


def read_image(path):
    """An image file as (H, W, 3) float32 RGB in [0, 1]; grey becomes RGB, an alpha channel is dropped.

    Raises:
      ValueError: the file is missing, or not an image that OpenCV reads.
    """
    return np.ascontiguousarray(_decode(path, cv2.IMREAD_COLOR)[..., ::-1]).astype(np.float32) / 255


def read_mask(path):
    """A grey image file as (H, W) bool: true where it is not black.

    Raises:
      ValueError: the file is missing, or not an image that OpenCV reads.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE) > 0


def image_size(path):
    """(height, width) of an image file.

    Raises:
      ValueError: the file is missing, or not an image that OpenCV reads.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE).shape


def write_image(path, picture):
    """Write a picture, or a (H, W) bool mask, in the format that the path's suffix names; the folder is made.

    Raises:
      ValueError: not a picture, not finite, or a suffix OpenCV cannot write.
      OSError: the disk is full or the place not writable; nothing half-written is left.
    """
    path, pixels = Path(path), to_bytes(picture)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: cannot write pictures as `{path.suffix}`; use one of {', '.join(SUFFIXES)}.")
    _, content = cv2.imencode(path.suffix, pixels[..., ::-1] if pixels.ndim == 3 else pixels)
    write_bytes(path, content.tobytes())


def to_bytes(picture):
    """Floats in [0, 1] (clipped) or booleans to uint8, rounded; uint8 is unchanged. Any leading axes.

    Raises:
      ValueError: not finite, another type, or neither (..., H, W, 3) nor a (H, W) mask.
    """
    pixels = np.asarray(picture)
    if not (pixels.ndim >= 3 and pixels.shape[-1] == 3) and not (pixels.ndim == 2 and pixels.dtype == bool):
        raise ValueError(f"to_bytes: `picture` should be (..., H, W, 3) or a (H, W) bool mask, got {pixels.shape}.")
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype == bool:
        return pixels.astype(np.uint8) * 255
    if pixels.dtype.kind != "f" or not np.isfinite(pixels).all():
        raise ValueError(f"to_bytes: `picture` should be finite floats, booleans or uint8, got {pixels.dtype}.")
    return np.round(np.clip(pixels, 0, 1) * 255).astype(np.uint8)


def depth_picture(depth, *, near, far):
    """(H, W) depths, world units, as a picture: even in inverse depth, near bright, not finite or <= 0 black.

    Raises:
      ValueError: not (H, W).
    """
    check_shapes("depth_picture", depth=(depth, "H W"))
    depth, near, far = np.asarray(depth, np.float64), float(near), float(far)
    known = np.isfinite(depth) & (depth > 0)
    level = (1 / np.where(known, depth, far) - 1 / far) / (1 / near - 1 / far)
    return np.where(known[..., None], _coloured("turbo", level), 0).astype(np.float32)


def share_picture(share):
    """(H, W) values in [0, 1], such as the dynamicness, as a picture: black to bright yellow.

    Raises:
      ValueError: not (H, W).
    """
    check_shapes("share_picture", share=(share, "H W"))
    return _coloured("inferno", np.asarray(share))


def error_picture(picture, truth, *, most=0.25):
    """Absolute differences of two float pictures, mean over the channels; `most` and above is brightest.

    Raises:
      ValueError: shapes do not match.
    """
    check_shapes("error_picture", picture=(picture, "H W 3"), truth=(truth, "H W 3"))
    return share_picture(np.abs(np.asarray(picture) - np.asarray(truth)).mean(-1) / most)


def resize_area(picture, height, width):
    """A float picture (H, W, 3) in [0, 1] resized by the area its pixels cover; enlarged bilinearly."""
    have = picture.shape[:2]
    if have == (height, width):
        return picture
    shrinks = height <= have[0] and width <= have[1]
    resized = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.clip(resized, 0, 1)  # OpenCV's sums exceed 1 by rounding


def resize_nearest(values, height, width):
    """(H, W, ...) values of any type at the pixel centres of another size: masks, depths and flows are never mixed."""
    rows, columns = (
        np.minimum(((np.arange(size) + 0.5) * have / size).astype(int), have - 1)
        for size, have in zip((height, width), values.shape[:2], strict=True)
    )
    return values[rows[:, None], columns[None]]


def side_by_side(pictures, *, labels=None, columns=None, gap=4):
    """Pictures (H, W, 3) of one size on a white grid, each with its label above it.

    Args:
      pictures: sequence of float or uint8 pictures.
      labels: one string each, or None for no labels.
      columns: pictures in a row; all in one row unless told.
      gap: pixels between them.

    Returns:
      uint8 picture.

    Raises:
      ValueError: no pictures, sizes that differ, or another number of labels.
    """
    pictures = [to_bytes(picture) for picture in pictures]
    if not pictures or len({picture.shape for picture in pictures}) != 1:
        raise ValueError(f"side_by_side: expected pictures of one size, got {[p.shape for p in pictures]}.")
    if labels is not None and len(labels) != len(pictures):
        raise ValueError(f"side_by_side: `labels` has {len(labels)} entries, expected {len(pictures)}.")
    height, width = pictures[0].shape[:2]
    columns, head = columns or len(pictures), 18 if labels is not None else 0
    rows = math.ceil(len(pictures) / columns)
    sheet = np.full((rows * (height + head + gap) + gap, columns * (width + gap) + gap, 3), 255, np.uint8)
    for i, picture in enumerate(pictures):
        top, left = gap + i // columns * (height + head + gap), gap + i % columns * (width + gap)
        sheet[top + head : top + head + height, left : left + width] = picture
        if labels is not None:
            cell = np.full((head, width, 3), 255, np.uint8)
            cv2.putText(cell, labels[i], (1, head - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
            sheet[top : top + head, left : left + width] = cell
    return sheet


def _decode(path, flag):
    try:
        content = np.frombuffer(Path(path).read_bytes(), np.uint8)
        pixels = cv2.imdecode(content, flag) if content.size else None
    except OSError as error:
        raise ValueError(f"{path}: could not be read ({error.strerror or error}); check the path.") from error
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError(f"{path}: is not a picture that can be read (truncated, or another format); replace it.")
    return pixels


def _coloured(name, level):
    return matplotlib.colormaps[name](np.clip(level, 0, 1))[..., :3].astype(np.float32)
