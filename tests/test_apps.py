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
from zestjax.io.reading import FileWarning
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


def test_a_fixed_camera_stands_still_while_time_runs_once(video):
    path = paths.camera_path("fixed", video)
    np.testing.assert_array_equal(path.times, np.arange(12))
    assert np.ptp(path.cameras.camera_from_world, axis=0).max() < 1e-6


def test_a_stabilised_path_is_the_videos_own_without_its_jumps(video):
    path = paths.camera_path("stabilised", video)
    np.testing.assert_array_equal(path.times, np.arange(12))
    x, own = path.cameras.camera_from_world[:, 0, 3], video.cameras.camera_from_world[:, 0, 3]
    assert np.abs(np.diff(x)).max() < 0.2 * np.abs(np.diff(own)).max()
    assert own.min() < x.min() and x.max() < own.max()


def test_space_time_runs_circles_while_time_stands_and_runs_on(video):
    path = paths.camera_path("space-time", video)
    places = np.asarray(rigid_inverse(path.cameras.camera_from_world))[:, :3, 3]
    assert len(path.times) == 36 and path.times[0] == 0 and path.times[-1] == 11
    assert (path.times[12:24] == 6).all() and np.ptp(places[12:24, 1]) > 0.02
    assert (np.diff(path.times) >= 0).all() and np.ptp(places[:12, 1]) < 1e-6 and np.ptp(places[24:, 1]) < 1e-6


def test_a_dolly_zoom_comes_nearer_and_the_middle_depth_keeps_its_size(video):
    path = paths.camera_path("dolly", video)
    depth = 2 / (1 / 2 + 1 / 8)
    places = np.asarray(rigid_inverse(path.cameras.camera_from_world))[:, :3, 3]
    assert places[0, 2] < 1e-6 and np.ptp(places[:, 2]) == pytest.approx(paths.CLOSER * depth, rel=1e-3)
    at = lambda z: np.array([[places[0, 0] + x, 0, z] for x in (-0.1, 0.1)], np.float32)
    size = lambda i, z: np.ptp(
        project(Camera(*(jnp.asarray(leaf[i]) for leaf in path.cameras)), jnp.asarray(at(z))).pixels[:, 0]
    )
    np.testing.assert_allclose(size(12, depth), size(0, depth), rtol=1e-4)
    assert size(12, 8) < 0.95 * size(0, 8)


def studio_file(tmp_path, video, *, transform=None, scale=1.0, **more):
    """nerfstudio's file of the video's first three cameras, as its viewer writes it, in its world: the data's, turned
    by `transform` and then scaled."""
    world = np.asarray(rigid_inverse(video.cameras.camera_from_world), np.float64)[:3]
    world = world @ np.diag([1, -1, -1, 1])  # OpenGL's axes
    if transform is not None:
        world = np.concatenate([transform, [[0, 0, 0, 1]]]) @ world
        world[:, :3, 3] *= scale
        told = {"transform": transform.tolist(), "scale": scale}
        (tmp_path / "dataparser_transforms.json").write_text(json.dumps(told))
    fov = float(np.degrees(2 * np.arctan(12 / 40)))  # 24 rows, focal length 40
    poses = [{"camera_to_world": pose.ravel().tolist(), "fov": fov, "aspect": 4 / 3} for pose in world]
    for i, pose in enumerate(poses):
        pose.update({name: value[i] for name, value in more.items()})
    told = {"camera_type": "perspective", "render_height": 24, "render_width": 32, "fps": 24, "seconds": 4}
    (tmp_path / "camera_path.json").write_text(json.dumps(told | {"camera_path": poses, "keyframes": []}))
    return str(tmp_path / "camera_path.json")


def test_a_path_of_nerfstudio_is_read_in_the_scenes_own_world(tmp_path, video):
    turn = np.array([[0, 0, 1, 0.3], [1, 0, 0, -0.2], [0, 1, 0, 0.7]])
    read = paths.camera_path(studio_file(tmp_path, video, transform=turn, scale=0.37), video)
    np.testing.assert_allclose(read.cameras.camera_from_world, video.cameras.camera_from_world[:3], atol=1e-5)
    np.testing.assert_allclose(read.cameras.intrinsics, video.cameras.intrinsics[:3], rtol=1e-5)
    np.testing.assert_array_equal(read.times, [0, 4, 8])


def test_a_path_of_nerfstudio_without_its_world_says_what_it_is_taken_for(tmp_path, video):
    file = studio_file(tmp_path, video, render_time=[0.0, 0.5, 1.0])
    with pytest.warns(FileWarning, match="taken to be in the scene's own"):
        read = paths.camera_path(file, video)
    np.testing.assert_allclose(read.cameras.camera_from_world, video.cameras.camera_from_world[:3], atol=1e-5)
    np.testing.assert_array_equal(read.times, [0, 6, 11])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"fov": [50, 200, 50]}, "between 0 and 180"), ({"fov": [50, "wide", 50]}, "fov"),
        ({"camera_to_world": [[1.0] * 12] * 3}, "16 numbers"), ({"render_time": [0, 1, 2]}, "0 to 1"),
        ({"camera_to_world": [[0.0] * 16] * 3}, "camera_path.json"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::zestjax.io.reading.FileWarning")
def test_a_bad_path_of_nerfstudio_is_one_error_that_names_the_file(tmp_path, video, more, message):
    with pytest.raises(ValueError, match=message) as caught:
        paths.camera_path(studio_file(tmp_path, video, **more), video)
    assert "camera_path.json: " in str(caught.value)


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
