"""Which source views may be trusted at a point: not those in which something moving, or nearer, covers it.

    static               (..., H, W) probability that a source's pixel shows the static scene, in [0, 1]
    inverse_depth        (..., H, W) of what the pixel shows, in the source camera, 1 / world unit, >= 0
    tolerance            (..., H, W) how far inverse depths may differ and still be one surface, > 0
    point_inverse_depth  (...) of the point asked about, in the same source camera

Every test is soft, so that a coarse depth costs little and a gradient flows.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array
from zestjax.cameras import Camera, project
from zestjax.resample import bilinear

FARTHEST = 10  # tolerances: beyond, exp(-x^2) is 0 in float32, while x^2 and d x / d tolerance may overflow
NARROWEST = 1e-12  # 1 / world unit, the least tolerance: its square must not underflow


class Trust(NamedTuple):
    """Maps of each input frame, at one resolution. static: (..., H, W) in [0, 1]. inverse_depth: (..., H, W), >= 0.
    tolerance: (..., H, W), > 0, of the inverse depth."""

    static: Array
    inverse_depth: Array
    tolerance: Array


def agreement(inverse_depth: Array, tolerance: Array, point_inverse_depth: Array) -> jax.Array:
    """exp(-((inverse_depth - point) / tolerance)^2), in [0, 1]: is the point on the surface that the frame shows?"""
    gap = _gap(jnp.abs(inverse_depth - point_inverse_depth), tolerance)
    return jnp.exp(-gap * gap)


def trusted(static: Array, inverse_depth: Array, tolerance: Array, point_inverse_depth: Array) -> Array:
    """Weight in [0, 1] of a source at a point: static and not hidden.

    static * exp(-(relu(inverse_depth - point) / tolerance)^2); the arguments are arrays of one shape, see the header.

    Raises:
      ValueError: the shapes do not broadcast.
    """
    arrays = dict(inverse_depth=inverse_depth, tolerance=tolerance, point_inverse_depth=point_inverse_depth)
    check_shapes("trusted", static=(static, "..."), **{name: (x, "...") for name, x in arrays.items()})
    gap = _gap(jax.nn.relu(inverse_depth - point_inverse_depth), tolerance)
    return static * jnp.exp(-gap * gap)


def trusted_at(trust: Trust, camera: Camera, points: Array) -> jax.Array:
    """Weight of one source view at world points: `trusted`, with the maps read where the points project to.

    Args:
      trust: `Trust` of (H, W) maps.
      camera: the source's `Camera`, at the maps' resolution.
      points: (..., 3) world.

    Returns:
      (...) in [0, 1]; 0 outside the image and behind the camera.

    Raises:
      ValueError: on a wrong shape.
    """
    check_shapes(
        "trusted_at", static=(trust.static, "H W"), tolerance=(trust.tolerance, "H W"), points=(points, "... 3")
    )
    pixels, depth, in_front = project(camera, points)
    maps, visible = bilinear(jnp.stack(trust, axis=-1), pixels)
    seen = visible & in_front
    tolerance = jnp.where(seen, maps[..., 2], 1)
    weight = trusted(maps[..., 0], maps[..., 1], tolerance, 1 / jnp.where(in_front, depth, 1))
    return jnp.where(seen, weight, 0)


def _gap(distance, tolerance):
    """distance / tolerance, at most 10, with a gradient that stays finite however small the tolerance."""
    tolerance = jnp.maximum(tolerance, NARROWEST)
    far = distance >= FARTHEST * tolerance
    return jnp.where(far, FARTHEST, distance / jnp.where(far, 1, tolerance))
