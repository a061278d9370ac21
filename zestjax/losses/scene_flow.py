"""Losses on the dynamic field's scene flow.

    S           samples on a ray, near to far
    flow        (..., S, 3)  displacement of a sample to a neighbouring frame, world units
    confidence  (..., S)     in [0, 1], w: 1 where the sample has a counterpart there
    valid       leading axes of the flow's; 0 for a neighbour that does not exist

Convert flows from frustum units with `flow.world_flow` first.
"""

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_option, check_shapes
from zestjax.base.numerics import safe_norm
from zestjax.base.types import Array
from zestjax.losses.means import mean_over_valid


def cycle_loss(
    flow_there: Array,
    flow_back: Array,
    confidence: Array,
    *,
    valid: Array | None = None,
    norm: str = "absolute",
    normalise: str = "count",
) -> jax.Array:
    """Going to the neighbour and back should return home: w |f_there(x) + f_back(x + f_there)|.

    Source: ZeST-NeRF eq. 16.
    Reference: ZeST-NeRF train.py, `norm="squared"` and `normalise="confidence"`; NSFF run_nerf.py, absolute.

    Args:
      flow_there: (..., S, 3) flow from t to the neighbour at each sample.
      flow_back: (..., S, 3) flow from the neighbour to t at the displaced sample.
      confidence: (..., S).
      valid: see the header.
      norm: "absolute" (the paper's) or "squared" (the released code's).
      normalise: see `losses.means.mean_over_valid`.

    Returns:
      () mean over samples and the 3 components.

    Raises:
      ValueError: if the shapes do not fit.
    """
    check_shapes("cycle_loss", flow_there=(flow_there, "... S 3"), flow_back=(flow_back, "... S 3"))
    residual = flow_there + flow_back
    return mean_over_valid("cycle_loss", residual, norm=norm, valid=valid, confidence=confidence, normalise=normalise)


def minimum_flow_loss(flow: Array, *, valid: Array | None = None, sum_components: bool = False) -> jax.Array:
    """Most of space stands still: |f|.

    Source: ZeST-NeRF eq. 17.
    Reference: ZeST-NeRF train.py, `sum_components=True`.

    Args:
      flow: (..., S, 3).
      valid: see the header.
      sum_components: add x, y and z before the absolute value, as the released code does: opposite
        components then cancel.

    Returns:
      () mean over samples (and components).

    Raises:
      ValueError: if the shapes do not fit.
    """
    check_shapes("minimum_flow_loss", flow=(flow, "... S 3"))
    residual = jnp.sum(flow, axis=-1) if sum_components else flow
    return mean_over_valid("minimum_flow_loss", residual, norm="absolute", valid=valid)


def spatial_smoothness_loss(
    flow: Array, points: Array, *, valid: Array | None = None, weighting: str = "distance", drop_far: float = 0.0
) -> jax.Array:
    """Neighbouring points move alike: exp(-2 |x - y|) |f(x) - f(y)| of consecutive samples.

    Source: ZeST-NeRF eq. 18.
    Reference: ZeST-NeRF losses.py `compute_sf_smooth_loss`: `weighting="uniform"`, `drop_far=0.05`.

    Args:
      flow: (..., S, 3), S >= 2.
      points: (..., S, 3) of the samples, world units.
      valid: leading axes of the flow's, not its samples'.
      weighting: "distance" or "uniform".
      drop_far: share of the samples, counted from the far end, that is left out.

    Returns:
      () mean over pairs of samples and the 3 components.

    Raises:
      ValueError: if the shapes do not fit, fewer than two samples are left, or `weighting` is unknown.
    """
    check_shapes("spatial_smoothness_loss", flow=(flow, "... S 3"), points=(points, "... S 3"))
    check_option("spatial_smoothness_loss", weighting=(weighting, ("distance", "uniform")))
    kept = _near(flow.shape[-2], drop_far)
    if kept < 2:
        raise ValueError(f"spatial_smoothness_loss: axis S of `flow` is {flow.shape[-2]}, of which {kept} kept; "
                         "expected at least 2.")  # fmt: skip
    between = lambda x: x[..., 1:kept, :] - x[..., : kept - 1, :]
    residual, steps = jnp.broadcast_arrays(between(flow), between(points))
    if weighting == "distance":
        distance = safe_norm(steps, keepdims=True)
        residual = jnp.exp(-2 * distance) * residual
    return mean_over_valid("spatial_smoothness_loss", residual, norm="absolute", valid=valid)


def temporal_loss(
    flow_forward: Array, flow_backward: Array, *, valid: Array | None = None, drop_far: float = 0.0
) -> jax.Array:
    """Constant velocity: (f_forward + f_backward)^2.

    Source: ZeST-NeRF eq. 19.
    Reference: ZeST-NeRF losses.py `compute_sf_lke_loss`: half of this, with `drop_far=0.1`.

    Args:
      flow_forward: (..., S, 3) flow from t to t + 1.
      flow_backward: (..., S, 3) flow from t to t - 1, at the same samples.
      valid: leading axes of the flow's; 0 unless both neighbours exist.
      drop_far: share of the samples, counted from the far end, that is left out.

    Returns:
      () mean over samples and the 3 components.

    Raises:
      ValueError: if the shapes do not fit.
    """
    check_shapes("temporal_loss", flow_forward=(flow_forward, "... S 3"), flow_backward=(flow_backward, "... S 3"))
    kept = _near(flow_forward.shape[-2], drop_far)
    total = (flow_forward + flow_backward)[..., :kept, :]
    return mean_over_valid("temporal_loss", total, norm="squared", valid=valid)


def _near(samples, drop_far):
    """How many of the samples are kept when the far share is dropped."""
    return int(samples * (1 - drop_far))
