"""The static field: density, colour and blend of a point that does not move.

P  points   V  key-frames   C  channels of the geometry volume   Q  encoded direction
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.fields.conditioning import added, on_surface, over_views
from zestjax.fields.conditioning import hidden as hidden_behind
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

VIEW_FEATURES = 13
POOLED = 16
SUMMARIES = 5
RESIDUAL = 0.1


class StaticParams(NamedTuple):
    """The time-independent field. Depth, width and skip are in the shapes; `views` is None for a direct head."""

    trunk: Trunk
    density: Dense
    blend: Dense
    colour: ColourHead
    views: ViewHead | None


class StaticSample(NamedTuple):
    """density: (P,) >= 0. colour: (P, 3) in [0, 1]. blend: (P,) in (0, 1), 1 is dynamic. blend_logit: (P,)."""

    density: jax.Array
    colour: jax.Array
    blend: jax.Array
    blend_logit: jax.Array


def init_static(key, *, n_point, n_direction, n_volume, n_views, width, depth, head):
    """Parameters. n_views: values per point that concatenated views add; None where views are pooled."""
    keys = jax.random.split(key, 5)
    pooled = POOLED + SUMMARIES if n_views is None else n_views
    base = init_trunk(keys[0], n_point, max(n_volume + pooled, 1), width=width, depth=depth)
    views = init_view_head(keys[4], VIEW_FEATURES, width, width=POOLED) if head == "blend" else None
    blend = init_dense(keys[2], width, 1, scale=0.1)
    return StaticParams(
        base,
        init_dense(keys[1], width, 1, scale=0.1),
        blend._replace(bias=blend.bias - 2.0),  # static until the motion volume speaks
        init_colour_head(keys[3], width, n_direction),
        views,
    )


class StaticViews(NamedTuple):
    """Key-frames at points. features: (V, U, P) per view. weights: (V, P) trust. summary: (P, SUMMARIES)."""

    features: jax.Array
    weights: jax.Array
    summary: jax.Array


def static_views(samples, shift, times):
    """Per-view features of `sample_views` for the static scene.

    Args:
      samples: `ViewSamples` of the key-frames.
      shift: (V, P) pixels of parallax per plane.
      times: (V,) frames between the view and the target.

    Returns:
      `StaticViews`.
    """
    agree, behind = on_surface(samples.gap), hidden_behind(samples.gap)
    weights = samples.visible * (1 - samples.moving) * (1 - behind)
    mean = over_views(weights, samples.colour)
    size = jnp.sum(jnp.abs(samples.colour - mean[None]), axis=1)
    robust = weights * jnp.exp(-jnp.square(size / 0.3)) / (1 + shift)
    second = samples.colour - over_views(robust, samples.colour)[None]
    through = samples.visible * (1 - samples.moving) * jnp.square(jnp.minimum(samples.gap, 0) / 3)
    near = jnp.broadcast_to(jnp.exp(-jnp.abs(times) / 4)[:, None], size.shape)
    scalars = [
        size, jnp.sum(jnp.abs(second), 1), samples.visible, samples.moving, agree, behind, through,
        1 / (1 + shift), 1 / (1 + shift / 4), near,
    ]  # fmt: skip
    features = jnp.concatenate([4 * second, jnp.stack(scalars, 1)], 1)
    spread = over_views(weights, jnp.stack([size, agree, through], 1))
    views = range(size.shape[0])
    total = added(weights[v] for v in views) / len(views)
    best = added(weights[v] / (1 + shift[v]) for v in views) / len(views)
    summary = jnp.concatenate([spread, total[None], best[None]], 0).T
    return jax.lax.stop_gradient(StaticViews(features, weights, summary))


def static_field(params, point, direction, volume, samples, views, *, conditioning="multiply"):
    """Density, colour and blend of P points.

    Args:
      params: `StaticParams`.
      point: (P, n) encoded position.
      direction: (P, Q) encoded.
      volume: (P, C) looked up in the geometry volume; C may be 0.
      samples: `ViewSamples` of the key-frames, or None without them.
      views: `StaticViews` for a blend head, or None: colours and visibility are then concatenated.
      conditioning: see `trunk`.

    Returns:
      `StaticSample`.

    Source: ZeST-NeRF eq. 4.
    Differs from the reference: with a blend head the colour is a softmax over the key-frames' own colours.
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
    density = 4 * jax.nn.softplus(raised(dense(params.density, state))[:, 0])
    logit = raised(dense(params.blend, state))[:, 0]
    return StaticSample(density, colour, jax.nn.sigmoid(logit), logit)


def concatenated(volume, samples):
    """(P, C + 4 V): volume features, then every view's colour and visibility bit, as the paper conditions."""
    if samples is None:
        return volume if volume.shape[-1] else jnp.ones((volume.shape[0], 1), volume.dtype)
    per_view = jnp.concatenate([samples.colour, samples.visible[:, None]], axis=1)
    return jnp.concatenate([volume, per_view.reshape(-1, per_view.shape[-1]).T], axis=-1)
