"""Losses against exact answers, which only a simulated scene has. Real training data lacks them: each is optional.

D        depth planes of a volume
valid    in [0, 1]; 0 where there is no answer
"""

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array
from zestjax.losses.means import mean_over_valid, spread_mask


def depth_cross_entropy_loss(log_probability: Array, plane: Array, *, valid: Array | None = None) -> jax.Array:
    """Cross-entropy of a distribution over depth planes against the true depth.

    The true depth lies between two planes and is shared between them linearly.

    Args:
      log_probability: (..., D) log-probabilities over the planes, from `jax.nn.log_softmax`.
      plane: (...) true depth as a fractional plane index; outside [0, D - 1] it counts in nothing.
      valid: (...) in [0, 1].

    Returns:
      () mean over valid pixels, nats.

    Raises:
      ValueError: if the shapes do not fit.
    """
    arrays = dict(log_probability=(log_probability, "... D"), plane=(plane, "..."))
    planes = check_shapes("depth_cross_entropy_loss", **arrays)["D"]
    inside = (plane >= 0) & (plane <= planes - 1)
    plane = jnp.where(inside, plane, 0)
    index = jnp.arange(planes).astype(plane.dtype).reshape((1,) * plane.ndim + (planes,))
    share = jnp.maximum(1 - jnp.abs(plane[..., None] - index), 0)
    cost = -jnp.sum(share * jnp.where(share > 0, log_probability, 0), axis=-1)
    inside = inside.astype(cost.dtype)
    if valid is not None:
        inside = inside * spread_mask("depth_cross_entropy_loss", "valid", valid, inside.shape).astype(cost.dtype)
    return mean_over_valid("depth_cross_entropy_loss", cost, valid=inside)


def motion_mask_loss(
    dynamicness: Array, moving: Array, *, valid: Array | None = None, floor: float = 1e-3
) -> jax.Array:
    """Binary cross-entropy of the dynamic field's share of a pixel against whether the pixel moves.

    Args:
      dynamicness: (...) in [0, 1], from `rendering.render_blended`.
      moving: (...) in [0, 1], 1 where the scene moves.
      valid: (...) in [0, 1].
      floor: dynamicness is brought into [floor, 1 - floor] linearly, so that value and gradient are finite at
        exactly 0 and 1.

    Returns:
      () mean over valid pixels, nats.

    Raises:
      ValueError: if the shapes do not fit.
    """
    check_shapes("motion_mask_loss", dynamicness=(dynamicness, "..."), moving=(moving, "..."))
    share = floor + (1 - 2 * floor) * dynamicness
    moving = jnp.asarray(moving).astype(share.dtype)
    cost = -(moving * jnp.log(share) + (1 - moving) * jnp.log1p(-share))
    return mean_over_valid("motion_mask_loss", cost, valid=valid)


def scene_flow_loss(flow: Array, target: Array, *, valid: Array | None = None) -> jax.Array:
    """Mean absolute error of the scene flow of points (or of rays), world units.

    Args:
      flow: (..., 3).
      target: (..., 3).
      valid: leading axes of the flow's; 0 where the point has no true motion or the neighbour does not exist.

    Returns:
      () mean over valid points and the 3 components.

    Raises:
      ValueError: if the shapes do not fit.
    """
    check_shapes("scene_flow_loss", flow=(flow, "... 3"), target=(target, "... 3"))
    return mean_over_valid("scene_flow_loss", flow - target, norm="absolute", valid=valid)
