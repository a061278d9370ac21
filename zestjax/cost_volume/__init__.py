"""Cost volumes: how well the source views agree on every plane of a reference camera.

    tables        (V, Hs, Ws, C) what each view's pixels hold: features, colours, anything, concatenated
    homographies  (D, V, 3, 3) reference pixels to source pixels, see `planesweep`
    grid          (h, w, 3) homogeneous reference pixels; constant: no gradient flows to it
    weight        of a view at a cell: 1 where it sees the cell, 0 elsewhere, times its trust

Planes and views are streamed (`plane_statistics`): nothing the size of V times D is ever held.
"""

import jax
import jax.numpy as jnp
from jax import lax

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import matvec
from zestjax.base.types import Array
from zestjax.cost_volume.plane_statistics import CostVolume, Sweep, plane_statistics
from zestjax.frames.trust import Trust
from zestjax.planesweep import sweep_grid, warp
from zestjax.resample import bilinear


def cost_volume(
    tables: Array,
    homographies: Array,
    grid: Array,
    *,
    trust: Trust | None = None,
    depths: Array | None = None,
    floor: float = 1e-3,
    per_view: int = 0,
    planes_at_once: int = 1,
) -> CostVolume:
    """Mean and centred variance over the views that see, and may be trusted at, each cell of a plane sweep.

    mean = sum_v w_v f_v / sum_v w_v,   variance = sum_v w_v (f_v - mean)^2 / sum_v w_v

    A point of plane d at reference pixel p lies at depth d (H p)_3 in the source (see `planesweep.plane_homography`):
    that depth is what a `Trust` tests.

    Args:
      tables: (V, Hs, Ws, C).
      homographies: (D, V, 3, 3) to the tables' pixels.
      grid: (h, w, 3).
      trust: `Trust` of (V, Hs, Ws) maps, or None: every view that sees counts 1.
      depths: (D,) of the planes, needed with `trust`; constant.
      floor: in (0, 1], the least weight of a view that sees: a cell where no view is trusted falls back on all.
      per_view: how many of the last channels are also returned for each view (the paper's warped colours).
      planes_at_once: planes computed together. 1 is best on a CPU; on a GPU use 8 or more. Memory grows with it. The
        largest divisor of D that is not above it is taken.

    Returns:
      `CostVolume`. Differentiable in reverse mode towards tables, homographies and trust.

    Raises:
      ValueError: on a wrong shape, or `trust` without `depths`.

    Source: ZeST-NeRF sec. 3.1 and MVSNeRF (Chen et al. 2021) sec. 3.1.
    Differs from the reference: masked and centred (Welford), so never negative; `mvsnerf_cost_volume` is the published
    form.
    """
    sizes = check_shapes(
        "cost_volume", tables=(tables, "V Hs Ws C"), homographies=(homographies, "D V 3 3"), grid=(grid, "h w 3")
    )
    if not 0 <= per_view <= sizes["C"]:
        raise ValueError(
            f"cost_volume: `per_view` is {per_view}, expected 0 to {sizes['C']}, the channels of `tables`."
        )
    if trust is None:
        depths = jnp.ones(sizes["D"], tables.dtype)
    elif depths is None:
        raise ValueError("cost_volume: `trust` needs `depths`, the (D,) depths of the planes.")
    else:
        check_shapes(
            "cost_volume",
            tables=(tables, "V Hs Ws C"),
            static=(trust.static, "V Hs Ws"),
            inverse_depth=(trust.inverse_depth, "V Hs Ws"),
            tolerance=(trust.tolerance, "V Hs Ws"),
            homographies=(homographies, "D V 3 3"),
            depths=(depths, "D"),
        )
        tables = jnp.concatenate([tables, jnp.stack(trust, axis=-1).astype(tables.dtype)], axis=-1)
    sweep = Sweep(sizes["Hs"], sizes["Ws"], sizes["C"], per_view, None if trust is None else float(floor))
    together = max(n for n in range(1, max(1, min(planes_at_once, sizes["D"])) + 1) if sizes["D"] % n == 0)
    blocks = lambda x: x.reshape(-1, together, *x.shape[1:])
    flat = tables.reshape(sizes["V"], -1, tables.shape[-1])
    volume = plane_statistics(sweep, flat, blocks(homographies), blocks(depths), grid)
    return CostVolume(*(x.reshape(sizes["D"], *x.shape[2:]) for x in volume))


