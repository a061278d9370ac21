"""Statistics of a plane sweep, streamed over planes and views, with a gradient written by hand.

    sweep         `Sweep`: sizes and options, fixed while tracing
    flat          (V, rows, C') each view's table with its pixels flattened, the trust maps its last three channels
    homographies  (n, b, V, 3, 3) n blocks of b planes, reference pixels to source pixels
    depths        (n, b) of the planes
    grid          (h, w, 3) homogeneous reference pixels
    corners       the 4 table rows around each cell, (b, h, w, C') each

A view's rows are gathered once for all their channels: one flat table, four gathers. The gradient is the closed form

    d/df_v = weight_v / count * (d/dmean + 2 d/dvariance (f_v - mean))

so it needs no saved samples: it gathers again and adds to one view's table gradient, a scatter-add per corner.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero

from zestjax.base.types import Array
from zestjax.frames.trust import trusted
from zestjax.planesweep import carry
from zestjax.resample import bilinear_cells, corner_offsets, gather_corners, interpolate


class CostVolume(NamedTuple):
    """Weighted statistics over the views of what they see at each cell.

    mean: (D, h, w, C), 0 where no view sees.
    variance: (D, h, w, C), >= 0, biased; 0 where fewer than two views see.
    count: (D, h, w) sum of the weights, in [0, V].
    samples: (D, h, w, V, per_view) the last channels of each view alone, 0 where it does not see.
    """

    mean: jax.Array
    variance: jax.Array
    count: jax.Array  # pyright: ignore[reportIncompatibleMethodOverride]
    samples: jax.Array


class _Given(NamedTuple):
    """Gradients towards the statistics of a `CostVolume`; None where a caller did not use one, which costs nothing."""

    mean: jax.Array | None
    variance: jax.Array | None
    count: jax.Array | None  # pyright: ignore[reportIncompatibleMethodOverride]


class Sweep(NamedTuple):
    """What is fixed while tracing: source height and width, C, channels kept per view, the trust floor or None."""

    height: int
    width: int
    channels: int
    per_view: int
    floor: float | None


class _Placed(NamedTuple):
    """Where a view sees the points of a block of planes. across, down: see `Cells`. share: of the plane's depth."""

    across: Array
    down: Array
    share: Array


def _place(sweep, homography, grid):
    """(`_Placed`, (first, seen)) of one view: (b, 3, 3) -> (b, h, w), its table rows and who sees.

    Once for what is gathered and for what is interpolated: `rounded_once` says why.
    """
    u, v, share, in_front = carry(homography, grid)
    cells = bilinear_cells(u, v, sweep.height, sweep.width)
    return _Placed(cells.across, cells.down, share), (cells.first, cells.inside & in_front)


def _read(sweep, corners, placed, seen, depth):
    """Value (b, h, w, C) and weight (b, h, w) of one view, from the table rows at the corners of its cells."""
    rows = interpolate(corners, placed.across, placed.down)
    value, weight = rows[..., : sweep.channels], seen.astype(rows.dtype)
    if sweep.floor is not None:
        static, inverse_depth, tolerance = (rows[..., sweep.channels + k] for k in range(3))
        point = 1 / jnp.where(seen, placed.share * depth[:, None, None], 1)
        tolerance = jnp.where(seen, tolerance, 1)
        weight *= sweep.floor + (1 - sweep.floor) * trusted(static, inverse_depth, tolerance, point)
    return value, weight, jnp.where(seen[..., None], value[..., sweep.channels - sweep.per_view :], 0)


def _gather(sweep, table, first):
    return gather_corners(table, first, corner_offsets(sweep.height, sweep.width))


def _block(sweep, flat, homographies, depth, grid):
    """A block of planes: homographies (b, V, 3, 3), depth (b,). Welford over the views, one in memory at a time."""

    def view(state, inputs):
        count, mean, spread = state
        table, homography = inputs
        placed, (first, seen) = _place(sweep, homography, grid)
        value, weight, sample = _read(sweep, _gather(sweep, table, first), placed, seen, depth)
        count = count + weight
        share = weight / jnp.where(count > 0, count, 1)
        delta = value - mean
        # weight delta^2 (1 - share) is 0 exactly for the first view, and never negative.
        spread = spread + (weight * (1 - share))[..., None] * delta * delta
        return (count, mean + delta * share[..., None], spread), sample

    shape = (depth.shape[0], *grid.shape[:2])
    zeros = jnp.zeros((*shape, sweep.channels), flat.dtype)
    state = (jnp.zeros(shape, flat.dtype), zeros, zeros)
    (count, mean, spread), samples = lax.scan(view, state, (flat, jnp.swapaxes(homographies, 0, 1)))
    variance = spread / jnp.where(count > 0, count, 1)[..., None]
    return CostVolume(mean, variance, count, jnp.moveaxis(samples, 0, -2))


