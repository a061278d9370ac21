"""The checks for users find what they are meant to find, and nothing else."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import normal, uniform

from zestjax.testing import assert_finite, assert_grads_match, explain_gradient, held
from zestjax.testing.walk import program, run


def sound(params, x):
    return {"a": jnp.tanh(x @ params["w"]) + params["b"][None], "b": jnp.sum(x**2)}


PARAMS = {"w": normal(0, 3, 4), "b": normal(1, 4)}


def test_sound_functions_pass():
    assert_finite(sound, PARAMS, uniform(2, 5, 3))
    assert_grads_match(sound, PARAMS, uniform(2, 5, 3))
    assert not jax.config.jax_enable_x64


def test_what_is_not_finite_is_named():
    norm = lambda p: jnp.sqrt(jnp.sum(p["w"] ** 2))
    with pytest.raises(AssertionError, match=r"the gradient of argument 0\['w'\] has 6 of 6 entries"):
        assert_finite(norm, {"w": jnp.zeros((2, 3))})
    with pytest.raises(AssertionError, match="the value has 1 of 2 entries"):
        assert_finite(jnp.log, jnp.array([0.0, 1.0]))


@jax.custom_vjp
def wrong(x):
    return x**2


wrong.defvjp(lambda x: (x**2, x), lambda x, d: (3 * x * d,))


def test_a_wrong_gradient_is_found_wherever_it_hides():
    for fn in (wrong, jax.jit(wrong), lambda x: jax.lax.map(wrong, x), jax.checkpoint(wrong)):
        with pytest.raises(AssertionError, match="is not the slope of central differences"):
            assert_grads_match(fn, uniform(0, 4, low=0.5))


def stopped(x):
    return jnp.sum(jax.lax.stop_gradient(jnp.sin(x)) * x)


def in_a_scan(x):
    return jax.lax.scan(lambda total, row: (total + stopped(row), row * 2), 0.0 * x[0, 0], x, reverse=True)


@pytest.mark.parametrize(
    "fn",
    [
        stopped,
        jax.jit(stopped),
        jax.checkpoint(stopped),
        in_a_scan,
        lambda x: jax.lax.map(stopped, x),
        jax.vmap(stopped),
    ],
    ids=["plain", "jit", "checkpoint", "scan", "map", "vmap"],
)
def test_what_stops_gradients_is_held(fn):
    x = uniform(3, 2, 5, low=0.2)
    assert_grads_match(fn, x)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), held(fn, x)(x), fn(x))


def test_a_stop_inside_a_condition_says_so():
    fn = lambda x: jax.lax.cond(x[0] > 0, stopped, jnp.sum, x)
    with pytest.raises(NotImplementedError, match="a stop_gradient inside `cond`"):
        assert_grads_match(fn, uniform(0, 3))


def test_walking_a_program_gives_its_result():
    fn = lambda x: jax.lax.scan(lambda c, row: (jnp.tanh(c + row), (c, row**2)), jnp.zeros(3), x)
    x = normal(4, 6, 3)
    closed, leaves, tree = program(fn, x)
    walked = jax.tree.unflatten(tree, run(closed, leaves, lambda equation, inputs, outputs: outputs))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), walked, fn(x))
    none = program(lambda x: jax.lax.scan(lambda c, row: (c, row), 1.0, x), x[:0])
    assert [jnp.shape(out) for out in run(none[0], none[1], lambda equation, inputs, outputs: outputs)] == [(), (0, 3)]


class Losses(NamedTuple):
    data: object
    prior: object
    absent: object = None


def test_norms_by_term_and_group_are_those_of_the_gradient():
    losses = lambda p: Losses(jnp.sum(p["w"] ** 2), jnp.sum(3 * p["b"]))
    found = explain_gradient(losses, PARAMS)
    assert found.terms == ("data", "prior") and found.groups == ("['b']", "['w']") and found.origin is None
    expected = [[0, 2 * np.linalg.norm(PARAMS["w"])], [6, 0]]
    np.testing.assert_allclose(found.norms, expected, rtol=1e-6)
    np.testing.assert_allclose(found.values, [np.sum(np.square(PARAMS["w"])), 3 * np.sum(PARAMS["b"])], rtol=1e-5)
    assert "everything is finite" in str(found) and "prior" in str(found)


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit, jax.checkpoint], ids=["plain", "jit", "checkpoint"])
def test_the_first_operation_that_is_not_finite_is_named_with_its_line(wrap):
    def bad(p):
        inner = wrap(lambda x: jnp.log(x - x))
        return {"good": jnp.sum(p), "bad": jnp.sum(jnp.exp(inner(p)))}

    origin = explain_gradient(bad, jnp.ones(3)).origin
    assert (origin.term, origin.operation, origin.stage, origin.shape) == ("bad", "log", "value", (3,))
    assert "test_testing.py" in origin.where


def test_a_gradient_that_is_not_finite_though_the_value_is():
    found = explain_gradient(lambda p: {"norm": jnp.sqrt(jnp.sum(p**2))}, jnp.zeros(3))
    assert found.origin.stage == "gradient" and "not finite first in the gradient of `norm`" in str(found)


def test_losses_must_be_scalars_by_name():
    with pytest.raises(ValueError, match=r"should give scalars by name, got \{'a': \(3,\)\}"):
        explain_gradient(lambda p: {"a": p}, jnp.ones(3))


def test_an_operation_inside_a_librarys_compiled_function_has_its_callers_place():
    flow = jnp.zeros((4, 3))
    jnp.linalg.norm(flow, axis=-1)  # now JAX has its program, and no longer says who asked for it
    found = explain_gradient(lambda f: {"length": jnp.mean(jnp.linalg.norm(f, axis=-1))}, flow)
    assert found.groups == ("all",) and "test_testing.py" in found.origin.where
