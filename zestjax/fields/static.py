"""The static field: density, colour and blend of a point that does not move.

P  points   V  key-frames   C  channels of the geometry volume   Q  encoded direction
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.numerics import added
from zestjax.fields.conditioning import GAP_LIMIT, ViewSamples, on_surface, over_views
from zestjax.fields.conditioning import hidden as hidden_behind
from zestjax.fields.heads import HeadParams, Reading, ViewFeatures
from zestjax.fields.trunk import Trunk, init_trunk, trunk
from zestjax.nets.layers import Dense, dense, init_dense, raised

VIEW_FEATURES = 13  # three colours and the ten scalars of `static_views`
SUMMARIES = 5  # means of three features over the views, and how many views can be trusted, and are near


class StaticParams(NamedTuple):
    """The time-independent field. Depth, width and skip are in the shapes. head: of the field's `heads.Head`."""

    trunk: Trunk
    density: Dense
    blend: Dense
    head: HeadParams


class StaticSample(NamedTuple):
    """density: (P,) >= 0. colour: (P, 3) in [0, 1]. blend: (P,) in (0, 1), 1 is dynamic. blend_logit: (P,)."""

    density: jax.Array
    colour: jax.Array
    blend: jax.Array
    blend_logit: jax.Array


def init_static(
    key: jax.Array, *, n_point: int, n_condition: int, width: int, depth: int, head: Callable[[jax.Array], HeadParams]
) -> StaticParams:
    """Parameters. n_condition: what the head reads of a point. head: key -> its parameters."""
    keys = jax.random.split(key, 4)
    blend = init_dense(keys[2], width, 1, scale=0.1)
    return StaticParams(
        init_trunk(keys[0], n_point, n_condition, width=width, depth=depth),
        init_dense(keys[1], width, 1, scale=0.1),
        blend._replace(bias=blend.bias - 2.0),  # static until the motion volume speaks
        head(keys[3]),
    )


def static_views(samples: ViewSamples, shift: jax.Array, times: jax.Array) -> ViewFeatures:
    """Per-view features of `sample_views` for the static scene.

    Args:
      samples: `ViewSamples` of the key-frames.
      shift: (V, P) pixels of parallax per plane.
      times: (V,) frames between the view and the target.

    Returns:
      `heads.ViewFeatures`, with weights of trust.
    """
    agree, behind = on_surface(samples.gap), hidden_behind(samples.gap)
    weights = samples.visible * (1 - samples.moving) * (1 - behind)
    mean = over_views(weights, samples.colour)
    size = jnp.sum(jnp.abs(samples.colour - mean[None]), axis=1)
    # A view that is 0.3 (summed over the channels) off the mean is an outlier: a guess that was never varied.
    robust = weights * jnp.exp(-jnp.square(size / 0.3)) / (1 + shift)
    second = samples.colour - over_views(robust, samples.colour)[None]
    through = samples.visible * (1 - samples.moving) * jnp.square(jnp.minimum(samples.gap, 0) / GAP_LIMIT)
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
    return jax.lax.stop_gradient(ViewFeatures(features, weights, weights, summary))


def static_field(
    params: StaticParams, point: jax.Array, direction: jax.Array, reading: Reading, *, modulation: str = "multiply"
) -> StaticSample:
    """Density, colour and blend of P points.

    Args:
      params: `StaticParams`.
      point: (P, n) encoded position.
      direction: (P, Q) encoded.
      reading: what the field's head reads of the points, see `heads`.
      modulation: see `trunk`.

    Returns:
      `StaticSample`.

    Source: ZeST-NeRF eq. 4.
    Differs from the reference: with a blend head the colour is a softmax over the key-frames' own colours.
    """
    state = trunk(params.trunk, point, reading.condition, modulation=modulation)
    colour = reading.colour(state, direction)
    density = 4 * jax.nn.softplus(raised(dense(params.density, state))[:, 0])
    logit = raised(dense(params.blend, state))[:, 0]
    return StaticSample(density, colour, jax.nn.sigmoid(logit), logit)
