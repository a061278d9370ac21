"""What a model must beat: two predictions that need no learning.

nearest frame   the input nearest in time, then in camera position, unchanged
plane warp      the neighbours warped to the target by the one fronto-parallel plane on which they agree best

N        frames of the video
V        neighbours of a time, one per offset
H W      rows and columns of the frames, and of the prediction
offset   a neighbour's time minus the target's
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import safe_divide, safe_norm
from zestjax.base.types import Array
from zestjax.cameras import Camera, centre
from zestjax.planesweep import homographies, plane_depths, warp
from zestjax.video import Video

OFFSETS = (-2, -1, 0, 1, 2)  # the neighbours that the systems' dynamic fields have
LEAST_OVERLAP = 0.5
"""A plane competes when at least this share of the most overlap any plane has remains: agreeing on a sliver is luck."""


class Nearest(NamedTuple):
    """The nearest frame.

    image: (H, W, 3) that frame, unchanged.
    frame: () int32, which one it is.
    """

    image: jax.Array
    frame: jax.Array


class PlaneWarped(NamedTuple):
    """The plane warp.

    image: (H, W, 3) mean of the warped neighbours; the nearest frame where none is seen.
    seen: (H, W) bool, some neighbour sees the pixel on the plane.
    depth: () of the plane in the target camera, world units; without meaning where `overlap` is 0.
    overlap: () share of the pixels that two or more neighbours see on that plane; at 0 (fewer than two neighbours)
      nothing can agree and the image is the nearest frame.
    """

    image: jax.Array
    seen: jax.Array
    depth: jax.Array
    overlap: jax.Array


def nearest_frame(video: Video, camera: Camera, time: int | Array, *, exclude: Sequence[int] | Array = ()) -> Nearest:
    """The input nearest in time, and among those the nearest in camera position.

    Source: zestjax, accuracy floor 1.

    Args:
      video: `Video` of N frames.
      camera: the target's `Camera`, no batch axes.
      time: () frame index of the target, an integer or a traced one.
      exclude: indices of frames that may not be used: a sequence or an integer array, both free to repeat.

    Returns:
      `Nearest`.

    Raises:
      ValueError: shapes do not match, or every frame is excluded.
    """
    available = _available("nearest_frame", video, exclude)
    distance_in_time = jnp.abs(jnp.arange(available.shape[0]) - jnp.asarray(time))
    far_away = jnp.iinfo(distance_in_time.dtype).max
    least = jnp.min(jnp.where(available, distance_in_time, far_away))
    tied = available & (distance_in_time == least)
    offsets = centre(video.cameras) - centre(camera)[None]
    index = jnp.argmin(jnp.where(tied, safe_norm(offsets), jnp.inf)).astype(jnp.int32)
    return Nearest(video.images[index], index)


def plane_warp(
    video: Video,
    camera: Camera,
    time: int | Array,
    *,
    exclude: Sequence[int] | Array = (),
    offsets: Sequence[int] = OFFSETS,
    planes: int = 32,
) -> PlaneWarped:
    """The valid neighbours, warped by the plane on which they agree best and averaged where they see.

    A neighbour is valid when its time exists, it is not excluded, and at offset 0 it is another camera's picture.
    Neighbours agree by the mean squared difference of their colours, over the pairs that see a pixel and over the
    pixels; the planes are regular in inverse depth.

    Source: zestjax, accuracy floor 2.

    Args:
      video: `Video` of N frames.
      camera: the target's `Camera`, no batch axes; the prediction has the size of the frames.
      time: () frame index of the target, an integer or a traced one.
      exclude: indices of frames that may not be used: a sequence or an integer array, both free to repeat.
      offsets: times of the neighbours minus the target's.
      planes: how many depths are tried between the video's near and far.

    Returns:
      `PlaneWarped`.

    Raises:
      ValueError: shapes do not match, or every frame is excluded.
    """
    available = _available("plane_warp", video, exclude)
    frames, valid = _neighbours(video, camera, time, available, offsets)
    depths = plane_depths(video.near, video.far, planes, spacing="inverse")
    carry = homographies(camera, frames.cameras, depths)

    def warped(maps):
        values, seen = jax.vmap(warp, in_axes=(0, 0, None))(frames.images, maps, _homogeneous_pixels(frames.images))
        return values, (seen & valid[:, None, None]).astype(values.dtype)

    differences, overlaps = jax.lax.map(lambda maps: _disagreement(*warped(maps)), carry)
    competes = (overlaps > 0) & (overlaps >= LEAST_OVERLAP * jnp.max(overlaps))
    best = jnp.argmin(jnp.where(competes, differences, jnp.inf))
    values, seen = warped(carry[best])
    views = jnp.sum(seen, axis=0)
    seen_any = (views > 0) & (overlaps[best] > 0)
    mean = safe_divide(jnp.sum(values * seen[..., None], axis=0), views[..., None])
    instead = nearest_frame(video, camera, time, exclude=exclude).image
    return PlaneWarped(jnp.where(seen_any[..., None], mean, instead), seen_any, depths[best], overlaps[best])


class _Frames(NamedTuple):
    images: jax.Array
    cameras: Camera


def _neighbours(video, camera, time, available, offsets):
    """The frames at the offsets (V, ...) and which of them are valid (V,)."""
    count = video.images.shape[0]
    times = jnp.asarray(time) + jnp.asarray(offsets)
    index = jnp.clip(times, 0, count - 1)
    cameras = jax.tree.map(lambda leaf: leaf[index], video.cameras)
    moved = jnp.max(jnp.abs(cameras.camera_from_world - camera.camera_from_world[None]), axis=(1, 2))
    zoomed = jnp.max(jnp.abs(cameras.intrinsics - camera.intrinsics[None]), axis=(1, 2))
    other_camera = (moved > 1e-6) | (zoomed > 1e-3)  # more than rounding of a pose, and of focal lengths in pixels
    valid = (times == index) & available[index] & ((jnp.asarray(offsets) != 0) | other_camera)
    return _Frames(video.images[index], cameras), valid


def _disagreement(values, seen):
    """Mean squared colour difference of the pairs of views that see a pixel, and the share of pixels seen by a pair.

    Args:
      values: (V, H, W, 3).
      seen: (V, H, W) of 0 and 1.
    """
    views = jnp.sum(seen, axis=0)
    mean = safe_divide(jnp.sum(values * seen[..., None], axis=0), views[..., None])
    squares = jnp.sum(jnp.mean((values - mean[None]) ** 2, axis=-1) * seen, axis=0)
    paired = (views >= 2).astype(values.dtype)
    difference = paired * safe_divide(2 * squares, views - 1)
    return safe_divide(jnp.sum(difference), jnp.sum(paired)), jnp.mean(paired)


def _homogeneous_pixels(images):
    """(H, W, 3) grid of (u, v, 1)."""
    height, width = images.shape[-3:-1]
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    return jnp.asarray(np.stack([u, v, np.ones_like(u)], axis=-1), images.dtype)


def _available(where, video, exclude):
    """(N,) bool, the frames that may be used."""
    count = check_shapes(where, images=(video.images, "N H W 3"))["N"]
    if not isinstance(exclude, jax.Array) and count and set(range(count)) <= {int(i) for i in exclude}:
        raise ValueError(f"{where}: `exclude` names all {count} frames, expected at least one left to use.")
    exclude = jnp.asarray(exclude, jnp.int32).reshape(-1)
    return ~jnp.any(jnp.arange(count)[:, None] == exclude[None], axis=1)
