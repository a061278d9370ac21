"""The commands: what they write, and one clear line for every kind of bad input."""

import dataclasses
import json
from typing import Any

import jax
import numpy as np
import pytest

from zestjax import novel_view
from zestjax.apps import frontier
from zestjax.apps.host import host_camera, host_video
from zestjax.apps.weights import open_weights, system_of
from zestjax.cli import main
from zestjax.io.nsff import write_nsff
from zestjax.io.scenes import Target
from zestjax.io.weights import save_weights
from zestjax.model import init_params
from zestjax.novel_view import View
from zestjax.presets import preset

FRAMES, HEIGHT, WIDTH = 6, 32, 48


def camera(step):
    """A camera that has moved sideways."""
    focal = np.array([[40, 0, (WIDTH - 1) / 2], [0, 40, (HEIGHT - 1) / 2], [0, 0, 1]], np.float32)
    pose = np.eye(4, dtype=np.float32)
    pose[0, 3] = 0.1 * step
    return host_camera(focal, pose)


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A scene's folder and weights of the tiny preset that know nothing."""
    root = tmp_path_factory.mktemp("cli")
    rng = np.random.default_rng(0)
    images = rng.random((FRAMES, HEIGHT, WIDTH, 3), np.float32)
    cameras = host_camera(*(np.stack(leaf) for leaf in zip(*(camera(i % 3) for i in range(FRAMES)), strict=True)))
    video = host_video(images, cameras, np.float32(1), np.float32(5))
    dynamic = np.zeros((HEIGHT, WIDTH), bool)
    dynamic[8:20, 8:30] = True
    depth = np.full((HEIGHT, WIDTH), 2, np.float32)
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    held_out = [
        Target(t, f"cam{c:02d}", camera(c), rng.random((HEIGHT, WIDTH, 3), np.float32), dynamic, (), depth, flow)
        for t, c in ((1, 0), (4, 2))
    ]
    write_nsff(root / "scene", "toy", video, held_out=held_out)
    for name, changes in (("tiny", {}), ("geometry", {"motion": False})):
        config = preset("tiny", **changes)
        shapes = jax.eval_shape(lambda config=config: init_params(jax.random.key(0), config))
        zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
        save_weights(root / f"{name}.safetensors", zeros, metadata={"config": dataclasses.asdict(config), "seed": 0})
    return root


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    """The user's cache folder is not the tests' to fill."""
    monkeypatch.setattr("zestjax.cli._prepare_jax", lambda: None)


@pytest.fixture
def grey(monkeypatch):
    """A model that shows grey, so that nothing has to be compiled."""

    def render_view(params, prepared, camera, time, *, config, exclude=()):
        size = prepared.images.shape[1:3]
        maps = np.full(size, 0.5, np.float32)
        colour = np.full((*size, 3), 0.5, np.float32)
        leaves: Any = (colour, colour, None, 4 * maps, maps, maps, np.zeros((*size, 2), np.float32))
        return View(*leaves)

    monkeypatch.setattr(novel_view, "prepare", lambda params, video, *, config: video)
    monkeypatch.setattr(novel_view, "render_view", render_view)


def run(places, command, *flags, weights="tiny", scene="scene"):
    where = ["--out", str(places / "out" / command)] if "--out" not in flags else []
    given = ["--scene", str(places / scene)] if scene else []
    given += ["--weights", str(places / f"{weights}.safetensors")] if weights else []
    return main([command, *given, *where, *flags])


def test_evaluate_writes_the_scores_and_a_picture_of_every_target(places, grey, capsys):
    assert run(places, "evaluate", "--size", f"{HEIGHT}x{WIDTH}") == 0
    said = capsys.readouterr()
    assert said.out.startswith("evaluate: toy: full ") and said.out.count("\n") == 1 and "error:" not in said.err
    report = json.loads((places / "out/evaluate/metrics.json").read_text())
    assert report["scene"] == "toy" and report["system"] == "zest" and report["protocol"] == "held-out"
    assert (report["height"], report["width"], report["preset"]) == (HEIGHT, WIDTH, "tiny")
    for scores in (report["mean"], *report["floors"].values(), *report["targets"]):
        assert all(set(scores[region]) == {"psnr", "ssim", "lpips"} for region in ("full", "dynamic", "static"))
    assert set(report["floors"]) == {"nearest_frame", "plane_warp"} and report["ceiling"] is None
    assert report["mean"]["depth_abs_rel"] == 0 and report["mean"]["flow_epe_px"] == 0
    assert report["mean"]["seconds_per_frame"] >= 0 and report["compile_seconds"] >= 0
    assert [(t["time"], t["camera"]) for t in report["targets"]] == [(1, "cam00"), (4, "cam02")]
    assert all((places / "out/evaluate" / t["file"]).is_file() for t in report["targets"])


def test_the_strict_protocol_never_shows_a_target_to_the_model(places, grey, monkeypatch):
    asked, shown = [], novel_view.render_view
    monkeypatch.setattr(
        novel_view, "render_view", lambda *a, exclude=(), **k: (asked.append((a[3], exclude)), shown(*a, **k))[1]
    )
    assert run(places, "evaluate", "--protocol", "strict", "--targets", "1,4", "--no-pictures", "--quiet") == 0
    assert set(asked) == {(1, (1,)), (4, (4,))}


def test_quiet_is_silent(places, grey, capsys):
    assert run(places, "evaluate", "--quiet", "--no-pictures", "--out", str(places / "out/quiet")) == 0
    assert capsys.readouterr() == ("", "")


