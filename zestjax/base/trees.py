"""Trees of arrays: names of leaves, norms, casts, and where a number stopped being one.

A leaf's name is its path as Python writes it: `.trunk[0].kernel`.
"""

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from zestjax.base.numerics import added, safe_sqrt
from zestjax.base.types import T, Tree


def leaf_names(tree: Tree) -> list[str]:
    """Names of the leaves, in the order of `jax.tree.leaves`."""
    return [jax.tree_util.keystr(path) for path, _ in jax.tree.leaves_with_path(tree)]


def tree_norm(tree: Tree) -> jax.Array:
    """() Euclidean norm of all entries of all leaves together; 0, with a 0 gradient, where all are 0.

    The largest entry is taken out before squaring, so that neither 1e30 nor 1e-30 is lost in float32.
    """
    leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(tree) if jnp.size(leaf)]
    if not leaves:
        return jnp.float32(0)
    largest = jax.lax.stop_gradient(jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in leaves])))
    scale = jnp.where(largest > 0, largest, 1)
    squares = [jnp.vdot(leaf / scale, leaf / scale, precision=jax.lax.Precision.HIGHEST) for leaf in leaves]
    return scale * safe_sqrt(added(squares))


def tree_cast(tree: T, dtype: DTypeLike) -> T:
    """The tree with its floating-point leaves in `dtype`; integers, booleans and keys are left alone."""
    cast = lambda leaf: leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf
    return jax.tree.map(lambda leaf: cast(jnp.asarray(leaf)), tree)


def all_finite(tree: Tree) -> jax.Array:
    """() bool: every entry of every floating-point leaf is finite. Works under jit."""
    checks = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.stack(checks)) if checks else jnp.bool_(True)


def first_nonfinite(tree: Tree) -> str | None:
    """Name of the first leaf that holds a NaN or an infinity, or None. For arrays with values: not under jit."""
    for path, leaf in jax.tree.leaves_with_path(tree):
        if not all_finite(jnp.asarray(leaf)):
            return jax.tree_util.keystr(path)
    return None


def check_finite(where: str, tree: Tree) -> None:
    """Refuse a tree with a NaN or an infinity in it.

    Raises:
      ValueError: naming the function and the first offending leaf.
    """
    name = first_nonfinite(tree)
    if name is not None:
        raise ValueError(f"{where}: leaf `{name}` is not finite.")
