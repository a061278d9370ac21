"""The whole way, with real processes: simulate, train, be killed, resume, evaluate, render, fine-tune."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from zestjax.apps.log import read_log
from zestjax.apps.weights import open_weights
from zestjax.io.nsff import read_nsff
from zestjax.io.weights import load_weights
from zestjax.losses.objective import PAPER_WEIGHTS

NOT_SECOND = (1, *range(3, 13))  # the second camera took frame 1

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("whole")


def start(place, *arguments):
    environment = os.environ | {"XDG_CACHE_HOME": str(place / "cache")}
    command = [sys.executable, "-m", "zestjax.apps.cli", *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(place, *arguments):
    process = start(place, *arguments)
    out, err = process.communicate(timeout=1500)
    assert process.returncode == 0, err
    return out


def training(place, name):
    clips = ("--clips", place / "clips", "--clip-count", 2, "--steps-per-clip", 3, "--steps", 12)
    return ("train", "--preset", "tiny", "--out", place / name, *clips, "--checkpoint-minutes", 0.0001)


@pytest.fixture(scope="module")
def weights(place):
    """Weights of an uninterrupted run of the tiny preset."""
    assert finish(place, *training(place, "whole")).startswith("train: 12 steps")
    return place / "whole/weights.safetensors"


@pytest.fixture(scope="module")
def scene(place):
    finish(place, "simulate", "--scene", "walker", "--size", "32x48", "--frames", 6, "--out", place / "scene")
    return place / "scene"


def test_a_killed_run_resumes_to_the_same_bits(place, weights):
    process = start(place, *training(place, "killed"))
    while process.poll() is None and not list((place / "killed/checkpoints").glob("step_*.safetensors")):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    finish(place, *training(place, "killed"), "--resume")
    (whole, _), (resumed, _) = load_weights(weights), load_weights(place / "killed/weights.safetensors")
    assert whole.keys() == resumed.keys()
    for name in whole:
        np.testing.assert_array_equal(whole[name], resumed[name], err_msg=name)


def test_stages_follow_one_another_and_real_scenes_serve_too(place, weights, scene):
    given = training(place, "frames")
    finish(place, *given, "--stage", "frames", "--weights", weights)
    finish(place, *training(place, "views"), "--stage", "views", "--weights", place / "frames/weights.safetensors")
    own = ("train", "--preset", "tiny", "--scenes", scene, scene, "--steps", 3, "--out", place / "own")
    finish(place, *own, "--weights", place / "views/weights.safetensors")
    at = {name: load_weights(place / name / "weights.safetensors")[0] for name in ("whole", "frames", "views", "own")}
    moved = lambda a, b: {name.split(".")[1] for name in at[a] if (at[a][name] != at[b][name]).any()}
    assert moved("whole", "frames") == {"analysis"}
    assert moved("frames", "views") == {"static", "dynamic"}
    assert moved("views", "own")


def test_the_log_has_every_loss_term(place, weights):
    line = json.loads((weights.parent / "log.jsonl").read_text().splitlines()[-1])
    assert {"step", "seconds", "seconds_per_step", "total", "rec"} <= line.keys() and line["step"] == 12


def test_a_simulated_folder_is_numbered_as_published_and_needs_no_truth_for_its_poses(scene, tmp_path):
    assert [p.name for p in sorted((scene / "mv_images/00001").iterdir())] == [f"cam{i:02d}.png" for i in NOT_SECOND]
    assert {p.name for p in (scene / "truth").glob("00001_*")} == {f"00001_cam{i:02d}.npz" for i in NOT_SECOND}
    bare = shutil.copytree(scene, tmp_path / "bare", ignore=shutil.ignore_patterns("truth", "scene.json"))
    told, known = read_nsff(bare).held_out, {(t.time, t.camera_name): t.camera for t in read_nsff(scene).held_out}
    assert len(told) == 6 * 5  # cameras 7 to 12 took none of the six frames
    for target in told:
        expected = known[target.time, target.camera_name].camera_from_world
        np.testing.assert_allclose(target.camera.camera_from_world, expected, atol=1e-5)


def test_a_simulated_folder_is_evaluated_rendered_and_learned_from(place, weights, scene):
    given = ("--scene", scene, "--weights", weights, "--size", "32x48")
    finish(place, "evaluate", *given, "--targets", "2,3", "--out", place / "scores")
    report = json.loads((place / "scores/metrics.json").read_text())
    assert report["preset"] == "tiny" and report["mean"]["full"]["psnr"] > 5
    assert report["mean"]["flow_epe_px"] is not None and report["mean"]["depth_abs_rel"] < 1
    finish(place, "render", *given, "--frames", 4, "--out", place / "film")
    assert len(list((place / "film/frames").iterdir())) == 4
    tuning = start(place, "finetune", *given, "--budget", 5, "--exclude", "1", "--out", place / "tuned")
    assert "of the pixels for moving" in tuning.communicate()[1]  # weights of twelve steps know nothing yet
    assert tuning.returncode == 2 and not (place / "tuned").exists()


def test_a_bench_scene_is_scored_below_its_ceiling(place, weights):
    out = place / "bench"
    finish(
        place,
        "evaluate",
        "--scene",
        "bench:blobs",
        "--weights",
        weights,
        "--size",
        "32x48",
        "--targets",
        "5",
        "--out",
        out,
    )
    report = json.loads((out / "metrics.json").read_text())
    assert report["ceiling"]["full"]["psnr"] > report["floors"]["plane_warp"]["full"]["psnr"]


def test_the_papers_preset_learns_from_exactly_the_papers_terms(place):
    """At full size: some 12 GB, and minutes of compiling."""
    clips = ("--clips", place / "large", "--clip-count", 1)
    finish(place, "train", "--preset", "paper", "--steps", 1, *clips, "--out", place / "paper")
    (line,) = read_log(place / "paper/log.jsonl")[0]
    assert line.keys() - {"step", "seconds", "seconds_per_step", "total"} == PAPER_WEIGHTS.keys()
    assert all(np.isfinite(line[name]) for name in PAPER_WEIGHTS)


@pytest.mark.parametrize("system", ["svs", "mvsnerf"])
def test_a_baseline_goes_through_the_same_commands(place, scene, system):
    out, clips = place / system, ("--clips", place / "clips", "--clip-count", 2)
    learn = ("train", "--preset", "tiny", "--system", system, *clips, "--out", out)
    finish(place, *learn, "--steps", 4)
    finish(place, *learn, "--steps", 8, "--resume")
    weights = out / "weights.safetensors"
    model = open_weights(weights, system=system)
    assert model.name == system and (model.opponent is not None) == (system == "svs")
    given, tuned = ("--scene", scene, "--weights", weights, "--system", system), place / f"{system}_tuned"
    finish(place, "finetune", *given, "--budget", 2, "--out", tuned)
    before, after = (load_weights(path)[0] for path in (weights, tuned / "weights.safetensors"))
    assert before.keys() == after.keys() and any((before[name] != after[name]).any() for name in before)
    finish(place, "evaluate", *given, "--targets", 2, "--out", place / f"{system}_scores")
    report = json.loads((place / f"{system}_scores/metrics.json").read_text())
    assert report["system"] == system and report["mean"]["full"]["psnr"] > 5
    finish(place, "render", *given, "--frames", 2, "--out", place / f"{system}_path")
    refused = start(place, "evaluate", *given[:4], "--system", "zest", "--out", place / "no")
    assert f"holds weights of `{system}`, not `zest`" in refused.communicate()[1] and refused.returncode == 2


def test_nsff_learns_a_scene_by_heart_through_the_same_commands(place, scene):
    learn = ("train", "--preset", "tiny", "--system", "nsff", "--scenes", scene, "--out", place / "nsff")
    finish(place, *learn, "--steps", 20)
    finish(place, *learn, "--steps", 40, "--resume")
    weights = place / "nsff/weights.safetensors"
    tuned = place / "nsff_tuned/weights.safetensors"
    told = finish(place, "finetune", "--scene", scene, "--weights", weights, "--budget", 2, "--out", tuned.parent)
    before, after = (load_weights(path)[0] for path in (weights, tuned))
    assert told.startswith("finetune: ") and any((before[name] != after[name]).any() for name in before)
    finish(place, "evaluate", "--scene", scene, "--weights", weights, "--targets", 2, "--out", place / "nsff_scores")
    report = json.loads((place / "nsff_scores/metrics.json").read_text())
    assert report["system"] == "nsff" and report["mean"]["full"]["psnr"] > 5
    finish(place, "render", "--scene", scene, "--weights", weights, "--frames", 2, "--out", place / "nsff_path")


def test_a_fold_that_is_killed_ends_with_the_bits_of_one_that_is_not(place):
    for name in ("blobs", "walker"):
        finish(place, "simulate", "--scene", name, "--size", "32x48", "--frames", 6, "--out", place / "few" / name)
    given = ("crossval", "--scenes", place / "few", "--preset", "tiny", "--steps", 40, "--targets", 2)
    given += ("--checkpoint-minutes", 0.0001)
    assert finish(place, *given, "--out", place / "unbroken").startswith("crossval: 2 of 2 folds done: zest ")
    process = start(place, *given, "--out", place / "broken")
    while process.poll() is None and not list(place.glob("broken/work/000/fold/train/checkpoints/step_*")):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert not list(place.glob("broken/folds/*/*"))
    finish(place, *given, "--out", place / "broken")
    for file in ("blobs/train/weights.safetensors", "walker/train/weights.safetensors"):
        (whole, _), (resumed, _) = (load_weights(place / out / "folds/zest" / file) for out in ("unbroken", "broken"))
        assert all(np.array_equal(whole[name], resumed[name]) for name in whole)
    assert "2 of 2 folds finished" in (place / "broken/table.md").read_text()
    tuned = ("--system", "zest-none", "--steps", 4, "--finetune", 3, "--preset", "tiny", "--targets", 2)
    told = finish(place, "crossval", *tuned, "--scenes", place / "few", "--out", place / "tuned")
    assert told.startswith("crossval: 2 of 2 folds done")
    learned = place / "tuned/folds/zest-none/blobs/finetune/weights.safetensors"
    flags = ("--system", "zest-none", "--steps", 0, "--weights", learned, "--targets", 2)
    finish(place, "crossval", *flags, "--scenes", place / "few/blobs", "--out", place / "scored")
    one, other = (
        json.loads((place / f"{name}/folds/zest-none/blobs/metrics.json").read_text()) for name in ("tuned", "scored")
    )
    assert one["mean"]["full"] == other["mean"]["full"] and one["weights"] == other["weights"] == str(learned)
