"""Primitives whose value *and* gradient stay finite where the naive form breaks.

Each is named for what it guarantees; the test beside it goes to the point where the naive form breaks.
"""

import functools
import operator
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer

from zestjax.base.types import Array, Scalar, T

HIGHEST = jax.lax.Precision.HIGHEST  # on GPUs and TPUs the default rounds to the digits of a half: pixels off


def exclusive_cumsum(x: Array) -> jax.Array:
    """Running sum of the entries before each one, on the last axis; starts at 0.

    Not `cumsum(x) - x`: a large last entry (the reference closes every ray with a 1e10 interval) would
    absorb the sum it is then subtracted from.
    """
    zero = jnp.zeros_like(x[..., :1])
    return jnp.concatenate([zero, jnp.cumsum(x[..., :-1], axis=-1)], axis=-1)


def exclusive_cumprod(x: Array) -> jax.Array:
    """Running product of the entries before each one, on the last axis; starts at 1."""
    ones = jnp.ones_like(x[..., :1])
    return jnp.cumprod(jnp.concatenate([ones, x[..., :-1]], axis=-1), axis=-1)


def safe_sqrt(x: Array) -> jax.Array:
    """Square root of x >= 0 whose gradient at 0 is 0 rather than infinite."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_norm(x: Array, *, axis: int = -1, keepdims: bool = False) -> jax.Array:
    """Euclidean norm whose gradient at x = 0 is 0 rather than NaN."""
    return safe_sqrt(jnp.sum(x * x, axis=axis, keepdims=keepdims))


def safe_divide(numerator: Scalar, denominator: Scalar, *, otherwise: Scalar = 0.0) -> jax.Array:
    """numerator / denominator; `otherwise`, with a 0 gradient, where the denominator is 0.

    The slope is (d numerator - quotient d denominator) / denominator: the square of a small denominator, by which the
    textbook's form divides, is 0 in float32 from 1e-23 on.
    """
    zero = denominator == 0
    return jnp.where(zero, otherwise, _quotient(numerator, jnp.where(zero, 1, denominator)))


@jax.custom_jvp
def _quotient(numerator, denominator):
    return numerator / denominator


@_quotient.defjvp
def _quotient_jvp(primals, tangents):
    quotient = _quotient(*primals)
    return quotient, (tangents[0] - quotient * tangents[1]) / primals[1]


def added(arrays: Iterable[jax.Array]) -> jax.Array:
    """The sum of one array or more of one shape."""
    return functools.reduce(operator.add, arrays)


def masked_mean(x: Array, mask: Array) -> jax.Array:
    """Mean of x where mask is 1; exactly 0, with a 0 gradient, when mask is empty.

    Args:
      x: any shape; may be non-finite where mask is 0.
      mask: broadcasts to x; weights in [0, 1].
    """
    mask = jnp.broadcast_to(mask, x.shape).astype(x.dtype)
    count = jnp.sum(mask)
    return jnp.sum(jnp.where(mask > 0, x, 0) * mask) / jnp.where(count > 0, count, 1)


def matvec(matrix: Array, vector: Array) -> jax.Array:
    """(..., i, j) x (..., j) -> (..., i) in true float32, on GPUs and TPUs too."""
    return jnp.einsum("...ij,...j->...i", matrix, vector, precision=HIGHEST)


def matmul(a: Array, b: Array) -> jax.Array:
    """(..., i, j) x (..., j, k) -> (..., i, k) in true float32, on GPUs and TPUs too."""
    return jnp.matmul(a, b, precision=HIGHEST)


def computed_once(fn: Callable[..., T], *args: Any) -> T:
    """`fn(*args)`, kept, where XLA's CPU compiler would compute it again in everything that reads it.

    The compiler takes gathers and sums of products for cheap, and repeats them in each of their readers, through a
    `lax.optimization_barrier` too. No code leaves a branch, so this is the branch of a condition that always
    holds, which it cannot know: that a random number of [0, 1) is below 2. (One made of the arguments is known where
    these are constants, and differs from view to view under `vmap`, which then computes both branches into the
    readers again.) Values and gradients are those of `fn`; on other devices this is `fn` itself.

    Args:
      fn: of arrays, to a tree of arrays.
      *args: trees of arrays.
    """
    if jax.default_backend() != "cpu":
        return fn(*args)
    always = jax.lax.rng_uniform(jnp.float32(0), jnp.float32(1), ()) < 2
    if not isinstance(always, Tracer):  # nothing is compiled: every operation is run as it comes, and kept
        return fn(*args)
    nothing = lambda *args: jax.tree.map(jnp.zeros_like, fn(*args))  # shaped and placed alike; nothing of `fn` is left
    return jax.lax.cond(always, fn, nothing, *args)


def rounded_once(x: T) -> T:
    """Arrays that all their readers see alike, to the last bit, in a program for the CPU; elsewhere `x` as it is.

    What is computed again in two readers may be rounded differently in each, as products and sums are joined here and
    not there. Where a number decides which row of a table is read by one and how far from that row it lies by
    another, a row too far is read in silence: 4.9999998 and 5 are near each other, rows 4 and 5 are not.
    """
    return computed_once(lambda x: x, x)
