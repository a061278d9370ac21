"""A mean over blocks of data whose gradient needs one block's memory.

block    an equal part of the data along the leading axis of every leaf
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import CustomVJPPrimal, SymbolicZero


def in_blocks(loss: Callable, count: int, *, where: str = "in_blocks") -> Callable:
    """Make a loss of a block of data the mean over `count` blocks of all the data.

    The gradient in `shared` is found with the value, block by block, and kept in place of everything that a block
    computed. `held` and the data are constants. One block is the loss itself, with a gradient in everything.

    Args:
      loss: `loss(shared, held, block) -> (value, aux)`, pure; aux: a tree of arrays.
      count: blocks.
      where: name used in the message.

    Returns:
      `mean(shared, held, data) -> (value, aux)`, means over the blocks. In reverse mode alone where there are several.

    Raises:
      ValueError: when called with data that has no so many equal blocks.
    """
    if count == 1:
        return loss

    @jax.custom_vjp
    def mean(shared, held, data):
        return mean_over_blocks(lambda block: loss(shared, held, block), split(data))

    def forward(shared, held, data):
        shared, held, data = jax.tree.map(lambda primal: primal.value, (shared, held, data), is_leaf=_is_primal)
        both = jax.value_and_grad(loss, has_aux=True)
        return mean_over_blocks(lambda block: both(shared, held, block), split(data))

    def backward(grads, cotangents):
        value, aux = cotangents
        if not all(isinstance(leaf, SymbolicZero) for leaf in jax.tree.leaves(aux, is_leaf=_is_zero)):
            raise ValueError(f"{where}: only the total has a gradient in {count} blocks, its terms have none; ask one.")
        value = jnp.zeros(value.shape, value.dtype) if _is_zero(value) else value
        return jax.tree.map(lambda g: value * g, grads), None, None

    def split(data):
        return _split(data, count, where)

    mean.defvjp(forward, backward, symbolic_zeros=True)
    return mean


def recomputed(fn: Callable, count: int, *, where: str = "recomputed") -> Callable:
    """Make a function of a block of data one of all the data, computed in `count` blocks, and again for the gradient:
    what lies between a block and its result is in memory for one block at a time.

    Args:
      fn: `fn(shared, block) -> tree`, pure; every leaf has the block's leading axis.
      count: blocks. One block is the function itself.
      where: name used in the message.

    Returns:
      `whole(shared, data) -> tree`, with a gradient in everything.

    Raises:
      ValueError: when called with data that has no so many equal blocks.
    """
    if count == 1:
        return fn

    def whole(shared, data):
        again = jax.checkpoint(fn)
        parts = jax.lax.map(lambda block: again(shared, block), _split(data, count, where))
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), parts)

    return whole


def over_clips(objective: Callable, count: int) -> Callable:
    """Make an objective of one clip the mean over several, found one after the other as by `in_blocks`.

    Args:
      objective: `objective(params, batch, *weights) -> (total, terms)`.
      count: clips; every leaf of a batch then has them as a new leading axis. One clip is the objective itself.

    Returns:
      `mean(params, batch, *weights) -> (total, terms)`.

    Raises:
      ValueError: when called with a batch of another number of clips.
    """
    if count == 1:
        return objective

    def of_one(params, weights, batch):
        return objective(params, jax.tree.map(lambda x: x[0], batch), *weights)

    of_all = in_blocks(of_one, count, where="over_clips")

    def mean(params, batch, *weights):
        sizes = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(batch)}
        if sizes != {(count,)}:
            raise ValueError(f"over_clips: the batch has leading axes {sorted(sizes)}, expected {count} clips in each.")
        return of_all(params, weights, batch)

    return mean


def _split(data, count, where):
    """Data in equal blocks, along a new leading axis."""
    size = len(jax.tree.leaves(data)[0])
    if size % count:
        raise ValueError(f"{where}: {size} rays have no {count} equal blocks; give another number of blocks.")
    return jax.tree.map(lambda x: x.reshape(count, -1, *x.shape[1:]), data)


def _is_primal(x):
    return isinstance(x, CustomVJPPrimal)


def _is_zero(x):
    return isinstance(x, SymbolicZero)


def mean_over_blocks(fn: Callable, blocks: Any) -> Any:
    """Mean of a tree-valued function over the leading axis of `blocks`, summed inside the loop: one block in memory."""
    count = jax.tree.leaves(blocks)[0].shape[0]
    shapes = jax.eval_shape(fn, jax.tree.map(lambda x: x[0], blocks))
    zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    total, _ = jax.lax.scan(lambda carry, block: (jax.tree.map(jnp.add, carry, fn(block)), None), zeros, blocks)
    return jax.tree.map(lambda x: x / count, total)
