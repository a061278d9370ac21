"""Where a number ceases to be finite: a program is walked, and what is not finite is followed to its result.

kind    `nan` or `inf`. They are followed apart: an infinity is often meant (a mask of -inf), a NaN hardly ever
source  an array that no operation made: a leaf of the parameters, or a constant
healed  an origin taken away, to see what is left: what is not finite there is replaced by a plain number
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.types import Tree
from zestjax.testing.walk import bind, branch_taken, place_of, program, run

KINDS = {"nan": np.isnan, "inf": np.isinf}
PASSING = ("scan", "while")  # visited where they take rows apart and put them together
PLAIN = 0.7  # neither 0, whose logarithm and quotient are infinite, nor a number that programs compare with


class Origin(NamedTuple):
    """The first operation whose result is not finite though what it was given is, or that read a source that is not.

    term: str. operation: str, empty where a source is the result. where: file and line of the code that asked for it.
    shape: of the result. stage: `value` or `gradient`. source: such as `params['w'] with nan`, empty where the
    operation's inputs are finite."""

    term: str
    operation: str
    where: str
    shape: tuple
    stage: str
    source: str = ""

    def __str__(self):
        read = f"{self.operation} {self.shape} at {self.where}" if self.operation else "the result"
        found = f"{self.source}, in {read}" if self.source else read
        return f"not finite first in the {self.stage} of `{self.term}`: {found}"


def find_origin(loss: Callable, params: Tree, term: str) -> Origin | None:
    """Where what is not finite in a loss or its gradient begins.

    Args:
      loss: `loss(params)` gives a scalar.
      params: pytree of floating-point arrays.
      term: name of the loss.

    Returns:
      `Origin`, or None where value and gradient are finite.
    """
    names = [f"params{jax.tree_util.keystr(path)}" for path, _ in jax.tree_util.tree_leaves_with_path(params)]
    before = []
    for stage, fn in (("value", loss), ("gradient", jax.grad(loss))):
        closed, leaves, _ = program(fn, params)
        names_of, begin = dict(zip(map(id, leaves), names, strict=True)), Origin(term, "", "", (), stage)
        follow = functools.partial(_follow, closed, leaves, names_of, begin)
        found, begun = follow(healed=frozenset())
        if found:
            origin = _to_blame(found, follow)
            same = [b for b in before if b.where and (b.where, b.source) == (origin.where, origin.source)]
            return (same or [origin])[0]  # the slope of log at 0 is not finite, and log itself was not
        before = begun
    return None


def _to_blame(found, follow):
    """Of several origins the first that spoils the result alone: no bystander that a mask keeps out."""
    found = sorted(found, key=_meant)
    for origin in found[:-1]:
        if origin in follow(healed=frozenset(found) - {origin})[0]:
            return origin
    return found[-1]


def _meant(origin):
    """Whether it may be no fault: a constant of infinities, as masks are."""
    return origin.source.endswith("inf") and not origin.source.startswith("params")


def _follow(closed, leaves, names, begin, healed):
    """(origins that the result depends on, all of them), in the order of the program. names: of leaves, by their id."""
    known, order = {}, {}  # id of an array -> (the array, which keeps its id its own; kind -> its origins)

    def origins_of(x, here):
        if id(x) in known:
            return known[id(x)][1]
        name = names.get(id(x)) or f"a constant {jnp.result_type(x)} {np.shape(x)}"
        return {kind: {here._replace(source=f"{name} with {kind}")} for kind in _kinds(x)}

    def visit(equation, inputs, outputs):
        if not any(map(_kinds, outputs)):
            return outputs
        shape = tuple(np.shape(outputs[0]))
        here = begin._replace(operation=equation.primitive.name, where=place_of(equation), shape=shape)
        given = [origins_of(x, here) for x in inputs]
        if healed & _union(given):  # sources, since what is healed later on is finite by now
            inputs = [_plain(x) if healed & _union([origins]) else x for x, origins in zip(inputs, given, strict=True)]
            outputs, given = _again(equation, inputs, outputs), [origins_of(x, here) for x in inputs]
        own = _again(equation, list(map(_plain, inputs)), outputs) if any(given) else outputs
        return [noted(*pair, given, here) for pair in zip(outputs, own, strict=True)]

    def noted(x, own, given, here):
        origins = {kind: _origins(kind, given, here, kind in _kinds(own)) for kind in _kinds(x)}
        if healed & _union([origins]):
            x = _plain(x, where=own if here in healed else x)
            origins = {kind: origins[kind] - healed for kind in _kinds(x)}
        order.update(dict.fromkeys(sorted(_union([origins]) - set(order))))
        if origins:
            known.setdefault(id(x), (x, origins))
        return x

    result = run(closed, leaves, visit, choose=branch_taken, turns=True)
    reached = _union(origins_of(x, begin) for x in result)
    return [*(origin for origin in order if origin in reached), *sorted(reached - set(order))], list(order)


def _union(given):
    """Origins of any kind in any of several arrays."""
    return set().union(*(origins for kinds in given for origins in kinds.values()))


def _origins(kind, given, here, own):
    """Origins of what is of a kind in an operation's result. own: whether it would be there of plain inputs too."""
    inherited = set().union(*(x.get(kind, ()) for x in given))
    if kind == "nan" and not inherited and not own:  # inf - inf or 0 * inf: this is where a source's infinity hurts
        infinite = set().union(*(x.get("inf", ()) for x in given))
        inherited = {here._replace(source=origin.source) if origin.source else origin for origin in infinite}
    return inherited | {here} if own or not inherited else inherited


def _again(equation, inputs, outputs):
    """Outputs of an operation of other inputs; rows of a loop, which are only passed on, become plain."""
    return list(map(_plain, outputs)) if equation.primitive.name in PASSING else bind(equation, inputs)


def _plain(x, *, where=None):
    """The array with a plain number where it, or another of its shape, is not finite."""
    where = x if where is None else where
    if not _kinds(where):
        return x
    x = np.asarray(x)
    return jnp.asarray(np.where(np.isfinite(np.asarray(where)), x, x.dtype.type(PLAIN)))


def _kinds(x):
    """Of what an array holds: any of `KINDS`."""
    if not jnp.issubdtype(getattr(x, "dtype", None) or np.result_type(x), jnp.inexact):
        return ()
    return tuple(kind for kind, test in KINDS.items() if test(np.asarray(x)).any())
