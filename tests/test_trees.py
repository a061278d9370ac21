"""Trees: names, norms, casts and the leaf that broke."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite

from zestjax.base import trees


class Layer(NamedTuple):
    """A leaf with a name and one with an index."""

    kernel: jax.Array
    rest: tuple


def layer(value):
    return Layer(jnp.full((2, 3), value), (jnp.ones(2), jnp.arange(3)))


def test_leaves_are_named_by_their_path():
    assert trees.leaf_names(layer(1.0)) == [".kernel", ".rest[0]", ".rest[1]"]


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_norm_is_that_of_all_entries_however_large(scale):
    tree = [jnp.full(4, 3.0) * scale, jnp.full(16, 2.0) * scale]
    np.testing.assert_allclose(trees.tree_norm(tree), 10 * scale, rtol=1e-6)
    assert_finite(trees.tree_norm, tree)


def test_norm_of_nothing_is_zero():
    assert trees.tree_norm([]) == 0 and trees.tree_norm([jnp.zeros((0, 3))]) == 0
    np.testing.assert_array_equal(jax.grad(trees.tree_norm)(jnp.zeros(3)), 0)


def test_gradient_of_the_norm_is_the_direction():
    np.testing.assert_allclose(jax.grad(trees.tree_norm)(jnp.asarray([3.0, 4.0])), [0.6, 0.8], rtol=1e-6)


def test_cast_leaves_integers_alone():
    cast = trees.tree_cast(layer(1.0), jnp.bfloat16)
    assert [leaf.dtype for leaf in jax.tree.leaves(cast)] == [jnp.bfloat16, jnp.bfloat16, jnp.int32]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_the_first_leaf_that_is_not_finite_is_named(bad):
    assert trees.all_finite(layer(1.0)) and trees.first_nonfinite(layer(1.0)) is None
    assert not jax.jit(trees.all_finite)(layer(bad))
    with pytest.raises(ValueError, match="train: leaf `.kernel` is not finite"):
        trees.check_finite("train", layer(bad))
    trees.check_finite("train", layer(0.0))


def test_a_tree_without_numbers_is_finite():
    assert trees.all_finite(()) and trees.all_finite([jnp.arange(3)])
