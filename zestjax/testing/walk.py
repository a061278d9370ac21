"""A function's program, run one primitive at a time, so that what happens inside can be looked at or held.

primitive  an operation that JAX does not take apart further
visit      `visit(equation, inputs, outputs) -> outputs`, called for every primitive in the order of the program
choose     `choose(index) -> branch` of a `cond`, called in that order too
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax._src import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from zestjax.base.types import Array, Tree

INNER = ("jaxpr", "call_jaxpr", "fun_jaxpr")
INLINED = ("jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2", "custom_jvp_call",
           "custom_vjp_call", "custom_vjp_call_jaxpr")  # fmt: skip


def program(fn: Callable, *args: Tree) -> tuple[ClosedJaxpr, list[jax.Array], Any]:
    """(`ClosedJaxpr`, leaves of the arguments, tree of the result) of a function of pytrees."""
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, args))
    flat = lambda *leaves: fn(*jax.tree.unflatten(tree, leaves))
    jaxpr, shape = jax.make_jaxpr(flat, return_shape=True)(*leaves)
    return jaxpr, leaves, jax.tree.structure(shape)


def run(
    closed: ClosedJaxpr,
    leaves: Sequence[Array],
    visit: Callable,
    *,
    choose: Callable | None = None,
    turns: bool = False,
) -> list[Array]:
    """Outputs of a program; what is compiled, rematerialised or scanned inside is walked through too.

    Args:
      closed: `ClosedJaxpr`.
      leaves: its arguments.
      visit: sees every primitive and may change what it gives. A `scan` is also visited where it takes a row apart and
        where it stacks its turns, so that no array appears that was not visited.
      choose: walk into the branch of every `cond` that this says; None: the `cond` is one operation.
      turns: walk into the turns that a `while` makes. It needs values, not tracers.

    Returns:
      List of arrays.
    """
    return _run(closed, leaves, visit, (choose, turns))


def branch_taken(index: Array) -> int:
    """The branch that a `cond` takes: `choose` of `run`, where values are known."""
    return int(index)


def contains(closed: ClosedJaxpr | Jaxpr, name: str) -> bool:
    """Whether a primitive of this name is anywhere in a program."""
    return any(
        e.primitive.name == name or any(contains(j, name) for j in inner_programs(e)) for e in _jaxpr(closed).eqns
    )


def _jaxpr(closed):
    return closed.jaxpr if isinstance(closed, ClosedJaxpr) else closed


def inner_programs(equation: JaxprEqn) -> list[ClosedJaxpr | Jaxpr]:
    """Programs that an operation holds: of what it calls, of its branches, of a loop's condition and turn."""
    values = [equation.params[name] for name in INNER if name in equation.params]
    return values + list(equation.params.get("branches", ())) + [
        equation.params[name] for name in ("cond_jaxpr", "body_jaxpr") if name in equation.params
    ]  # fmt: skip


def _run(closed, leaves, visit, into):
    jaxpr, consts = _jaxpr(closed), closed.consts if isinstance(closed, ClosedJaxpr) else ()
    known = dict(zip(jaxpr.constvars, consts, strict=True)) | dict(zip(jaxpr.invars, leaves, strict=True))
    read = lambda variable: variable.val if isinstance(variable, Literal) else known[variable]
    for equation in jaxpr.eqns:
        inputs = [read(variable) for variable in equation.invars]
        known.update(zip(equation.outvars, _outputs(equation, inputs, visit, into), strict=True))
    return [read(variable) for variable in jaxpr.outvars]


def _outputs(equation, inputs, visit, into):
    name, params = equation.primitive.name, equation.params
    within = lambda inside, inputs, outputs: visit(_placed(inside, equation), inputs, outputs)
    if name in INLINED and (inner := inner_programs(equation)):
        return _run(inner[0], inputs, within, into)
    if name == "scan":
        return _scan(equation, inputs, within, into)
    choose, turns = into
    if name == "cond" and choose:
        branch = min(max(choose(inputs[0]), 0), len(params["branches"]) - 1)
        return _run(params["branches"][branch], inputs[1:], within, into)
    if name == "while" and turns:
        return _while(equation, inputs, within, into)
    return visit(equation, inputs, bind(equation, inputs))


def bind(equation: JaxprEqn, inputs: Sequence[Array]) -> list[jax.Array]:
    """Outputs of one operation, a list."""
    outputs = equation.primitive.bind(*inputs, **equation.params)
    return list(outputs) if equation.primitive.multiple_results else [outputs]


def place_of(equation: JaxprEqn) -> str:
    """File, line and function that asked for an operation; empty where JAX has not kept them."""
    return source_info_util.summarize(equation.source_info)


def _placed(equation, caller):
    """An operation of a function that was compiled before has no place of its own: it has its caller's."""
    return equation if place_of(equation) else equation.replace(source_info=caller.source_info)


def _scan(equation, inputs, visit, into):
    """One turn after the other; the outputs of the turns are stacked again."""
    params = equation.params
    consts, carry = params["num_consts"], params["num_carry"]
    fixed, state, rows = inputs[:consts], inputs[consts : consts + carry], inputs[consts + carry :]
    turns = range(params["length"])
    found = []
    for i in reversed(turns) if params["reverse"] else turns:
        now = [visit(equation, [row], [row[i]])[0] for row in rows]
        out = _run(params["jaxpr"], [*fixed, *state, *now], visit, into)
        state = out[:carry]
        found.append(out[carry:])
    found = found[::-1] if params["reverse"] else found
    if not found:
        shapes = [variable.aval for variable in params["jaxpr"].jaxpr.outvars[carry:]]
        return [*state, *(jnp.zeros((0, *s.shape), s.dtype) for s in shapes)]
    return [*state, *(visit(equation, list(turns), [jnp.stack(turns)])[0] for turns in zip(*found, strict=True))]


def _while(equation, inputs, visit, into):
    """Turn by turn while the condition holds; of a mapped loop, those rows move on for which it does."""
    params = equation.params
    asked, made = params["cond_nconsts"], params["body_nconsts"]
    of_condition, of_body, state = inputs[:asked], inputs[asked : asked + made], inputs[asked + made :]

    def moved(goes, new, old):
        goes = jnp.reshape(goes, goes.shape + (1,) * (jnp.ndim(new) - goes.ndim))
        return visit(equation, [new, old], [jnp.where(goes, new, old)])[0]

    while True:
        (goes,) = _run(params["cond_jaxpr"], [*of_condition, *state], visit, into)
        if not jnp.any(goes):
            return state
        new = _run(params["body_jaxpr"], [*of_body, *state], visit, into)
        state = [moved(goes, *pair) for pair in zip(new, state, strict=True)] if goes.shape else new
