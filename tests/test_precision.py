"""Precision: half-precision networks beside float32 geometry are close and finite; float64 is float64 throughout."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import uniform
from stage import MINI, PAPER, STILL

from zestjax import cameras, cost_volume, frustum, planesweep, rays, rendering
from zestjax.apps.weights import at_precision, open_weights
from zestjax.base.precision import geometry_at, network_at
from zestjax.novel_view import _maps, render_inputs
from zestjax.testing.walk import program

at = lambda system, precision: dataclasses.replace(system, precision=precision)


@functools.cache
def rendered(system, precision):
    """The view of the stage's inputs, compiled at a precision."""
    params, (inputs, frames) = stage.params_of(system), stage.inputs_of(system)
    maps, run = None, at(system, precision)
    if params.analysis is not None:
        evidence = jax.tree.map(lambda x: x[frames], stage.prepared(system).evidence)
        maps = _maps(params.analysis, evidence, system=run)
    return render_inputs(params, inputs, maps, system=run, rows=4)


@pytest.mark.parametrize("system", [MINI, STILL, PAPER], ids=["mini", "still", "paper"])
def test_a_view_hardly_depends_on_the_precision(system):
    whole, half = rendered(system, "float32"), rendered(system, "bfloat16")
    with jax.enable_x64(True):
        exact = rendered(system, "float64")
    assert {x.dtype for x in jax.tree.leaves(half)} == {jnp.dtype("float32")}  # what leaves a network is raised
    assert {x.dtype for x in jax.tree.leaves(exact)} == {jnp.dtype("float64")}
    rms = lambda x: np.sqrt(np.mean((np.asarray(x.colour, np.float64) - np.asarray(exact.colour)) ** 2))
    assert rms(whole) < 1e-3 and rms(whole) < rms(half) < 0.05
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(half))


def test_only_networks_are_in_half_precision():
    """Everything before the first and after the last of a network's layers is float32 at least."""
    params, (inputs, _) = stage.params_of(PAPER), stage.inputs_of(PAPER)
    fn = lambda p, i: render_inputs(p, i, None, system=at(PAPER, "bfloat16"), rows=4)
    closed, _, _ = program(fn, params, inputs)
    halves = [name for name in ("sort", "gather", "scatter-add", "cumsum", "cumprod") if contains_half(closed, name)]
    assert contains_half(closed, "conv_general_dilated") and contains_half(closed, "dot_general")
    assert not halves  # samples, look-ups, warps and compositing


def contains_half(closed, name):
    """Whether an operation of that name has a bfloat16 result, anywhere in a program."""
    return any(
        v.aval.dtype == jnp.bfloat16 for e in stage.equations(closed) if e.primitive.name == name for v in e.outvars
    )


K = jnp.asarray([[40.0, 0, 8], [0, 40, 6], [0, 0, 1]])
CAMERA = cameras.Camera(K, jnp.eye(4))
GEOMETRY = {
    "project": lambda x: cameras.project(CAMERA, x).pixels,
    "unproject": lambda x: cameras.unproject(CAMERA, x[:, :2], x[:, 2]),
    "rays": lambda x: rays.rays_from_pixels(CAMERA, x[:, :2]),
    "frustum": lambda x: frustum.frustum_from_world(frustum.Frustum(CAMERA, 1.0, 9.0, 12, 16), x, spacing="inverse"),
    "world": lambda x: frustum.world_from_frustum(frustum.Frustum(CAMERA, 1.0, 9.0, 12, 16), x, spacing="inverse"),
    "homographies": lambda x: planesweep.homographies(CAMERA, jax.tree.map(lambda c: c[None], CAMERA), x[0]),
    "sweep": lambda x: (
        cost_volume.cost_volume(jnp.ones((1, 6, 8, 2)), x[None, None, :3], planesweep.sweep_grid(4, 5)).mean
    ),
    "composite": lambda x: rendering.weights_from_density(x, jnp.ones_like(x)),
}


@pytest.mark.parametrize("name", GEOMETRY)
def test_no_product_of_the_geometry_may_run_in_tf32(name):
    """A GPU multiplies float32 matrices in TF32 unless told otherwise: every product here is told."""
    closed, _, _ = program(GEOMETRY[name], uniform(0, 3, 3, low=1, high=2))
    products = [e.params["precision"] for e in stage.equations(closed) if e.primitive.name == "dot_general"]
    highest = jax.lax.Precision.HIGHEST
    assert all(p == (highest, highest) for p in products), products


def test_float64_is_refused_where_jax_has_it_switched_off():
    with pytest.raises(ValueError, match="jax_enable_x64"):
        network_at("float64", stage.params_of(MINI))
    assert geometry_at("bfloat16", jnp.ones(2, jnp.bfloat16)).dtype == jnp.float32


def test_an_unknown_precision_lists_the_known_ones():
    with pytest.raises(ValueError, match="'float32', 'bfloat16', 'float64'"):
        at(MINI, "float16")
    with pytest.raises(ValueError, match="'float32', 'bfloat16', 'float64'"):
        at_precision(open_weights(), "half")
    assert at_precision(open_weights(), None).system.precision == "float32"
