"""Losses against what pre-trained networks say of a frame: optical flow and depth. Their weights fade.

P        pixels (or rays) of one frame: a prior depth's scale and shift are shared by them
pixels   (..., 2)  (u, v)
valid    in [0, 1]; 0 leaves a pixel out
"""

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array
from zestjax.depth import FLAT, whitened
from zestjax.losses.means import mean_over_valid


def geometric_loss(pixels: Array, target_pixels: Array, *, valid: Array | None = None) -> jax.Array:
    """Where scene flow takes a ray's point in the neighbouring image, against where optical flow does.

    Source: ZeST-NeRF eq. 21.
    Reference: ZeST-NeRF train.py; in pixels, not divided by the image's size.

    Args:
      pixels: (..., 2), from `flow.induced_flow`.
      target_pixels: (..., 2) the ray's pixel plus the prior's optical flow.
      valid: (...) where the prior is consistent, the neighbour exists and the point is visible.

    Returns:
      () mean absolute error in pixels, over u and v.

    Raises:
      ValueError: if the shapes do not fit.
    """
    check_shapes("geometric_loss", pixels=(pixels, "... 2"), target_pixels=(target_pixels, "... 2"))
    return mean_over_valid("geometric_loss", pixels - target_pixels, norm="absolute", valid=valid)


def depth_loss(
    depth: Array, target: Array, *, valid: Array | None = None, norm: str = "absolute", floor: float = FLAT
) -> jax.Array:
    """Rendered depth against a depth known up to a scale > 0 and a shift.

    Source: ZeST-NeRF eq. 22.
    Reference: ZeST-NeRF losses.py `compute_depth_loss`, `norm="squared"`, median and mean absolute deviation.

    Args:
      depth: (..., P) rendered. Render disparity (or minus it) where the prior predicts that: an affine
        change relates like with like only.
      target: (..., P) the prior, any units; may be non-finite where not valid.
      valid: (..., P) or None.
      norm: "absolute" (the paper's) or "squared" (the released code's).
      floor: least spread of a map, as a share of its median. A prior flatter than that counts in nothing.

    Returns:
      () mean over valid pixels of the difference of the whitened maps.

    Raises:
      ValueError: if the shapes do not fit or `norm` is unknown.
    """
    check_shapes("depth_loss", depth=(depth, "... P"), target=(target, "... P"))
    mask = jnp.ones_like(depth) if valid is None else jnp.broadcast_to(valid, depth.shape).astype(depth.dtype)
    ours, theirs = whitened(depth, mask, floor=floor), whitened(target, mask, floor=floor)
    usable = mask * theirs.usable[..., None].astype(mask.dtype)
    return mean_over_valid("depth_loss", ours.values - theirs.values, norm=norm, valid=usable)