def sweep_colours(images: Array, homographies: Array, grid: Array) -> jax.Array:
    """Every view's colours on every plane, side by side: the colour half of the paper's volume.

    Where features are swept at the same resolution, `cost_volume(..., per_view=3)` returns them from the same gathers.

    Args:
      images: (V, Hs, Ws, C).
      homographies: (D, V, 3, 3) to the images' pixels.
      grid: (h, w, 3).

    Returns:
      (D, h, w, V C), views in order, 0 where a view does not see.

    Raises:
      ValueError: on a wrong shape.

    Source: ZeST-NeRF sec. 3.1.
    """
    sizes = check_shapes(
        "sweep_colours", images=(images, "V Hs Ws C"), homographies=(homographies, "D V 3 3"), grid=(grid, "h w 3")
    )

    @jax.checkpoint
    def plane(homographies):
        values = lax.map(lambda view: warp(view[0], view[1], grid).values, (images, homographies))
        return jnp.moveaxis(values, 0, -2).reshape(*grid.shape[:2], -1)

    return lax.map(plane, homographies).reshape(sizes["D"], sizes["h"], sizes["w"], -1)


def mvsnerf_cost_volume(
    features: Array, colours: Array, homographies: Array, *, padding: int = 0, colour_views: int | None = None
) -> jax.Array:
    """The cost volume that MVSNeRF's published weights were trained with, faults included.

    Channels: the reference's colours (not warped, 0 in the padding), the other views' warped colours, then
    (sum_v f^2) / n - ((sum_v f) / n)^2 with n the number of views that see. The sums are not masked: samples up to a
    pixel outside a view contribute but are not counted, the reference counts everywhere, points behind a camera count
    as well, and the difference can be strongly negative.

    Args:
      features: (V, h, w, C), view 0 the reference.
      colours: (V, h, w, 3) of ImageNet-normalised images, see `quarter_colours`.
      homographies: (D, V, 3, 3), that of view 0 not read.
      padding: cells added on each side of the reference's grid.
      colour_views: how many views' colours are kept, all by default; ZeST-NeRF keeps 3 whatever V is.

    Returns:
      (D, h + 2 padding, w + 2 padding, 3 colour_views + C).

    Raises:
      ValueError: on a wrong shape.

    Reference: MVSNeRF models.py `build_volume_costvar_img`; ZeST-NeRF networks.py `build_volume_cost`.
    """
    sizes = check_shapes(
        "mvsnerf_cost_volume",
        features=(features, "V h w C"),
        colours=(colours, "V h w 3"),
        homographies=(homographies, "D V 3 3"),
    )
    kept = sizes["V"] if colour_views is None else colour_views
    grid = sweep_grid(sizes["h"], sizes["w"], padding=padding, dtype=features.dtype)
    rim = [(padding, padding), (padding, padding), (0, 0)]
    own = jnp.concatenate([jnp.pad(colours[0], rim), jnp.pad(features[0], rim)], axis=-1)
    # One zero pixel around each image gives its readers the published fade to 0 outside.
    tables = jnp.pad(jnp.concatenate([colours, features], axis=-1)[1:], [(0, 0), (1, 1), (1, 1), (0, 0)])

    @jax.checkpoint
    def plane(homographies):
        values, seen = jax.vmap(_published_warp, (0, 0, None))(tables, homographies[1:], grid)
        values = jnp.concatenate([own[None], values])
        count = 1 + jnp.sum(seen, axis=0, dtype=values.dtype)[..., None]
        spread = jnp.sum(values[..., 3:] ** 2, axis=0) / count - (jnp.sum(values[..., 3:], axis=0) / count) ** 2
        shown = jnp.moveaxis(values[:kept, ..., :3], 0, -2)
        return jnp.concatenate([shown.reshape(*grid.shape[:2], -1), spread], axis=-1)

    return lax.map(plane, homographies)


def _published_warp(table, homography, grid):
    """A (h + 2, w + 2, C) padded image on a plane: dividing by any third coordinate, and seen strictly inside."""
    height, width = table.shape[0] - 2, table.shape[1] - 2
    image = matvec(homography, grid)
    divisor = jnp.where(image[..., 2:] == 0, 1, image[..., 2:])
    pixels = jnp.where(image[..., 2:] == 0, -2, image[..., :2] / divisor)
    u, v = pixels[..., 0], pixels[..., 1]
    seen = (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
    return bilinear(table, pixels + 1).values, seen


def quarter_colours(images: Array) -> jax.Array:
    """Images (..., H, W, 3) to the (..., H / 4, W / 4, 3) that MVSNeRF's volume holds: the middle 2 x 2 of every 4 x 4.

    Raises:
      ValueError: if H or W is not a multiple of 4.
    """
    height, width = images.shape[-3:-1]
    if height % 4 or width % 4:
        raise ValueError(f"quarter_colours: image size should be a multiple of 4, got {height}x{width} (HxW).")
    blocks = images.reshape(*images.shape[:-3], height // 4, 4, width // 4, 4, images.shape[-1])
    return jnp.mean(blocks[..., :, 1:3, :, 1:3, :], axis=(-4, -2))
