"""The compiler is kept from returning wrong sums, and `doctor` says where it is not."""

import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import normal

import zestjax
from zestjax.apps import doctor
from zestjax.apps.cli import main
from zestjax.base import backend
from zestjax.cameras import Camera, project, unproject
from zestjax.testing import backend_checks, check_backend
from zestjax.testing.backend import Check, batched_gradient_error

FUSED = "__ynn_fusion"  # how the compiler names what it hands to those kernels
SWITCHED_OFF = f"{backend.FLAG}="


def decided(monkeypatch, flags, *, version=(0, 10), runs=False, error=0.0):
    """The decision and `XLA_FLAGS` after it; nothing is computed."""
    monkeypatch.setattr(backend, "sum_error", lambda: error)
    monkeypatch.setattr(backend, "_jaxlib_version", lambda: version)
    monkeypatch.setattr(backend, "_cpu_runs", lambda: runs)
    monkeypatch.setenv("XLA_FLAGS", flags)
    return backend.decide(), os.environ["XLA_FLAGS"]


def test_the_flag_is_added_to_those_of_the_user(monkeypatch):
    assert decided(monkeypatch, "") == (("off", SWITCHED_OFF), SWITCHED_OFF)
    both = f"--xla_dump_to=x {SWITCHED_OFF}"
    assert decided(monkeypatch, "--xla_dump_to=x") == (("off", both), both)


@pytest.mark.parametrize(
    "flags, state, change",
    [
        (f"--xla_dump_to=x {backend.FLAG}=REDUCE", "user", {}),
        ("flags.txt", "file", {}),
        ("--xla_dump_to=x", "unknown", {"version": (0, 9)}),
        ("", "unknown", {"version": backend.KNOWN[1]}),
        ("", "running", {"runs": True}),
    ],
)
def test_what_must_not_be_touched_is_not(monkeypatch, flags, state, change):
    assert decided(monkeypatch, flags, **change) == ((state, flags), flags)


def test_where_jax_runs_already_a_wrong_sum_is_warned_of(monkeypatch):
    with pytest.warns(backend.CompilerWarning, match="returns wrong sums here.*set XLA_FLAGS=.*before Python starts"):
        found = decided(monkeypatch, "", runs=True, error=0.9)
    assert found == (("running", ""), "")


LATE = """
import json, warnings
import jax, jax.numpy as jnp
jnp.zeros(3)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    import zestjax
from zestjax.base.backend import sum_error
mapped = jax.jit(jax.vmap(lambda x: jnp.sum((jnp.eye(3) @ x) ** 2))).lower(jnp.zeros((40000, 3))).compile().as_text()
print(json.dumps([zestjax.BACKEND.state, len(caught), sum_error(), "FUSED" in mapped]))
""".replace("FUSED", FUSED)


def test_a_process_in_which_jax_ran_first_is_warned_if_and_only_if_its_sums_are_wrong():
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    ran = subprocess.run([sys.executable, "-c", LATE], env=environment, capture_output=True, text=True, check=True)
    state, warned, error, fused = json.loads(ran.stdout)
    assert state == "running" and warned == (error > backend.LARGEST_ERROR)
    assert fused or error < 1e-6  # that name is what the tests below look for


# This process, and what zestjax compiles in it.


def test_this_suite_runs_with_the_fusion_off():
    assert zestjax.BACKEND.state in ("off", "user") and SWITCHED_OFF in os.environ["XLA_FLAGS"]
    assert backend.sum_error() < 1e-6 and batched_gradient_error() < 1e-6


def test_the_rendering_and_the_training_program_hold_no_such_fusion():
    params, batch = stage.params_of(stage.MINI), stage.batch()
    step, init = stage.step()
    inputs, frames = stage.inputs_of()
    evidence = jax.tree.map(lambda x: x[frames], stage.prepared().evidence)
    programs = {
        "render": stage.forward().lower(params, inputs, evidence, stage.pixels()),
        "train": step.lower(params, init(params), batch),
    }
    assert not [name for name, program in programs.items() if FUSED in program.compile().as_text()]


