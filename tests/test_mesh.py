"""A step on several devices is the step on one, but for the order in which a mean is summed."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage

from zestjax.base.parts import from_stored, to_stored
from zestjax.train.batches import stacked
from zestjax.train.blocks import over_clips
from zestjax.train.mesh import mesh_of, mesh_trainer, shares
from zestjax.train.recipes import PARTS, SVS, TINY, ZEST

CHILD = Path(__file__).with_name("mesh_child.py")
SECONDS = 900  # of a loaded machine; a process of `jax.distributed` heeds no SIGTERM, so it is killed


def free_port():
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def on_two_processes(*command):
    """The outputs of a command run twice, with PORT, 2 and 0 or 1 after its first word."""
    port, one_core = str(free_port()), {"PJRT_NPROC": "1", "OMP_NUM_THREADS": "1"}
    both = [
        subprocess.Popen([sys.executable, command[0], port, "2", index, *command[1:]], env=os.environ | one_core,
                         stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for index in "01"
    ]  # fmt: skip
    try:
        said = [process.communicate(timeout=SECONDS) for process in both]
    finally:
        for process in both:
            process.kill()
    assert [process.returncode for process in both] == [0, 0], said
    return [out for out, _ in said]


@pytest.mark.parametrize("terms", ["few", pytest.param("all", marks=pytest.mark.slow)])
def test_two_processes_have_the_parameters_of_one_device(terms):
    """Three steps of Adam in float64. A gradient's rounding, 1e-16, over Adam's eps of 1e-8 moves a parameter by 1e-8
    of a rate of 1e-4: 1e-12 a step."""
    found = json.loads(on_two_processes(CHILD, terms)[0].splitlines()[-1])  # Gloo greets on the same stream
    assert found["rays"]["mesh"] == {"clips": 1, "rays": 2} and found["clips"]["mesh"] == {"clips": 2, "rays": 1}
    for case in found.values():
        assert case["params"] < 1e-11 and case["terms"] < 1e-11 and case["moved"] > 1e-4, found


def square(params, batch, weight=1.0):
    total = weight * jnp.sum((params - batch["x"]) ** 2)
    return total, {"rec": total, "first": batch["x"][0]}


def test_the_objective_of_several_clips_is_their_mean():
    params, batch = jnp.arange(3.0), {"x": jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)), jnp.float32)}
    plain = lambda p, w: jnp.mean(jax.vmap(lambda x: square(p, {"x": x}, w)[0])(batch["x"]))
    for weights in ((), (jnp.float32(2.0),)):
        of_all = jax.value_and_grad(over_clips(square, 4), has_aux=True)
        (total, terms), grads = of_all(params, batch, *weights)
        np.testing.assert_allclose(total, plain(params, *(weights or (1.0,))), rtol=1e-6)
        np.testing.assert_allclose(grads, jax.grad(plain)(params, *(weights or (1.0,))), rtol=1e-6)
        np.testing.assert_allclose(terms["first"], batch["x"][:, 0].mean(), rtol=1e-6)


def test_a_batch_of_another_number_of_clips_is_refused():
    with pytest.raises(ValueError, match="expected 2 clips"):
        over_clips(square, 2)(jnp.zeros(3), {"x": jnp.zeros((4, 3))})
    assert over_clips(square, 1) is square


@pytest.mark.parametrize(
    ("clips", "blocks", "count", "expected"),
    [(1, 4, 1, (1, 1)), (1, 4, 2, (1, 2)), (1, 4, 4, (1, 4)), (2, 4, 2, (2, 1)), (2, 4, 8, (2, 4)), (6, 2, 4, (2, 2)),
     (4, 1, 4, (4, 1))],
)  # fmt: skip
def test_clips_are_shared_before_rays(clips, blocks, count, expected):
    assert shares(replace(ZEST, clips=clips, blocks=blocks), count) == expected


def test_devices_without_equal_parts_are_refused():
    for recipe, count in ((ZEST, 3), (ZEST, 8), (replace(ZEST, clips=4), 12), (SVS["tiny"], 2)):
        with pytest.raises(ValueError, match=f"{count} devices cannot have equal parts"):
            shares(recipe, count)
    assert shares(ZEST.stage("views"), 4) == (1, 4)
    with pytest.raises(ValueError, match="in 1 blocks of rays"):  # frames alone: there are no rays
        shares(ZEST.stage("frames"), 2)


def test_a_mesh_of_one_device_makes_the_same_step():
    system = stage.STILL
    recipe, batch = stage.recipe_of(system).weighted(dict(rec=1.0)), stage.batch(system)
    init, step = recipe.trainer(steps=9)
    start = lambda: jax.tree.map(jnp.copy, stage.params_of(system))
    alone = jax.jit(step)(start(), init(start()), batch)
    init, step = mesh_trainer(recipe, mesh_of(recipe, jax.devices()[:1]), steps=9)
    shared = step(start(), init(start()), batch)
    np.testing.assert_allclose(shared[2]["total"], alone[2]["total"], rtol=1e-6)
    assert shared[0].static.net is not None and shared[1].iter_num == 1


def test_batches_of_clips_are_stacked_where_they_are_alike():
    one, other = (stage.batch(stage.MINI, kind) for kind in range(2))
    both = stacked([one, other])
    assert both.inputs.time.tolist() == [one.inputs.time, other.inputs.time] and stacked([one]) is one
    assert both.truth.colour.shape == (2, *one.truth.colour.shape) and both.inputs.time.dtype == one.inputs.time.dtype
    with pytest.raises(ValueError, match="bring all scenes to one size"):
        stacked([one, other._replace(truth=other.truth._replace(depth=None))])


def test_the_number_of_clips_belongs_to_the_recipe():
    stored = to_stored(TINY)
    del stored["clips"]
    assert from_stored(stored, PARTS) == TINY and TINY.clips == 1  # a file written before there were several
    with pytest.raises(ValueError, match="`clips` is 0"):
        replace(TINY, clips=0)
    with pytest.raises(ValueError, match="judges 1 a step"):
        replace(SVS["tiny"], clips=2)
