"""Picture files: frames and masks, as they are stored.

picture  (H, W, 3) RGB, float in [0, 1] or uint8
T        frames of a video
"""

import warnings
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from zestjax.base.types import Array, FilePath
from zestjax.io.claims import claimed_size, most_pixels
from zestjax.io.files import write_bytes
from zestjax.io.reading import FileWarning, read_regular, silenced_stderr

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")
MOST_PIXELS = 2**27  # of a picture: twice those of a telephone; as floats they take 1.6 GB
MOST_OFF = 0.01  # share by which rounding may change a shape: 376x504 for 378x504
MOST_GREY = 0.01  # of a mask's pixels before it is doubted: edges of a JPEG stay below
UNREADABLE = "is not a picture that can be read (truncated, or none of PNG, JPEG, BMP, WebP and TIFF); replace it."


def read_image(path: FilePath, *, native: tuple[int, int] | None = None, transparent: bool = False) -> np.ndarray:
    """An image file as (H, W, 3) float32 RGB in [0, 1], its pixels as they are stored; grey becomes RGB.

    A tag that asks viewers to turn the picture (EXIF) is not followed: poses are of the pixels as stored. What lies
    under transparent pixels is not the scene, and what should stand there is not known: such a picture is refused.

    Args:
      path: the file.
      native: (height, width) that its cameras count pixels in; see `check_fits`.
      transparent: take the colours under transparent pixels all the same, with a `FileWarning`.

    Raises:
      ValueError: the file is missing, no image that OpenCV reads, of floats, partly transparent, or does not fit.
    """
    path = Path(path)
    pixels = _decode(path)
    check_fits(path, pixels.shape[:2], native)
    colours, alpha = _colours(pixels)
    unused = path.suffix.lower() == ".bmp" and alpha is not None and not alpha.any()
    if alpha is not None and not unused and (share := float((alpha < _full(pixels)).mean())):
        if not transparent:
            raise ValueError(
                f"{path}: {share:.1%} of it are transparent; lay it on a background, or save it without alpha."
            )
        warnings.warn(
            f"{path.parent}: has transparent pixels, whose stored colours are used.", FileWarning, stacklevel=2
        )
    shades = colours[..., ::-1] if colours.shape[2] == 3 else np.repeat(colours, 3, -1)
    return np.ascontiguousarray(shades).astype(np.float32) / _full(pixels)


def read_mask(path: FilePath, *, native: tuple[int, int] | None = None) -> np.ndarray:
    """The mask of `doubted_mask`, with a `FileWarning` where it is doubtful; raises as that."""
    mask, doubt = doubted_mask(path, native=native)
    if doubt:
        warnings.warn(mask_warning({path: doubt}), FileWarning, stacklevel=2)
    return mask


def mask_warning(doubts: Mapping[FilePath, str]) -> str:
    """One sentence on the masks that are doubtful: {path: what `doubted_mask` says}, not empty."""
    path, doubt = next(iter(doubts.items()))
    others = f" (and {len(doubts) - 1} more masks like it)" if len(doubts) > 1 else ""
    return f"{path}: {doubt}{others}; a mask is white where pixels move, black elsewhere: look at it."


def doubted_mask(path: FilePath, *, native: tuple[int, int] | None = None) -> tuple[np.ndarray, str | None]:
    """An image file as (H, W) bool: true where it is brighter than half, or is not 0 where its values are 0 and 1.

    Of colours the brightest counts, and transparent pixels are black; of one colour all over, opacity is the mask.

    Args:
      path: the file.
      native: (height, width) of the pictures that it belongs to; see `check_fits`.

    Returns:
      (mask, what makes it doubtful: str or None).

    Raises:
      ValueError: the file is missing, no image that OpenCV reads, of floats, or does not fit.
    """
    path = Path(path)
    pixels = _decode(path)
    check_fits(path, pixels.shape[:2], native)
    colours, alpha = _colours(pixels)
    values = colours.max(-1)
    if alpha is not None:
        one_colour = (colours == colours[:1, :1]).all() and (alpha != alpha[0, 0]).any()
        values = alpha if one_colour else np.where(2 * alpha.astype(int) > alpha.max(), values, 0)
    share = values.astype(np.float32) / (1 if values.max() == 1 else _full(pixels))
    return share > 0.5, _doubt(share)


def image_size(path: FilePath) -> tuple[int, int]:
    """(height, width) of an image file, as it is stored.

    Raises:
      ValueError: the file is missing, or not an image that OpenCV reads.
    """
    return _decode(path).shape[:2]


