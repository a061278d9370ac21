"""Each input frame's own coarse depth and moving pixels: what decides which source view may be trusted at a point.

V        frames
h w      cells, a quarter of the image; 2h 2w are its half-resolution pixels
E        planes, uniform in inverse depth, the nearest first
coordinate  plane coordinate in [0, 1], linear in inverse depth: 0 at the near bound, 1 at the far one (a frustum's z)
"""

import functools
import math
import operator
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_counts
from zestjax.base.parts import part
from zestjax.base.types import Array
from zestjax.frames.evidence import FLOW_CHANNELS, Evidence
from zestjax.nets.layers import raised
from zestjax.nets.unet2d import UNet2d, init_unet2d, unet2d

# static, best, still, still along; moving, moving along; and each averaged over its surroundings
STILL_COSTS, MOVING_COSTS = 8, 4
COSTS = STILL_COSTS + MOVING_COSTS  # all, the static ones first
SURROUNDINGS = 5  # cells, 20 pixels: the side of the square that costs are averaged over; a guess that was never varied
GAIN = 3.0  # nats between the least and the greatest of a cost, before anything is learned
SUMMARIES = 2 * COSTS + 4  # the least of each cost and its plane; ground and what stands, for both of `STANDING`
STATIC_AROUND = STILL_COSTS // 2  # of the costs, the static one averaged over its surroundings
# Static cost above which a cell is taken to move, where what it stands on is looked for. Two, as one suits textured
# scenes and the other flat ones: a guess that was never varied.
STANDING = (0.25, 0.5)
MOVING_PARTS = 4  # a mask value for each half-resolution pixel of a cell
NEVER = -30.0  # logit of moving where nothing does: a probability of 1e-13, and finite
NOWHERE = -1e9  # logit of a plane that is not looked at: finite, so that of none a softmax is even
MOST_PLANES, MOST_WIDTH, MOST_LEVELS = 512, 4096, 8  # of a network that fits a machine, whoever wrote its file


class AnalysisParams(NamedTuple):
    """net: 2-D U-Net over the evidence of a frame (planes are channels)."""

    net: UNet2d


class FrameMaps(NamedTuple):
    """What a frame tells about itself; the cache of a scene.

    logits: (V, h, w, E) of the visible surface's plane.
    coordinate: (V, h, w) plane coordinate of the visible surface, in [0, 1].
    tolerance: (V, h, w) its uncertainty, > 0, in plane coordinates.
    moving_logits: (V, 2h, 2w) of the pixel showing something that moves.
    """

    logits: jax.Array
    coordinate: jax.Array
    tolerance: jax.Array
    moving_logits: jax.Array


def init_analysis(key: jax.Array, *, planes: int, widths: Sequence[int]) -> AnalysisParams:
    """Parameters for E planes; `widths` are the U-Net's."""
    n_in = COSTS // 2 * planes + SUMMARIES + FLOW_CHANNELS + 2 + 12  # as `_channels` joins them
    net = init_unet2d(key, n_in, widths, 2 * planes + COSTS + 2 + MOVING_PARTS)
    # A small head: at first the costs decide.
    return AnalysisParams(net._replace(head=jax.tree.map(lambda x: 0.1 * x, net.head)))


@part
class OwnMaps:
    """Every frame is asked for its own depth, on `planes` planes, and its moving pixels; `widths` of the U-Net."""

    planes: int = 32
    widths: tuple[int, ...] = (48, 64, 96, 128)

    def __post_init__(self):
        check_counts("OwnMaps", planes=(self.planes, 2, MOST_PLANES), levels=(len(self.widths), 1, MOST_LEVELS))
        check_counts("OwnMaps", **{f"widths[{i}]": (n, 1, MOST_WIDTH) for i, n in enumerate(self.widths)})

    def init(self, key: jax.Array) -> AnalysisParams:
        """Parameters."""
        return init_analysis(key, planes=self.planes, widths=self.widths)

    def __call__(self, params: AnalysisParams, evidence: Evidence, *, still: bool = False) -> FrameMaps:
        """See `frame_maps`."""
        return frame_maps(params, evidence, still=still)


