"""Adam against the book, and jaxopt's solvers on problems with known answers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.example_libraries import optimizers
from oracles import adam_by_loop, normal

from zestjax import solve
from zestjax.losses.objective import make_objective
from zestjax.train import schedules

X, TRUTH = normal(0, 20, 3), jnp.array([1.0, -2.0, 0.5])
DATA = {"x": X, "y": X @ TRUTH}
START = {"w": jnp.zeros(3), "b": jnp.zeros(())}
MEASURES = dict(rec=lambda out, batch: jnp.mean((out - batch["y"]) ** 2))


def predict(params, batch):
    return batch["x"] @ params["w"] + params["b"]


OBJECTIVE = make_objective(predict, MEASURES, weights=dict(rec=1.0))


def many(data, count):
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), data)


def scanned(solver, params, data, count):
    """`count` updates in one loop."""
    start = (params, solver.init_state(params, data))
    step = lambda carry, _: (tuple(solver.update(*carry, data)), None)
    return jax.lax.scan(step, start, None, length=count)[0]


def adam(**options):
    return solve.Adam(fun=lambda params, data: OBJECTIVE(params, data), has_aux=True, **options)


def test_adam_is_the_published_algorithm():
    solver = solve.Adam(learning_rate=0.1)
    gradients = [3.0, -1.0, 0.5, 1e-3, 2.0]
    params = {"x": jnp.float32(0.7)}
    state = solver.init_state(params)
    for g in gradients:
        params, state = solver.apply(params, state, {"x": jnp.float32(g)}, jnp.float32(0))
    np.testing.assert_allclose(params["x"], adam_by_loop(gradients, 0.7, rate=0.1), rtol=1e-5)


def test_adam_equals_jaxs_own_to_float_precision():
    rate = lambda step: schedules.cosine(step, peak=0.05, floor=1e-4, steps=300, warmup=10)
    ours, state = jax.jit(lambda p: scanned(adam(learning_rate=rate), p, DATA, 300))(START)
    init, update, read = optimizers.adam(rate)
    grad = jax.grad(lambda p: OBJECTIVE(p, DATA)[0])
    step = lambda i, s: update(i, grad(read(s)), s)
    theirs = read(jax.jit(lambda s: jax.lax.fori_loop(0, 300, step, s))(init(START)))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), ours, theirs)
    assert state.iter_num == 300 and state.skipped == 0 and state.aux["rec"] < 0.01


def test_adam_runs_from_an_iterator_and_to_a_tolerance():
    params, state = adam(learning_rate=0.1, maxiter=40).run_iterator(START, iter([DATA] * 41))
    assert state.iter_num == 40 and state.value < 1.0
    params, state = adam(learning_rate=0.1, maxiter=500, tol=0.05).run(START, DATA)
    assert state.error <= 0.05 and state.iter_num < 500


def test_adam_is_the_same_jitted_mapped_and_donated():
    solver = adam(learning_rate=0.1, clip_norm=1.0)
    starts = jax.tree.map(lambda x: jnp.stack([x, x + 1]), START)
    mapped = jax.jit(jax.vmap(lambda p: scanned(solver, p, DATA, 5)[0]))(starts)
    step = jax.jit(lambda p, s, data: solver.update(p, s, data), donate_argnums=(0, 1))
    params = jax.tree.map(lambda x: x + 1, START)
    state = solver.init_state(params, DATA)
    for _ in range(5):
        params, state = step(params, state, DATA)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[1], b, rtol=1e-5), mapped, params)


def test_a_gradient_at_hand_is_the_same_step():
    solver = adam(learning_rate=0.1, clip_norm=0.5)
    (value, terms), grads = jax.value_and_grad(OBJECTIVE, has_aux=True)(START, DATA)
    state = solver.init_state(START, DATA)
    given, taken = solver.apply(START, state, grads, value, aux=terms), solver.update(START, state, DATA)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), given, taken)


def test_clipping_bounds_the_gradient_and_leaves_small_ones_alone():
    step = jax.jit(lambda g, norm: solve.Adam(clip_norm=norm).apply(
        {"x": jnp.zeros(4)}, solve.Adam().init_state({"x": jnp.zeros(4)}), {"x": g}, jnp.float32(0)).state,
        static_argnums=1)  # fmt: skip
    large = step(jnp.full(4, 1e30), 1.0)
    np.testing.assert_allclose(large.error, 2e30, rtol=1e-5)
    np.testing.assert_allclose(large.mean["x"], 0.1 * 0.5, rtol=1e-5)
    np.testing.assert_allclose(step(jnp.full(4, 0.25), 1.0).mean["x"], 0.1 * 0.25, rtol=1e-6)
    assert np.isfinite(step(jnp.zeros(4), 1.0).mean["x"]).all()


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf])
def test_a_step_that_is_not_finite_changes_nothing_but_its_count(bad):
    solver = solve.Adam(learning_rate=0.1, clip_norm=1.0)
    params = {"x": jnp.ones(2)}
    step = jax.jit(solver.apply)
    good = {"x": jnp.ones(2)}
    once = step(params, solver.init_state(params), good, jnp.float32(0))
    for grads, value in [({"x": jnp.array([1.0, bad])}, 0.0), (good, bad)]:
        after = step(*once, grads, jnp.float32(value))
        np.testing.assert_array_equal(after.params["x"], once.params["x"])
        np.testing.assert_array_equal(after.state.square["x"], once.state.square["x"])
        assert after.state.skipped == 1 and after.state.iter_num == 2
    again, twice = step(*after, good, jnp.float32(0)), step(*once, good, jnp.float32(0))
    np.testing.assert_array_equal(again.params["x"], twice.params["x"])


def test_params_of_two_precisions_keep_theirs_and_moments_are_float32():
    params = {"half": jnp.ones(2, jnp.bfloat16), "full": jnp.ones(2)}
    solver = solve.Adam(learning_rate=0.1)
    after = jax.jit(solver.apply)(params, solver.init_state(params), params, jnp.float32(0))
    assert after.params["half"].dtype == jnp.bfloat16 and after.state.mean["half"].dtype == jnp.float32
    np.testing.assert_allclose(np.asarray(after.params["half"], np.float32), 0.9, rtol=1e-2)


def test_adam_without_a_function_says_so():
    with pytest.raises(ValueError, match="Adam: `fun` is None"):
        solve.Adam(jit=False).update(START, solve.Adam().init_state(START), DATA)


WEIGHTS = dict(rec=1.0)


@pytest.mark.parametrize(
    "fit, batch, close",
    [
        (functools.partial(solve.fit_lbfgs, tol=1e-3), DATA, 1e-2),
        (functools.partial(solve.fit_gradient, tol=1e-3), DATA, 1e-2),
        (functools.partial(solve.fit_adam, learning_rate=0.1, tol=0.0), many(DATA, 200), 1e-1),
        (functools.partial(solve.fit_armijo, tol=0.0), many(DATA, 200), 1e-1),
    ],
    ids=["lbfgs", "gradient", "adam", "armijo"],
)
def test_every_solver_recovers_the_regression(fit, batch, close):
    found = jax.jit(lambda batch: fit(OBJECTIVE, START, batch, WEIGHTS))(batch)
    np.testing.assert_allclose(found.params["w"], TRUTH, atol=close)
    assert found.terms["rec"] < close and found.steps > 1
    assert found.converged == (fit.keywords["tol"] > 0)


def test_folds_fit_by_vmap_find_their_own_least_squares():
    folds = {"x": normal(1, 2, 20, 3), "y": normal(2, 2, 20)}
    fit = lambda batch: solve.fit_gradient(OBJECTIVE, START, batch, WEIGHTS, tol=1e-4).params["w"]
    found = jax.jit(jax.vmap(fit))(folds)
    for f in range(2):
        columns = np.concatenate([folds["x"][f], np.ones((20, 1))], axis=1)
        np.testing.assert_allclose(found[f], np.linalg.lstsq(columns, folds["y"][f])[0][:3], atol=2e-3)


@pytest.mark.parametrize("method", ["levenberg_marquardt", "gauss_newton"])
def test_least_squares_recovers_a_curve(method):
    t = jnp.linspace(0, 2, 12)
    residual = lambda p, y: {"all": p["a"] * jnp.exp(-p["k"] * t) - y}
    start = {"a": jnp.float32(1), "k": jnp.float32(0.5)}
    fit = jax.jit(lambda y: solve.fit_least_squares(residual, start, y, method=method, tol=1e-4))
    found = fit(2 * jnp.exp(-1.3 * t))
    np.testing.assert_allclose([found.params["a"], found.params["k"]], [2, 1.3], rtol=1e-3)
    assert found.converged


def test_least_squares_stays_finite_where_the_answer_is_not_unique():
    residual = lambda p: jnp.broadcast_to(p["a"] + p["b"] - 1, (3,))
    found = jax.jit(
        lambda: solve.fit_least_squares(residual, {"a": jnp.float32(0), "b": jnp.float32(0)}, max_steps=5)
    )()
    np.testing.assert_allclose(found.params["a"] + found.params["b"], 1, atol=1e-3)


def test_unknown_solver_options_list_the_known_ones():
    with pytest.raises(ValueError, match="'backtracking', 'zoom', 'hager-zhang'"):
        solve.fit_lbfgs(OBJECTIVE, START, DATA, WEIGHTS, linesearch="wolfe")
    with pytest.raises(ValueError, match="'levenberg_marquardt', 'gauss_newton'"):
        solve.fit_least_squares(lambda p: p["w"], START, method="newton")


@pytest.mark.parametrize("value", [0.0, 1e-25, 1.0])
def test_an_update_can_be_differentiated_also_where_a_parameter_has_no_gradient(value):
    """Of a loss after a step, in a weight of the loss: parameters that nothing pulls at have a second moment of 0."""
    params = {"pulled": jnp.array([1.0, 2.0]), "not pulled": jnp.zeros(3)}

    def after(weight):
        grads = {"pulled": weight * params["pulled"], "not pulled": weight * jnp.full(3, value)}
        solver = solve.Adam(clip_norm=1.0)
        stepped, _ = solver.apply(params, solver.init_state(params), grads, weight)
        return sum(jnp.sum(x**2) for x in jax.tree.leaves(stepped))

    for slope in (jax.jacfwd(after), jax.jacrev(after)):
        assert np.isfinite(slope(jnp.float32(0.5)))


def test_adam_takes_numbers_of_pythons_and_names_what_has_no_gradient():
    solver = solve.Adam(learning_rate=0.1)
    params = {"a": 1.0, "b": jnp.ones(2)}
    state = solver.init_state(params)
    params, state = solver.apply(params, state, {"a": 2.0, "b": jnp.ones(2)}, jnp.float32(1))
    assert params["a"] == pytest.approx(0.9, abs=1e-6) and params["a"].dtype == jnp.float32
    with pytest.raises(TypeError, match=r"leaf `\['n'\]` is int32"):
        solver.init_state({"n": 3})


@pytest.mark.parametrize(
    "grads",
    [{"a": (3,), "b": (2,)}, {"a": (2,), "c": (3,)}, {"a": (2, 1), "b": (3,)}],
    ids=["swapped", "named", "turned"],
)
def test_adam_refuses_a_gradient_of_another_form(grads):
    params = {"a": jnp.ones(2), "b": jnp.ones(3)}
    solver = solve.Adam(learning_rate=0.1)
    with pytest.raises(ValueError, match="adam: a leaf of params|key"):
        solver.apply(params, solver.init_state(params), {k: jnp.ones(s) for k, s in grads.items()}, jnp.float32(1))


def test_what_an_objective_closes_over_may_be_mapped():
    def fitted(place):
        away = lambda p, batch, _: (jnp.sum((p["x"] - place) ** 2) * batch, {})
        return solve.fit_lbfgs(away, {"x": jnp.zeros(3)}, jnp.float32(2), {}).params["x"]

    places = jnp.arange(1.0, 3.0)
    np.testing.assert_allclose(jax.vmap(fitted)(places), jnp.stack([fitted(p) for p in places]), rtol=1e-5)
