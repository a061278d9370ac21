"""The dynamic field: density, colour, scene flow and confidence of a point at a time.

P  points   V  slots (neighbours of the time)   C  channels of the motion volume   Q  encoded direction
flow  offsets in coordinates of the target's frustum, forward (t + 1) and backward (t - 1)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.fields.conditioning import hidden as hidden_behind
from zestjax.fields.conditioning import on_surface, over_views
from zestjax.fields.static import concatenated
from zestjax.fields.trunk import (
    ColourHead,
    Trunk,
    ViewHead,
    blend_of_views,
    direct_colour,
    init_colour_head,
    init_trunk,
    init_view_head,
    lifted,
    pooled_views,
    trunk,
    view_scores,
)
from zestjax.nets.layers import Dense, dense, init_dense, raised

VIEW_FEATURES = 14
POOLED = 16
SUMMARIES = 4
RESIDUAL = 0.1


class DynamicParams(NamedTuple):
    """The time-dependent field. `motion` (early flow from the volume alone) and `views` are None for a direct head."""

    trunk: Trunk
    density: Dense
    blend: Dense | None
    flow: Dense
    confidence: Dense
    colour: ColourHead
    motion: tuple[Dense, Dense] | None
    views: ViewHead | None


class DynamicSample(NamedTuple):
    """density: (P,) >= 0. colour: (P, 3) in [0, 1]. blend_logit: (P,), added to the static field's.
    flow_forward, flow_backward: (P, 3) bounded. confidence_forward, confidence_backward: (P,) in (0, 1)."""

    density: jax.Array
    colour: jax.Array
    blend_logit: jax.Array
    flow_forward: jax.Array
    flow_backward: jax.Array
    confidence_forward: jax.Array
    confidence_backward: jax.Array


def init_dynamic(key, *, n_point, n_direction, n_volume, n_views, slots, width, depth, head):
    """Parameters. n_views: values per point that concatenated views add; None where views are pooled."""
    keys = jax.random.split(key, 9)
    pooled = POOLED + SUMMARIES + 2 * slots if n_views is None else n_views
    base = init_trunk(keys[0], n_point, max(n_volume + pooled, 1), width=width, depth=depth)
    small = lambda k, n: init_dense(k, width, n, scale=0.1)
    blending = head == "blend"
    motion = (init_dense(keys[6], n_volume + n_point, 24), init_dense(keys[7], 24, 6, scale=0.1)) if blending else None
    return DynamicParams(
        base, small(keys[1], 1), small(keys[2], 1) if blending else None, small(keys[3], 6), small(keys[4], 2),
        init_colour_head(keys[5], width, n_direction), motion,
        init_view_head(keys[8], VIEW_FEATURES, width, width=POOLED) if blending else None,
    )  # fmt: skip


def early_flow(params, point, volume, *, reach):
    """(P, 6) flow forward then backward, from the motion volume alone, within +-reach of the frustum.

    It says where to look in the neighbours before their colours are read (flow-compensated aggregation).
    """
    first, second = params.motion
    state = jax.nn.relu(dense(first, jnp.concatenate([volume, point], axis=-1)))
    return reach * jnp.tanh(raised(dense(second, state)))


class DynamicViews(NamedTuple):
    """Slots at points. features: (V, U, P). weights: (V, P) trust. summary: (P, SUMMARIES + 2 V)."""

    features: jax.Array
    weights: jax.Array
    summary: jax.Array


def dynamic_views(samples, times):
    """Per-view features of `sample_views` for what moves: seen moving, at its own depth, in its slot."""
    agree, behind = on_surface(samples.gap), hidden_behind(samples.gap)
    support = samples.visible * samples.moving * agree
    weights = support + 0.02 * samples.visible * (1 - behind)
    deviation = samples.colour - over_views(weights, samples.colour)[None]
    size = jnp.sum(jnp.abs(deviation), axis=1)
    through = samples.visible * jnp.square(jnp.minimum(samples.gap, 0) / 3)
    wide = lambda x: jnp.broadcast_to(x[:, None], size.shape)
    scalars = [
        size, samples.visible, samples.moving, agree, behind, through, support, samples.gap / 3,
        samples.moving * through, wide(jnp.exp(-jnp.abs(times))), wide(jnp.tanh(times)),
    ]  # fmt: skip
    features = jnp.concatenate([4 * deviation, jnp.stack(scalars, 1)], 1)
    spread = over_views(weights, jnp.stack([size, agree, through, samples.moving], 1))
    return DynamicViews(features, weights, jnp.concatenate([spread, support, through], 0).T)


def dynamic_field(params, point, direction, volume, samples, views, *, reach=1.0, early=None, conditioning="multiply"):
    """Density, colour, flow and confidence of P points at one time.

    Args:
      params: `DynamicParams`.
      point: (P, n) encoded position and time.
      direction: (P, Q) encoded.
      volume: (P, C) looked up in the motion volume; C may be 0.
      samples: `ViewSamples` of the slots, or None without them.
      views: `DynamicViews` for a blend head, or None: colours and visibility are then concatenated.
      reach: bound of the flow, frustum units; the paper's tanh reaches the whole frustum, 1.
      early: (P, 6) flow that the last layer corrects, or None.
      conditioning: see `trunk`.

    Returns:
      `DynamicSample`.

    Source: ZeST-NeRF eq. 5.
    Differs from the reference: with a blend head colours come from the neighbours at the point's displaced position.
    """
    lift = None if views is None else lifted(params.views, views.features)
    if views is None:
        condition = concatenated(volume, samples)
    else:
        condition = jnp.concatenate([volume, pooled_views(lift, views.weights), views.summary], -1)
    state = trunk(params.trunk, point, condition, conditioning=conditioning)
    if views is not None:
        scores = view_scores(params.views, lift, state)
        colour = blend_of_views(scores, views.weights, samples.visible, samples.colour)
        residual = direct_colour(params.colour, state, direction) - 0.5
        colour = jnp.clip(colour + RESIDUAL * residual, 0, 1)
    else:
        colour = direct_colour(params.colour, state, direction)
    head = lambda part: raised(dense(part, state))
    raw_flow = head(params.flow)
    flow = reach * jnp.tanh(raw_flow) if early is None else early + 0.2 * reach * jnp.tanh(raw_flow)
    confidence = jax.nn.sigmoid(head(params.confidence) + 2.0)
    logit = jnp.zeros_like(raw_flow[:, 0]) if params.blend is None else head(params.blend)[:, 0]
    return DynamicSample(
        4 * jax.nn.softplus(head(params.density)[:, 0]), colour, logit,
        flow[:, :3], flow[:, 3:], confidence[:, 0], confidence[:, 1],
    )  # fmt: skip