def _costs(evidence):
    """(COSTS, V, h, w, E) all costs of a plane, each in [0, 1]: of standing still, then of moving evenly."""
    still = [evidence.static, evidence.best, evidence.still, evidence.still_along]
    moving = [evidence.moving, evidence.moving_along]
    around = lambda costs: [_surrounding_mean(cost) for cost in costs]
    return jnp.stack([*still, *around(still), *moving, *around(moving)])


def _surrounding_mean(x):
    """Mean of (V, h, w, E) over the square of cells around each, those outside left out."""
    reach = SURROUNDINGS // 2
    for axis in (1, 2):
        count = jnp.ones((1,) * axis + (x.shape[axis],) + (1,) * (3 - axis), x.dtype)
        x, count = (_windowed(a, axis, reach) for a in (x, count))
        x = x / count
    return x


def _windowed(x, axis, reach):
    pad = [(reach, reach) if a == axis else (0, 0) for a in range(x.ndim)]
    padded = jnp.pad(x, pad)
    take = lambda k: jax.lax.slice_in_dim(padded, k, k + x.shape[axis], axis=axis)
    return functools.reduce(operator.add, (take(k) for k in range(2 * reach + 1)))


def _ground(costs):
    """(2, V, h, w) coordinate of the nearest still surface at or below a cell in its column, and (2, V, h, w) how much
    of it is the cell's own; for both of `STANDING`. What moves mostly stands on what does not."""
    summed = costs[:STILL_COSTS].sum(0)
    own = (summed.argmin(-1) / (costs.shape[-1] - 1)).astype(costs.dtype)
    least = costs[STATIC_AROUND].min(-1)
    still = jnp.stack([jnp.exp(-jnp.square(least / level)) for level in STANDING])

    def up(below, row):
        here, weight = row
        found = weight * here + (1 - weight) * below
        return found, found

    rows = jnp.moveaxis(jnp.broadcast_to(own, still.shape), 2, 0), jnp.moveaxis(still, 2, 0)
    _, found = jax.lax.scan(up, rows[0][-1], rows, reverse=True)
    return jnp.moveaxis(found, 0, 2), still


