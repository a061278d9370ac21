"""Solvers: Adam with jaxopt's stochastic-solver interface, and jaxopt's own on the same objective.

The one module that imports jaxopt, which is no longer developed: the way out stays short.

    objective   `objective(params, batch, weights) -> (total, terms)`, from `losses.objective.make_objective`
    params      tree of float arrays
    batch       tree, passed through
    weights     by term; Python numbers stay static, so that a weight of 0 keeps its term out of the program

jaxopt's solvers are given one flat vector, and, outside of `jit` and `vmap`, a compiled gradient that their own loop
calls: they ask for it at many places, and a compiled loop would hold, and compile, one copy of the model for each.
"""

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from zestjax.adam import AdamState, adam, init_adam
from zestjax.base.checks import check_option, traced
from zestjax.base.trees import tree_norm
from zestjax.base.types import Array, Tree

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", "JAXopt is no longer", DeprecationWarning)
    import jaxopt
    from jaxopt.base import OptStep, StochasticSolver


class Fit(NamedTuple):
    """params: like the initial ones. total, terms, grad_norm (() L2): at them, or at the last batch before the last
    step. steps: () int. converged: () bool, that the solver's own stopping measure came down to tol."""

    params: Tree
    total: jax.Array
    terms: Tree
    grad_norm: jax.Array
    steps: jax.Array
    converged: jax.Array


@dataclasses.dataclass(eq=False)
class Adam(StochasticSolver):
    """Adam (Kingma and Ba 2015, algorithm 1) as a jaxopt stochastic solver.

    Source: ZeST-NeRF section 4.1 (5e-4, the published rate).

    Attributes:
      fun: `fun(params, *args, **kwargs) -> value`, or `(value, aux)` with `has_aux`; None if only `apply` is used.
      learning_rate: float, or a function of the step (from 0) such as a `schedules.cosine`.
      b1, b2, eps: decay of the two moments, and what is added to the root of the second.
      clip_norm: gradients with a larger L2 norm are scaled down to it; None never.
      skip_nonfinite: leave params and moments as they are when the value or the gradient is not finite, and count it.
      maxiter, tol: `run` stops after so many updates or at this gradient norm.
      value_and_grad: `fun` returns the gradient too.
      verbose, jit, unroll, implicit_diff, implicit_diff_solve: jaxopt's.

    A new solver is a new program: make one and keep it. jaxopt's `run_iterator` uses its first batch only to
    initialise. `update` does not donate its inputs: inside your own jit, with `donate_argnums`, it may.
    """

    fun: Callable | None = None
    learning_rate: float | Callable = 5e-4
    b1: float = 0.9
    b2: float = 0.999
    eps: float = 1e-8
    clip_norm: float | None = None
    skip_nonfinite: bool = True
    has_aux: bool = False
    value_and_grad: bool = False
    maxiter: int = 500
    tol: float = 0.0
    verbose: bool = False
    jit: bool = True
    unroll: int | str = "auto"
    implicit_diff: bool = False
    implicit_diff_solve: Callable | None = None

    def __post_init__(self):
        super().__post_init__()
        self.reference_signature = self.fun

    def _value_and_grad(self, params, *args, **kwargs):
        """((value, aux), gradient)."""
        if self.fun is None:
            raise ValueError("Adam: `fun` is None; give a function to minimise, or call `apply` with gradients.")
        if self.value_and_grad:
            value, grads = self.fun(params, *args, **kwargs)
            return (value if self.has_aux else (value, None)), grads
        pair = self.fun if self.has_aux else lambda *a, **k: (self.fun(*a, **k), None)  # type: ignore[misc]
        return jax.value_and_grad(pair, has_aux=True)(params, *args, **kwargs)

    def init_state(self, init_params: Tree, *args: Any, **kwargs: Any) -> AdamState:
        """The state before the first update; `aux` is zeros of its shape if `fun`'s arguments are given, else None."""
        if self.fun is None or not (args or kwargs):
            return init_adam(init_params)
        (value, shapes), _ = jax.eval_shape(self._value_and_grad, init_params, *args, **kwargs)
        aux = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        return init_adam(init_params, value_dtype=value.dtype, aux=aux)

    def update(self, params: Tree, state: AdamState, *args: Any, **kwargs: Any) -> OptStep:
        """One step on `fun(params, *args, **kwargs)`; returns jaxopt's `OptStep(params, state)`."""
        (value, aux), grads = self._value_and_grad(params, *args, **kwargs)
        return self.apply(params, state, grads, value, aux=aux)

    def apply(self, params: Tree, state: AdamState, grads: Tree, value: Array, *, aux: Tree = None) -> OptStep:
        """One step with a gradient already at hand.

        Args:
          params: tree of float arrays.
          state: `AdamState`, from `init_state` or the last step.
          grads: tree like `params`.
          value: () objective at `params`, for the state and for the finiteness test.
          aux: kept in the state.

        Returns:
          `OptStep(params, state)`.
        """
        params, state = adam(
            params,
            state,
            grads,
            value,
            rate=self.learning_rate(state.iter_num) if callable(self.learning_rate) else self.learning_rate,
            b1=self.b1,
            b2=self.b2,
            eps=self.eps,
            clip_norm=self.clip_norm,
            skip=self.skip_nonfinite,
            aux=aux,
        )
        return OptStep(params=params, state=state)

    def optimality_fun(self, params: Tree, *args: Any, **kwargs: Any) -> Tree:
        """The gradient, which is 0 at a solution: what jaxopt differentiates implicitly."""
        return self._value_and_grad(params, *args, **kwargs)[1]


