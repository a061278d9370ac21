"""Checks for a loss of one's own: is it finite, and is its gradient its slope?"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.backend import quick
from zestjax.base.checks import traced
from zestjax.base.types import Tree
from zestjax.testing.raised import is_float, raised, wide
from zestjax.testing.walk import branch_taken, contains, inner_programs, program, run

UNSEEN = "while"  # its turns differ from point to point: what is inside is not held


def assert_finite(fn: Callable, *args: Tree) -> None:
    """Values and the gradients of their sum are finite, at and in every argument.

    Args:
      fn: any function over pytrees of floating-point arrays.
      *args: where it is asked.

    Raises:
      AssertionError: naming the first leaf of the value or of an argument's gradient that is not finite.
    """
    value, grads = value_and_gradients(fn, *args)
    found = [("the value", value), *((f"the gradient of argument {i}", grad) for i, grad in enumerate(grads))]
    for what, tree in found:
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            bad = int(np.sum(~np.isfinite(np.asarray(leaf, np.float64))))
            if bad:
                raise AssertionError(
                    f"assert_finite: {what}{jax.tree_util.keystr(path)} has {bad} of {leaf.size} entries that are not "
                    "finite; `explain_gradient` finds where they begin."
                )


@functools.partial(jax.jit, static_argnums=0)
def value_and_gradients(fn: Callable, *args: Tree) -> tuple[Tree, tuple[Tree, ...]]:
    """(fn(*args), the gradient of the sum of its value in every argument), compiled once for a function and shapes."""
    total = lambda *args: sum(jnp.sum(x) for x in jax.tree.leaves(fn(*args)))
    return fn(*args), jax.grad(total, argnums=tuple(range(len(args))))(*args)


def held(fn: Callable, *args: Tree) -> Callable:
    """The function whose slope at `args` is the gradient: what passes a `stop_gradient` keeps its value there, and a
    `cond` its branch.

    Args:
      fn: function over pytrees.
      *args: the point.

    Returns:
      A function of the same arguments; it equals `fn` at `args`, and everywhere if `fn` stops no gradient.

    Raises:
      NotImplementedError: a `stop_gradient` inside `lax.while_loop`, or a `lax.cond` where `args` are traced.
    """
    closed, leaves, tree = program(fn, *args)
    if not contains(closed, "stop_gradient"):
        return fn
    values, branches = [], []

    def record(equation, _, outputs):
        if equation.primitive.name == UNSEEN and any(contains(j, "stop_gradient") for j in inner_programs(equation)):
            raise NotImplementedError(f"held: a stop_gradient inside `{UNSEEN}` cannot be held.")
        if equation.primitive.name == "stop_gradient":
            values.append(outputs)
        return outputs

    def choose(index):
        if traced(index):
            raise NotImplementedError("held: which branch a `cond` takes is not known where `args` are traced.")
        branches.append(branch_taken(index))
        return branches[-1]

    run(closed, leaves, record, choose=choose)

    def again(*args):
        kept, taken = iter(values), iter(branches)
        replay = lambda equation, _, out: next(kept) if equation.primitive.name == "stop_gradient" else out
        found = run(closed, jax.tree.leaves(args), replay, choose=lambda _: next(taken))
        return jax.tree.unflatten(tree, found)

    return again


def assert_grads_match(
    fn: Callable,
    *args: Tree,
    constant: Sequence[Tree] = (),
    step: float = 1e-6,
    directions: int = 3,
    rtol: float = 1e-5,
    atol: float = 1e-7,
    seed: int = 0,
) -> None:
    """The gradient of a random mix of a function's outputs is its slope, by central differences in float64.

    The function is traced as it is, and its program, with what it closes over and casts to, is run in float64 (see
    `raised`); 64 bits are switched on for that alone. What passes a `stop_gradient` is held while the arguments move,
    as its gradient does.

    Args:
      fn: any function over pytrees of arrays; what it gives that is no floating-point number is not looked at.
      *args: where it is asked. Their floating-point leaves move. Keep away from kinks (the corner of an absolute
        value), where no slope exists.
      constant: arguments that follow these, such as a batch or a PRNG key; nothing in them moves.
      step: of the differences, in units of the arguments.
      directions: random directions in which slopes are compared.
      rtol: tolerance, relative.
      atol: tolerance, absolute.
      seed: draws directions and mix.

    Raises:
      AssertionError: a slope disagrees; gives both.
      ValueError: no argument has a floating-point leaf.
      NotImplementedError: what cannot be held or raised, with its line.
    """
    rng = np.random.default_rng(seed)
    draw = lambda x: rng.normal(size=np.shape(x))
    outputs, point, fixed = _of_floats(fn, args, tuple(constant))
    if not point:
        raise ValueError("assert_grads_match: no argument has a floating-point leaf, expected one that can move.")
    mix = [draw(s).astype(s.dtype) for s in jax.eval_shape(outputs, point, fixed)]
    pull = raised(lambda point, fixed, mix: jax.vjp(lambda p: outputs(p, fixed), point)[1](mix)[0], point, fixed, mix)
    values = raised(outputs, point, fixed)
    with jax.enable_x64(True):
        point, fixed, mix = wide((point, fixed, mix))
        still = held(values, point, fixed)
        moved = lambda t, way: [x + t * d for x, d in zip(point, way, strict=True)]
        value = jax.jit(lambda t, way: _dot(mix, still(moved(t, way), fixed)), compiler_options=quick())
        gradient = jax.jit(pull, compiler_options=quick())(point, fixed, mix)
        for _ in range(directions):
            way = [jnp.asarray(draw(x)) for x in point]
            numeric = (value(jnp.float64(step), way) - value(jnp.float64(-step), way)) / (2 * step)
            np.testing.assert_allclose(
                _dot(gradient, way), numeric, rtol=rtol, atol=atol,
                err_msg="assert_grads_match: the gradient (first) is not the slope of central differences (second)",
            )  # fmt: skip


def _of_floats(fn, args, constant):
    """(`outputs(point, fixed) -> [floating-point outputs]`, floating-point leaves of the arguments, what stays)."""
    leaves, tree = jax.tree.flatten(args)
    moves = [is_float(x) for x in leaves]
    point, still = ([x for x, m in zip(leaves, moves, strict=True) if m is kind] for kind in (True, False))

    def outputs(point, fixed):
        point, still, constant = iter(point), iter(fixed[0]), fixed[1]
        args = jax.tree.unflatten(tree, [next(point if m else still) for m in moves])
        return [x for x in map(jnp.asarray, jax.tree.leaves(fn(*args, *constant))) if is_float(x)]

    return outputs, point, (still, constant)


def _dot(a, b):
    return sum(jnp.sum(x * y) for x, y in zip(a, b, strict=True))
