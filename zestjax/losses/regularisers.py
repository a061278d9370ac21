"""Losses that need no answer: they say which of many explanations to prefer.

S           samples on a ray
blend       (..., S)  in [0, 1], 1 is all dynamic
confidence  (..., S)  in [0, 1]
weights     (..., S)  from `rendering`
"""

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_option, check_shapes
from zestjax.base.types import Array
from zestjax.losses.means import mean_over_valid

LEAST = 1e-7  # a probability under which its logarithm is held


def blend_entropy_loss(
    blend: Array, *, given: str = "probability", symmetric: bool = False, valid: Array | None = None
) -> jax.Array:
    """Each sample should belong to one field: -b log b.

    Source: ZeST-NeRF eq. 15.
    Reference: ZeST-NeRF train.py, with log(b + 1e-8).

    Args:
      blend: (...) probabilities in [0, 1], 0 and 1 among them, or logits.
      given: "probability" or "logit". From logits value and gradient are exact at any magnitude.
      symmetric: add -(1 - b) log(1 - b), the whole entropy; the paper's half is not symmetric.
      valid: leading axes of `blend`.

    Returns:
      () mean, nats.

    Raises:
      ValueError: if `given` is unknown or `valid` does not fit.
    """
    check_option("blend_entropy_loss", given=(given, ("probability", "logit")))
    if given == "logit":
        half = lambda z: jax.nn.sigmoid(z) * jax.nn.softplus(-z)
        cost = half(blend) + half(-blend) if symmetric else half(blend)
    else:
        half = lambda b: -b * jnp.log(jnp.maximum(b, LEAST))
        cost = half(blend) + half(1 - blend) if symmetric else half(blend)
    return mean_over_valid("blend_entropy_loss", cost, valid=valid)


def disocclusion_loss(confidence: Array, *, valid: Array | None = None) -> jax.Array:
    """Confidences should be near one unless there is cause: |w - 1|.

    Source: ZeST-NeRF eq. 14.
    Reference: ZeST-NeRF train.py, the mean of prob = 1 - w.

    Args:
      confidence: (M, ..., S) in [0, 1], for each neighbour.
      valid: (M,) or further leading axes; 0 for a neighbour that does not exist.

    Returns:
      () mean over valid samples.

    Raises:
      ValueError: if `valid` does not fit.
    """
    return mean_over_valid("disocclusion_loss", confidence - 1, norm="absolute", valid=valid)


def distortion_loss(weights: Array, edges: Array, *, valid: Array | None = None) -> jax.Array:
    """Weights of a ray should lie together: sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 length_i.

    Source: mip-NeRF 360 (Barron et al. 2022), eq. 15.
    Reference: ZeST-NeRF losses.py, which halves the pairs, sums over rays and drops the last sample.

    Args:
      weights: (..., S).
      edges: (..., S + 1) ends of the samples' intervals, increasing; normalise to [0, 1] for a loss
        that does not depend on the scene's scale.
      valid: (...) rays that count.

    Returns:
      () mean over rays. Linear in S: pairs are counted by the gap they span, a sum of terms >= 0.

    Raises:
      ValueError: if `edges` has not one entry more than `weights`.
    """
    samples = check_shapes("distortion_loss", weights=(weights, "... S"))["S"]
    check_shapes("distortion_loss", edges=(edges, f"... {samples + 1}"))
    lengths, middles = jnp.diff(edges, axis=-1), (edges[..., 1:] + edges[..., :-1]) / 2
    lengths = jnp.broadcast_to(lengths, weights.shape)
    gaps = jnp.broadcast_to(jnp.diff(middles, axis=-1), (*weights.shape[:-1], samples - 1))
    before = jnp.cumsum(weights, axis=-1)[..., :-1]
    behind = jnp.flip(jnp.cumsum(jnp.flip(weights, -1), axis=-1), -1)[..., 1:]
    pairs = 2 * jnp.sum(before * behind * gaps, axis=-1)
    return mean_over_valid("distortion_loss", pairs + jnp.sum(weights**2 * lengths, axis=-1) / 3, valid=valid)


def edge_aware_depth_loss(
    disparity: Array, image: Array, *, valid: Array | None = None, relative: bool = True
) -> jax.Array:
    """Disparity should be smooth where the image is: |d disparity| exp(-|d image|), both over rows and columns.

    Source: Monodepth2 (Godard et al. 2019), eq. 3.
    Reference: ZeST-NeRF losses.py, `relative=False`.

    Args:
      disparity: (..., H, W).
      image: (..., H, W, C) in [0, 1].
      valid: (...) frames or patches that count.
      relative: divide the disparity by its mean over the image, so that its scale does not matter.

    Returns:
      () mean over vertical neighbours plus mean over horizontal ones.

    Raises:
      ValueError: if the shapes do not fit.
    """
    check_shapes("edge_aware_depth_loss", disparity=(disparity, "... H W"), image=(image, "... H W C"))
    if relative:
        disparity = disparity / (jnp.abs(jnp.mean(disparity, axis=(-2, -1), keepdims=True)) + LEAST)

    def along(axis):
        edge = jnp.mean(jnp.abs(jnp.diff(image, axis=axis - 1)), axis=-1)
        cost = jnp.abs(jnp.diff(disparity, axis=axis)) * jnp.exp(-edge)
        return mean_over_valid("edge_aware_depth_loss", cost, valid=valid)

    return along(-2) + along(-1)
