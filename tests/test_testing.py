"""The checks for users find what they are meant to find, and nothing else."""

import inspect
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import normal, uniform

from zestjax.testing import Explanation, assert_finite, assert_grads_match, explain_gradient, held
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


def branched(x):
    """A stop in the branch that is taken: of the square where x is positive."""
    stopped = lambda x: jax.lax.stop_gradient(jnp.sin(x)) * x
    return jnp.sum(jax.lax.cond(x[0] > 0, stopped, jnp.square, x))


def test_a_stop_in_a_branch_is_held_and_so_is_the_branch():
    x = jnp.asarray([0.3, 2.0])
    fixed = held(branched, x)
    np.testing.assert_allclose(fixed(x), branched(x), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(fixed)(x - 1.0), jnp.sum(jnp.sin(x) * (x - 1.0)), rtol=1e-6)
    assert_grads_match(branched, x)
    with pytest.raises(NotImplementedError, match="which branch a `cond` takes is not known"):
        jax.jit(lambda x: held(branched, x)(x))(x)


def test_a_stop_inside_a_loop_says_so():
    step = lambda state: (state[0] + 1, state[1] * jax.lax.stop_gradient(state[1]))
    loop = lambda x: jnp.sum(jax.lax.while_loop(lambda state: state[0] < 3, step, (0, x))[1])
    with pytest.raises(NotImplementedError, match="a stop_gradient inside `while`"):
        held(loop, jnp.ones(2))


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


def test_all_terms_are_one_program():
    traced = []

    def losses(p):
        traced.append(type(p["b"]))
        return {str(i): jnp.sum(p["w"] ** i) * (1 + p["b"][i]) for i in range(4)}

    found = explain_gradient(losses, PARAMS)
    assert len(traced) == 2  # for the names, and for the program
    w, b = (np.asarray(PARAMS[name], np.float64) for name in ("w", "b"))
    slopes = [i * np.linalg.norm(w ** max(i - 1, 0)) * abs(1 + b[i]) for i in range(4)]
    np.testing.assert_allclose(found.norms[:, 1], slopes, rtol=1e-5)
    np.testing.assert_allclose(found.norms[:, 0], [abs(np.sum(w**i)) for i in range(4)], rtol=1e-5)


def test_a_term_is_not_spoilt_by_anothers_infinite_slope():
    """In one program their gradients meet: 0 times infinity, where only one of them is asked."""
    losses = lambda x: {"bad": jnp.sum(jnp.sqrt(x)), "good": jnp.sum(3 * x), "worse": jnp.sum(jnp.log(x))}
    found = explain_gradient(losses, jnp.zeros(4))
    np.testing.assert_array_equal(np.isfinite(found.norms[:, 0]), [False, True, False])
    assert found.norms[1, 0] == 6 and found.origin.term == "bad" and found.origin.stage == "gradient"


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


def last_line(losses, params):
    return str(explain_gradient(losses, params)).splitlines()[-1]


def origin_of(loss, params):
    return explain_gradient(lambda p: {"v": loss(p)}, params).origin


def line_of(fn, text):
    """File and number of the first line of a function that has `text`."""
    lines, first = inspect.getsourcelines(fn)
    return f"test_testing.py:{first + next(i for i, line in enumerate(lines) if text in line)}:"


HOLES = np.array([np.nan, 1, 2], np.float32)
MASK = np.array([False, True, True])


def test_a_constant_that_is_not_a_number_is_named():
    with jax.numpy_rank_promotion("allow"):
        found = explain_gradient(lambda x: {"v": jnp.sum(x * jnp.array([jnp.nan, 1, 1]))}, jnp.ones((4, 3)))
    assert "everything is finite" not in str(found) and not np.isfinite(found.norms).any()
    expected = "not finite first in the value of `v`: a constant float32 (3,) with nan, in broadcast_in_dim (1, 3) at "
    assert expected in str(found)
    here = test_a_constant_that_is_not_a_number_is_named
    assert line_of(here, "jnp.array([jnp.nan") in found.origin.where


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit, jax.checkpoint], ids=["plain", "jit", "checkpoint"])
@pytest.mark.parametrize("value, kind", [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "inf")])
def test_what_a_function_closes_over_is_named(wrap, value, kind):
    constant = np.array([1, value], np.float32)
    origin = origin_of(wrap(lambda x: jnp.sum(x * constant)), jnp.ones(2))
    assert (origin.source, origin.operation) == (f"a constant float32 (2,) with {kind}", "mul")
    assert line_of(test_what_a_function_closes_over_is_named, "jnp.sum(x * constant)") in origin.where
    assert origin_of(lambda x: jnp.sum(x) * value, jnp.ones(2)).source == f"a constant float32 () with {kind}"


@pytest.mark.parametrize("value, kind", [(np.nan, "nan"), (np.inf, "inf")])
def test_a_leaf_of_the_parameters_is_named_by_its_path(value, kind):
    params = {"a": jnp.ones(2), "w": [jnp.array([1, value])]}
    found = last_line(lambda p: {"v": jnp.sum(p["a"] + p["w"][0])}, params)
    assert f"params['w'][0] with {kind}, in add (2,) at " in found and "test_testing.py" in found
    assert f"params with {kind}, in the result" in last_line(lambda x: {"v": x}, jnp.float32(value))


def test_an_infinity_is_named_with_the_operation_that_it_spoils():
    origin = origin_of(lambda x: jnp.sum(x - jnp.max(x)), jnp.full(3, jnp.inf))
    assert (origin.source, origin.operation, origin.shape) == ("params with inf", "sub", (3,))


