"""Depth of a ray, and comparing depths known only up to a scale and a shift.

S        samples on a ray
P        pixels (or rays) over which a scale and a shift are shared: one frame, flattened
weights  (..., S)  from `rendering`
depths   (..., S) or (S,)  of the samples, world units, increasing
mask     (..., P)  weights in [0, 1]; 0 leaves a pixel out, whatever it holds
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array, Scalar

EMPTY = 1e-6  # opacity to which a ray's depth is that of what lies behind it
FLAT = 1e-3  # mean absolute deviation, as a share of the median, under which a depth map is flat


class Alignment(NamedTuple):
    """target ~ scale * values + shift. scale, shift: (...)."""

    scale: jax.Array
    shift: jax.Array


class Whitened(NamedTuple):
    """(values - median) / mean absolute deviation from it.

    values: (..., P), 0 where masked out. centre, spread: (...) in the units of the input, spread > 0.
    usable: (...) bool, that some pixel was valid and the map was not flat.
    """

    values: jax.Array
    centre: jax.Array
    spread: jax.Array
    usable: jax.Array


def expected_depth(weights: Array, depths: Array, *, background: Scalar | None = None) -> jax.Array:
    """Mean depth of what a ray shows.

    Source: ZeST-NeRF eq. 20 (expected termination point); eq. 22 names it D.
    Reference: ZeST-NeRF renderer.py `raw2outputs` (`depth_map`).

    Args:
      weights: (..., S).
      depths: (..., S) or (S,), world units.
      background: (...) or () depth of what shows through; None divides by the opacity instead.

    Returns:
      (...,) depth. Without a background an empty ray has the depth of its last sample, and a value and
      gradient that are finite.

    Raises:
      ValueError: if the sample axes differ.

    Differs from the reference: it neither divides by the opacity nor adds a background, so that a
    half-transparent ray comes out too near. `background=0.0` gives its value.
    """
    check_shapes("expected_depth", weights=(weights, "... S"), depths=(depths, "... S"))
    weights, depths = jnp.broadcast_arrays(weights, depths)
    opacity, total = jnp.sum(weights, axis=-1), jnp.sum(weights * depths, axis=-1)
    if background is None:
        return (total + EMPTY * depths[..., -1]) / (opacity + EMPTY)
    return total + (1 - opacity) * background


def median_depth(weights: Array, depths: Array) -> jax.Array:
    """Depth of the sample at which half of the ray's opacity is reached; of the last one if it is empty.

    It is one of the samples' depths: no average of a near and a far surface. No gradient reaches `weights`.

    Args:
      weights: (..., S).
      depths: (..., S) or (S,), world units.

    Returns:
      (...,) depth.

    Raises:
      ValueError: if the sample axes differ.
    """
    check_shapes("median_depth", weights=(weights, "... S"), depths=(depths, "... S"))
    weights, depths = jnp.broadcast_arrays(weights, depths)
    reached = jnp.cumsum(weights, axis=-1)
    half = reached[..., -1:] / 2
    index = jnp.where(half[..., 0] > EMPTY / 2, jnp.argmax(reached >= half, axis=-1), depths.shape[-1] - 1)
    return jnp.take_along_axis(depths, index[..., None], axis=-1)[..., 0]


def disparity_from_depth(depth: Array, *, nearest: float = 1e-6) -> jax.Array:
    """1 / depth, with depths under `nearest` (world units) held there; 0 at an infinite depth.

    Reference: ZeST-NeRF renderer.py `raw2outputs` (`disp_map`), which is 0 / 0 on an empty ray.
    """
    return 1 / jnp.maximum(depth, nearest)


def masked_median(values: Array, mask: Array) -> jax.Array:
    """Median over the last axis of the values with a mask above 0; 0 where there are none.

    Of an even number of values it is the lower of the middle two, one of the values.

    Args:
      values: (..., P); may be non-finite where mask is 0.
      mask: (..., P).

    Returns:
      (...,).

    Raises:
      ValueError: if the last axes differ.
    """
    check_shapes("masked_median", values=(values, "... P"), mask=(mask, "... P"))
    values, mask = jnp.broadcast_arrays(values, jnp.asarray(mask).astype(bool))
    count = jnp.sum(mask, axis=-1)
    ordered = jnp.sort(jnp.where(mask, values, jnp.inf), axis=-1)
    middle = jnp.maximum(count - 1, 0) // 2
    found = jnp.take_along_axis(ordered, middle[..., None], axis=-1)[..., 0]
    return jnp.where(count > 0, found, 0)


def whitened(values: Array, mask: Array, *, floor: float = FLAT) -> Whitened:
    """Remove a map's scale and shift robustly: subtract the median, divide by the mean absolute deviation.

    Reference: ZeST-NeRF losses.py `compute_depth_loss`; NSFF run_nerf_helpers.py.

    Args:
      values: (..., P) depths or disparities.
      mask: (..., P) in [0, 1].
      floor: least spread, as a share of |median|.

    Returns:
      `Whitened`.

    Raises:
      ValueError: if the shapes do not fit.

    Differs from the reference: the spread has a floor, without which a flat map is 0 / 0.
    """
    check_shapes("whitened", values=(values, "... P"), mask=(mask, "... P"))
    values, mask = jnp.broadcast_arrays(values, jnp.asarray(mask).astype(values.dtype))
    centre = masked_median(values, mask)
    seen = jnp.where(mask > 0, values - centre[..., None], 0)
    count = jnp.sum(mask, axis=-1)
    spread = jnp.sum(jnp.abs(seen) * mask, axis=-1) / jnp.where(count > 0, count, 1)
    least = floor * jnp.abs(centre) + float(jnp.finfo(values.dtype).tiny) ** 0.5
    usable = (count > 0) & (spread > least)
    spread = jnp.maximum(spread, least)
    return Whitened(values=seen / spread[..., None], centre=centre, spread=spread, usable=usable)


def align_least_squares(values: Array, target: Array, mask: Array) -> Alignment:
    """Scale and shift that bring `values` nearest to `target` in the masked mean of squares.

    Args:
      values: (..., P); may be non-finite where mask is 0.
      target: (..., P), likewise.
      mask: (..., P) in [0, 1].

    Returns:
      `Alignment`; constant values have scale 0, an empty mask scale 0 and shift 0.

    Raises:
      ValueError: if the last axes differ.
    """
    check_shapes("align_least_squares", values=(values, "... P"), target=(target, "... P"), mask=(mask, "... P"))
    values, mask = jnp.broadcast_arrays(values, jnp.asarray(mask).astype(values.dtype))
    count = jnp.sum(mask, axis=-1)
    mean = lambda x: jnp.sum(jnp.where(mask > 0, x, 0) * mask, axis=-1) / jnp.where(count > 0, count, 1)
    values_mean, target_mean = mean(values), mean(target)
    centred = jnp.where(mask > 0, values - values_mean[..., None], 0)
    unit = jax.lax.stop_gradient(jnp.max(jnp.abs(centred), axis=-1))
    limits = jnp.finfo(values.dtype)
    # Below the cube root of the least number the slope of the scale, 1 / unit^2, has no room.
    varied = unit > 4 * float(limits.eps) * jnp.abs(values_mean) + float(limits.tiny) ** (1 / 3)
    unit = jnp.where(varied, unit, 1)
    centred = centred / unit[..., None]
    variance, covariance = mean(centred**2), mean(centred * (target - target_mean[..., None]))
    scale = jnp.where(varied, covariance / jnp.where(varied, variance, 1), 0) / unit
    return Alignment(scale=scale, shift=target_mean - scale * values_mean)


def align_robust(values: Array, target: Array, mask: Array, *, floor: float = FLAT) -> Alignment:
    """Scale and shift that give `values` the target's median and mean absolute deviation: outliers matter little.

    Args:
      values: (..., P); may be non-finite where mask is 0.
      target: (..., P), likewise. It must rise with `values`: the scale is > 0.
      mask: (..., P) in [0, 1].
      floor: see `whitened`.

    Returns:
      `Alignment`.

    Raises:
      ValueError: if the last axes differ.
    """
    check_shapes("align_robust", values=(values, "... P"), target=(target, "... P"), mask=(mask, "... P"))
    ours, theirs = whitened(values, mask, floor=floor), whitened(target, mask, floor=floor)
    scale = theirs.spread / ours.spread
    return Alignment(scale=scale, shift=theirs.centre - scale * ours.centre)


def aligned(alignment: Alignment, values: Array) -> jax.Array:
    """scale * values + shift, (..., P)."""
    return alignment.scale[..., None] * values + alignment.shift[..., None]