def test_render_writes_frames_a_film_and_its_timing(places, grey):
    assert run(places, "render", "--path", "freeze", "--frames", "5", "--budget-seconds", "100", "--quiet") == 0
    out = places / "out/render"
    timing = json.loads((out / "timing.json").read_text())
    assert len(list((out / "frames").iterdir())) == timing["frames"] == 5
    assert (out / timing["video"]).stat().st_size > 0 and timing["seconds_per_frame"] >= 0
    assert timing["scale"] == 1.0


def test_a_budget_that_is_too_small_falls_back_to_the_smallest_size(places, grey):
    out = places / "out/hurry"
    assert run(places, "render", "--frames", "3", "--budget-seconds", "1e-9", "--quiet", "--out", str(out)) == 0
    timing = json.loads((out / "timing.json").read_text())
    assert timing["scale"] < 0.4 and (timing["height"], timing["width"]) == (HEIGHT, WIDTH)


def test_frontier_writes_every_setting_and_marks_what_no_other_beats(places, grey, capsys):
    assert run(places, "frontier") == 0
    assert capsys.readouterr().out.startswith("frontier: on toy")
    lines = (places / "out/frontier/frontier.csv").read_text().splitlines()
    assert lines[0] == "setting,psnr_full,psnr_dynamic,ssim_full,seconds_per_frame,peak_mb,pareto"
    assert len(lines) == 1 + len(frontier.settings_of(preset("tiny")))
    assert (places / "out/frontier/frontier.png").is_file()


def test_the_pareto_set_holds_what_is_fastest_what_is_best_and_no_loser():
    rows = [{"seconds_per_frame": s, "psnr_full": p} for s, p in ((1, 20), (2, 25), (3, 24), (2, 24), (0.5, 10))]
    assert [row["pareto"] for row in frontier.mark_pareto(rows)] == [1, 1, 0, 0, 1]


def test_weights_tell_their_system(places):
    assert open_weights(places / "tiny.safetensors").system == "zest"
    assert open_weights(places / "geometry.safetensors", system="zest-geometry").system == "zest-geometry"
    assert system_of(preset("tiny", geometry=False, motion=False)) == "zest-none"


def refused(capsys, code, *words):
    """The command failed with one line on standard error that says what the words say."""
    said = capsys.readouterr()
    assert code == 2 and said.out == ""
    assert said.err.startswith("error: ") and said.err.count("\n") == 1, said.err
    for word in words:
        assert word in said.err, said.err


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["paint", "--out", "x"], "paint"),
        (["evaluate", "--out", "x"], "--scene"),
        (["simulate", "--scene", "walker", "--out", "x", "--size", "144"], "HxW"),
        (["simulate", "--out", "x"], "--random"),
        (["train", "--out", "x", "--steps", "0"], "from 1"),
        (["evaluate", "--scene", "s", "--out", "x", "--targets", "1;2"], "i,j"),
        (["train", "--out", "x", "--minutes", "-1"], "above 0"),
        (["render", "--scene", "s", "--out", "x", "--seed", "-3"], "from 0"),
    ],
)
def test_bad_arguments_are_one_line(capsys, arguments, word):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    refused(capsys, caught.value.code, word)


def test_bad_input_is_one_line_that_names_it(places, grey, capsys, tmp_path):
    refused(capsys, run(places, "evaluate", scene="nowhere"), "nowhere", "not a folder")
    refused(capsys, run(places, "evaluate", weights="nowhere"), "nowhere.safetensors", "check the path")
    refused(capsys, run(places, "evaluate", "--protocol", "lenient"), "lenient", "strict")
    refused(capsys, run(places, "evaluate", "--system", "zest-motion"), "zest-motion", "--system")
    refused(capsys, run(places, "evaluate", "--targets", "99"), "99")
    refused(capsys, run(places, "render", "--path", "loop"), "orbit")
    refused(capsys, run(places, "finetune", "--exclude", "0,1,2,3"), "leave at least 3")
    refused(capsys, run(places, "finetune", "--exclude", "77"), "77")
    refused(capsys, main(["simulate", "--scene", "nowhere", "--out", str(tmp_path / "s")]), "nowhere", "walker")
    refused(capsys, main(["train", "--preset", "huge", "--out", str(tmp_path / "t")]), "huge", "small")
    refused(capsys, main(["train", "--system", "nerf", "--out", str(tmp_path / "t")]), "nerf", "zest-geometry")
    assert not (tmp_path / "s").exists() and not (tmp_path / "t").exists()


def test_truncated_and_altered_weights_are_one_line(places, grey, capsys):
    whole = (places / "tiny.safetensors").read_bytes()
    (places / "short.safetensors").write_bytes(whole[: len(whole) // 2])
    refused(capsys, run(places, "evaluate", weights="short"), "short.safetensors", "truncated")
    (places / "changed.safetensors").write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    refused(capsys, run(places, "evaluate", weights="changed"), "changed.safetensors", "altered")


def test_a_full_disk_is_one_line(places, grey, capsys, monkeypatch):
    def full(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("zestjax.apps.results.write_bytes", full)
    refused(capsys, run(places, "evaluate", "--no-pictures", "--quiet"), "No space left", "free some space")


def test_a_target_camera_that_sees_nothing_is_refused(places, grey, capsys, tmp_path):
    away = np.eye(4, dtype=np.float32)
    away[0, 0] = away[2, 2] = -1
    np.savez(tmp_path / "away.npz", intrinsics=camera(0).intrinsics[None], camera_from_world=away[None], times=[0])
    refused(capsys, run(places, "render", "--path", str(tmp_path / "away.npz")), "sees nothing")
