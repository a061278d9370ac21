"""Plane sweep: carry a source view's pixels onto depth planes of a reference camera.

depths        (D,) z of the planes in the reference camera, world units
homographies  (D, V, 3, 3) reference pixels to source pixels, scaled so that the third coordinate, times the
              plane's depth, is the point's depth in the source camera
grid          (h, w, 3) homogeneous reference pixels (u, v, 1)
"""

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import matmul, matvec
from zestjax.base.types import Array, Scalar
from zestjax.cameras import NEAREST_DEPTH, Camera, intrinsics_inverse, relative
from zestjax.rays import pixel_grid, regular_depths
from zestjax.resample import Sampled, bilinear


def plane_depths(near: Scalar, far: Scalar, count: int, *, spacing: str = "depth") -> jax.Array:
    """(D,) depths of the planes, near and far included; `spacing` is `depth` or `inverse`: what they are even in.

    Raises:
      ValueError: on an unknown spacing, or a count below 1.
    """
    return regular_depths(near, far, count, spacing=spacing)


def sweep_grid(height: int, width: int, *, padding: int = 0, dtype: DTypeLike = jnp.float32) -> jax.Array:
    """(h + 2 padding, w + 2 padding, 3) homogeneous reference pixels; those of the padding lie outside the image."""
    pixels = pixel_grid(height + 2 * padding, width + 2 * padding, dtype=dtype) - padding
    return jnp.concatenate([pixels, jnp.ones_like(pixels[..., :1])], axis=-1)


def plane_homography(reference: Camera, source: Camera, depth: Scalar) -> jax.Array:
    """Homography from reference pixels to source pixels through the plane z = depth of the reference camera.

    H(d) = K_s (R + t n^T / d) K_r^-1, with [R | t] = source_from_reference and n = (0, 0, 1). Its scale is fixed: for a
    pixel p = (u, v, 1) and intrinsics that end in (0, 0, 1), d H p = K_s X with X the point in the source's axes, so
    d (H p)_3 is the point's depth in the source.

    Source: ZeST-NeRF eq. 1 (the printed formula has K_r^T where K_r^-1 belongs, and does not type-check).
    Reference: ZeST-NeRF utils.py `homo_warp`.

    Args:
      reference: one `Camera`, no batch axes.
      source: one `Camera`, no batch axes.
      depth: () world units, > 0.

    Returns:
      (3, 3).

    Raises:
      ValueError: if a camera has batch axes.
    """
    check_shapes(
        "plane_homography",
        reference=(reference.intrinsics, "3 3"),
        source=(source.intrinsics, "3 3"),
    )
    source_from_reference = relative(source, reference)
    rotation, translation = source_from_reference[:3, :3], source_from_reference[:3, 3]
    turn = matmul(matmul(source.intrinsics, rotation), intrinsics_inverse(reference.intrinsics))
    # n^T K_r^-1 = (0, 0, 1): the translation touches the last column alone.
    return turn.at[:, 2].add(matvec(source.intrinsics, translation) / depth)


def homographies(reference: Camera, sources: Camera, depths: Array) -> jax.Array:
    """`plane_homography` of V sources at D depths.

    Args:
      reference: one `Camera`.
      sources: `Camera` with (V, ...) leaves.
      depths: (D,) world units, > 0.

    Returns:
      (D, V, 3, 3).

    Raises:
      ValueError: on a wrong shape.
    """
    check_shapes("homographies", sources=(sources.intrinsics, "V 3 3"), depths=(depths, "D"))
    per_source = jax.vmap(plane_homography, in_axes=(None, 0, None))
    return jax.vmap(per_source, in_axes=(None, None, 0))(reference, sources, depths)


def carry(homography: Array, grid: Array) -> tuple[jax.Array, jax.Array, Array, Array]:
    """Source pixels of a grid, written elementwise: true float32 on every backend, and it fuses with what follows.

    Args:
      homography: (..., 3, 3), leading axes before those of the grid.
      grid: (h, w, 3) homogeneous reference pixels.

    Returns:
      u, v, share, in_front, each (..., h, w): source pixels, the point's depth in the source as a share of the plane's,
      and whether that is in front. Behind the source u and v are finite and mean nothing; the gradient is 0 there.
    """
    entry = lambda i, j: homography[..., i, j][..., None, None]
    plane = tuple(jnp.expand_dims(grid[..., j], tuple(range(homography.ndim - 2))) for j in range(3))
    row = lambda i: entry(i, 0) * plane[0] + entry(i, 1) * plane[1] + entry(i, 2) * plane[2]
    share = row(2)
    in_front = share > NEAREST_DEPTH
    safe = jnp.where(in_front, share, 1)
    return jnp.where(in_front, row(0), 0) / safe, jnp.where(in_front, row(1), 0) / safe, share, in_front


def warp(image: Array, homography: Array, grid: Array) -> Sampled:
    """A source image seen on one plane of the reference camera.

    Args:
      image: (H, W, C) of the source.
      homography: (3, 3) reference pixels to source pixels, see `plane_homography`.
      grid: (h, w, 3) homogeneous reference pixels.

    Returns:
      `Sampled` of (h, w, C) and (h, w): visible where the point is in front of the source and inside its image; values
      are 0 elsewhere.

    Raises:
      ValueError: on a wrong shape.

    Differs from the reference: ZeST-NeRF counts points behind the source as seen, and divides by a z that may be 0.
    """
    check_shapes("warp", image=(image, "H W C"), homography=(homography, "3 3"), grid=(grid, "h w 3"))
    u, v, _, in_front = carry(homography, grid)
    outside = -jnp.ones_like(u)
    return bilinear(image, jnp.stack([jnp.where(in_front, u, outside), v], axis=-1))
