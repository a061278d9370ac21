"""What a frame's own pixels say about its depth and its motion, without learning: computed once a frame, cached.

J        source frames compared with the reference frame
E        planes of the sweep, uniform in inverse depth, the nearest first
h w      rows and columns of a cell, a quarter of the image: cell j is centred on image pixel 4 j + 3/2
cost     truncated absolute colour difference / TRUNCATION, in [0, 1]; 1 where nothing can be compared
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.cameras import Camera, resized
from zestjax.checks import check_shapes
from zestjax.numerics import matvec
from zestjax.planesweep import homographies, plane_depths
from zestjax.resample import bilinear

TRUNCATION = 0.15
REACH = 2  # cells that a moving point may shift between frames, in the constant-velocity match


class Evidence(NamedTuple):
    """Of one frame, or of many on a leading axis; every value in [0, 1].

    static: (h, w, E) mean cost over the sources if the point stands still at that plane.
    moving: (h, w, E) cost if it moves with constant velocity through t - 1, t, t + 1: least over small opposite shifts.
    colours: (h, w, 12) the frame's colours at the four half-resolution pixels of the cell.
    """

    static: jax.Array
    moving: jax.Array
    colours: jax.Array


class Sources(NamedTuple):
    """Frames to compare with: half-resolution images (J, 2h, 2w, 3), `Camera` of full size (J, ...), valid (J,)."""

    images: jax.Array
    cameras: Camera
    valid: jax.Array


def pooled(x, factor):
    """Mean over factor x factor blocks of (..., H, W, C); the remainder at the right and bottom repeats the edge."""
    height, width, channels = x.shape[-3:]
    lead = [(0, 0)] * (x.ndim - 3)
    x = jnp.pad(x, [*lead, (0, -height % factor), (0, -width % factor), (0, 0)], mode="edge")
    rows, columns = x.shape[-3] // factor, x.shape[-2] // factor
    x = x.reshape(*x.shape[:-3], rows, factor, columns, factor, channels)
    return x.mean(axis=(-4, -2))


def cell_colours(half):
    """Half-resolution images (..., 2h, 2w, 3) as the four colours of each cell, (..., h, w, 12)."""
    *lead, height, width, channels = half.shape
    x = half.reshape(*lead, height // 2, 2, width // 2, 2, channels)
    return jnp.moveaxis(x, -4, -3).reshape(*lead, height // 2, width // 2, 4 * channels)


def half_images(images):
    """Images (..., H, W, 3) at half resolution with even sizes, so that cells are whole."""
    half = pooled(images, 2)
    lead = [(0, 0)] * (half.ndim - 3)
    return jnp.pad(half, [*lead, (0, half.shape[-3] % 2), (0, half.shape[-2] % 2), (0, 0)], mode="edge")


def _plane_cost(reference, warped, seen):
    """(..., h, w) cost of one warped image; 1 where it does not see."""
    difference = jnp.mean(jnp.abs(reference - warped), axis=-1)
    return jnp.where(seen, jnp.minimum(difference / TRUNCATION, 1), 1)


def _grid(height, width, dtype):
    v, u = jnp.meshgrid(jnp.arange(height, dtype=dtype), jnp.arange(width, dtype=dtype), indexing="ij")
    return jnp.stack([u, v, jnp.ones_like(u)], -1)


def _warp(image, homography, grid):
    points = matvec(homography, grid)
    front = points[..., 2] > 1e-6
    sampled = bilinear(image, points[..., :2] / jnp.where(front, points[..., 2], 1)[..., None])
    return sampled.values, sampled.visible & front


def static_cost(reference, sources, hom):
    """(2h, 2w) mean cost over the valid sources at one plane; hom (J, 3, 3) between half-resolution pixels."""
    grid = _grid(reference.shape[0], reference.shape[1], reference.dtype)

    def add(total, inputs):
        image, homography, valid = inputs
        warped, seen = _warp(image, homography, grid)
        weight = seen.astype(valid.dtype) * valid
        return (total[0] + weight * _plane_cost(reference, warped, seen), total[1] + weight), None

    zero = jnp.zeros(reference.shape[:2], reference.dtype)
    (total, count), _ = jax.lax.scan(add, (zero, zero), (sources.images, hom, sources.valid))
    return jnp.where(count > 0, total / jnp.where(count > 0, count, 1), 1)


def moving_cost(reference, before, after, hom, valid):
    """(h, w) least constant-velocity cost at one plane; quarter-resolution images, hom (2, 3, 3), valid (2,)."""
    height, width, _ = reference.shape
    grid = _grid(height, width, reference.dtype)
    costs = []
    for image, homography, sign in zip((before, after), hom, (1, -1), strict=True):
        warped, seen = _warp(image, homography, grid)
        both = jnp.concatenate([warped, seen[..., None].astype(warped.dtype)], -1)
        both = jnp.pad(both, [(REACH, REACH), (REACH, REACH), (0, 0)])
        shifts = [(sign * i, sign * j) for i in range(-REACH, REACH + 1) for j in range(-REACH, REACH + 1)]
        moved = [both[REACH + i : REACH + i + height, REACH + j : REACH + j + width] for i, j in shifts]
        costs.append(jnp.stack([_plane_cost(reference, m[..., :3], m[..., 3] > 0.5) for m in moved]))
    weights = valid / jnp.maximum(jnp.sum(valid), 1)
    total = jnp.min(weights[0] * costs[0] + weights[1] * costs[1], axis=0)
    return jnp.where(jnp.sum(valid) > 0, total, 1)


def frame_evidence(image, camera, sources, neighbours, near, far, *, planes):
    """Evidence of one frame.

    Args:
      image: (2h, 2w, 3) the frame at half resolution (`half_images`).
      camera: its `Camera`, of the full-size image.
      sources: `Sources` for the static cost.
      neighbours: `Sources` of two frames, t - 1 and t + 1.
      near: () world units.
      far: () world units.
      planes: E.

    Returns:
      `Evidence`.

    Source: zestjax; each input frame gets evidence of its own depth and motion.
    """
    check_shapes("frame_evidence", image=(image, "P Q 3"), sources=(sources.images, "J P Q 3"),
                 neighbours=(neighbours.images, "2 P Q 3"))  # fmt: skip
    depths = plane_depths(near, far, planes, spacing="inverse")
    half = lambda c: resized(c, 0.5, 0.5)
    quarter = lambda c: resized(c, 0.25, 0.25)
    hom_half = homographies(half(camera), half(sources.cameras), depths)
    hom_quarter = homographies(quarter(camera), quarter(neighbours.cameras), depths)
    small, around = pooled(image, 2), pooled(neighbours.images, 2)

    def plane(hom):
        static = pooled(static_cost(image, sources, hom[0])[..., None], 2)[..., 0]
        return static, moving_cost(small, around[0], around[1], hom[1], neighbours.valid)

    static, moving = jax.lax.map(plane, (hom_half, hom_quarter))
    return Evidence(jnp.moveaxis(static, 0, -1), jnp.moveaxis(moving, 0, -1), cell_colours(image))
