"""Adam as pure functions: the arithmetic behind `solve.Adam`.

params   tree of float arrays
grads    tree like the params
moments  trees like the params in at least float32
"""

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from zestjax.base.numerics import computed_once, safe_sqrt
from zestjax.base.trees import all_finite, tree_cast, tree_norm
from zestjax.base.types import Array, Scalar, Tree


class AdamState(NamedTuple):
    """iter_num: () int, updates tried. skipped: () int, those left out because value or gradient was not finite.
    value: () objective before the last update. error: () L2 norm of its gradient, before clipping.
    mean, square: moments of the gradient. aux: whatever the objective returned beside its value."""

    iter_num: jax.Array
    skipped: jax.Array
    value: jax.Array
    error: jax.Array
    mean: Tree
    square: Tree
    aux: Tree


def moment_dtype(x: Array) -> DTypeLike:
    """float64 for float64 arrays, float32 for all others."""
    return jnp.float64 if x.dtype == jnp.float64 else jnp.float32


def _arrays(tree):
    """The tree with numbers of Python's as arrays.

    Raises:
      TypeError: a leaf that is no floating-point number has no gradient.
    """
    tree = jax.tree.map(lambda leaf: leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf), tree)
    for path, leaf in jax.tree.leaves_with_path(tree):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            name = jax.tree_util.keystr(path) or "the tree"
            raise TypeError(f"Adam: leaf `{name}` is {leaf.dtype}, expected a floating type; keep it out of the tree.")
    return tree


def init_adam(params: Tree, *, value_dtype: DTypeLike | None = None, aux: Tree = None) -> AdamState:
    """The state before the first update.

    Args:
      params: tree of float arrays.
      value_dtype: of the objective; None takes the moments'.
      aux: what the state holds until the first update: zeros of the objective's aux where the state's structure
        must not change (`jax.lax.scan`).

    Returns:
      `AdamState`; no two leaves share a buffer, so it may be donated.
    """
    params = _arrays(params)
    zeros = lambda: jax.tree.map(lambda p: jnp.zeros(p.shape, moment_dtype(p)), params)
    count = lambda: jnp.zeros((), jnp.int32)
    double = any(p.dtype == jnp.float64 for p in jax.tree.leaves(params))
    scalar = jnp.float64 if double else jnp.float32
    return AdamState(
        iter_num=count(),
        skipped=count(),
        value=jnp.full((), jnp.inf, value_dtype or scalar),
        error=jnp.full((), jnp.inf, scalar),
        mean=zeros(),
        square=zeros(),
        aux=aux,
    )


def adam(
    params: Tree,
    state: AdamState,
    grads: Tree,
    value: Array,
    *,
    rate: Scalar,
    b1: Scalar = 0.9,
    b2: Scalar = 0.999,
    eps: Scalar = 1e-8,
    clip_norm: Scalar | None = None,
    skip: bool = True,
    aux: Tree = None,
) -> tuple[Tree, AdamState]:
    """One update.

    Source: Adam (Kingma and Ba 2015), algorithm 1.

    Args:
      params: tree of float arrays.
      state: `AdamState`.
      grads: tree like `params`, of the objective at `params`.
      value: () the objective there, for the state and for the test of finiteness.
      rate: () learning rate of this update.
      b1: decay of the first moment.
      b2: decay of the second.
      eps: added to the root of the second.
      clip_norm: a gradient with a larger L2 norm is scaled down to it; None never.
      skip: leave params and moments as they are, and count it, when the value or the gradient is not finite.
      aux: kept in the state.

    Returns:
      (params, state).
    """
    params, grads = _arrays(params), _arrays(grads)
    vectors, restored = _vectors(params, grads, state.mean, state.square)
    finite = all_finite([g for _, g, _, _ in vectors])
    norm = jnp.where(finite, tree_norm(tree_cast([g for _, g, _, _ in vectors], state.error.dtype)), jnp.inf)
    good = finite & jnp.isfinite(value) if skip else jnp.bool_(True)
    scale = 1.0 if clip_norm is None else clip_norm / jnp.maximum(norm, clip_norm)
    count = state.iter_num - state.skipped + 1

    def stepped(p, g, m, v):
        cast = lambda x: jnp.asarray(x).astype(m.dtype)
        g = cast(g) * cast(scale)
        mean, square = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g**2
        debiased = lambda x, b: x / (1 - cast(b) ** cast(count))
        change = cast(rate) * debiased(mean, b1) / (safe_sqrt(debiased(square, b2)) + eps)
        keep = lambda new, old: jnp.where(good, new, old)
        return keep((cast(p) - change).astype(p.dtype), p), keep(mean, m), keep(square, v)

    params, mean, square = restored([computed_once(stepped, *four) for four in vectors])
    left_out = jnp.where(good, 0, 1).astype(state.skipped.dtype)
    return params, AdamState(state.iter_num + 1, state.skipped + left_out, jnp.asarray(value), norm, mean, square, aux)


def _of_one_shape(first, *others):
    """Refuse leaves of several shapes: their vectors would be added up all the same."""
    if any(other.shape != first.shape for other in others):
        shapes = ", ".join(str(x.shape) for x in (first, *others))
        raise ValueError(
            f"adam: a leaf of params, gradient and moments has shapes {shapes}, expected one and the same."
        )


def _vectors(*trees):
    """([for each type of leaves a vector of every tree], what makes a tuple of trees of such lists again).

    Compiled leaf by leaf, an update of 140 leaves takes 17 s to compile.
    """
    jax.tree.map(_of_one_shape, *trees)
    leaves = list(zip(*map(jax.tree.leaves, trees), strict=True))
    kinds: dict[Any, list[int]] = {}
    for i, leaf in enumerate(leaves):
        kinds.setdefault(tuple(x.dtype for x in leaf), []).append(i)
    joined = lambda *arrays: jnp.concatenate([jnp.ravel(x) for x in arrays])
    vectors = [
        [computed_once(joined, *(leaves[i][k] for i in places)) for k in range(len(trees))] for places in kinds.values()
    ]

    def restored(found):
        parts: list[Any] = [None] * len(leaves)
        for places, results in zip(kinds.values(), found, strict=True):
            ends = list(itertools.accumulate(leaves[i][0].size for i in places))[:-1]
            for i, part in zip(places, zip(*(jnp.split(x, ends) for x in results), strict=True), strict=True):
                parts[i] = tuple(x.reshape(leaves[i][0].shape) for x in part)
        return tuple(jax.tree.unflatten(jax.tree.structure(trees[0]), column) for column in zip(*parts, strict=True))

    return vectors, restored