def _stream(sweep, flat, homographies, depths, grid):
    """`plane_statistics` as JAX would differentiate it."""
    return lax.map(lambda block: _block(sweep, flat, block[0], block[1], grid), (homographies, depths))


def _stream_forward(sweep, flat, homographies, depths, grid):
    turned = jnp.zeros(0) if homographies.perturbed else None  # are the cameras being fitted?
    inputs = (flat.value, homographies.value, depths.value, grid.value)
    volume = _stream(sweep, *inputs)
    return volume, (inputs, volume[:3], turned)


def _stream_backward(sweep, saved, cotangent):
    """One view at a time, and for it one block of planes at a time: gather again, add to the view's table gradient."""
    (flat, homographies, depths, grid), volume, turned = saved
    *given, per_view = (None if isinstance(c, SymbolicZero) else c for c in cotangent)
    given = _Given(*given)
    per_view = None if per_view is None else jnp.moveaxis(per_view, -2, 0)

    def view(_, inputs):
        table, homographies, sample_gradients = inputs

        def block(table_gradient, inputs):
            homography, depth, volume, given, sample_gradient = inputs
            place = lambda homography: _place(sweep, homography, grid)
            placed, turn, (first, seen) = jax.vjp(place, homography, has_aux=True)
            read = lambda corners, placed: _read(sweep, corners, placed, seen, depth)
            (value, weight, sample), pull = jax.vjp(read, _gather(sweep, table, first), placed)
            sample_gradient = jnp.zeros_like(sample) if sample_gradient is None else sample_gradient
            rows, towards = pull((*_view_gradient(value, weight, volume, given), sample_gradient))
            turns = () if turned is None else turn(towards)  # what is not used is not in the program
            for offset, row in zip(corner_offsets(sweep.height, sweep.width), rows, strict=True):
                at = table_gradient.at[first + offset]
                table_gradient = at.add(row, mode="promise_in_bounds", wrap_negative_indices=False)
            return table_gradient, turns

        blocks = (homographies, depths, volume, given, sample_gradients)
        return None, lax.scan(block, jnp.zeros_like(table), blocks)

    _, (tables, turns) = lax.scan(view, None, (flat, jnp.moveaxis(homographies, 2, 0), per_view))
    turns = jnp.moveaxis(turns[0], 0, 2) if turns else jnp.zeros_like(homographies)
    return tables, turns, jnp.zeros_like(depths), jnp.zeros_like(grid)


def _view_gradient(value, weight, volume, given):
    """Gradients towards one view's value (b, h, w, C) and weight (b, h, w), from those towards the statistics."""
    mean, variance, count = volume
    share = 1 / jnp.where(count > 0, count, 1)
    delta = value - mean
    towards_value, towards_weight = jnp.zeros_like(value), jnp.zeros_like(weight)
    if given.mean is not None:
        towards_value += given.mean
        towards_weight += jnp.sum(given.mean * delta, axis=-1)
    if given.variance is not None:
        towards_value += 2 * given.variance * delta
        towards_weight += jnp.sum(given.variance * (delta * delta - variance), axis=-1)
    towards_weight = towards_weight * share
    if given.count is not None:
        towards_weight += given.count
    return towards_value * (weight * share)[..., None], towards_weight


_streamed = jax.custom_vjp(_stream, nondiff_argnums=(0,))
_streamed.defvjp(_stream_forward, _stream_backward, symbolic_zeros=True)


def plane_statistics(sweep: Sweep, flat: Array, homographies: Array, depths: Array, grid: Array) -> CostVolume:
    """`CostVolume` with leading axes (n, b), of arguments as the header names them; the kernel of `cost_volume`.

    Reverse-mode gradients flow to `flat` and `homographies`; that of the latter is computed only where it is asked for.
    `depths` and `grid` are constants.
    """
    return _streamed(sweep, flat, homographies, lax.stop_gradient(depths), lax.stop_gradient(grid))