def _channels(evidence, costs, ground, still):
    """(V, h, w, n) what the net sees: every part of the evidence about 0, and where each cost is least."""
    planes = jnp.linspace(-1, 1, costs.shape[-1], dtype=costs.dtype)
    summaries = jnp.concatenate([2 * costs.min(-1) - 1, planes[costs.argmin(-1)], 2 * ground - 1, 2 * still - 1])
    alone = (*costs[:STATIC_AROUND], *costs[STILL_COSTS : STILL_COSTS + MOVING_COSTS // 2])
    parts = [*(2 * cost - 1 for cost in alone), jnp.moveaxis(summaries, 0, -1)]
    return jnp.concatenate([*parts, 8 * evidence.flow - 4, 2 * evidence.sure - 1, 2 * evidence.colours - 1], -1)


def frame_maps(params: AnalysisParams, evidence: Evidence, *, still: bool = False) -> FrameMaps:
    """Depth and moving pixels of each frame from its evidence.

    A cell's surface stands still or moves, with the probability of its mask; either way it has a distribution over
    planes, and the two are mixed. The net says how much each cost is to be believed there, how far from the ground
    below it the moving surface is expected and how surely; what is left is free for every plane.

    Args:
      params: `AnalysisParams`.
      evidence: `evidence.Evidence` with a leading axis V.
      still: nothing moves, whatever the net says: surfaces are those that stand.

    Returns:
      `FrameMaps`.

    Source: zestjax: a coarse depth and a motion mask for every input frame.
    """
    evidence = jax.tree.map(raised, evidence)
    costs = jax.lax.stop_gradient(_costs(evidence))
    planes = costs.shape[-1]
    ground, standing = jax.lax.stop_gradient(_ground(costs))
    out = unet2d(params.net, _channels(evidence, costs, ground, standing))
    parts = jnp.split(out, np.cumsum([planes, planes, COSTS, 1, 1]), axis=-1)
    still_free, moving_free, gains, place, sharpness, moving = parts
    gains = jax.nn.softplus(4 * gains + math.log(math.expm1(GAIN)))
    believed = [gains[..., k : k + 1] * costs[k] for k in range(COSTS)]
    index = jnp.linspace(0, 1, planes, dtype=out.dtype).reshape(1, 1, 1, planes)
    away = jnp.abs(index - ground[0][..., None] - place)
    standing = still_free - functools.reduce(operator.add, believed[:STILL_COSTS])
    moved = moving_free - functools.reduce(operator.add, believed[STILL_COSTS:])
    moving = jnp.full_like(moving, NEVER) if still else moving
    # About 7 nats from one end of the planes to the other, before anything is learned.
    moved = moved - 10 * jax.nn.softplus(4 * sharpness) * away
    moves = jnp.mean(moving, axis=-1, keepdims=True)
    logits = _mixed(standing, moved, moves)
    # The mode of the likelier of the two distributions, not of their mixture: there, a narrow peak of small weight can
    # be the highest point.
    coordinate, tolerance = plane_moments(jnp.where(moves > 0, moved, standing))
    v, h, w, _ = moving.shape
    moving = jnp.moveaxis(moving.reshape(v, h, w, 2, 2), 3, 2).reshape(v, 2 * h, 2 * w)
    return FrameMaps(logits, coordinate, tolerance, moving)


def _mixed(standing, moved, moving):
    """log((1 - p) softmax(standing) + p softmax(moved)) over the last axis, with p = sigmoid(moving)."""
    log = lambda logits, logit: jax.nn.log_softmax(logits, axis=-1) + jax.nn.log_sigmoid(logit)
    return jnp.logaddexp(log(standing, -moving), log(moved, moving))


def without_mode(logits: Array, *, reach: int = 2) -> jax.Array:
    """Logits (..., E) over planes without those within `reach` planes of the mode, for what else may be there."""
    index = jnp.arange(logits.shape[-1]).reshape((1,) * (logits.ndim - 1) + (logits.shape[-1],))
    mode = jnp.argmax(logits, axis=-1)[..., None]
    return jnp.where(jnp.abs(index - mode) <= reach, jnp.asarray(NOWHERE, logits.dtype), logits)


def plane_moments(logits: Array, *, reach: int = 2) -> tuple[jax.Array, jax.Array]:
    """Sub-plane coordinate of the mode of a distribution over planes, and its spread.

    The mean is taken within `reach` planes of the mode: the mean of two surfaces is on neither.

    Args:
      logits: (..., E).
      reach: planes on either side of the mode that the mean is taken over.

    Returns:
      coordinate (...,) in [0, 1] and tolerance (...,) in plane coordinates, at least 0.7 planes.
    """
    planes = logits.shape[-1]
    index = jnp.arange(planes, dtype=logits.dtype).reshape((1,) * (logits.ndim - 1) + (planes,))
    mode = jax.lax.stop_gradient(jnp.argmax(logits, axis=-1).astype(logits.dtype))
    near = jnp.abs(index - mode[..., None]) <= reach
    probability = jax.nn.softmax(jnp.where(near, logits, NOWHERE), axis=-1)
    mean = jnp.sum(probability * index, axis=-1)
    variance = jnp.sum(probability * (index - mean[..., None]) ** 2, axis=-1)
    whole = jax.nn.softmax(logits, axis=-1)
    outside = 1 - jnp.sum(jnp.where(near, whole, 0), axis=-1)
    # At least 0.7 planes, as a surface may lie between two; two more where all of the mass is elsewhere.
    tolerance = (0.7 + jnp.sqrt(variance + 1e-6) + 2 * outside) / (planes - 1)
    return mean / (planes - 1), tolerance
