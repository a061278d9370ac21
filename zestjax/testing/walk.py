"""A function's program, run one primitive at a time, so that what happens inside can be looked at or held.

primitive  an operation that JAX does not take apart further
visit      `visit(equation, inputs, outputs) -> outputs`, called for every primitive in the order of the program
"""

import jax
import jax.numpy as jnp
from jax._src import source_info_util
from jax.extend.core import ClosedJaxpr, Literal

INNER = ("jaxpr", "call_jaxpr", "fun_jaxpr")
INLINED = ("jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2", "custom_jvp_call",
           "custom_vjp_call", "custom_vjp_call_jaxpr")  # fmt: skip


def program(fn, *args):
    """(`ClosedJaxpr`, leaves of the arguments, tree of the result) of a function of pytrees."""
    leaves, tree = jax.tree.flatten(jax.tree.map(jnp.asarray, args))
    flat = lambda *leaves: fn(*jax.tree.unflatten(tree, leaves))
    jaxpr, shape = jax.make_jaxpr(flat, return_shape=True)(*leaves)
    return jaxpr, leaves, jax.tree.structure(shape)


def run(closed, leaves, visit):
    """Outputs of a program; what is compiled, rematerialised or scanned inside is walked through too."""
    return _run(closed.jaxpr, closed.consts, leaves, visit)


def contains(closed, name):
    """Whether a primitive of this name is anywhere in a program."""
    return any(e.primitive.name == name or any(contains(j, name) for j in _inner(e)) for e in _jaxpr(closed).eqns)


def _jaxpr(program):
    return program.jaxpr if isinstance(program, ClosedJaxpr) else program


def _inner(equation):
    values = [equation.params[name] for name in INNER if name in equation.params]
    return values + list(equation.params.get("branches", ())) + [
        equation.params[name] for name in ("cond_jaxpr", "body_jaxpr") if name in equation.params
    ]  # fmt: skip


def _run(jaxpr, consts, leaves, visit):
    known = dict(zip(jaxpr.constvars, consts, strict=True)) | dict(zip(jaxpr.invars, leaves, strict=True))
    read = lambda variable: variable.val if isinstance(variable, Literal) else known[variable]
    for equation in jaxpr.eqns:
        inputs = [read(variable) for variable in equation.invars]
        known.update(zip(equation.outvars, _outputs(equation, inputs, visit), strict=True))
    return [read(variable) for variable in jaxpr.outvars]


def _outputs(equation, inputs, visit):
    name, inner = equation.primitive.name, _inner(equation)
    if name in INLINED and inner:
        consts = inner[0].consts if isinstance(inner[0], ClosedJaxpr) else ()
        within = lambda inside, inputs, outputs: visit(_placed(inside, equation), inputs, outputs)
        return _run(_jaxpr(inner[0]), consts, inputs, within)
    if name == "scan":
        return _scan(equation.params, inputs, visit)
    outputs = equation.primitive.bind(*inputs, **equation.params)
    outputs = list(outputs) if equation.primitive.multiple_results else [outputs]
    return visit(equation, inputs, outputs)


def place_of(equation):
    """File, line and function that asked for an operation; empty where JAX has not kept them."""
    return source_info_util.summarize(equation.source_info)


def _placed(equation, caller):
    """An operation of a function that was compiled before has no place of its own: it has its caller's."""
    return equation if place_of(equation) else equation.replace(source_info=caller.source_info)


def _scan(params, inputs, visit):
    """One turn after the other; the outputs of the turns are stacked again."""
    consts, carry = params["num_consts"], params["num_carry"]
    fixed, state, rows = inputs[:consts], inputs[consts : consts + carry], inputs[consts + carry :]
    turns = range(params["length"])
    found = []
    for i in reversed(turns) if params["reverse"] else turns:
        out = run(params["jaxpr"], [*fixed, *state, *(row[i] for row in rows)], visit)
        state = out[:carry]
        found.append(out[carry:])
    found = found[::-1] if params["reverse"] else found
    if not found:
        shapes = [variable.aval for variable in params["jaxpr"].jaxpr.outvars[carry:]]
        return [*state, *(jnp.zeros((0, *s.shape), s.dtype) for s in shapes)]
    return [*state, *(jnp.stack(column) for column in zip(*found, strict=True))]
