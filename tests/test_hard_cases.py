"""Every named hard case is finite, right against float64, and the same however it is run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hard_cases import CASES

from zestjax.testing.walk import program, run

NAMED = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


def scalar(case):
    """A sum of the values with unequal weights, so that errors do not cancel in its gradient."""

    def total(*args):
        out = case.fn(*args)
        mix = jnp.asarray(1 + np.arange(out.size, dtype=np.float64).reshape(out.shape) / 7 % 1, out.dtype)
        return jnp.sum(mix * out)

    return total


def value_and_gradients(case, args, *, run=jax.jit):
    both = lambda *args: (case.fn(*args), jax.grad(scalar(case), argnums=tuple(range(len(args))))(*args))
    return jax.tree.map(np.asarray, run(both)(*args))


def close(case, ours, theirs, what):
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        scale = max(case.unit, float(np.max(np.abs(b), initial=0)))
        np.testing.assert_allclose(
            a, b, rtol=case.tolerance, atol=case.tolerance * scale, err_msg=f"{case.name}: {what}"
        )


@NAMED
def test_value_and_gradient_are_finite_and_those_of_float64(case):
    ours = value_and_gradients(case, tuple(map(jnp.asarray, case.args)))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(ours)), f"{case.name}: {ours}"
    with jax.enable_x64(True):
        exact = value_and_gradients(case, tuple(jnp.asarray(x, jnp.float64) for x in case.args))
    close(case, ours, exact, "float64")
    assert np.shape(case.expected) == ours[0].shape
    close(case, ours[0], np.asarray(case.expected), "what must hold")


@NAMED
def test_eager_compiled_and_mapped_agree(case):
    args = tuple(map(jnp.asarray, case.args))
    compiled = value_and_gradients(case, args)
    close(case, value_and_gradients(case, args, run=lambda f: f), compiled, "eager")
    twice = value_and_gradients(case, tuple(jnp.stack([x, x]) for x in args), run=lambda f: jax.jit(jax.vmap(f)))
    for row in (0, 1):
        close(case, jax.tree.map(lambda x, row=row: x[row], twice), compiled, "vmap and grad of vmap")


@NAMED
def test_nothing_on_the_way_is_not_a_number(case):
    """So that a user may search for the cause of a NaN of their own with `jax_debug_nans`."""
    args, found = tuple(map(jnp.asarray, case.args)), []
    for fn in (case.fn, jax.grad(scalar(case), argnums=tuple(range(len(args))))):

        def visit(equation, inputs, outputs):
            if not any(map(has_nan, inputs)) and any(map(has_nan, outputs)):
                found.append(equation)
            return outputs

        closed, leaves, _ = program(fn, *args)
        run(closed, leaves, visit)
    assert not found, f"{case.name}: {found[0]}"


def has_nan(x):
    return jnp.issubdtype(x.dtype, jnp.floating) and bool(jnp.isnan(x).any())


@NAMED
def test_half_precision_is_finite(case):
    args = tuple(jnp.asarray(x, jnp.bfloat16) for x in case.args)
    value, grads = value_and_gradients(case, args)
    assert all(np.isfinite(np.asarray(x, np.float32)).all() for x in jax.tree.leaves((value, grads))), case.name


def test_names_are_unique_and_causes_told():
    assert len({case.name for case in CASES}) == len(CASES) and all(case.cause for case in CASES)
