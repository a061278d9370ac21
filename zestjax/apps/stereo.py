"""The real stereo pair that ships with scikit-image, as a video of two frames with true depth.

    H W      rows and columns after resizing
    disparity  columns by which a point of the left picture lies farther left in the right one, pixels

Source: Middlebury 2014 Motorcycle, at a quarter of its size, calibrated in `skimage.data.stereo_motorcycle`.
"""

from typing import NamedTuple

import jax
import numpy as np

from zestjax.cameras import Camera, resized
from zestjax.io.pictures import resize_area, resize_nearest
from zestjax.video import Video

FOCAL, CENTRE, CENTRE_SHIFT, BASELINE = 994.978, (311.193, 254.877), 31.086, 0.193001  # pixels, pixels, pixels, metres


class StereoScene(NamedTuple):
    """video: `Video` of the left and the right picture, metres. depth: (H, W) true depth of the left one, NaN unknown.
    middle: `Camera` half-way. middle_image: (H, W, 3) both pictures carried there by the true disparity.
    middle_known: (H, W) bool, where that is known."""

    video: Video
    depth: np.ndarray
    middle: Camera
    middle_image: np.ndarray
    middle_known: np.ndarray


def stereo_scene(height, width):
    """The pair, cut to the shape of `height` x `width` in the middle and resized to it.

    Returns:
      `StereoScene`.
    """
    from skimage.data import stereo_motorcycle

    left, right, disparity = stereo_motorcycle()
    size, rows = (height, width), round(height * disparity.shape[1] / width)
    top = (disparity.shape[0] - rows) // 2
    disparity = disparity[top : top + rows]
    pictures = np.stack([left, right])[:, top : top + rows].astype(np.float32) / 255
    factors = (width / disparity.shape[1], height / rows)
    both = jax.tree.map(lambda *leaves: np.stack(leaves), camera(0.0, top), camera(1.0, top))
    cameras = resized(both, factors[0], factors[1])
    known = np.isfinite(disparity)
    depth = np.where(known, FOCAL * BASELINE / (disparity + CENTRE_SHIFT), np.nan)
    near, far = 0.95 * depth[known].min(), 1.05 * depth[known].max()
    images = np.stack([resize_area(picture, *size) for picture in pictures])
    middle, seen = carried_half_way(pictures[0], pictures[1], disparity)
    return StereoScene(
        Video(images, Camera(*map(np.asarray, cameras)), np.float32(near), np.float32(far)),
        resize_nearest(depth, *size).astype(np.float32),
        Camera(*map(np.asarray, resized(camera(0.5, top), factors[0], factors[1]))),
        resize_area(np.where(seen[..., None], middle, 0).astype(np.float32), *size),
        resize_area(seen.astype(np.float32)[..., None].repeat(3, -1), *size)[..., 0] > 0.999,
    )


def camera(share, top):
    """The camera at a share of the way from the left (0) to the right (1) one, `top` rows cut off, at full size."""
    centre = (CENTRE[0] + share * CENTRE_SHIFT, CENTRE[1] - top)
    intrinsics = np.array([[FOCAL, 0, centre[0]], [0, FOCAL, centre[1]], [0, 0, 1]], np.float32)
    pose = np.eye(4, dtype=np.float32)
    pose[0, 3] = -share * BASELINE
    return Camera(intrinsics, pose)


def carried_half_way(left, right, disparity):
    """The view half-way: the disparity carried there, the nearest surface first, and both pictures along it.

    Args:
      left: (H, W, 3).
      right: (H, W, 3).
      disparity: (H, W) of the left picture, not finite where unknown.

    Returns:
      ((H, W, 3) mean of both pictures, (H, W) bool where a disparity arrives and both pictures agree on the colour).
    """
    height, width = disparity.shape
    rows, columns = np.nonzero(np.isfinite(disparity))
    values = disparity[rows, columns]
    order = np.argsort(values)  # the nearest are written last
    rows, columns, values = rows[order], columns[order], values[order]
    carried = np.full((height, width), np.nan)
    for place in (np.floor, np.ceil):
        landed = place(columns - values / 2).astype(int)
        inside = (landed >= 0) & (landed < width)
        here = np.full((height, width), -np.inf)
        np.maximum.at(here, (rows[inside], landed[inside]), values[inside])
        carried = np.fmax(carried, np.where(np.isfinite(here), here, np.nan))
    known = np.isfinite(carried)
    shift = np.where(known, carried, 0) / 2
    u = np.arange(width)[None] + np.zeros((height, 1))
    from_left, from_right = _along_rows(left, u + shift), _along_rows(right, u - shift)
    inside = (u + shift <= width - 1) & (u - shift >= 0)
    agree = np.abs(from_left - from_right).mean(-1) < 0.1  # an occluded point has the colour of what hides it
    return (from_left + from_right) / 2, known & inside & agree


def _along_rows(picture, columns):
    """Linear look-up of (H, W, 3) at real columns (H, W)."""
    low = np.clip(np.floor(columns).astype(int), 0, picture.shape[1] - 2)
    rows, share = np.arange(picture.shape[0])[:, None], (columns - low)[..., None]
    return picture[rows, low] * (1 - share) + picture[rows, low + 1] * share
