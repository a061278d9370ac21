"""Encoding volumes: source frames swept over the planes of one camera, compared, and encoded by a 3-D U-Net.

V        source frames: the K key-frames of the geometry volume, or the slots of the motion volume
D h w    planes (the nearest first), rows and columns of a volume
C        learned feature channels; a table holds C features, 3 colours, and of trusted frames 3 maps:
         probability of moving, inverse depth of the visible surface, tolerance of it
votes    what the frames' own depths say about a cell: is it their surface, or do they look through it
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.types import Array
from zestjax.cameras import Camera
from zestjax.cost_volume import cost_volume
from zestjax.frames.trust import Trust, agreement
from zestjax.nets.cost_regulariser import CostRegulariser, cost_regulariser, init_cost_regulariser
from zestjax.nets.feature_pyramid import FeaturePyramid, init_feature_pyramid
from zestjax.nets.layers import Dense, dense, init_dense, raised
from zestjax.planesweep import carry, homographies, sweep_grid

TRUST_MAPS = 3  # moving, inverse depth and its tolerance: the last channels of a trusted table
CELL_COLOURS = 12  # the four half-resolution pixels of a cell
VOTE_GAIN = 4.0  # first logit of a cell that all frames call a surface: a guess that was never varied
# Least total weight by which motion votes are divided, about that of one frame two away (exp(-4)): votes of frames
# far in time must not be scaled up to full strength.
LEAST_WEIGHT = 0.02


class VolumeParams(NamedTuple):
    """pyramid: 2-D feature net, None where features come from the frames' analysis. regulariser: 3-D U-Net.
    occupied: Dense from the encoded channels to a logit per cell, None without guided sampling."""

    pyramid: FeaturePyramid | None
    regulariser: CostRegulariser
    occupied: Dense | None


class SweepViews(NamedTuple):
    """tables: (V, h, w, C + colours + maps), see the header. cameras: `Camera` (V, ...) at the tables' resolution.
    valid: (V,) 1, or 0 for a slot the video does not fill. times: (V,) frame time minus target time, frames."""

    tables: Array
    cameras: Camera
    valid: Array
    times: Array


class Volume(NamedTuple):
    """cells: (D, h, w, channels) encoded; with logits the last channel is their softmax along the ray.
    logits: (D, h, w), a surface is here; None without guided sampling."""

    cells: jax.Array
    logits: Array | None


class Votes(NamedTuple):
    """Per cell and frame, each (D, h, w, V), 0 where the frame does not see the cell.

    seen: 1 where it does. moving: probability that its pixel moves. surface: that the cell is its visible surface.
    through: how clearly it looks through the cell, in [0, 1].
    """

    seen: Array
    moving: Array
    surface: Array
    through: Array


def init_volume(
    key: jax.Array,
    *,
    features: int,
    views: int,
    widths: Sequence[int],
    colours: str,
    trusted: bool,
    motion_votes: bool,
    pyramid_widths: tuple[int, int, int] | None,
    occupied: bool,
) -> VolumeParams:
    """Parameters of one encoding volume.

    Args:
      key: random key.
      features: C.
      views: V, which decides the channels where every view's colours are kept.
      widths: of the 3-D U-Net.
      colours: `all` keeps every view's warped colour (the paper's 32 + 3 V channels), `mean` the mean and variance
        of the cells' colours.
      trusted: whether tables carry trust maps.
      motion_votes: whether votes are kept slot by slot (motion) or averaged over frames (geometry).
      pyramid_widths: of the feature net, or None without one.
      occupied: whether cells get a surface logit.
    """
    a, b, c = jax.random.split(key, 3)
    channels = features + (3 * views if colours == "all" else 2 * CELL_COLOURS + 1)
    channels += (3 * views if motion_votes else 4) * trusted
    pyramid = None if pyramid_widths is None else init_feature_pyramid(a, widths=pyramid_widths)
    regulariser = init_cost_regulariser(b, channels, widths=widths)
    return VolumeParams(pyramid, regulariser, init_dense(c, widths[0], 1, scale=0.1) if occupied else None)


def cell_votes(samples: Array, hom: Array, grid: Array, depths: Array) -> Votes:
    """`Votes` from the trust maps that each view shows at each cell.

    Args:
      samples: (D, h, w, V, 3) moving, inverse depth and tolerance; 0 where a view does not see.
      hom: (D, V, 3, 3).
      grid: (h, w, 3).
      depths: (D,).
    """
    moving, surface, tolerance = samples[..., 0], samples[..., 1], samples[..., 2]
    seen = tolerance > 0
    share = jnp.moveaxis(carry(hom, grid)[2], 1, -1)
    point = 1 / jnp.where(seen, share * depths[:, None, None, None], 1)
    safe = jnp.where(seen, tolerance, 1)
    number = seen.astype(samples.dtype)
    through = jnp.square(jnp.clip((point - surface) / safe / 3, 0, 1))  # full from 3 tolerances on, as `GAP_LIMIT` is
    return Votes(number, number * moving, number * agreement(surface, safe, point), number * through)


def _geometry_votes(votes):
    """(D, h, w, 4) over the frames that show something still, and (D, h, w) what they say of a surface here."""
    still = votes.seen * (1 - votes.moving)
    weight = jnp.maximum(jnp.sum(still, -1), 0.5)  # less than half a frame that stands still has no full vote
    surface = jnp.sum(still * votes.surface, -1) / weight
    through = jnp.sum(still * votes.through, -1) / weight
    count = votes.seen.shape[-1]
    shares = [surface, through, jnp.sum(still, -1) / count, jnp.sum(votes.seen, -1) / count]
    return jnp.stack(shares, -1), VOTE_GAIN * (surface - through)


def _motion_votes(votes, times):
    """(D, h, w, 3 V) slot by slot, and (D, h, w) what they say of a moving surface here; frames nearer
    in time weigh more: exp(-2 |t|)."""
    support = votes.moving * votes.surface
    channels = jnp.concatenate([support, votes.moving, votes.through], -1)
    nearness = jnp.exp(-2 * jnp.abs(times))[:, None]
    weighted = lambda x: (x @ nearness)[..., 0]
    return channels, VOTE_GAIN * weighted(support - votes.through) / jnp.maximum(weighted(votes.seen), LEAST_WEIGHT)


def encode_volume(
    params: VolumeParams,
    views: SweepViews,
    camera: Camera,
    size: tuple[int, int],
    depths: Array,
    *,
    colours: str,
    trusted: bool,
    motion_votes: bool,
) -> Volume:
    """Sweep, compare, encode.

    Args:
      params: `VolumeParams`.
      views: `SweepViews`.
      camera: reference `Camera` at the volume's resolution.
      size: (h, w).
      depths: (D,) planes in the reference camera, world units.
      colours: as in `init_volume`.
      trusted: as in `init_volume`.
      motion_votes: as in `init_volume`.

    Returns:
      `Volume`.

    Source: ZeST-NeRF eq. 1, eq. 2 (geometry volume), eq. 3 (motion volume).
    Reference: ZeST-NeRF networks.py, MVSNet.
    Differs from the reference: the motion volume is swept too (theirs stacks features unwarped); trusted views only.
    """
    sizes = check_shapes("encode_volume", tables=(views.tables, "V h w C"), depths=(depths, "D"))
    grid = sweep_grid(*size, dtype=views.tables.dtype)
    hom = homographies(camera, views.cameras, depths) * views.valid[None, :, None, None]
    tables, trust = views.tables, None
    if trusted:
        moving, inverse_depth, tolerance = (tables[..., k] for k in range(-TRUST_MAPS, 0))
        # For motion, what a frame calls still counts a tenth, as it may be wrong: a guess that was never varied.
        trust = Trust(0.1 + 0.9 * moving if motion_votes else 1 - moving, inverse_depth, tolerance)
    kept = TRUST_MAPS if trusted else 3 * (colours == "all")
    cost = cost_volume(tables, hom, grid, trust=trust, depths=depths if trusted else None, per_view=kept)
    features = sizes["C"] - (3 if colours == "all" else CELL_COLOURS) - TRUST_MAPS * trusted
    variance = jnp.log1p(100 * cost.variance) / 4  # colours differ by 0.01 to 0.5: brought to order 1
    if colours == "all":
        flat = cost.samples.reshape(*cost.samples.shape[:3], -1)
        channels, vote = [cost.variance[..., :features], flat], 0
    else:
        count = cost.count[..., None] / sizes["V"]
        mean = cost.mean[..., features : features + CELL_COLOURS]
        channels, vote = [variance[..., : features + CELL_COLOURS], mean, count], 0
    if trusted:
        votes = cell_votes(cost.samples, hom, grid, depths)
        extra, vote = _motion_votes(votes, views.times) if motion_votes else _geometry_votes(votes)
        channels.append(extra)
    cells = cost_regulariser(params.regulariser, jnp.concatenate(channels, axis=-1))
    if params.occupied is None:
        return Volume(cells, None)
    logits = raised(dense(params.occupied, cells))[..., 0] + vote
    return Volume(jnp.concatenate([cells, jax.nn.softmax(logits, axis=0)[..., None]], axis=-1), logits)