def fit_lbfgs(
    objective: Callable,
    params: Tree,
    batch: Tree,
    weights: Mapping[str, Any],
    *,
    max_steps: int = 100,
    tol: float = 1e-4,
    history: int = 10,
    linesearch: str = "backtracking",
) -> Fit:
    """Minimise `objective` over `params` with L-BFGS: the last mile, on a batch that does not change.

    May be `vmap`ped over batches or arrays of weights. Not differentiable in reverse.

    Args:
      objective: see the header.
      params: of one dtype.
      batch: passed through.
      weights: see the header.
      max_steps: stop after this many.
      tol: stop at this L2 gradient norm.
      history: gradients kept; memory is 2 * history times the params.
      linesearch: "backtracking", "zoom" or "hager-zhang".

    Returns:
      `Fit`. Running out of steps is reported in `converged`, not raised: a raise cannot cross `vmap`.

    Raises:
      ValueError: if `linesearch` is unknown.
    """
    check_option("fit_lbfgs", linesearch=(linesearch, ("backtracking", "zoom", "hager-zhang")))
    options = dict(maxiter=max_steps, tol=tol, history_size=history, linesearch=linesearch)
    return _run(jaxopt.LBFGS, options, objective, params, batch, weights)


def fit_gradient(
    objective: Callable,
    params: Tree,
    batch: Tree,
    weights: Mapping[str, Any],
    *,
    max_steps: int = 500,
    tol: float = 1e-4,
    stepsize: float = 0.0,
    acceleration: bool = True,
) -> Fit:
    """Minimise `objective` over `params` by gradient descent with a line search.

    Args:
      objective: see the header.
      params: of one dtype.
      batch: passed through.
      weights: see the header.
      max_steps: stop after this many.
      tol: stop at this L2 gradient norm.
      stepsize: 0 searches for it each step.
      acceleration: Nesterov's.

    Returns:
      `Fit`; not differentiable in reverse.
    """
    options = dict(maxiter=max_steps, tol=tol, stepsize=stepsize, acceleration=acceleration)
    return _run(jaxopt.GradientDescent, options, objective, params, batch, weights)


def fit_adam(
    objective: Callable,
    params: Tree,
    batches: Tree,
    weights: Mapping[str, Any],
    *,
    learning_rate: float | Callable = 5e-4,
    clip_norm: float | None = 1.0,
    tol: float = 0.0,
) -> Fit:
    """One pass of `Adam` over `batches`, in one compiled loop.

    Args:
      objective: see the header.
      params: see the header.
      batches: tree whose leaves have a leading axis, one entry a step.
      weights: see the header.
      learning_rate: see `Adam`.
      clip_norm: see `Adam`.
      tol: gradient norm that counts as converged; the pass does not stop there.

    Returns:
      `Fit`.
    """
    solver = Adam(
        fun=lambda p, data: objective(p, data, weights), has_aux=True, learning_rate=learning_rate, clip_norm=clip_norm
    )
    return _pass(solver, params, batches, tol)


