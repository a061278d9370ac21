"""Where a gradient comes from: which loss pulls at which parameters, and where numbers cease to be finite.

term   one named loss of several
group  parameters that share the first steps of their path in the tree
"""

from typing import NamedTuple

import jax
import numpy as np

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


def explain_gradient(losses, params, *, depth=1):
    """Value and gradient norms of every term by group, and the origin of what is not finite.

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
    for term in shapes:
        value, grads = jax.jit(jax.value_and_grad(lambda p, term=term: named(p)[term]))(params)
        squares = dict.fromkeys(groups, 0.0)
        for group, leaf in zip(paths, jax.tree.leaves(grads), strict=True):
            squares[group] += float(np.sum(np.square(np.asarray(leaf, np.float64))))
        values.append(float(value))
        norms.append([squares[group] ** 0.5 for group in groups])
        if origin is None and not np.isfinite([values[-1], *norms[-1]]).all():
            origin = find_origin(lambda p, term=term: named(p)[term], params, term)
    return Explanation(tuple(shapes), groups, np.array(values), np.array(norms), origin)


def _named(losses):
    named = losses if isinstance(losses, dict) else losses._asdict()
    return {str(name): value for name, value in named.items() if value is not None}
