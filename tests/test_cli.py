"""The commands: what they write, and one clear line for every kind of bad input."""

import dataclasses
import io
import json
import os
import warnings
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax import novel_view
from zestjax.apps import cache, frontier, settings, tables
from zestjax.apps.cli import main
from zestjax.apps.producer import ProducerError
from zestjax.apps.train import TrainOptions, fresh
from zestjax.apps.weights import ablated_name, arithmetic, open_weights
from zestjax.base.parts import to_stored
from zestjax.cameras import Camera
from zestjax.io.nsff import write_nsff
from zestjax.io.scenes import Target
from zestjax.io.video import read_video
from zestjax.io.weights import save_weights
from zestjax.novel_view import View
from zestjax.systems.presets import ABLATED
from zestjax.train.recipes import RECIPES, TINY
from zestjax.video import Video

FRAMES, HEIGHT, WIDTH = 6, 32, 48


def camera(step):
    """A camera that has moved sideways."""
    focal = np.array([[40, 0, (WIDTH - 1) / 2], [0, 40, (HEIGHT - 1) / 2], [0, 0, 1]], np.float32)
    pose = np.eye(4, dtype=np.float32)
    pose[0, 3] = 0.1 * step
    return Camera(focal, pose)


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A scene's folder and weights of the tiny preset that know nothing."""
    root = tmp_path_factory.mktemp("cli")
    rng = np.random.default_rng(0)
    images = rng.random((FRAMES, HEIGHT, WIDTH, 3), np.float32)
    cameras = Camera(*(np.stack(leaf) for leaf in zip(*(camera(i % 3) for i in range(FRAMES)), strict=True)))
    video = Video(images, cameras, np.float32(1), np.float32(5))
    dynamic = np.zeros((HEIGHT, WIDTH), bool)
    dynamic[8:20, 8:30] = True
    depth = np.full((HEIGHT, WIDTH), 2, np.float32)
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    held_out = [
        Target(t, f"cam{c:02d}", camera(c), rng.random((HEIGHT, WIDTH, 3), np.float32), dynamic, (), depth, flow)
        for t, c in ((1, 0), (4, 2))
    ]
    write_nsff(root / "scene", "toy", video, held_out=held_out)
    for name, system in (("tiny", "zest"), ("geometry", "zest-geometry")):
        save_zeros(root / f"{name}.safetensors", TINY.of(ABLATED[system](TINY.system)))
    return root


def save_zeros(path, recipe):
    """Weights of a recipe that know nothing."""
    shapes = jax.eval_shape(recipe.system.init, jax.random.key(0))
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    save_weights(path, zeros, metadata={"recipe": to_stored(recipe), "preset": "tiny", "seed": 0})


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    """The user's cache folder is not the tests' to fill."""
    monkeypatch.setattr("zestjax.apps.cli._prepare_jax", lambda: None)


@pytest.fixture
def grey(monkeypatch):
    """A model that shows grey, so that nothing has to be compiled."""

    def render_view(params, prepared, camera, time, *, system, exclude=()):
        size = prepared.images.shape[1:3]
        maps = np.full(size, 0.5, np.float32)
        colour = np.full((*size, 3), 0.5, np.float32)
        leaves: Any = (colour, colour, None, 4 * maps, maps, maps, np.zeros((*size, 2), np.float32))
        return View(*leaves)

    monkeypatch.setattr(novel_view, "prepare", lambda params, video, *, system: video)
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
    assert report["floors"].pop("flow_interpolation") is None  # the frames of the targets' times are there
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
    floors = json.loads((places / "out/evaluate/metrics.json").read_text())["floors"]
    assert floors["flow_interpolation"]["full"]["psnr"] > 0


def test_evaluate_says_once_what_a_scene_lacks_and_what_is_null_for_it(places, grey, capsys):
    flags = ("--no-pictures", "--out", str(places / "out/lacking"))
    assert run(places, "evaluate", *flags) == 0
    told = lambda: [line for line in capsys.readouterr().err.splitlines() if "null in" in line]
    ceiling = "no ceiling without the exact answers for held-out cameras that bench:NAME alone has"
    assert told() == [f"evaluate: toy: {ceiling}; null in metrics.json"]
    assert run(places, "evaluate", "--protocol", "strict", *flags) == 0
    masks = "no score of dynamic and static pixels without masks (motion_masks/, mv_masks/)"
    truth = "no depth error without true depth (truth/), no flow error without true flow (truth/)"
    assert told() == [f"evaluate: toy: {masks}, {truth}, {ceiling}; null in metrics.json"]
    report = json.loads((places / "out/lacking/metrics.json").read_text())
    assert report["mean"]["dynamic"] is report["mean"]["depth_abs_rel"] is report["ceiling"] is None
    assert tables.lacking("all", tables.NEEDS) is None


