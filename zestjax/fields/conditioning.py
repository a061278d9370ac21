"""What the source views say about a point: their colours, and whether each can be trusted there.

V        source views (key-frames, or the neighbours of a time)
P        points
gap      how far a view's own surface lies in front of the point, in its tolerances: > 0 the point is hidden,
         about 0 it is that surface, < 0 the view looks through it
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import added, matmul, safe_divide
from zestjax.base.types import Array
from zestjax.cameras import NEAREST_DEPTH, Camera
from zestjax.resample import bilinear_cells, corner_offsets, gather_corners, interpolate

GAP_LIMIT = 3.0  # tolerances: beyond, exp(-gap^2) is below 1e-3, and a gap says no more


class SourceViews(NamedTuple):
    """tables: (V, H, W, C): colour, then, of trusted views, probability of moving, inverse depth, its tolerance.
    cameras: `Camera` (V, ...). valid: (V,) 1 or 0. times: (V,) frame time minus target time, frames."""

    tables: Array
    cameras: Camera
    valid: Array
    times: Array


class ViewSamples(NamedTuple):
    """colour: (V, 3, P), 0 where not visible. visible: (V, P) 1 or 0. moving: (V, P) in [0, 1]. gap: (V, P) in
    [-3, 3]. The last two are 0 of views without trust maps."""

    colour: jax.Array
    visible: jax.Array
    moving: jax.Array
    gap: jax.Array


def sample_views(views: SourceViews, points: jax.Array) -> ViewSamples:
    """Every view's colour and trust maps where the points project to.

    Four gathers of whole rows for all views at once, from one flat table.

    Args:
      views: `SourceViews`.
      points: (V, P, 3) world, or (1, P, 3) for the same points in every view.

    Returns:
      `ViewSamples`.

    Source: ZeST-NeRF section 3.2 (colours of the inputs as conditioning).
    Differs from the reference: a point behind a camera is not visible in it.
    """
    sizes = check_shapes("sample_views", tables=(views.tables, "V H W C"), points=(points, "one P 3"))
    count, height, width, channels = (sizes[a] for a in "VHWC")
    column, row, depth, front = _projected(views.cameras, points)
    cells = bilinear_cells(column, row, height, width)
    seen = cells.inside & front & (views.valid[:, None] > 0)
    first = cells.first + (jnp.arange(count, dtype=jnp.int32) * (height * width))[:, None]
    corners = gather_corners(views.tables.reshape(-1, channels), first, corner_offsets(height, width))
    values = jnp.moveaxis(interpolate(corners, cells.across, cells.down), -1, 1)
    values = jnp.where(seen[:, None], values, 0)
    visible = seen.astype(values.dtype)
    if channels == 3:
        return ViewSamples(values, visible, jnp.zeros_like(visible), jnp.zeros_like(visible))
    surface, tolerance = values[:, 4], jnp.where(seen, values[:, 5], 1)
    gap = jnp.clip((surface - 1 / jnp.where(seen, depth, 1)) / tolerance, -GAP_LIMIT, GAP_LIMIT)
    return ViewSamples(values[:, :3], visible, values[:, 3], jnp.where(seen, gap, 0))


def hidden(gap: jax.Array) -> jax.Array:
    """Soft probability that a point at `gap` is hidden behind a view's surface, in [0, 1]."""
    return -jnp.expm1(-jnp.square(jnp.maximum(gap, 0)))


def on_surface(gap: jax.Array) -> jax.Array:
    """Soft probability that a point at `gap` is the view's surface, in [0, 1]; `trust.agreement` of a gap."""
    return jnp.exp(-jnp.square(gap))


def over_views(weights: jax.Array, values: jax.Array) -> jax.Array:
    """Weighted mean over views: (V, P), (V, C, P) -> (C, P); 0 where all weights are 0.

    Written as a sum of products: sums over a leading axis are slow on a CPU.

    Raises:
      ValueError: on shapes that do not fit.
    """
    check_shapes("over_views", weights=(weights, "V P"), values=(values, "V C P"))
    views = range(weights.shape[0])
    total = added(weights[v] for v in views)
    summed = added(weights[v][None] * values[v] for v in views)
    return jax.lax.optimization_barrier(safe_divide(summed, total[None]))


def parallax(cameras: Camera, points: jax.Array, points_beyond: jax.Array) -> jax.Array:
    """(V, P) pixels by which the views see two points of each target ray apart: 0 from the target's own position."""
    columns, rows, _, front = _projected(cameras, points)
    columns_beyond, rows_beyond, _, front_beyond = _projected(cameras, points_beyond)
    shift = jnp.abs(columns - columns_beyond) + jnp.abs(rows - rows_beyond)
    # Behind a view: as far apart as two ends of an image, so that it counts as the farthest of views.
    return jax.lax.stop_gradient(jnp.where(front & front_beyond, shift, 200.0))


def _projected(cameras: Camera, points: Array) -> tuple[Array, Array, Array, Array]:
    """Column, row, depth and whether in front, (V, P) each, of points (V, P, 3) or (1, P, 3): `project`, axis by axis.

    Products of so small matrices are slow as products, and three numbers a point do not fill a vector.
    """
    turned = matmul(cameras.intrinsics, cameras.camera_from_world[:, :3])[..., None]
    x, y, z = (points[..., axis] for axis in range(3))
    along = lambda r: turned[:, r, 0] * x + turned[:, r, 1] * y + turned[:, r, 2] * z + turned[:, r, 3]
    depth = along(2)
    front = depth > NEAREST_DEPTH
    scale = 1 / jnp.where(front, depth, 1)
    return along(0) * scale, along(1) * scale, depth, front
