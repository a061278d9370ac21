"""Heads: what a field reads of its source views at a point, and the colour it makes of it.

P  points   V  source views   C  channels of the volume   U  features of a view   Q  encoded direction
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from zestjax.base.numerics import computed_once
from zestjax.base.parts import part
from zestjax.fields.conditioning import ViewSamples
from zestjax.fields.trunk import (
    ColourHead,
    ViewHead,
    blend_of_views,
    direct_colour,
    init_colour_head,
    init_view_head,
    lifted,
    pooled_views,
    view_scores,
)

POOLED = 16  # channels of the views' pooled features
RESIDUAL = 0.1  # how far a colour may leave what the views show: highlights, not paint


class ViewFeatures(NamedTuple):
    """Views at points. features: (V, U, P) of each. weights: (V, P) how far it counts, and prior: (V, P) how far its
    colour does. summary: (P, F) of them all."""

    features: jax.Array
    weights: jax.Array
    prior: jax.Array
    summary: jax.Array


class HeadParams(NamedTuple):
    """colour: `ColourHead`. views: `ViewHead`, None where views are not looked at one by one."""

    colour: ColourHead
    views: ViewHead | None


class Reading(NamedTuple):
    """condition: (P, F) what modulates the trunk. colour: (state (P, width), direction (P, Q)) -> (P, 3)."""

    condition: jax.Array
    colour: Callable[[jax.Array, jax.Array], jax.Array]


class Head(Protocol):
    """looks: whether it needs each view's `ViewFeatures`."""

    looks: ClassVar[bool]

    def channels(self, *, volume: int, views: int, summaries: int) -> int:
        """Values of a point's condition; volume: channels of a look-up, views: 0 without a volume."""
        ...

    def init(self, key: jax.Array, *, features: int, width: int, directions: int) -> HeadParams:
        """Parameters. features: U. directions: Q."""
        ...

    def __call__(
        self, params: HeadParams, volume: jax.Array, samples: ViewSamples | None, views: ViewFeatures | None
    ) -> Reading:
        """Read points. volume: (P, C), C may be 0. samples: `ViewSamples`, or None without views."""
        ...


@part
class Blend:
    """The colour is a softmax over the views' own colours at the point, learned from features of each view."""

    looks: ClassVar[bool] = True

    def channels(self, *, volume: int, views: int, summaries: int) -> int:
        """See `Head`."""
        return volume + POOLED + summaries

    def init(self, key: jax.Array, *, features: int, width: int, directions: int) -> HeadParams:
        """See `Head`."""
        colour, views = jax.random.split(key)
        return HeadParams(
            init_colour_head(colour, width, directions), init_view_head(views, features, width, width=POOLED)
        )

    def __call__(self, params, volume, samples, views):
        """See `Head`."""
        lift = lifted(params.views, views.features)
        condition = jnp.concatenate([volume, computed_once(pooled_views, lift, views.weights).T, views.summary], -1)

        def colour(state, direction):
            scores = computed_once(view_scores, params.views, lift, state)
            shown = computed_once(blend_of_views, scores, views.prior, samples.visible, samples.colour).T
            residual = direct_colour(params.colour, state, direction) - 0.5
            return jnp.clip(shown + RESIDUAL * residual, 0, 1)

        return Reading(condition, colour)


@part
class Direct:
    """The paper's: every view's colour and visibility are part of the condition, and the trunk paints."""

    looks: ClassVar[bool] = False

    def channels(self, *, volume: int, views: int, summaries: int) -> int:
        """See `Head`."""
        return max(volume + 4 * views, 1)

    def init(self, key: jax.Array, *, features: int, width: int, directions: int) -> HeadParams:
        """See `Head`."""
        return HeadParams(init_colour_head(key, width, directions), None)

    def __call__(self, params, volume, samples, views):
        """See `Head`."""
        colour = lambda state, direction: direct_colour(params.colour, state, direction)
        return Reading(concatenated(volume, samples), colour)


def concatenated(volume: jax.Array, samples: ViewSamples | None) -> jax.Array:
    """(P, C + 4 V): volume features, then every view's colour and visibility bit, as the paper conditions."""
    if samples is None:
        return volume if volume.shape[-1] else jnp.ones((volume.shape[0], 1), volume.dtype)
    per_view = jnp.concatenate([samples.colour, samples.visible[:, None]], axis=1)
    return jnp.concatenate([volume, per_view.reshape(-1, per_view.shape[-1]).T], axis=-1)
