"""Cells: the quarter-resolution pixels in which frames are analysed and volumes are built.

H W      rows and columns of an image
h w      cells that cover it; cell j covers the pixels 4 j to 4 j + 3, and is centred on pixel 4 j + 3/2
half     half-resolution maps, made even: two rows and two columns of them to a cell
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from zestjax.base.numerics import rounded_once
from zestjax.base.types import Array

SIDE = 4  # pixels to a cell
CENTRE = (SIDE - 1) / 2  # of cell 0, pixels


def cells_of(size: int) -> int:
    """Cells that cover `size` pixels: half-resolution pixels, made even, in pairs."""
    return (size + SIDE - 1) // SIDE


def pooled(x: Array, factor: int) -> jax.Array:
    """Mean over factor x factor blocks of (..., H, W, C); the remainder at the right and bottom repeats the edge."""
    height, width, channels = x.shape[-3:]
    lead = [(0, 0)] * (x.ndim - 3)
    x = jnp.pad(x, [*lead, (0, -height % factor), (0, -width % factor), (0, 0)], mode="edge")
    rows, columns = x.shape[-3] // factor, x.shape[-2] // factor
    x = x.reshape(*x.shape[:-3], rows, factor, columns, factor, channels)
    return x.mean(axis=(-4, -2))


def cell_values(half: Array) -> jax.Array:
    """Half-resolution maps (..., 2h, 2w, C) as the four values of each cell, (..., h, w, 4 C)."""
    *lead, height, width, channels = half.shape
    x = half.reshape(*lead, height // 2, 2, width // 2, 2, channels)
    return jnp.moveaxis(x, -4, -3).reshape(*lead, height // 2, width // 2, 4 * channels)


def half_images(images: Array) -> jax.Array:
    """Images (..., H, W, 3) at half resolution with even sizes, so that cells are whole."""
    half = pooled(images, 2)
    lead = [(0, 0)] * (half.ndim - 3)
    return jnp.pad(half, [*lead, (0, half.shape[-3] % 2), (0, half.shape[-2] % 2), (0, 0)], mode="edge")


def grown(x: Array, size: Sequence[int], *, factor: int) -> jax.Array:
    """(V, h, w) maps to image size (H, W): linear between the centres of what is `factor` pixels wide."""
    wide = jax.image.resize(x, (x.shape[0], factor * x.shape[1], factor * x.shape[2]), "linear")
    return wide[:, : size[0], : size[1]]


def nearest_cells(maps: Array, pixels: Array) -> jax.Array:
    """What the four cells about a pixel hold, and their blend.

    Args:
      maps: (G, h, w) a value of each cell, in G maps.
      pixels: (R, 2) column and row.

    Returns:
      (R, 5 G): of the cell above left, above right, below left and below right, and what is between them linearly.
    """
    height, width = maps.shape[1:]
    place = rounded_once((pixels - CENTRE) / SIDE)
    last = jnp.array([[max(width - 2, 0), max(height - 2, 0)]], place.dtype)
    base = jnp.clip(jnp.floor(place), 0, last)
    across, down = jnp.moveaxis(jnp.clip(place - base, 0, 1), -1, 0)[:, None]
    column, row = jnp.moveaxis(base.astype(jnp.int32), -1, 0)
    right, below = jnp.minimum(column + 1, width - 1), jnp.minimum(row + 1, height - 1)
    corner = lambda r, c: maps[:, r, c]
    a, b, c, d = corner(row, column), corner(row, right), corner(below, column), corner(below, right)
    mixed = (a * (1 - across) + b * across) * (1 - down) + (c * (1 - across) + d * across) * down
    return jnp.concatenate([a, b, c, d, mixed]).T
