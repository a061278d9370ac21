"""A training step of every hard scene is finite, right against float64, and spoils no neighbour in a batch."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from hard_scenes import SCENES
from stage import MINI, PAPER

from zestjax.losses.objective import PAPER_WEIGHTS
from zestjax.train.learn import SIMULATED_WEIGHTS

SYSTEMS = {"mini": (MINI, SIMULATED_WEIGHTS), "paper": (PAPER, PAPER_WEIGHTS)}
BY_SYSTEM = pytest.mark.parametrize("system", SYSTEMS)
BY_SCENE = pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)


@functools.cache
def compiled(system, precision="float32", mapped=False):
    """(params, batch) -> (gradient, losses)."""
    parts, weights = SYSTEMS[system]
    gradients = stage.gradients(dataclasses.replace(parts, precision=precision), weights)
    fn = lambda params, batch: gradients(params, batch)[:2]
    return jax.jit(jax.vmap(fn) if mapped else fn)


def hard(system, scene):
    parts, _ = SYSTEMS[system]
    return scene.change(stage.params_of(parts), stage.batch(parts), parts)


def flat(tree):
    return np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(tree)])


def assert_close(ours, theirs, tolerance):
    """Each loss, and the gradient as one vector."""
    (gradient, losses), (exact_gradient, exact_losses) = ours, theirs
    for name, loss in losses.items():
        np.testing.assert_allclose(loss, exact_losses[name], rtol=tolerance, atol=1e-5, err_msg=name)
    gradient, exact_gradient = flat(gradient), flat(exact_gradient)
    away = np.linalg.norm(gradient - exact_gradient) / max(np.linalg.norm(exact_gradient), 1e-6)
    assert away < tolerance, f"gradient: {away:.1e} of its norm away"


@BY_SYSTEM
@BY_SCENE
def test_losses_and_gradients_are_finite_and_those_of_float64(scene, system):
    ours = compiled(system)(*hard(system, scene))
    assert np.isfinite(flat(ours)).all()
    with jax.enable_x64(True):
        exact = compiled(system, "float64")(*hard(system, scene))
    assert_close(ours, exact, scene.tolerance)


@BY_SYSTEM
def test_a_hard_scene_does_not_spoil_its_neighbours_in_a_batch(system):
    """All scenes mapped over at once: each is what it is alone."""
    alone = [compiled(system)(*hard(system, scene)) for scene in SCENES]
    stacked = jax.tree.map(lambda *rows: jnp.stack([jnp.asarray(r) for r in rows]), *(hard(system, s) for s in SCENES))
    together = compiled(system, mapped=True)(*stacked)
    for i, scene in enumerate(SCENES):
        assert_close(jax.tree.map(lambda x, i=i: x[i], together), alone[i], scene.tolerance)


@BY_SYSTEM
@BY_SCENE
def test_half_precision_networks_are_finite_there(scene, system):
    assert np.isfinite(flat(compiled(system, "bfloat16")(*hard(system, scene)))).all()


def same_direction(whole, half):
    assert {g.dtype for g in jax.tree.leaves((whole, half))} == {jnp.dtype("float32")}
    whole, half = flat(whole), flat(half)
    return whole @ half / np.linalg.norm(whole) / np.linalg.norm(half) > 0.9


def test_a_half_precision_step_learns_in_the_same_direction_with_whole_gradients():
    args = hard("mini", SCENES[0])
    assert same_direction(compiled("mini")(*args)[0], compiled("mini", "bfloat16")(*args)[0])


def test_a_half_precision_step_of_the_papers_system_does_too():
    # At random weights points come next to the camera's plane, where the geometric loss tells any two roundings apart.
    weights, args = PAPER_WEIGHTS | {"geo": 0}, hard("paper", SCENES[0])
    step = lambda precision: stage.gradients(dataclasses.replace(PAPER, precision=precision), weights)
    assert same_direction(*(jax.jit(step(precision))(*args)[0] for precision in ("float32", "bfloat16")))


@pytest.mark.slow
@BY_SYSTEM
def test_run_eagerly_it_is_the_same(system):
    for scene in SCENES[:2]:
        args = hard(system, scene)
        assert_close(stage.gradients(*SYSTEMS[system])(*args)[:2], compiled(system)(*args), scene.tolerance)


def test_names_are_unique_and_causes_told():
    assert len({scene.name for scene in SCENES}) == len(SCENES) and all(scene.cause for scene in SCENES)
