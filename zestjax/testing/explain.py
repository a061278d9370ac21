"""Where a gradient comes from: which loss pulls at which parameters, and where numbers cease to be finite.

term   one named loss of several
group  parameters that share the first steps of their path in the tree
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.backend import quick
from zestjax.base.types import Tree
from zestjax.testing.origin import Origin, find_origin

NOT_FOUND = "not finite, yet nothing is found where it begins: run one at a time, all operations are finite"


class Explanation(NamedTuple):
    """terms, groups: names. values: (T,) of the losses. norms: (T, G) Euclidean norms of their gradients.
    origin: `Origin`, or None when everything is finite or nothing is found."""

    terms: tuple[str, ...]
    groups: tuple[str, ...]
    values: np.ndarray
    norms: np.ndarray
    origin: Origin | None

    def __str__(self):
        wide = max(len(name) for name in (*self.terms, "term"))
        head = f"{'term':{wide}}  {'value':>10}  " + "  ".join(f"{group:>12}" for group in self.groups)
        rows = [
            f"{term:{wide}}  {value:10.4g}  " + "  ".join(f"{norm:12.4g}" for norm in norms)
            for term, value, norms in zip(self.terms, self.values, self.norms, strict=True)
        ]
        finite = np.isfinite(self.values).all() and np.isfinite(self.norms).all()
        found = "everything is finite" if finite else NOT_FOUND
        if self.origin is not None:
            found = str(self.origin)
        return "\n".join([head, *rows, found])


def explain_gradient(losses: Callable, params: Tree, *, depth: int = 1) -> Explanation:
    """Value and gradient norms of every term by group, and the origin of what is not finite.

    One program is compiled for all terms; each that is not finite in it is asked once more, alone.

    Args:
      losses: `losses(params)` gives scalars by name: a dict, or a NamedTuple of which entries may be None.
      params: pytree of floating-point arrays.
      depth: steps of a leaf's path that name its group.

    Returns:
      `Explanation`; print it.

    Raises:
      ValueError: `losses` gives no term, or one that is not a scalar.
    """
    named = lambda p: _named(losses(p))
    shapes = jax.eval_shape(named, params)
    if not shapes or any(x.shape != () for x in shapes.values()):
        got = {name: x.shape for name, x in shapes.items()}
        raise ValueError(f"explain_gradient: `losses` should give scalars by name, got {got}.")
    paths = [jax.tree_util.keystr(p[:depth]) or "all" for p, _ in jax.tree_util.tree_leaves_with_path(params)]
    groups, values, norms, origin = tuple(dict.fromkeys(paths)), [], [], None
    found = _gradients(named, tuple(shapes), params)
    for i, term in enumerate(shapes):
        one = lambda p, term=term: named(p)[term]
        value, leaves = found[0][term], [leaf[i] for leaf in found[1]]
        if not _finite(value, leaves):  # another term's infinity times this one's 0 may have spoilt it: ask it alone
            value, grads = jax.jit(jax.value_and_grad(one), compiler_options=quick())(params)
            leaves = list(map(np.asarray, jax.tree.leaves(grads)))
        if origin is None and not _finite(value, leaves):
            origin = find_origin(one, params, term)
        values.append(float(value))
        norms.append([_norm(leaves, paths, group) for group in groups])
    return Explanation(tuple(shapes), groups, np.array(values), np.array(norms), origin)


def _gradients(named, terms, params):
    """(values by term, leaves of the gradient with the terms as leading axis), by one program: one forward pass."""

    @partial(jax.jit, compiler_options=quick())
    def both(params):
        values, pull = jax.vjp(named, params)
        chosen = lambda i: {name: jnp.where(i == k, 1, 0).astype(values[name].dtype) for k, name in enumerate(terms)}
        return values, jax.lax.map(lambda i: pull(chosen(i))[0], jnp.arange(len(terms)))

    values, grads = both(params)
    return values, [np.asarray(leaf) for leaf in jax.tree.leaves(grads)]


def _finite(value, leaves):
    return all(np.isfinite(np.asarray(x, np.float64)).all() for x in (value, *leaves))


def _norm(leaves, paths, group):
    """Euclidean norm of the leaves of a group."""
    return (
        sum(
            float(np.sum(np.square(np.asarray(x, np.float64))))
            for x, p in zip(leaves, paths, strict=True)
            if p == group
        )
        ** 0.5
    )


def _named(losses):
    named = losses if isinstance(losses, dict) else losses._asdict()
    return {str(name): value for name, value in named.items() if value is not None}
