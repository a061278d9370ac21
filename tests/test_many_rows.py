"""Every function of the fuzzing table at more than 32,768 rows, compiled, beside float64: the net for sums that a
compiler gets wrong only of many rows (`zestjax.base.backend`), which no test of usual sizes shows.

many    the function's own rows are many: its rays, points or pixels
mapped  few rows, and the function mapped by `jax.vmap` over many sets of them
"""

import functools
import importlib.metadata
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import normal
from test_fuzz import FUNCTIONS, shape_of

import zestjax
from zestjax.base.backend import FLAG

FUSION = FLAG.lstrip("-")
ROWS = 40_000
FEW = dict(R=2, S=3, P=3, H=2, W=3, h=2, w=2, C=2, D=2, V=2, B=1, O=2)
GROWS = ({"R": ROWS}, {"P": ROWS}, {"h": 200, "w": 200}, {"H": 200, "W": 200}, {"D": ROWS})  # the first that has one
WITHIN = {  # the documented range of a kind, away from its corners
    "real": (-2, 2), "divisor": (0.5, 2), "unit": (0.05, 0.95), "density": (0.1, 3), "length": (0.1, 1),
    "depth": (0.5, 5), "logit": (-3, 3), "pixel": (0.1, 1.9), "share": (0.05, 0.95), "vector": (-2, 2),
}  # fmt: skip
# An oracle may not have the fault that it is to show: float64 too is wrong where the fusion is on.
EXACT = {"xla_backend_optimization_level": 0} | ({FUSION: ""} if zestjax.BACKEND.state != "unknown" else {})
# One for all sets of rows, and no gradient: XLA's convolution by N kernels at once takes memory that grows with N^2.
SHARED = {"conv2d": "kernel"}
TOLERANCE = 1e-5


def sizes_of(name, form):
    axes = {axis for axes, _ in FUNCTIONS[name][1].values() for axis in axes.split()}
    grown = next(grows for grows in GROWS if set(grows) <= axes)
    return FEW | grown if form == "many" else FEW


def drawn(rng, argument, kind, shape):
    if kind == "mask":
        return np.maximum(rng.integers(0, 2, shape), np.arange(shape[-1]) < 2)
    if argument.startswith("homograph"):
        return np.eye(3) + rng.uniform(-0.1, 0.1, shape)
    if kind == "point":
        return rng.uniform(-0.5, 0.5, shape) + [0, 0, 2]
    if argument == "flow":  # no point comes next to the camera, where rounding is divided by the square of its depth
        return rng.uniform(-0.5, 0.5, shape)
    low, high = WITHIN[kind]
    if argument == "values" and kind == "unit":  # apart from each other, as what a line is fitted to must be
        return low + (high - low) * (np.arange(shape[-1]) + rng.uniform(0, 0.5, shape)) / shape[-1]
    return rng.uniform(low, high, shape)


def arguments(name, form):
    rng, sizes, spec = np.random.default_rng(zlib.crc32(name.encode())), sizes_of(name, form), FUNCTIONS[name][1]
    sets = lambda argument: (ROWS,) if form == "mapped" and argument != SHARED.get(name) else ()
    draw = lambda argument, axes, kind: drawn(rng, argument, kind, sets(argument) + shape_of(axes, sizes))
    return [draw(argument, axes, kind).astype(np.float32) for argument, (axes, kind) in spec.items()]


def program(name, form):
    """(function of many rows, places of the arguments that it is differentiated by)."""
    fn, spec = FUNCTIONS[name]
    own = [form == "many" or argument != SHARED.get(name) for argument in spec]
    fn = fn if form == "many" else jax.vmap(fn, [0 if mine else None for mine in own])
    return fn, tuple(np.flatnonzero(own))


def slopes(fn, places):
    """(gradients of a sum of a function's values with unequal weights, the values)."""

    def total(*args):
        values = fn(*args)
        leaves = [x for x in jax.tree.leaves(values) if jnp.issubdtype(x.dtype, jnp.floating)]
        weights = [jnp.asarray(1 + np.arange(x.size) / 7 % 1, x.dtype).reshape(x.shape) for x in leaves]
        return functools.reduce(jnp.add, (jnp.sum(w * x) for w, x in zip(weights, leaves, strict=True))), values

    return jax.grad(total, argnums=places, has_aux=True)


def largest_error(fn, places, args, options=None):
    """Of any value or gradient, relative to the largest of its array. options: of the compiler.

    Values and gradients are two programs: where both are asked for, a sum is not fused as it is where one is.
    """
    both = slopes(fn, places)
    programs = (lambda *args: both(*args)[0], fn)
    found = [jax.jit(p, compiler_options=options)(*map(jnp.asarray, args)) for p in programs]
    with jax.enable_x64(True):
        exact = jax.jit(both, compiler_options=EXACT)(*(jnp.asarray(x, jnp.float64) for x in args))
    error = lambda a, b: np.abs(a - b).max(initial=0) / (np.abs(b).max(initial=0) or 1)
    numbers = lambda tree: [np.asarray(x, np.float64) for x in jax.tree.leaves(tree)]
    return max(error(*pair) for pair in zip(numbers(found), numbers(exact), strict=True))


@pytest.mark.parametrize("form", ["many", "mapped"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_gradients_of_many_rows_are_those_of_float64(name, form):
    assert largest_error(*program(name, form), arguments(name, form)) < TOLERANCE


def test_the_net_holds_what_it_is_for():
    """The sum that jaxlib 0.10.2 gets wrong is right as zestjax sets the compiler; with the fusion on, it is seen."""
    fn, args = jax.vmap(lambda m, p: jnp.sum((m @ p) ** 2), (None, 0)), (normal(0, 3, 3), normal(1, ROWS, 3))
    assert largest_error(fn, (0, 1), args) < TOLERANCE
    if importlib.metadata.version("jaxlib") == "0.10.2":
        assert largest_error(fn, (0, 1), args, {FUSION: "LIBRARY_FUSION_TYPE_DOT"}) > 0.1
