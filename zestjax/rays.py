"""Rays through pixels, and the depths at which they are sampled.

origins     (R, 3) world
directions  (R, 3) world, of z = 1 in the camera: a point of the ray is origin + depth * direction, depth a z
depths      (S,) or (R, S) z, from near to far
spacing     "depth": even in depth; "inverse": even in inverse depth
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from zestjax.base.checks import check_option, check_shapes
from zestjax.base.numerics import matvec
from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera, centre, intrinsics_inverse

SPACINGS = ("depth", "inverse")  # what samples are even in: the paper's, and that in which parallax is even


class Rays(NamedTuple):
    """origins: (..., 3) world. directions: (..., 3) world, not of unit length: their z in the camera is 1, so that the
    ray's parameter is depth."""

    origins: jax.Array
    directions: jax.Array


class DrawnPixels(NamedTuple):
    """pixels: (count, 2) column and row, float. valid: (count,) bool, all false when the mask is empty.
    available: () int32, how many pixels the mask holds."""

    pixels: jax.Array
    valid: jax.Array
    available: jax.Array


def pixel_grid(height: int, width: int, *, dtype: DTypeLike = jnp.float32) -> jax.Array:
    """(H, W, 2) column and row of every pixel."""
    v, u = jnp.meshgrid(jnp.arange(height, dtype=dtype), jnp.arange(width, dtype=dtype), indexing="ij")
    return jnp.stack([u, v], axis=-1)


def rays_from_pixels(camera: Camera, pixels: Array) -> Rays:
    """Rays from the optical centre through pixels.

    Args:
      camera: one `Camera`, or a batch whose leading axes broadcast with those of `pixels`.
      pixels: (..., 2) column and row.

    Returns:
      `Rays` of (..., 3); `origins + depth * directions` is `cameras.unproject(camera, pixels, depth)`.

    Raises:
      ValueError: if `pixels` does not end in 2.
    """
    check_shapes("rays_from_pixels", pixels=(pixels, "... 2"))
    homogeneous = jnp.concatenate([pixels, jnp.ones_like(pixels[..., :1])], axis=-1)
    world_from_camera = jnp.swapaxes(camera.camera_from_world[..., :3, :3], -1, -2)
    directions = matvec(world_from_camera, matvec(intrinsics_inverse(camera.intrinsics), homogeneous))
    return Rays(jnp.broadcast_to(centre(camera), directions.shape), directions)


def depths_from_fractions(fractions: Array, near: Scalar, far: Scalar, *, spacing: str = "depth") -> jax.Array:
    """Fractions in [0, 1], any shape, to depths from near (at 0) to far (at 1).

    Args:
      fractions: (...).
      near: scalar, world units, > 0.
      far: scalar, > near.
      spacing: `depth` or `inverse`.

    Raises:
      ValueError: on an unknown spacing.
    """
    check_option("depths_from_fractions", spacing=(spacing, SPACINGS))
    if spacing == "depth":
        return jnp.asarray(near * (1 - fractions) + far * fractions)
    return jnp.asarray(1 / ((1 - fractions) / near + fractions / far))


def regular_depths(near: Scalar, far: Scalar, count: int, *, spacing: str = "depth") -> jax.Array:
    """(S,) depths from near to far, both included; the middle one (in the spacing) if count is 1.

    Raises:
      ValueError: on an unknown spacing, or a count below 1.
    """
    if count < 1:
        raise ValueError(f"regular_depths: `count` is {count}, expected at least 1.")
    dtype = jnp.result_type(near, far, float)
    fractions = jnp.linspace(0, 1, count, dtype=dtype) if count > 1 else jnp.full(1, 0.5, dtype)
    return depths_from_fractions(fractions, near, far, spacing=spacing)


def stratified_depths(
    key: jax.Array, near: Scalar, far: Scalar, count: int, rays: int, *, spacing: str = "depth"
) -> jax.Array:
    """One uniform draw in each of `count` equal strata between near and far.

    Args:
      key: random key.
      near: scalar, world units, > 0.
      far: scalar, > near.
      count: samples on a ray.
      rays: how many rays.
      spacing: `depth` or `inverse`: what the strata are equal in.

    Returns:
      (R, S) ascending depths in [near, far].

    Raises:
      ValueError: on an unknown spacing.

    Source: NeRF (Mildenhall et al. 2020), eq. 2.
    Differs from the reference: ZeST-NeRF's strata end at the midpoints of the regular depths, so its two outer ones
    are half as wide as the others and sampled twice as densely; these are equal.
    """
    dtype = jnp.result_type(near, far, float)
    jitter = jax.random.uniform(key, (rays, count), dtype)
    fractions = (jnp.arange(count, dtype=dtype)[None] + jitter) / count
    return depths_from_fractions(fractions, near, far, spacing=spacing)


def interval_lengths(depths: Array, near: Scalar, far: Scalar) -> jax.Array:
    """Length of the interval that each sample stands for: its borders are the midpoints, near and far.

    Args:
      depths: (..., S) ascending, in [near, far].
      near: scalar, where the first interval begins.
      far: scalar, where the last one ends.

    Returns:
      (..., S), >= 0, finite; they sum to far - near. In depth: times the direction's norm they are world lengths.

    Differs from the reference: ZeST-NeRF measures to the next sample and closes the ray with 1e10, whose gradient in
    empty space is as large.
    """
    end = lambda bound: jnp.broadcast_to(jnp.asarray(bound, depths.dtype), (*depths.shape[:-1], 1))
    middles = (depths[..., 1:] + depths[..., :-1]) / 2
    return jnp.diff(jnp.concatenate([end(near), middles, end(far)], axis=-1), axis=-1)


def sample_pixels(key: jax.Array, mask: Array, count: int) -> DrawnPixels:
    """Pixels drawn uniformly, with replacement, from those where a mask is set; works under jit.

    Args:
      key: random key.
      mask: (H, W) bool, or numbers of which those > 0 are set. An empty mask is normal: nothing drawn is valid.
      count: how many to draw.

    Returns:
      `DrawnPixels`; of an empty mask the pixels are (0, 0) and not valid.

    Raises:
      ValueError: if `mask` is not (H, W).
    """
    width = check_shapes("sample_pixels", mask=(mask, "H W"))["W"]
    chosen = mask if mask.dtype == bool else mask > 0
    running = jnp.cumsum(chosen.reshape(-1), dtype=jnp.int32)
    available = running[-1]
    rank = jax.random.randint(key, (count,), 0, jnp.maximum(available, 1))
    index = jnp.searchsorted(running, rank + 1).astype(jnp.int32)
    valid = jnp.broadcast_to(available > 0, (count,))
    index = jnp.where(valid, index, 0)
    pixels = jnp.stack([index % width, index // width], axis=-1).astype(jnp.float32)
    return DrawnPixels(pixels, valid, available)
