"""Scores as dicts, tables, camera paths, and where a run's batches come from."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage

from zestjax.apps import paths, scoring, stereo, tables, train
from zestjax.cameras import Camera, project, rigid_inverse, unproject
from zestjax.frames.known import known_frames
from zestjax.video import Video


def test_the_stereo_pair_agrees_with_its_calibration():
    scene = stereo.stereo_scene(72, 128)
    rows, columns = (x.ravel()[::97] for x in np.nonzero(np.isfinite(scene.depth)))
    left, right = (jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i]), scene.video.cameras) for i in (0, 1))
    pixels = jnp.asarray(np.stack([columns, rows], -1), jnp.float32)
    landed = project(right, unproject(left, pixels, jnp.asarray(scene.depth[rows, columns])))
    np.testing.assert_allclose(landed.pixels[:, 1], rows, atol=1e-3)
    u = np.round(np.asarray(landed.pixels[:, 0])).astype(int)
    inside = (u >= 0) & (u < 128)
    error = np.abs(scene.video.images[0][rows, columns] - scene.video.images[1][rows, np.clip(u, 0, 127)]).mean(-1)
    assert np.median(error[inside]) < 0.04
    assert 0.5 < scene.middle_known.mean() < 1 and float(scene.video.near) < float(scene.video.far)


def image(seed, height=24, width=32):
    return np.random.default_rng(seed).random((height, width, 3), np.float32)


def test_regions_are_scored_by_their_own_pixels():
    truth, dynamic = image(0), np.zeros((24, 32), bool)
    dynamic[:, :16] = True
    wrong = truth.copy()
    wrong[:, :16] = np.clip(truth[:, :16] - 0.1, 0, 1)
    scores = scoring.score_image(wrong, truth, dynamic)
    error = np.mean((wrong - truth)[:, :16] ** 2)
    assert scores["dynamic"]["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
    assert scores["static"]["psnr"] == 100 and scores["full"]["lpips"] is None
    assert scores["full"]["psnr"] == pytest.approx(-10 * np.log10(error / 2), abs=1e-3)


def test_a_region_of_a_few_pixels_has_no_score():
    dynamic = np.zeros((24, 32), bool)
    dynamic[0, :3] = True
    scores = scoring.score_image(image(0), image(1), dynamic)
    assert scores["dynamic"] is None and scores["static"] is not None
    assert scoring.score_image(image(0), image(1))["static"] is None


def test_unknown_depth_and_flow_have_no_score():
    assert scoring.score_depth(np.ones((4, 4)), None) is None and scoring.score_flow(None, np.ones((4, 4, 2))) is None
    assert scoring.score_depth(np.full((4, 4), 1.1), np.ones((4, 4))) == pytest.approx(0.1, abs=1e-5)
    assert scoring.score_flow(np.zeros((4, 4, 2)), np.full((4, 4, 2), np.nan)) is None


def test_means_leave_out_what_a_row_lacks():
    rows = [
        {"full": {"psnr": 20.0}, "depth": None},
        {"full": {"psnr": 22.0}, "depth": 0.5},
        {"full": None, "depth": None},
    ]
    assert scoring.mean_scores(rows) == {"full": {"psnr": 21.0}, "depth": 0.5}
    assert scoring.mean_scores([None, None]) is None


def report(psnr):
    region = lambda value: {"full": {"psnr": value, "ssim": 0.5, "lpips": None}, "dynamic": None, "static": None}
    return {
        "scene": "toy", "system": "zest", "protocol": "held-out", "height": 24, "width": 32, "preset": "tiny",
        "device": "cpu", "weights": "w", "ceiling": region(30.0) | {"unseen": 0.1},
        "mean": {**region(psnr), "depth_abs_rel": None, "flow_epe_px": 1.0, "seconds_per_frame": 0.5},
        "floors": {"nearest_frame": region(10.0), "plane_warp": region(20.0)},
        "targets": [{"time": 0, "file": "a.png"}],
    }  # fmt: skip


def test_the_share_of_the_way_runs_from_the_better_floor_to_the_ceiling():
    row = report(25.0)
    assert scoring.share_of_the_way(row["mean"], row["floors"], row["ceiling"]) == 0.5
    assert scoring.share_of_the_way(row["mean"], row["floors"], None) is None
    assert "full 25.00 dB (+5.00 on the best floor)" in tables.headline(row)


def test_the_table_ends_with_the_mean_and_every_row_has_every_column(tmp_path):
    whole = tables.write_table(tmp_path, [report(24.0), report(26.0)])
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert len(lines) == 5 and len({line.count("|") for line in lines}) == 1
    assert (
        whole["mean"]["full"]["psnr"]
        == 25.0
        == json.loads((tmp_path / "metrics.json").read_text())["mean"]["full"]["psnr"]
    )
    assert whole["targets"][0]["file"] == "toy/a.png"


@pytest.fixture
def video():
    """A rig of four cameras in a row, visited in turn; they look along +z."""
    frames = 12
    intrinsics = np.tile(np.array([[40, 0, 15.5], [0, 40, 11.5], [0, 0, 1]], np.float32), (frames, 1, 1))
    poses = np.tile(np.eye(4, dtype=np.float32), (frames, 1, 1))
    poses[:, 0, 3] = 0.2 * (np.arange(frames) % 4)
    images = np.zeros((frames, 24, 32, 3), np.float32)
    return Video(images, Camera(intrinsics, poses), np.float32(2), np.float32(8))


@pytest.mark.parametrize("name", sorted(paths.PATHS))
def test_a_path_keeps_the_middle_of_the_scene_in_view(name, video):
    path = paths.camera_path(name, video)
    assert path.times.min() >= 0 and path.times.max() < 12
    pose = path.cameras.camera_from_world
    np.testing.assert_allclose(
        pose[:, :3, :3] @ np.swapaxes(pose[:, :3, :3], 1, 2), np.tile(np.eye(3), (len(pose), 1, 1)), atol=1e-5
    )
    middle = np.broadcast_to(np.array([-0.3, 0, 3.2], np.float32), (len(pose), 3))
    landed = project(Camera(*(jnp.asarray(leaf) for leaf in path.cameras)), jnp.asarray(middle))
    inside = (landed.pixels >= 0) & (landed.pixels <= jnp.array([31.0, 23.0])[None])
    assert bool((inside.all(-1) & landed.in_front).all())


def test_time_stands_still_in_a_freeze_and_runs_in_an_orbit(video):
    assert len(set(paths.camera_path("freeze", video).times)) == 1
    orbit = paths.camera_path("orbit", video, count=24)
    assert orbit.times[0] == 0 and orbit.times[-1] == 11 and (np.diff(orbit.times) >= 0).all()
    centres = np.asarray(rigid_inverse(orbit.cameras.camera_from_world))[:, :3, 3]
    assert np.ptp(centres[:, 1]) > 0.02, "the camera circles, though the rig is a line"


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_a_path_can_be_read_from_a_file(tmp_path, suffix, video):
    frames = paths.camera_path("frames", video, count=3)
    stored = {**frames.cameras._asdict(), "times": frames.times}
    file = tmp_path / f"path{suffix}"
    if suffix == ".npz":
        np.savez(file, **stored)
    else:
        file.write_text(json.dumps({name: np.asarray(value).tolist() for name, value in stored.items()}))
    read = paths.camera_path(str(file), video)
    np.testing.assert_array_equal(read.times, frames.times)
    np.testing.assert_allclose(read.cameras.camera_from_world, frames.cameras.camera_from_world)


def test_a_bad_path_says_what_it_should_be(tmp_path, video):
    with pytest.raises(ValueError, match="orbit"):
        paths.camera_path("loop", video)
    (tmp_path / "path.json").write_text("{}")
    with pytest.raises(ValueError, match="should hold"):
        paths.camera_path(str(tmp_path / "path.json"), video)
    frames = paths.camera_path("frames", video)
    np.savez(tmp_path / "late.npz", **frames.cameras._asdict(), times=frames.times + 5)
    with pytest.raises(ValueError, match="0 to 11"):
        paths.camera_path(str(tmp_path / "late.npz"), video)


def test_scenes_are_learned_from_in_turn_each_from_its_own_frames():
    dark = stage.video()._replace(images=0.5 * stage.video().images)
    shown = {"light": known_frames(stage.video()), "dark": known_frames(dark)}
    options = train.TrainOptions(Path("unused"), scenes=("light", "dark"))
    with train.batches(stage.recipe_of(stage.MINI), options, tuple(shown.values())) as batch_at:
        found = [batch_at(step) for step in range(4)]
    brightest = [float(np.max(batch.inputs.key.images)) for batch in found]
    assert max(brightest[1::2]) <= 0.5 < min(brightest[::2])
    for batch in found:
        assert int(batch.inputs.time) not in batch.inputs.key.times[batch.inputs.key.valid > 0]
        assert batch.truth.depth is None and batch.truth.flow is None


@pytest.mark.parametrize("change, words", [
    ({"scenes": ("a",), "stage": "frames"}, "exact answers"),
    ({"preset": "paper", "stage": "frames"}, "drop --stage"),
    ({"stage": "rays"}, "`stage` is 'rays'"),
])  # fmt: skip
def test_stages_that_cannot_be_are_refused(change, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        train.train(train.TrainOptions(tmp_path / "t", **change))
    assert not (tmp_path / "t").exists()