def check_fits(path: FilePath, have: tuple[int, int], native: tuple[int, int] | None) -> None:
    """Refuse a picture, or a map of its pixels, that was cropped or turned, so that no camera of its poses took it.

    One that was resized passes, with the rounding that this takes: up to a pixel, or two if they are below 1 %.

    Args:
      path: its file.
      have: its (height, width).
      native: (height, width) that its cameras count pixels in, or None where they are not known.

    Raises:
      ValueError: naming both sizes, and the tag that turns the picture where it has one.
    """
    if native is None or tuple(have) == tuple(native):
        return
    (height, width), (rows, columns) = map(int, have), map(int, native)
    off, side = abs(width * rows - height * columns), max(rows, columns)
    resized = off <= side or (off <= 2 * side and off <= MOST_OFF * height * columns)
    if not resized or height == rows or width == columns:
        turned = Path(path).suffix.lower() in SUFFIXES and _as_viewers_show(path).shape[:2] != (height, width)
        hint = " (turned by EXIF? viewers show it turned, by a tag in it)" if turned else ""
        raise ValueError(
            f"{path}: has {height}x{width} pixels (HxW), but its poses are of {rows}x{columns}{hint}; "
            "give the picture that the poses are of, resized at most."
        )


def write_image(path: FilePath, picture: Array) -> None:
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


def encoded_png(picture: Array) -> bytes:
    """A (H, W, 3) picture as the bytes of a PNG; raises as `to_bytes`."""
    return cv2.imencode(".png", to_bytes(picture)[..., ::-1])[1].tobytes()


def to_bytes(picture: Array) -> np.ndarray:
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


def resize_area(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """A float picture (H, W, 3) in [0, 1] resized by the area its pixels cover; enlarged bilinearly."""
    have = picture.shape[:2]
    if have == (height, width):
        return picture
    shrinks = height <= have[0] and width <= have[1]
    resized = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.clip(resized, 0, 1)  # OpenCV's sums exceed 1 by rounding


def resize_nearest(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """(H, W, ...) values of any type at the pixel centres of another size: masks, depths and flows are never mixed."""
    rows, columns = (
        np.minimum(((np.arange(size) + 0.5) * have / size).astype(int), have - 1)
        for size, have in zip((height, width), values.shape[:2], strict=True)
    )
    return values[rows[:, None], columns[None]]


def _decode(path, flag=cv2.IMREAD_UNCHANGED):
    """Pixels as they are stored, (H, W) or (H, W, channels) of uint8 or uint16."""
    content = read_regular(path)
    _check_claim(path, content)
    try:
        with silenced_stderr():
            pixels = cv2.imdecode(np.frombuffer(content, np.uint8), flag)
    except (cv2.error, MemoryError):
        pixels = None
    if pixels is None:
        raise ValueError(f"{path}: {UNREADABLE}")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: has pixels of type {pixels.dtype}, expected 8 or 16 bits; save it as a PNG.")
    return pixels


def _as_viewers_show(path):
    return _decode(path, cv2.IMREAD_COLOR)


def _colours(pixels):
    """(colours (H, W, 1 or 3), opacity (H, W) or None) of decoded pixels."""
    pixels = pixels if pixels.ndim == 3 else pixels[..., None]
    if pixels.shape[2] in (1, 3):
        return pixels, None
    return pixels[..., :-1], pixels[..., -1]


def _full(pixels):
    return 255 if pixels.dtype == np.uint8 else 65535


def _check_claim(path, content):
    """Refuse a picture whose header claims more pixels than are ever decoded, or whose header is of none."""
    claim = claimed_size(content)
    if claim is None:
        raise ValueError(f"{path}: {UNREADABLE}")
    if claim[0] * claim[1] > MOST_PIXELS:
        raise ValueError(
            f"{path}: claims {claim[0]}x{claim[1]} pixels (HxW), more than the {MOST_PIXELS:,} that are read; "
            "give a smaller one."
        )
    if (most := most_pixels(content)) is not None and claim[0] * claim[1] > most:
        raise ValueError(f"{path}: {UNREADABLE}")


def _doubt(share):
    """What makes the values of a mask, in [0, 1], doubtful; None where nothing does."""
    moving, between = float((share > 0.5).mean()), float(((share > 0.25) & (share < 0.75)).mean())
    if moving == 1:
        return "all of it moves"
    if moving == 0 and share.max() > 0:
        return "nothing in it is brighter than half, so that nothing moves"
    return f"{between:.1%} of it are grey, neither moving nor still" if between > MOST_GREY else None
