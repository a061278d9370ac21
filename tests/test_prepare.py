"""`zestjax prepare`: what it writes, that it goes on where it was, and what it refuses."""

import json
import shutil

import numpy as np
import pytest
from planes import path, pictures, texture

from zestjax.apps import prepare as prepare_module
from zestjax.apps.cli import main
from zestjax.apps.prepare import PrepareOptions, prepare
from zestjax.apps.prepare_maps import Maps
from zestjax.apps.quality import doubts_of
from zestjax.io.pictures import write_image
from zestjax.io.scenes import load_scene
from zestjax.io.video import video_frames, write_video
from zestjax.sfm.estimate import Estimated
from zestjax.sfm.gauge import pose_errors

COUNT = 8


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A folder of pictures."""
    folder = tmp_path_factory.mktemp("source")
    for i, image in enumerate(pictures(path(COUNT))):
        write_image(folder / f"shot_{i}.png", image)
    return folder


@pytest.fixture
def known(monkeypatch):
    """The cameras need not be found."""
    seen = lambda count, value: np.full(count, value)

    def cameras(images, *, avoid, focal, start, free_focal, seed, watch):
        count = len(images)
        return Estimated(
            "moving", path(COUNT)[:count], np.ones(count, bool), focal or 120.0, None if focal else 0.01, 1.0, 8.0,
            seen(count, 500), seen(count, 200), seen(count, 0.1), 1000, 9.0, 0.1, 0.1,
        )  # fmt: skip

    monkeypatch.setattr(prepare_module, "estimate_cameras", cameras)


@pytest.fixture
def quick(monkeypatch):
    """Nothing is found to move, and no network runs; the calls are counted."""
    calls = []

    def maps(video, cameras, flows):
        calls.append(len(video.images))
        shape = video.images.shape[:3]
        return Maps(np.zeros(shape, bool), np.ones(shape, np.float32) if cameras.kind == "moving" else None)

    monkeypatch.setattr(prepare_module, "frame_maps", maps)
    return calls


def left_in(out):
    return sorted(path.name for path in out.iterdir()) if out.exists() else None


@pytest.mark.slow
def test_the_whole_way_tells_depth_too(source, tmp_path):
    """With the shipped weights' analysis of the frames."""
    prepare(PrepareOptions(source, tmp_path / "scene", quiet=True))
    quality = json.loads((tmp_path / "scene/quality.json").read_text())
    assert max(quality["moving_share"]) < 0.2
    disparity = np.load(tmp_path / "scene/disp/00004.npy")
    nearer = disparity[40:60, 85:105].mean() / disparity[:15].mean()  # the plane at 3 and the one at 6
    assert 1.4 < nearer < 2.6


def test_a_folder_becomes_a_scene_that_opens(source, tmp_path, quick):
    line = prepare(PrepareOptions(source, tmp_path / "scene", quiet=True))
    assert line.startswith(f"prepare: {COUNT} frames of 96x128, camera moving")
    scene = load_scene(tmp_path / "scene", height=96, protocol="strict")
    poses = np.linalg.inv(np.asarray(scene.video.cameras.camera_from_world, np.float64))
    error = pose_errors(poses, path(COUNT))
    assert error.degrees.mean() < 0.3 and error.share.mean() < 0.02
    assert left_in(tmp_path / "scene") == [
        "disp", "flow_i1", "images", "motion_masks", "poses_bounds.npy", "quality.html", "quality.json", "scene.json",
    ]  # fmt: skip
    quality = json.loads((tmp_path / "scene/quality.json").read_text())
    assert quality["frames"] == {
        "found": COUNT, "repeated": 0, "chosen": COUNT, "registered": COUNT, "unregistered": [],
        "sources": [f"shot_{i}.png" for i in range(COUNT)],
    }  # fmt: skip
    assert quality["camera"] == "moving" and quick == [COUNT, COUNT]
    page = (tmp_path / "scene/quality.html").read_text()
    assert page.count("data:image/png;base64,") == 2 and "http" not in page