def seen(point):
    """Pixels of points, and points of pixels, by our own functions."""
    camera = Camera(jnp.asarray([[40.0, 1, 8], [0, 50, 6], [0, 0, 1]]), jnp.asarray(POSE, jnp.float32))
    pixel = project(camera, point).pixels
    return jnp.concatenate([pixel, unproject(camera, pixel, jnp.float32(2.0))])


POSE = np.eye(4)
POSE[:3, :3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
POSE[:3, 3] = [0.1, -0.2, 9.0]


def seen_in_numpy(points):
    intrinsics = np.array([[40.0, 1, 8], [0, 50, 6], [0, 0, 1]])
    here = points @ POSE[:3, :3].T + POSE[:3, 3]
    pixels = (here @ intrinsics.T)[:, :2] / here[:, 2:]
    ray = np.concatenate([pixels, np.ones((len(points), 1))], -1) @ np.linalg.inv(intrinsics).T
    return np.concatenate([pixels, (2 * ray - POSE[:3, 3]) @ POSE[:3, :3]], -1)


@pytest.mark.parametrize("count", [40_000, 100_000])
def test_our_cameras_mapped_over_more_points_than_the_compiler_got_right(count):
    points = np.asarray(normal(0, count, 3))
    expected = seen_in_numpy(points.astype(np.float64))
    found = jax.jit(jax.vmap(seen))(points)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-3)
    summed = jax.jit(jax.vmap(lambda p: jnp.sum(seen(p) ** 2)))(points)
    np.testing.assert_allclose(summed, np.sum(expected**2, -1), rtol=2e-3)


# The report.


def test_doctor_finds_this_machine_well(capsys):
    assert main(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] and not report["faults"]
    found = {line["name"]: line for section in report.values() if isinstance(section, list) for line in section}
    assert found["jax"]["found"] == jax.__version__ and "cpu" in found["devices"]["found"]
    assert {"mapped sum", "gradient of a batched product", "sum at rank 7 and 8"} < found.keys()


def test_doctor_says_what_is_wrong_and_fails(capsys, monkeypatch, tmp_path):
    wrong = Check("mapped sum", False, "relative error 1")
    monkeypatch.setattr(doctor, "backend_checks", lambda *, seed: (wrong,))
    (tmp_path / "file").touch()
    monkeypatch.setattr(doctor, "cache_folder", lambda: tmp_path / "file" / "zestjax")
    assert main(["doctor"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("doctor: 2 faults: mapped sum: relative error 1; cache folder:")
    assert any("FAULT mapped sum" in line for line in lines) and "XDG_CACHE_HOME" in lines[-1]
    assert main(["doctor", "--quiet"]) == 1 and not capsys.readouterr().out


def test_a_suite_is_stopped_by_name(monkeypatch):
    monkeypatch.setattr("zestjax.testing.backend.sum_error", lambda **_: 1.0)
    monkeypatch.setattr("zestjax.testing.backend._high_rank", lambda seed: Check("rank", True, ""))
    with pytest.raises(AssertionError, match="check_backend: mapped sum: relative error 1.0e[+]00; set XLA_FLAGS"):
        check_backend()
    assert [check.ok for check in backend_checks()] == [False, True, True]


def test_a_program_compiled_quickly_computes_the_same():
    points = jnp.asarray(np.random.default_rng(0).normal(size=(64, 3)), jnp.float32)
    fn = lambda x: jnp.sum(jnp.sin(x) * jnp.exp(-x), axis=-1)
    gradient = jax.grad(lambda x: fn(x).sum())
    found, expected = jax.jit(gradient, compiler_options=backend.quick())(points), jax.jit(gradient)(points)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_compiler_options_are_those_that_device_and_jaxlib_know(monkeypatch):
    monkeypatch.setattr(backend, "_jaxlib_version", lambda: (0, 10))
    assert set(backend.quick()) == {"xla_backend_optimization_level", "xla_cpu_use_fusion_emitters"}
    monkeypatch.setattr(backend, "_jaxlib_version", lambda: (0, 11))
    assert set(backend.quick()) == {"xla_backend_optimization_level"}
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert backend.quick() == {}
