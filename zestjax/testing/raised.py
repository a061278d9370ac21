"""A function's program in float64: every float in it is raised, also what it closes over and what it casts to.

The function is traced as it is called, in the precision that its user computes in; its program is then run in float64.
So a loss that casts to float32 inside, or meets a float32 batch, needs no second form to be checked.

wide     the float64 or complex128 of a narrower type; integers, bools and PRNG keys are their own
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from zestjax.base.types import Tree
from zestjax.testing.walk import INLINED, bind, inner_programs, place_of, program

FOREIGN = ("pure_callback", "io_callback", "ffi_call", "pallas_call")  # written for one type by another hand
OF_BITS = "bitcast_convert_type"  # how random numbers are made: stays as wide as it is


def raised(fn: Callable, *args: Tree) -> Callable:
    """The function in float64, whatever it is made of; call it with `wide` arguments where 64 bits are switched on.

    Args:
      fn: function over pytrees. Its own derivatives (`custom_vjp`) are lost: raise its gradient, traced, instead.
      *args: give shapes and types.

    Returns:
      A function of the same arguments.

    Raises:
      NotImplementedError: when called, of a callback or a kernel that cannot be raised, with its line.
    """
    closed, _, tree = program(fn, *args)

    def again(*args):
        pairs = zip(jax.tree.leaves(args), closed.in_avals, strict=True)
        return jax.tree.unflatten(tree, _run(closed, [_like(x, _wide_type(aval.dtype)) for x, aval in pairs]))

    return again


def wide(tree: Tree) -> Tree:
    """The tree's floating-point arrays in float64; all else as it is."""
    return jax.tree.map(lambda x: jnp.asarray(x, _wide_type(_type(x))) if is_float(x) else x, tree)


def is_float(x: Any) -> bool:
    """Whether a leaf is an array of real floating-point numbers."""
    return jnp.issubdtype(_type(x), jnp.floating)


def _type(x):
    return x.dtype if hasattr(x, "dtype") else np.result_type(x)


def _wide_type(dtype):
    if jnp.issubdtype(dtype, jnp.complexfloating):
        return np.dtype(np.complex128)
    return np.dtype(np.float64) if jnp.issubdtype(dtype, jnp.floating) else dtype


def _wide_shape(variable: Any):
    return jax.ShapeDtypeStruct(variable.aval.shape, _wide_type(variable.aval.dtype))


def _like(x, dtype):
    """An array in another type; keys have no other."""
    return x if jnp.issubdtype(dtype, jax.dtypes.extended) else jax.lax.convert_element_type(x, dtype)


def _run(closed, leaves):
    jaxpr, consts = (closed.jaxpr, closed.consts) if isinstance(closed, ClosedJaxpr) else (closed, ())
    consts = [_like(x, _wide_type(v.aval.dtype)) for x, v in zip(consts, jaxpr.constvars, strict=True)]
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *leaves], strict=True))
    read = lambda v: jnp.asarray(v.val, _wide_shape(v).dtype) if isinstance(v, Literal) else known[v]
    for equation in jaxpr.eqns:
        outputs = _outputs(equation, [read(v) for v in equation.invars])
        known.update(zip(equation.outvars, outputs, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _outputs(equation, inputs):
    name = equation.primitive.name
    if name in FOREIGN:
        raise NotImplementedError(
            f"raised: `{name}` at {place_of(equation)} cannot be raised to float64; compute what it gives beforehand "
            "and pass that as `constant`."
        )
    if name in INLINED and (inner := inner_programs(equation)):
        return _run(inner[0], inputs)
    if name == "reduce_precision":
        return inputs
    if name == OF_BITS:
        narrow = [_like(x, v.aval.dtype) for x, v in zip(inputs, equation.invars, strict=True)]
        return [_like(x, _wide_type(x.dtype)) for x in bind(equation, narrow)]
    params = {key: False if key == "weak_type" else _wide_choice(value) for key, value in equation.params.items()}
    return bind(equation.replace(params=params), inputs)


def _wide_choice(value):
    """A choice of an operation: the type of its result, a program inside, or several of them."""
    if isinstance(value, ClosedJaxpr | Jaxpr):
        variables = (value.jaxpr if isinstance(value, ClosedJaxpr) else value).invars
        closed = jax.make_jaxpr(lambda *leaves: _run(value, leaves))(*map(_wide_shape, variables))
        return closed if isinstance(value, ClosedJaxpr) else closed.jaxpr
    if isinstance(value, tuple):
        items = map(_wide_choice, value)
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    return _wide_type(value) if isinstance(value, np.dtype) else value