def test_an_input_that_is_masked_is_harmless():
    assert "everything is finite" in last_line(lambda x: {"v": jnp.sum(jnp.where(MASK, HOLES, 0.0) * x)}, jnp.ones(3))
    assert "everything is finite" in last_line(lambda p: {"v": jnp.sum(p["a"])}, {"a": jnp.ones(1), "b": HOLES})


@pytest.mark.parametrize(
    "loss, at, expected",
    [
        (lambda x: jax.nn.logsumexp(jnp.where(MASK, x, -jnp.inf)) + jnp.log(-x[0]), jnp.ones(3), "log"),
        (lambda x: jax.nn.logsumexp(jnp.where(MASK, jnp.exp(x), -jnp.inf)), jnp.full(3, 1e3), "exp"),
        (lambda x: jnp.sum(jnp.where(MASK, jnp.sqrt(x - HOLES), 0.0)), jnp.array([1, 0.5, 3]), "sqrt"),
        (lambda x: jnp.sum(jnp.where(MASK, jnp.sqrt(x), HOLES)), jnp.array([-1.0, 1, 1]), "select_n"),
        (lambda x: jnp.sum(jnp.where(MASK, HOLES, jnp.sqrt(x))), jnp.array([-1.0, 1, 1]), "sqrt"),
    ],
    ids=["beside a mask of -inf", "under a mask of -inf", "beside holes", "a hole beside", "under holes"],
)
def test_who_is_not_to_blame_is_not_blamed(loss, at, expected):
    """In each of them something else is not finite too, and is masked before it reaches the result."""
    origin = origin_of(loss, at)
    assert (origin.operation, origin.source != "") == (expected, expected == "select_n")


def test_a_constant_that_only_the_gradient_reads():
    @jax.custom_vjp
    def identity(x):
        return x * 1

    identity.defvjp(lambda x: (x, None), lambda _, slope: (slope * HOLES,))
    origin = origin_of(lambda x: jnp.sum(identity(x)), jnp.ones(3))
    assert (origin.stage, origin.source) == ("gradient", "a constant float32 (3,) with nan")


@jax.custom_jvp
def logarithm(x):
    return jnp.log(x - x)


logarithm.defjvps(lambda slope, value, x: slope)


def branch(x):
    return jnp.sum(
        jnp.log(x - x)  # here
    )


def turns(x):
    step = lambda total, row: (total + jnp.log(row - row), row)  # here
    return jax.lax.scan(step, 0.0, x)[0]


def loop(x):
    step = lambda state: (state[0] + 1, jnp.sqrt(state[1] - 1))  # here
    return jnp.sum(jax.lax.while_loop(lambda state: state[0] < 3, step, (0, jax.lax.stop_gradient(x)))[1])


def until(x):
    step = lambda x: x + jnp.log(x)  # here
    return jax.lax.while_loop(lambda x: x < 5, step, jax.lax.stop_gradient(x))


def custom(x):
    return jnp.sum(logarithm(x))


def either(fn):
    return lambda x: jax.lax.cond(x[0] > 0, fn, jnp.sum, x)


@pytest.mark.parametrize(
    "loss, inside",
    [
        (either(branch), branch),
        (either(jax.jit(branch)), branch),
        (jax.checkpoint(either(branch)), branch),
        (either(turns), turns),
        (lambda x: jax.lax.map(either(branch), x[:, None]).sum(), branch),
        (lambda x: jax.vmap(either(branch))(x[:, None]).sum(), branch),
        (loop, loop),
        (either(loop), loop),
        (lambda x: jax.vmap(until)(x - x[0]).sum(), until),
        (either(custom), logarithm),
        (lambda x: jax.lax.switch(x.size, [jnp.sum, branch], x), branch),
    ],
    ids=["cond", "jit in cond", "checkpoint", "scan in cond", "cond in map", "vmap of cond", "while", "while in cond",
         "vmap of while", "custom_jvp in cond", "switch"],
)  # fmt: skip
def test_the_line_inside_a_branch_or_a_loop_is_named(loss, inside):
    origin = origin_of(loss, jnp.ones(3))
    text = "jnp.log" if inside in (branch, logarithm) else "# here"
    source = inside.fun if inside is logarithm else inside
    assert line_of(source, text) in origin.where and origin.operation in ("log", "sqrt")


def test_a_branch_that_is_not_taken_is_not_blamed():
    assert origin_of(either(branch), -jnp.ones(3)) is None


def test_a_constant_inside_a_branch_is_named():
    origin = origin_of(either(lambda x: jnp.sum(x * HOLES)), jnp.ones(3))
    assert (origin.source, origin.operation) == ("a constant float32 (3,) with nan", "mul")


def test_a_row_that_a_scan_takes_from_a_constant_is_named():
    origin = origin_of(lambda x: jax.lax.scan(lambda c, r: (c + r[0] * r[1], ()), 0.0, (x, HOLES))[0], jnp.ones(3))
    assert (origin.source, origin.stage) == ("a constant float32 (3,) with nan", "value")


def test_a_table_that_is_not_finite_never_reads_as_if_it_were():
    """Also where operations are finite one at a time, and only what is compiled together is not."""
    for values, norms in (([np.nan], [[0.0]]), ([0.0], [[np.inf]])):
        found = str(Explanation(("a",), ("all",), np.array(values), np.array(norms), None))
        assert "everything is finite" not in found and "nothing is found where it begins" in found
