"""The trunk that both fields share: an MLP whose hidden state is modulated by the conditioning, and the view pooling.

P  points   F  conditioning features   Q  encoded direction   V  source views   U  channels per view
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_option
from zestjax.base.numerics import added
from zestjax.nets.layers import Dense, dense, init_dense, lowered, raised

MODULATIONS = ("multiply", "add")
SCORE_LIMIT = 8.0  # of a view's logit either way: exp stays finite without looking for the largest of the views


class Trunk(NamedTuple):
    """layers: of Dense; one whose kernel takes more than the last gave, skips. condition: Dense, F to the width."""

    layers: tuple[Dense, ...]
    condition: Dense


class ViewHead(NamedTuple):
    """What is learned for one view and shared by all: lift (U -> width), query (trunk -> width), score (width -> 1)."""

    lift: Dense
    query: Dense
    score: Dense


class ColourHead(NamedTuple):
    """feature: Dense. hidden: Dense on features and direction. colour: Dense to 3 raw channels."""

    feature: Dense
    hidden: Dense
    colour: Dense


def init_trunk(key: jax.Array, n_in: int, n_condition: int, *, width: int, depth: int) -> Trunk:
    """A trunk of `depth` layers; from six layers on, the input is joined again after the fifth, as in NeRF."""
    keys = jax.random.split(key, depth + 1)
    skip = 5 if depth > 5 else -1
    sizes = [n_in if i == 0 else width + n_in * (i == skip) for i in range(depth)]
    layers = tuple(init_dense(k, size, width) for k, size in zip(keys[:-1], sizes, strict=True))
    condition = init_dense(keys[-1], n_condition, width, scale=0.5)
    return Trunk(layers, condition._replace(bias=jnp.ones_like(condition.bias)))


def trunk(params: Trunk, x: jax.Array, condition: jax.Array, *, modulation: str = "multiply") -> jax.Array:
    """Hidden state of each point: relu(layer(h) * condition), layer by layer.

    Args:
      params: `Trunk`.
      x: (P, n) encoded position.
      condition: (P, F).
      modulation: how the condition acts on the state: `multiply`, or `add` as the paper prints it.

    Returns:
      (P, width).

    Source: ZeST-NeRF appendix, MLP table.
    Reference: ZeST-NeRF networks.py; MVSNeRF models.py (multiplies).
    """
    check_option("trunk", modulation=(modulation, MODULATIONS))
    given = dense(params.condition, condition)
    hidden = x = lowered(x, params.condition.kernel)
    for layer in params.layers:
        if layer.kernel.shape[0] > hidden.shape[-1]:
            hidden = jnp.concatenate([x, hidden], axis=-1)
        hidden = dense(layer, hidden)
        hidden = jax.nn.relu(hidden * given if modulation == "multiply" else hidden + given)
    return hidden


def init_view_head(key: jax.Array, n_view: int, n_hidden: int, *, width: int = 16) -> ViewHead:
    """Parameters of the per-view network."""
    lift, query, score = jax.random.split(key, 3)
    return ViewHead(
        init_dense(lift, n_view, width), init_dense(query, n_hidden, width), init_dense(score, width, 1, scale=0.3)
    )


def lifted(params: ViewHead, features: jax.Array) -> list[jax.Array]:
    """(V, U, P) -> V arrays (width, P) before any activation, one product per view."""
    kernel, bias = params.lift.kernel.T, params.lift.bias[:, None]
    features = lowered(features, kernel)
    return [kernel @ view + lowered(bias, kernel) for view in features]


def pooled_views(lift: Sequence[jax.Array], weights: jax.Array) -> jax.Array:
    """(width, P) weighted mean over views of their activated features; weights (V, P), every view at least a little."""
    weights = weights + 1e-3  # or a point that no view is trusted at had no features
    total = added(weights[v] for v in range(len(lift)))
    share = jax.lax.optimization_barrier(weights / total[None])
    share = lowered(share, lift[0])
    return raised(added(share[v][None] * jax.nn.relu(view) for v, view in enumerate(lift)))


def view_scores(params: ViewHead, lift: Sequence[jax.Array], hidden: jax.Array) -> jax.Array:
    """(V, P) logits with which each view's colour is chosen.

    Args:
      params: `ViewHead`.
      lift: V arrays (width, P) from `lifted`.
      hidden: (P, n) state of the points.
    """
    query = dense(params.query, hidden).T
    kernel = params.score.kernel.T
    return raised(jnp.concatenate([kernel @ jax.nn.relu(view + query) for view in lift]) + params.score.bias[0])


def blend_of_views(scores: jax.Array, prior: jax.Array, visible: jax.Array, colour: jax.Array) -> jax.Array:
    """Softmax over the views that see a point of their colours.

    Args:
      scores: (V, P) logits.
      prior: (V, P) >= 0 trust that multiplies the softmax.
      visible: (V, P) 1 or 0.
      colour: (V, 3, P).

    Returns:
      (3, P); 0 where no view sees the point.
    """
    scores = SCORE_LIMIT * jnp.tanh(scores / SCORE_LIMIT)
    weights = jnp.exp(scores) * (prior + 1e-4) * visible  # where no view is trusted, those that see choose the colour
    views = range(weights.shape[0])
    total = added(weights[v] for v in views)
    mean = added(weights[v][None] * colour[v] for v in views)
    return mean / jnp.maximum(total, 1e-9)[None]


def init_colour_head(key: jax.Array, n_hidden: int, n_view: int) -> ColourHead:
    """The paper's head: a linear map, then direction joined, half the width, three channels."""
    a, b, c = jax.random.split(key, 3)
    return ColourHead(
        init_dense(a, n_hidden, n_hidden),
        init_dense(b, n_hidden + n_view, max(n_hidden // 2, 4)),
        init_dense(c, max(n_hidden // 2, 4), 3),
    )


def direct_colour(params: ColourHead, hidden: jax.Array, direction: jax.Array) -> jax.Array:
    """(P, 3) in (0, 1) from the state and the encoded direction."""
    features = dense(params.feature, hidden)
    features = jnp.concatenate([features, lowered(direction, params.feature.kernel)], axis=-1)
    return jax.nn.sigmoid(raised(dense(params.colour, jax.nn.relu(dense(params.hidden, features)))))
