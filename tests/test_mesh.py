"""A step on several devices is the step on one, but for the order in which a mean is summed."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from safetensors.numpy import load_file

from zestjax.apps.cli import main
from zestjax.apps.hosts import run_mesh
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


def in_processes(commands):
    """The outputs of Python command lines that run at once, each on one core."""
    one_core = {"PJRT_NPROC": "1", "OMP_NUM_THREADS": "1"}
    all_of_them = [
        subprocess.Popen([sys.executable, *map(str, command)], env=os.environ | one_core, stdout=subprocess.PIPE,
                         stderr=subprocess.PIPE, text=True)
        for command in commands
    ]  # fmt: skip
    try:
        said = [process.communicate(timeout=SECONDS) for process in all_of_them]
    finally:
        for process in all_of_them:
            process.kill()
    assert not any(process.returncode for process in all_of_them), said
    return [out for out, _ in said]


@pytest.mark.parametrize("terms", ["few", pytest.param("all", marks=pytest.mark.slow)])
def test_two_processes_have_the_parameters_of_one_device(terms):
    """Three steps of Adam in float64. A gradient's rounding, 1e-16, over Adam's eps of 1e-8 moves a parameter by 1e-8
    of a rate of 1e-4: 1e-12 a step."""
    port = free_port()
    first, _ = in_processes([(CHILD, port, 2, index, terms) for index in range(2)])
    found = json.loads(first.splitlines()[-1])  # Gloo greets on the same stream
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


def trained_by_command(tmp_path, out, *flags):
    """A command line of `zestjax train`, of few terms, which compile in seconds."""
    off = [f"weights.{term}=0" for term in ("flow3d", "frame_ce", "frame_mask")]
    fixed = ("--preset", "tiny", "--system", "zest-none", "--steps", "6", "--clip-count", "2", "--set", "clips=2", *off)
    places = ("--clips", tmp_path / "clips", "--out", tmp_path / out)
    return ("-m", "zestjax.apps.cli", "train", *fixed, *places, *flags)


@pytest.mark.slow
def test_a_run_on_two_processes_is_one_run(tmp_path, monkeypatch):
    """What one writes the first of two writes, and the other leaves nothing; parameters agree to roundings of 2."""
    (tmp_path / "scratch").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    in_processes([trained_by_command(tmp_path, "alone")])
    at = f"127.0.0.1:{free_port()},2"
    in_processes([trained_by_command(tmp_path, "both", "--hosts", f"{at},{index}") for index in range(2)])
    alone, both = (load_file(tmp_path / out / "weights.safetensors") for out in ("alone", "both"))
    assert max(np.abs(alone[name] - both[name]).max() for name in alone) < 1e-6
    assert {path.name for path in (tmp_path / "both").iterdir()} == {
        path.name for path in (tmp_path / "alone").iterdir()
    }
    assert not list((tmp_path / "scratch").glob("zestjax-*"))
    (told,) = in_processes([trained_by_command(tmp_path, "both", "--resume")])
    assert "nothing was left to do" in told  # one device goes on with what several began


@pytest.mark.parametrize("given", ["nowhere", "127.0.0.1:5000,2", "127.0.0.1:5000,2,2", "h:0,1,0", "h:99999,2,1", ",,"])
def test_hosts_that_cannot_be_are_one_line(given, tmp_path, capsys):
    assert main(["train", "--out", str(tmp_path / "out"), "--hosts", given]) == 2
    assert capsys.readouterr().err.startswith(f"error: train: --hosts is {given}, expected HOST:PORT,COUNT,INDEX")


def test_a_process_that_is_alone_takes_as_many_devices_as_have_equal_parts(monkeypatch, capsys):
    @dataclass(frozen=True)
    class Device:
        id: int
        platform: str
        process_index: int = 0

    def taken(count, platform, quiet=False):
        monkeypatch.setattr(jax, "devices", lambda: [Device(i, platform) for i in range(count)])
        mesh = run_mesh(ZEST, quiet=quiet)
        return 1 if mesh is None else mesh.size

    assert taken(4, "cuda") == 4 and taken(2, "cpu") == 1 and not capsys.readouterr().err
    assert taken(3, "cuda") == 2
    assert capsys.readouterr().err == "train: uses 2 of 3 devices: a step has clips=1, blocks=4\n"
    assert taken(3, "cuda", quiet=True) == 2 and not capsys.readouterr().err
