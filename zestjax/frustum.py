"""A camera's frustum as a unit cube: the coordinates in which volumes are looked up and scene flow lives.

    coords   (..., 3) x, y, z in [0, 1] inside: x = u / (W - 1), y = v / (H - 1), z from 0 at near to 1 at far
    spacing  "depth": z linear in depth; "inverse": linear in inverse depth
    cells    (..., 3) plane, row, column of a volume that fills the frustum

A volume whose planes have their own camera (feature maps of stride 4: `cameras.scaled(camera, 1/4, 1/4)`, h, w) is
addressed exactly by the frustum of that camera and size: cell j is then feature pixel j.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_option, check_shapes
from zestjax.base.types import Array
from zestjax.cameras import Camera, project, unproject
from zestjax.rays import SPACINGS

NEAREST = 1e-3  # of near (far): the closest (1 / the farthest) depth that the inverse spacing tells apart


class Frustum(NamedTuple):
    """camera: one `Camera`. near, far: () world units, 0 < near < far. height, width: of the camera's image, pixels."""

    camera: Camera
    near: Array | np.floating
    far: Array | np.floating
    height: int
    width: int


def _span(size):
    """size - 1, or 1 for an axis of one pixel, of which every coordinate is then a pixel offset."""
    return jnp.maximum(jnp.asarray(size) - 1, 1)


def frustum_from_world(frustum: Frustum, points: Array, *, spacing: str = "depth") -> jax.Array:
    """World points to frustum coordinates.

    Args:
      frustum: `Frustum`.
      points: (..., 3) world.
      spacing: `depth` or `inverse`.

    Returns:
      (..., 3) x, y, z. Finite everywhere with finite gradients; points behind the camera have z < 0.

    Raises:
      ValueError: on a wrong shape or an unknown spacing.

    Reference: ZeST-NeRF utils.py `get_ndc_coordinate` (linear depth).
    """
    check_shapes("frustum_from_world", points=(points, "... 3"))
    check_option("frustum_from_world", spacing=(spacing, SPACINGS))
    near, far = frustum.near, frustum.far
    pixels, depth, _ = project(frustum.camera, points)
    if spacing == "depth":
        z = (depth - near) / (far - near)
    else:
        z = (1 / near - 1 / jnp.maximum(depth, NEAREST * near)) / (1 / near - 1 / far)
    x = pixels[..., 0] / _span(frustum.width).astype(depth.dtype)
    y = pixels[..., 1] / _span(frustum.height).astype(depth.dtype)
    return jnp.stack([x, y, z], axis=-1)


def world_from_frustum(frustum: Frustum, coords: Array, *, spacing: str = "depth") -> jax.Array:
    """Frustum coordinates to world points: the inverse of `frustum_from_world` in front of the camera.

    Args:
      frustum: `Frustum`.
      coords: (..., 3) x, y, z. In inverse spacing, z beyond infinity is held at 1000 far.
      spacing: `depth` or `inverse`.

    Returns:
      (..., 3) world.

    Raises:
      ValueError: on a wrong shape or an unknown spacing.

    Differs from the reference: ZeST-NeRF's losses invert with NSFF's OpenGL [-1, 1] cube, which is not the map that
    made its coordinates.
    """
    check_shapes("world_from_frustum", coords=(coords, "... 3"))
    check_option("world_from_frustum", spacing=(spacing, SPACINGS))
    near, far = frustum.near, frustum.far
    x, y, z = coords[..., 0], coords[..., 1], coords[..., 2]
    if spacing == "depth":
        depth = near + z * (far - near)
    else:
        depth = 1 / jnp.maximum(1 / near - z * (1 / near - 1 / far), NEAREST / far)
    u, v = x * _span(frustum.width).astype(x.dtype), y * _span(frustum.height).astype(x.dtype)
    return unproject(frustum.camera, jnp.stack([u, v], axis=-1), depth)


def cells_from_frustum(coords: Array, planes: int, h: int, w: int) -> jax.Array:
    """Frustum coordinates (..., 3) x, y, z to cells (..., 3) plane, row, column of a (planes, h, w) volume.

    The volume's outer samples sit on the frustum's faces; what lies outside [0, 1] lies outside [0, size - 1].
    """
    check_shapes("cells_from_frustum", coords=(coords, "... 3"))
    x, y, z = coords[..., 0], coords[..., 1], coords[..., 2]
    return jnp.stack([z * (planes - 1), y * (h - 1), x * (w - 1)], axis=-1)