def test_pictures_are_enlarged_with_a_word_unless_a_size_is_asked_for(places, grey, capsys):
    save_zeros(places / "tall.safetensors", dataclasses.replace(TINY, height=64, width=96))
    flags = ("--path", "frames", "--frames", "2", "--out", str(places / "out/tall"))
    warned = lambda: [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert run(places, "render", *flags, weights="tall") == 0
        (line,) = warned()
        assert line.endswith(
            "scene: pictures of 32x48 (HxW) are enlarged to 64x96, the preset's height; "
            "`--size HxW`, where a command has it, sets another."
        )
        assert run(places, "render", *flags, "--size", "64x96", weights="tall") == 0
        assert run(places, "render", *flags) == 0  # of the preset's own height
        assert run(places, "render", *flags, "--quiet", weights="tall") == 0
        assert warned() == []


def test_one_frame_is_not_called_frames(places, grey, capsys):
    for count, words in (("1", "render: 1 frame of 32x48, "), ("2", "render: 2 frames of 32x48, ")):
        assert run(places, "render", "--frames", count, "--out", str(places / "out/one")) == 0
        assert capsys.readouterr().out.startswith(words)


def test_a_scene_that_is_not_there_is_told_of_the_bench(places, grey, capsys):
    flags = ["--weights", str(places / "tiny.safetensors"), "--out", str(places / "out/absent")]
    refused(capsys, main(["evaluate", "--scene", "walker", *flags]), "walker: is not a folder", "mean bench:walker?")
    refused(capsys, main(["render", "--scene", "holiday", *flags]), "holiday: is not a folder", "bench:NAME", "marbles")


def test_quiet_is_silent(places, grey, capsys):
    assert run(places, "evaluate", "--quiet", "--no-pictures", "--out", str(places / "out/quiet")) == 0
    assert capsys.readouterr() == ("", "")


def test_render_writes_frames_a_film_and_its_timing(places, grey):
    assert run(places, "render", "--path", "freeze", "--frames", "5", "--budget-seconds", "100", "--quiet") == 0
    out = places / "out/render"
    timing = json.loads((out / "timing.json").read_text())
    assert len(list((out / "frames").iterdir())) == timing["frames"] == 5
    assert (out / timing["video"]).stat().st_size > 0 and timing["seconds_per_frame"] >= 0
    assert timing["scale"] >= 1.0 and timing["budget"]["fits"]


def test_evaluate_keeps_to_a_budget_and_says_what_was_chosen(places, grey, capsys):
    flags = ("--frame-ms", "300", "--at-least-db", "20", "--memory", "64GB", "--no-pictures")
    assert run(places, "evaluate", *flags, "--out", str(places / "out/frugal")) == 0
    said = capsys.readouterr()
    report = json.loads((places / "out/frugal/metrics.json").read_text())
    assert said.out.count("\n") == 1 and report["budget"]["said"] in said.out and "a second more a frame" in said.out
    assert sum(line.startswith("budget: ") for line in said.err.splitlines()) >= 1
    assert (report["height"], report["width"]) == (HEIGHT, WIDTH) and report["mean"]["full"]["psnr"] > 0
    with pytest.raises(SystemExit) as refusal:
        run(places, "evaluate", "--memory", "1.5")
    assert refusal.value.code == 2 and "no size of memory" in capsys.readouterr().err


def test_a_budget_that_is_too_small_falls_back_to_the_smallest_size(places, grey):
    out = places / "out/hurry"
    assert run(places, "render", "--frames", "3", "--budget-seconds", "1e-9", "--quiet", "--out", str(out)) == 0
    timing = json.loads((out / "timing.json").read_text())
    assert (
        timing["scale"] < 1 and not timing["budget"]["fits"] and (timing["height"], timing["width"]) == (HEIGHT, WIDTH)
    )


def test_frontier_writes_every_setting_and_marks_what_no_other_beats(places, grey, capsys):
    assert run(places, "frontier") == 0
    assert capsys.readouterr().out.startswith("frontier: on toy")
    lines = (places / "out/frontier/frontier.csv").read_text().splitlines()
    assert lines[0].startswith("setting,psnr_full,psnr_dynamic,ssim_full,seconds_per_frame,peak_mb,pareto,")
    assert len(lines) > 1 + len(settings.scales()) and any(line.startswith("as trained,") for line in lines)
    assert all((places / "out/frontier" / name).is_file() for name in ("frontier.png", "frontier.json", "report.html"))
    trials = (places / "out/frontier/trials.jsonl").read_bytes()
    assert run(places, "frontier", "--resume", "--quiet") == 0
    assert (places / "out/frontier/trials.jsonl").read_bytes().startswith(trials)
    refused(capsys, run(places, "frontier", "--resume", "--targets", "1", "--quiet"), "trials.jsonl", "--resume")


def test_the_pareto_set_holds_what_is_fastest_what_is_best_and_no_loser():
    points = ((1, 20, 2), (2, 25, 2), (3, 24, 2), (2, 24, 2), (0.5, 10, 2), (0.1, 99, 1))
    rows: list[dict] = [{"seconds_per_frame": s, "psnr_full": p, "targets": n, "pareto": 0} for s, p, n in points]
    assert [row["pareto"] for row in frontier.mark_pareto(rows, 2)] == [1, 1, 0, 0, 1, 0]


def test_weights_tell_their_system(places):
    assert open_weights(places / "tiny.safetensors").name == "zest"
    assert open_weights(places / "geometry.safetensors", system="zest-geometry").name == "zest-geometry"
    for preset in RECIPES.values():
        assert [ablated_name(change(preset.system)) for change in ABLATED.values()] == list(ABLATED)


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


def test_frames_are_those_of_the_last_run_and_what_no_record_names_stays(places, grey):
    out = places / "out/again"
    (out / "frames").mkdir(parents=True)
    (out / "frames/of_mine.png").write_text("mine")
    for count in (5, 2):
        assert run(places, "render", "--frames", str(count), "--quiet", "--out", str(out)) == 0
        names = {path.name for path in (out / "frames").iterdir()}
        assert names == {"of_mine.png", *(f"{i:05d}.png" for i in range(count))}
    for targets in ("1,4", "4"):
        assert run(places, "evaluate", "--quiet", "--targets", targets, "--out", str(places / "out/twice")) == 0
    assert [path.name for path in (places / "out/twice/pictures").iterdir()] == ["00004_cam02.png"]


def test_an_interrupted_render_keeps_its_frames_and_the_next_run_removes_them(places, grey, monkeypatch, capsys):
    shown, asked = novel_view.render_view, []

    def stopping(*arguments, **options):
        asked.append(1)
        if len(asked) == 4:
            raise KeyboardInterrupt
        return shown(*arguments, **options)

    out = places / "out/stopped"
    with monkeypatch.context() as patch:
        patch.setattr(novel_view, "render_view", stopping)
        assert run(places, "render", "--frames", "6", "--quiet", "--out", str(out)) == 1
    assert capsys.readouterr().err == "error: interrupted\n"
    assert len(list((out / "frames").iterdir())) == 3
    assert run(places, "render", "--frames", "2", "--quiet", "--out", str(out)) == 0
    assert len(list((out / "frames").iterdir())) == 2


def test_names_are_printed_whatever_letters_they_have(places, grey, tmp_path):
    latin = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9:1")
    flags = ["--weights", str(places / "tiny.safetensors"), "--frames", "2", "--path", "frames"]
    ascii_out = io.TextIOWrapper(io.BytesIO(), "ascii")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdout", ascii_out)
        assert main(["render", "--scene", str(places / "scene"), *flags, "--out", latin]) == 0
    ascii_out.seek(0)
    assert ascii_out.read().rstrip().endswith("/caf\\udce9:1/video.webm")
    assert read_video(f"{latin}/video.webm").shape == (2, HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("command", ["evaluate", "render", "finetune", "frontier", "train", "simulate"])
def test_a_place_that_cannot_be_written_to_is_refused_before_the_work(command, places, capsys, tmp_path):
    (tmp_path / "file").write_text("x")
    flags = {"train": [], "simulate": ["--scene", "walker"]}.get(command, ["--scene", str(places / "scene")])
    for out in ("file", "file/under"):
        refused(
            capsys, main([command, *flags, "--out", str(tmp_path / out)]), out, "a file lies where", "another place"
        )
    assert (tmp_path / "file").read_text() == "x"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that takes no files, even from root")
@pytest.mark.parametrize("command", ["train", "render", "import-mvsnerf"])
def test_a_place_that_takes_no_files_is_found_before_the_work(command, places, capsys, monkeypatch):
    def work(options):
        raise AssertionError("it began")

    monkeypatch.setattr(f"zestjax.apps.commands._run_{command.replace('-', '_')}", work)
    flags = {"render": ["--scene", str(places / "scene")], "import-mvsnerf": ["x.tar"]}.get(command, [])
    refused(capsys, main([command, *flags, "--out", "/proc/zestjax"]), "/proc")


def test_an_imported_file_is_not_a_folder(capsys, tmp_path):
    refused(capsys, main(["import-mvsnerf", "x.tar", "--out", str(tmp_path)]), "is a folder", "give the file")


@pytest.mark.parametrize(
    "error, code, words",
    [
        (MemoryError(), 2, "MemoryError: the input is too large"),
        (RecursionError("too deep"), 2, "too deep: the input is"),
        (ProducerError("it was ended by SIGKILL"), 1, "ended by SIGKILL"),
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED:\nno memory"), 1, "RESOURCE_EXHAUSTED: no memory"),
        (OSError(30, "Read-only file system", "d/f"), 2, "d/f: Read-only file system; choose a place that can be"),
    ],
)
def test_every_expected_error_is_one_line(error, code, words, monkeypatch, capsys):
    def fail(options):
        raise error

    monkeypatch.setattr("zestjax.apps.commands._run_doctor", fail)
    assert main(["doctor"]) == code
    said = capsys.readouterr().err
    assert words in said and said.startswith("error: ") and said.count("\n") == 1


def test_an_interrupted_run_prints_the_whole_command_that_goes_on(monkeypatch, capsys):
    from zestjax.apps import finetune

    stopped = SimpleNamespace(line="finetune: 3 steps", result=SimpleNamespace(finished=False))
    monkeypatch.setattr(finetune, "finetune", lambda options: stopped)
    given = ["finetune", "--scene", "a scene", "--out", "out", "--size", "32x48"]
    for command in (given, [*given, "--resume"]):
        assert main(command) == 1
        expected = "finetune: 3 steps; go on with: zestjax finetune --scene 'a scene' --out out --size 32x48 --resume\n"
        assert capsys.readouterr().out == expected


@pytest.mark.parametrize("started", [True, False])
def test_weights_are_float32_whatever_jax_was_started_with(places, started):
    with jax.enable_x64(started):
        model = open_weights(places / "tiny.safetensors")
        with arithmetic("float64"):
            assert jnp.result_type(float) == jnp.float64
        with arithmetic():
            state, _ = fresh(TINY, TrainOptions(places / "unused", preset="tiny"))
    for tree in (model.params, state.params):
        assert {leaf.dtype for leaf in jax.tree.leaves(tree)} == {jnp.dtype("float32")}


def test_two_evaluations_in_one_process_may_differ_in_precision(places, grey):
    for flags in (["--precision", "float64"], [], ["--precision", "bfloat16"]):
        with jax.numpy_dtype_promotion("standard"):  # as users have it: 64-bit JAX counts in int64
            assert run(places, "evaluate", "--quiet", "--no-pictures", *flags) == 0
        assert jnp.result_type(float) == jnp.float32


def test_without_a_home_the_cache_is_a_private_temporary_folder(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "t"))
    (tmp_path / "t").mkdir()
    (tmp_path / "home").write_text("no folder")

    def no_home():
        raise RuntimeError("Could not determine home directory.")

    for home in (no_home, lambda: tmp_path / "home"):
        cache._private_folder.cache_clear()
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setattr("pathlib.Path.home", home)
        folder = cache.cache_folder()
        assert folder == tmp_path / f"t/zestjax-{os.getuid()}" and folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    cache._private_folder.cache_clear()
    assert cache.cache_folder() != folder
    cache._private_folder.cache_clear()
    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path)
    assert cache.cache_folder() == tmp_path / ".cache/zestjax"