def fit_armijo(
    objective: Callable,
    params: Tree,
    batches: Tree,
    weights: Mapping[str, Any],
    *,
    max_stepsize: float = 1.0,
    tol: float = 0.0,
) -> Fit:
    """One pass of jaxopt's `ArmijoSGD` over `batches`: no learning rate to choose, 2-4 evaluations a step.

    Args:
      objective: see the header.
      params: of one dtype.
      batches: tree whose leaves have a leading axis, one entry a step.
      weights: see the header.
      max_stepsize: where the line search starts.
      tol: gradient norm that counts as converged; the pass does not stop there.

    Returns:
      `Fit`.
    """
    solver = jaxopt.ArmijoSGD(
        fun=lambda p, data: objective(p, data, weights), has_aux=True, max_stepsize=max_stepsize, implicit_diff=False
    )
    return _pass(solver, params, batches, tol)


def fit_least_squares(
    residual: Callable,
    params: Tree,
    *args: Tree,
    method: str = "levenberg_marquardt",
    max_steps: int = 50,
    tol: float = 1e-6,
) -> Fit:
    """Minimise the sum of squares of `residual(params, *args)`: poses, alignments, few parameters.

    Args:
      residual: `residual(params, *args) -> ` tree of arrays, flattened and joined.
      params: tree of float arrays of one dtype.
      *args: passed through.
      method: "levenberg_marquardt" (solved by QR: finite when the Jacobian is rank deficient) or "gauss_newton".
      max_steps: stop after this many.
      tol: stop at this L2 gradient norm.

    Returns:
      `Fit`; `terms` is the residual at the end, `total` the sum of its squares.

    Raises:
      ValueError: if `method` is unknown.
    """
    check_option("fit_least_squares", method=(method, ("levenberg_marquardt", "gauss_newton")))
    flat, unravel = ravel_pytree(params)
    options: dict[str, Any] = dict(
        residual_fun=lambda x: ravel_pytree(residual(unravel(x), *args))[0],
        maxiter=max_steps,
        tol=tol,
        implicit_diff=False,
        unroll=False,
    )
    with jax.numpy_dtype_promotion("standard"):  # inside, jaxopt multiplies numbers by booleans
        if method == "levenberg_marquardt":
            solver = jaxopt.LevenbergMarquardt(solver="qr", materialize_jac=True, **options)
        else:
            solver = jaxopt.GaussNewton(**options)
        flat, state = solver.run(flat)
    at_end, pullback = jax.vjp(options["residual_fun"], flat)
    return Fit(
        unravel(flat), jnp.sum(at_end**2), at_end, tree_norm(pullback(at_end)[0]), state.iter_num, state.error <= tol
    )


def _run(kind, options, objective, params, batch, weights):
    """A jaxopt solver of a kind run on one batch, as a `Fit`."""
    flat, unravel = ravel_pytree(params)
    gradient = jax.value_and_grad(lambda x, data: objective(unravel(x), data, weights), has_aux=True)
    shared = dict(value_and_grad=True, implicit_diff=False, **options)
    plain = lambda x, data: (lambda out: (out[0][0], out[1]))(gradient(x, data))  # jaxopt mixes up terms of its own
    closed_over = jax.make_jaxpr(gradient)(flat, batch).consts
    if traced((params, batch, weights, closed_over)):
        flat, state = kind(fun=plain, jit=True, unroll=False, **shared).run(flat, batch)
    else:
        gradient = _uninterrupted(jax.jit(gradient).lower(flat, batch).compile())
        with jax.disable_jit():  # of the loops and branches that jaxopt puts around it
            flat, state = kind(fun=plain, jit=False, unroll=True, **shared).run(flat, batch)
    (total, terms), grads = gradient(flat, batch)
    return Fit(unravel(flat), total, terms, tree_norm(grads), state.iter_num, state.error <= options["tol"])


def _uninterrupted(compiled):
    """A compiled function, also where `jit` is disabled."""

    def call(*args):
        with jax.disable_jit(False):
            return compiled(*args)

    return call


def _pass(solver, params, batches, tol):
    """A stochastic solver scanned over batches, as a `Fit`."""
    first = jax.tree.map(lambda x: x[0], batches)
    start = (params, solver.init_state(params, first))
    (params, state), _ = jax.lax.scan(lambda carry, data: (tuple(solver.update(*carry, data)), None), start, batches)
    return Fit(params, state.value, state.aux, state.error, state.iter_num, state.error <= tol)
