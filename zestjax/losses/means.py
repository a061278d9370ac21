"""The one way in which losses average.

    residual    any shape; may be non-finite where it is not valid
    confidence  in [0, 1], predicted: scales a residual, and gradients flow into it
    valid       in [0, 1], data: what is 0 counts in nothing (a missing neighbour, a masked pixel)

Masks are aligned with the residual from the left: axis i of a mask is axis i of the residual, and the
residual's further axes share its value. A norm printed in the paper is a mean over components here, as in the
released code, so that the published weights keep their meaning.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_option
from zestjax.base.numerics import masked_mean
from zestjax.base.types import Array

NORMS = {"absolute": jnp.abs, "squared": jnp.square}
NORMALISERS = ("count", "confidence")  # of a mean weighted by confidence; the released code has the second


def spread_mask(where: str, name: str, mask: Array | None, shape: Sequence[int]) -> jax.Array:
    """A mask with the leading axes of `shape`, broadcast to it; None is all ones.

    Args:
      where: name of the calling function, for the message.
      name: name of the argument.
      mask: leading axes of `shape` (an axis may be 1), or None.
      shape: the residual's.

    Returns:
      an array that broadcasts against `shape`.

    Raises:
      ValueError: naming the function, the argument and both shapes.
    """
    if mask is None:
        return jnp.ones((1,) * len(shape), bool)
    mask = jnp.asarray(mask)
    missing = len(shape) - mask.ndim
    if missing < 0 or any(a not in (1, b) for a, b in zip(mask.shape, shape, strict=False)):
        raise ValueError(
            f"{where}: `{name}` of shape {mask.shape} does not cover the leading axes of a residual of shape {shape}."
        )
    return mask.reshape(mask.shape + (1,) * missing)


def mean_over_valid(
    where: str,
    residual: Array,
    *,
    norm: str | None = None,
    valid: Array | None = None,
    confidence: Array | None = None,
    normalise: str = "count",
) -> jax.Array:
    """Mean of confidence * norm(residual) over what is valid; exactly 0, with a 0 gradient, when nothing is.

    What is not valid may hold NaN or infinity: neither the value nor the gradient sees it.

    Args:
      where: name of the calling loss, for messages.
      residual: any shape.
      norm: "absolute", "squared", or None for a residual that is a cost already.
      valid: leading axes of `residual`, or None.
      confidence: leading axes of `residual`, or None.
      normalise: "count" divides by the number of valid entries; "confidence" by the sum of confidences
        (the released code's), so that the gradient reaches the confidence through both.

    Returns:
      () scalar.

    Raises:
      ValueError: if a mask's shape does not fit, or `norm` or `normalise` is unknown.
    """
    check_option(where, normalise=(normalise, NORMALISERS))
    if norm is not None:
        check_option(where, norm=(norm, tuple(NORMS)))
    mask = spread_mask(where, "valid", valid, residual.shape).astype(residual.dtype)
    cost = jnp.where(mask > 0, residual, 0)
    cost = NORMS[norm](cost) if norm else cost
    if confidence is None:
        return masked_mean(cost, mask)
    confidence = spread_mask(where, "confidence", confidence, residual.shape).astype(residual.dtype)
    confidence = jnp.where(mask > 0, confidence, 0)
    if normalise == "confidence":
        return masked_mean(cost, mask * confidence)
    return masked_mean(cost * confidence, mask)
