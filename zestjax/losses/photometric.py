"""Losses on colours.

colour      (..., 3)  rendered RGB in [0, 1]
target      (..., 3)  true RGB in [0, 1]
M           neighbouring times that the scene is warped from
"""

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array
from zestjax.losses.means import mean_over_valid


def reconstruction_loss(
    colour: Array, target: Array, *, valid: Array | None = None, norm: str = "squared"
) -> jax.Array:
    """Mean squared error of the blended colour (or of any other render).

    Source: ZeST-NeRF eq. 10.
    Reference: ZeST-NeRF train.py, the combined reconstruction.

    Args:
      colour: (..., 3) RGB in [0, 1].
      target: (..., 3) RGB in [0, 1].
      valid: (...) in [0, 1]; None is everywhere.
      norm: "squared" or "absolute".

    Returns:
      () mean over valid pixels and channels.

    Raises:
      ValueError: if the shapes differ.
    """
    check_shapes("reconstruction_loss", colour=(colour, "... 3"), target=(target, "... 3"))
    return mean_over_valid("reconstruction_loss", colour - target, norm=norm, valid=valid)


def photometric_loss(
    warped: Array, target: Array, confidence: Array, *, valid: Array | None = None, normalise: str = "count"
) -> jax.Array:
    """Neighbouring times, warped to time t, should look like the frame at t where that is certain.

    Source: ZeST-NeRF eq. 11.
    Reference: ZeST-NeRF train.py, `normalise="confidence"`.

    Args:
      warped: (M, ..., 3) colour of the dynamic field at each neighbouring time, seen along the rays of t.
      target: (..., 3) true colour at t.
      confidence: (M, ...) in [0, 1], from `rendering.confidence_map`.
      valid: (M,) or (M, ...); 0 for a neighbour that does not exist.
      normalise: see `losses.means.mean_over_valid`.

    Returns:
      () mean over valid neighbours, rays and channels.

    Raises:
      ValueError: if the shapes do not fit.
    """
    check_shapes("photometric_loss", warped=(warped, "... 3"), target=(target, "... 3"))
    warped, target = jnp.broadcast_arrays(warped, target)
    residual = warped - target
    return mean_over_valid(
        "photometric_loss", residual, norm="squared", valid=valid, confidence=confidence, normalise=normalise
    )
