"""Pictures for people: depths, shares and errors as colours, and several pictures on one sheet.

picture  (H, W, 3) RGB, float in [0, 1] or uint8
"""

import io
import math
from collections.abc import Sequence
from typing import Any

import cv2
import matplotlib
import numpy as np

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array
from zestjax.io.pictures import to_bytes


def png_of(figure: Any, *, dpi: int = 110) -> bytes:
    """A matplotlib `Figure` as the bytes of a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def depth_picture(depth: Array, *, near: float, far: float) -> np.ndarray:
    """(H, W) depths, world units, as a picture: even in inverse depth, near bright, not finite or <= 0 black.

    Raises:
      ValueError: not (H, W).
    """
    check_shapes("depth_picture", depth=(depth, "H W"))
    depth, near, far = np.asarray(depth, np.float64), float(near), float(far)
    known = np.isfinite(depth) & (depth > 0)
    level = (1 / np.where(known, depth, far) - 1 / far) / (1 / near - 1 / far)
    return np.where(known[..., None], _coloured("turbo", level), 0).astype(np.float32)


def share_picture(share: Array) -> np.ndarray:
    """(H, W) values in [0, 1], such as the dynamicness, as a picture: black to bright yellow.

    Raises:
      ValueError: not (H, W).
    """
    check_shapes("share_picture", share=(share, "H W"))
    return _coloured("inferno", np.asarray(share))


def error_picture(picture: Array, truth: Array, *, most: float = 0.25) -> np.ndarray:
    """Absolute differences of two float pictures, mean over the channels; `most` and above is brightest.

    Raises:
      ValueError: shapes do not match.
    """
    check_shapes("error_picture", picture=(picture, "H W 3"), truth=(truth, "H W 3"))
    return share_picture(np.abs(np.asarray(picture) - np.asarray(truth)).mean(-1) / most)


def side_by_side(
    pictures: Sequence[Array], *, labels: Sequence[str] | None = None, columns: int | None = None, gap: int = 4
) -> np.ndarray:
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


def _coloured(name, level):
    return matplotlib.colormaps[name](np.clip(level, 0, 1))[..., :3].astype(np.float32)