@pytest.mark.parametrize("broken", ["estimate_cameras", "flow_between", "frame_maps", "write_nsff", "write_quality"])
def test_what_was_stopped_goes_on_and_ends_the_same(source, tmp_path, monkeypatch, known, quick, broken):
    options = lambda out: PrepareOptions(source, out, quiet=True)
    prepare(options(tmp_path / "whole"))
    calls, real = [], getattr(prepare_module, broken)

    def stopped(*args, **kwargs):
        calls.append(broken)
        if len(calls) == 2 or broken.startswith("write"):
            raise KeyboardInterrupt
        return real(*args, **kwargs)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(prepare_module, broken, stopped)
        prepare(options(tmp_path / "stopped"))
    assert left_in(tmp_path / "stopped") == [".prepare"]
    again, before = [], len(quick)
    monkeypatch.setattr(prepare_module, broken, lambda *a, **k: again.append(1) or real(*a, **k))
    prepare(options(tmp_path / "stopped"))
    assert len(again) < {"estimate_cameras": 2, "flow_between": COUNT - 1, "frame_maps": 2}.get(broken, 2)
    assert left_in(tmp_path / "stopped") == left_in(tmp_path / "whole")
    assert len(quick) - before == {"estimate_cameras": 1, "flow_between": 2, "frame_maps": 1}.get(broken, 0)
    for file in ("poses_bounds.npy", "quality.json", "images/00003.png"):
        assert (tmp_path / "stopped" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes()


def test_one_that_was_stopped_while_its_scene_appears_goes_on(source, tmp_path, monkeypatch, known, quick):
    out, options = tmp_path / "out", PrepareOptions(source, tmp_path / "out", quiet=True)
    prepare(options)
    whole, moves = left_in(out), []
    rename = type(out).rename

    def stopped(self, target):
        moves.append(target)
        if len(moves) == 11:  # eight of the earlier scene are out of the way, two of this one there
            raise KeyboardInterrupt
        return rename(self, target)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(type(out), "rename", stopped)
        prepare(options)
    assert not (out / "poses_bounds.npy").exists()
    prepare(options)
    assert left_in(out) == whole


def test_another_command_starts_over(source, tmp_path, monkeypatch, known, quick):
    out = tmp_path / "out"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(prepare_module, "write_nsff", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
        prepare(PrepareOptions(source, out, quiet=True))
    line = prepare(PrepareOptions(source, out, frames=5, focal=120.0, quiet=True))
    assert line.startswith("prepare: 5 frames")
    quality = json.loads((out / "quality.json").read_text())
    assert quality["focal"] == {"pixels": 120.0, "given": True, "relative_error": None, "degrees_across": 56.14}


@pytest.mark.filterwarnings("default")
def test_a_video_file_and_a_still_camera(tmp_path, quick, capfd):
    still = np.concatenate([pictures(path(1))] * 5).astype(int)
    still = (still + np.random.default_rng(0).integers(-3, 4, still.shape)).clip(0, 255).astype(np.uint8)
    film = write_video(tmp_path / "film", still)
    assert len(list(video_frames(film))) == 5
    assert main(["prepare", str(film), "--out", str(tmp_path / "scene")]) == 0
    out, err = capfd.readouterr()
    assert "camera still, 2 doubts" in out and "depths are unknown" in err and "the focal length is a guess" in err
    scene = load_scene(tmp_path / "scene", height=96, protocol="strict")
    assert np.ptp(np.asarray(scene.video.cameras.camera_from_world), axis=0).max() == 0
    assert not (tmp_path / "scene/disp").exists()


def refused(capfd, *arguments):
    """The one line that a command is refused with."""
    assert main(["prepare", *map(str, arguments)]) == 2
    out, err = capfd.readouterr()
    lines = [line for line in err.replace("\r", "\n").split("\n") if line.startswith("error:")]
    assert len(lines) == 1 and not out
    return lines[0]


def test_what_is_no_video_is_refused_by_one_line_and_leaves_nothing(source, tmp_path, capfd):
    out = tmp_path / "out"
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "text.mp4").write_text("no video")
    frames = {
        "one": [texture(64, 64)], "equal": [texture(64, 64)] * 3, "black": [np.zeros((64, 64, 3))] * 2,
        "small": [texture(16, 20, s) for s in (0, 1)], "flat": [np.full((64, 64, 3), k) for k in (90, 91, 92)],
        "unlike": [texture(64, 64, s) for s in range(4)], "sizes": [texture(64, 64), texture(64, 66)],
    }  # fmt: skip
    for name, images in frames.items():
        for i, image in enumerate(images):
            write_image(tmp_path / name / f"{i}.png", np.round(image).astype(np.uint8))
    said = {
        tmp_path / "none": "is neither a file nor a folder", empty: "holds no pictures", tmp_path / "text.mp4":
        "is not a video that can be read", tmp_path / "one": "one frame is no video", tmp_path / "equal":
        "3 equal frames are no video", tmp_path / "small": "give frames of 32", tmp_path / "flat": "no texture",
        tmp_path / "unlike": "pairs of frames show the same", tmp_path / "sizes": "1.png: has 64x66 pixels",
        tmp_path / "black": "all its frames are black",
    }  # fmt: skip
    for place, text in said.items():
        line = refused(capfd, place, "--out", out)
        assert text in line and str(place) in line
        assert left_in(out) is None
    assert "--frames 2 or more" in refused(capfd, source, "--out", out, "--frames", 1)
    assert "no field of view" in refused(capfd, source, "--out", out, "--fov", 200)


def test_a_place_of_something_else_is_refused_and_left_alone(source, tmp_path, capfd):
    used = tmp_path / "used"
    used.mkdir()
    (used / "mine.txt").write_text("mine")
    assert "did not write" in refused(capfd, source, "--out", used) and left_in(used) == ["mine.txt"]
    assert "is a file" in refused(capfd, source, "--out", used / "mine.txt").replace("a file lies", "is a file")
    own = tmp_path / "own"
    shutil.copytree(source, own / "images")
    for out in (own / "images", own, own / "images/out"):
        assert "choose another --out" in refused(capfd, own / "images", "--out", out)
    assert len(left_in(own / "images")) == COUNT


def report(**changes):
    sound = {
        "camera": "moving", "frames": {"chosen": 4, "unregistered": []},
        "focal": {"given": False, "relative_error": 0.02},
        "reprojection_px": {"by_frame": [0.2] * 4}, "features": [500] * 4, "observations": [200] * 4,
        "sharpness": [100.0] * 4, "moving_share": [0.1] * 4, "flow_sure_share": [0.9] * 3,
        "median_angle_degrees": 10.0, "drift_px": {"near": 0.2, "far": 0.3},
    }  # fmt: skip
    return sound | changes


@pytest.mark.parametrize("what, changes", [
    ("still camera", {"camera": "still"}), ("no parallax", {"camera": "turning"}),
    ("unregistered", {"frames": {"chosen": 4, "unregistered": [2]}}),
    ("few features", {"features": [500, 9, 500, 500]}),
    ("blurred", {"sharpness": [100.0, 100.0, 5.0, 100.0]}), ("much motion", {"moving_share": [0.1, 0.9, 0.1, 0.1]}),
    ("unsure flow", {"flow_sure_share": [0.9, 0.1, 0.9]}), ("weak frames", {"observations": [200, 20, 200, 200]}),
    ("reprojection error", {"reprojection_px": {"by_frame": [0.2, 3.0, None, 0.2]}}),
    ("little parallax", {"median_angle_degrees": 0.5}), ("drift", {"drift_px": {"near": 0.3, "far": 4.0}}),
    ("focal length", {"focal": {"given": False, "relative_error": 0.3}}),
])  # fmt: skip
def test_each_doubt_is_told_and_a_sound_scene_has_none(what, changes):
    assert doubts_of(report()) == []
    told = doubts_of(report(**changes))
    assert told[0]["what"] == what and all(doubt["advice"] for doubt in told)
