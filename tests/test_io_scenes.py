"""Scenes on disk: what is written comes back, at any size; bad input gets one clear error and leaves nothing behind."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportArgumentType=false, reportCallIssue=false

import errno
import json
import os
import shutil
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.cameras import Camera, look_at, project
from zestjax.frames.inputs import check_inputs, check_target
from zestjax.io.layouts import bounds_from_frames, select
from zestjax.io.nsff import write_nsff
from zestjax.io.pictures import write_image
from zestjax.io.scenes import Target, load_scene
from zestjax.video import Video

N, RIG, HEIGHT, WIDTH = 4, 3, 12, 20
SHARED = Path(__file__).parents[2] / "shared" / "data"


def rig_camera(c):
    intrinsics = np.array([[18, 0, (WIDTH - 1) / 2], [0, 18, (HEIGHT - 1) / 2], [0, 0, 1]], np.float32)
    pose = look_at(jnp.array([0.3 * c, -0.1, 0.0]), jnp.array([0.2, 0.1, 4.0]), up=jnp.array([0.0, -1, 0]))
    return Camera._make((intrinsics, np.asarray(pose)))


def make_video(count=N):
    images = np.random.default_rng(0).integers(0, 256, (count, HEIGHT, WIDTH, 3)) / np.float32(255)
    cameras = Camera._make(map(np.stack, zip(*(rig_camera(i % RIG) for i in range(count)), strict=True)))
    return Video(images.astype(np.float32), cameras, np.float32(1.5), np.float32(9))


def make_targets():
    rng = np.random.default_rng(1)
    for time in range(N):
        for c in range(RIG):
            if c != time % RIG:
                image = rng.integers(0, 256, (HEIGHT, WIDTH, 3)) / np.float32(255)
                depth = rng.random((HEIGHT, WIDTH)).astype(np.float32) + 2
                flow = rng.random((HEIGHT, WIDTH, 2)).astype(np.float32)
                yield Target(time, f"cam{c:02d}", rig_camera(c), image, depth > 2.5, depth=depth, flow=flow)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """(folder, what was written to it)"""
    rng = np.random.default_rng(2)
    known = {
        "motion_masks": rng.random((N, HEIGHT, WIDTH)) > 0.5,
        "disparity": rng.random((N, HEIGHT, WIDTH)).astype(np.float32),
        "flow_forward": (rng.random((N, HEIGHT, WIDTH, 2)).astype(np.float32), rng.random((N, HEIGHT, WIDTH)) > 0.2),
        "flow_backward": (rng.random((N, HEIGHT, WIDTH, 2)).astype(np.float32), rng.random((N, HEIGHT, WIDTH)) > 0.2),
        "truth": [{"depth": rng.random((HEIGHT, WIDTH)).astype(np.float32)} for _ in range(N)],
    }
    folder = tmp_path_factory.mktemp("scenes") / "scene"
    write_nsff(folder, "toy", make_video(), held_out=make_targets(), **known)
    return folder, known


@pytest.fixture
def folder(written, tmp_path):
    """A copy to spoil."""
    return Path(shutil.copytree(written[0], tmp_path / "scene"))


def test_a_written_scene_comes_back(written):
    folder, known = written
    scene, video = load_scene(folder), make_video()
    assert (scene.name, scene.layout) == ("toy", "nsff")
    np.testing.assert_allclose(scene.video.images, video.images, atol=1e-6)
    for read, wrote in zip(scene.video.cameras, video.cameras, strict=True):
        np.testing.assert_allclose(read, wrote, atol=1e-5)
    assert (scene.video.near, scene.video.far) == (1.5, 9)
    np.testing.assert_array_equal(scene.motion_masks, known["motion_masks"])
    np.testing.assert_array_equal(scene.disparity, known["disparity"])
    for flow, (vectors, valid), missing in (
        (scene.flow_forward, known["flow_forward"], N - 1),
        (scene.flow_backward, known["flow_backward"], 0),
    ):
        there = np.arange(N) != missing
        np.testing.assert_array_equal(flow.valid, valid & there[:, None, None])
        np.testing.assert_array_equal(flow.vectors, vectors * flow.valid[..., None])


def test_an_excluded_frame_is_never_read(written, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(written[0], folder)
    (folder / "images/00002.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match="00002.png"):
        load_scene(folder)
    scene, whole = load_scene(folder, exclude=(2,)), load_scene(written[0])
    assert (scene.video.images[2] == 0).all()
    np.testing.assert_array_equal(np.delete(scene.video.images, 2, 0), np.delete(whole.video.images, 2, 0))
    with pytest.raises(ValueError, match="no frame 99 to exclude; the video has 0 to"):
        load_scene(folder, exclude=(99,))


def test_a_scene_is_found_inside_the_folder_given_if_it_is_the_only_one(written, tmp_path):
    (tmp_path / "data").mkdir()
    shutil.copytree(written[0], tmp_path / "data/scene")
    np.testing.assert_array_equal(load_scene(tmp_path).video.images, load_scene(written[0]).video.images)
    shutil.copytree(written[0], tmp_path / "data/again")
    with pytest.raises(ValueError, match=r"several scenes \(data/again, data/scene\); name one"):
        load_scene(tmp_path)


def test_held_out_targets_are_the_other_cameras_with_their_truth(written):
    scene = load_scene(written[0])
    assert len(scene.targets) == N * (RIG - 1)
    for read, wrote in zip(scene.targets, make_targets(), strict=True):
        assert (read.time, read.camera_name, read.exclude) == (wrote.time, wrote.camera_name, ())
        np.testing.assert_allclose(read.image, wrote.image, atol=1e-6)
        np.testing.assert_array_equal(read.dynamic, wrote.dynamic)
        np.testing.assert_array_equal(read.depth, wrote.depth)
        np.testing.assert_array_equal(read.flow, wrote.flow)
        np.testing.assert_allclose(read.camera.camera_from_world, wrote.camera.camera_from_world, atol=1e-6)


def test_strict_targets_exclude_themselves_and_paper_targets_do_not(written):
    strict, paper = (load_scene(written[0], protocol=protocol, targets=[2, 0]) for protocol in ("strict", "paper"))
    assert [(t.time, t.exclude) for t in strict.targets] == [(2, (2,)), (0, (0,))]
    assert [(t.time, t.exclude) for t in paper.targets] == [(2, ()), (0, ())]
    np.testing.assert_array_equal(strict.targets[0].image, strict.video.images[2])
    np.testing.assert_array_equal(strict.targets[0].depth, written[1]["truth"][2]["depth"])


def test_targets_are_chosen_by_time_or_by_time_and_camera(written):
    scene = load_scene(written[0], targets=[3, (1, "cam02")])
    assert [(t.time, t.camera_name) for t in scene.targets] == [(3, "cam01"), (3, "cam02"), (1, "cam02")]
    assert [t.camera_name for t in scene.targets[1:]] == ["cam02", "cam02"]
    with pytest.raises(ValueError, match="no target 4; this protocol has times 0 to 3"):
        load_scene(written[0], targets=[4])


def test_without_truth_files_camera_c_has_the_pose_of_frame_c(folder):
    shutil.rmtree(folder / "truth")
    for time in range(N):  # the rig's own camera is there too, as in the NVIDIA scenes, and is no target
        write_image(folder / f"mv_images/{time:05d}/cam{time % RIG:02d}.png", make_video().images[time])
    scene = load_scene(folder)
    assert [(t.time, t.camera_name) for t in scene.targets] == [(t.time, t.camera_name) for t in make_targets()]
    for target in scene.targets:
        assert target.depth is None
        expected = select(scene.video.cameras, int(target.camera_name[-2:])).camera_from_world
        np.testing.assert_array_equal(target.camera.camera_from_world, expected)


def test_a_resized_scene_shows_the_same_world_at_the_same_place(written):
    full, half = load_scene(written[0]), load_scene(written[0], height=HEIGHT // 2)
    assert half.video.images.shape == (N, HEIGHT // 2, WIDTH // 2, 3)
    blocks = full.video.images.reshape(N, HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((2, 4))
    np.testing.assert_allclose(half.video.images, blocks, atol=1e-5)
    point = jnp.array([0.3, 0.2, 3.0])
    at = [np.asarray(project(select(scene.video.cameras, 1), point).pixels) for scene in (full, half)]
    np.testing.assert_allclose(at[1] + 0.5, (at[0] + 0.5) / 2, atol=1e-5)
    valid = half.flow_forward.valid
    np.testing.assert_allclose(half.flow_forward.vectors[valid] * 2, full.flow_forward.vectors[:, 1::2, 1::2][valid])
    np.testing.assert_array_equal(half.motion_masks, full.motion_masks[:, 1::2, 1::2])
    wide = load_scene(written[0], height=6, width=20, targets=[1])
    np.testing.assert_allclose(wide.video.cameras.intrinsics[0], [[18, 0, 9.5], [0, 9, 2.5], [0, 0, 1]], atol=1e-5)
    assert wide.targets[0].depth.shape == (6, 20)


def test_a_scene_may_lie_in_dense_and_its_pictures_in_a_sized_folder(folder, tmp_path):
    shutil.move(folder, tmp_path / "kid" / "dense")
    dense = tmp_path / "kid" / "dense"
    (dense / "scene.json").unlink()
    (dense / "images").rename(dense / "images_20x12")
    (dense / "images_20x12" / "notes.txt").write_text("not a picture")
    scene = load_scene(tmp_path / "kid", protocol="strict")
    assert scene.name == "kid" and len(scene.video.images) == N
    assert float(scene.video.near) == pytest.approx(0.9 * 1.5) and float(scene.video.far) == pytest.approx(10)


def test_bounds_ignore_stray_points():
    bounds = np.array([[0.002, 0.9]] + [[1.0, 5.0]] * 40 + [[1.0, 90.0]])
    assert bounds_from_frames(bounds) == pytest.approx((0.9, 5 / 0.9))
    for bad in ([[2.0, 1.0]], [[np.nan, 1.0]], [1.0, 2.0]):
        with pytest.raises(ValueError, match="bounds_from_frames"):
            bounds_from_frames(bad)


def make_nrnerf(folder, numbers):
    """A folder with four poses and pictures of these numbers, each as bright as its number."""
    poses = np.zeros((N, 3, 5))
    poses[:, :, :3] = np.eye(3)
    poses[:, 0, 3], poses[:, :, 4] = 0.1 * np.arange(N), [HEIGHT, WIDTH, 18.0]
    (folder / "images").mkdir()
    for number in numbers:
        write_image(folder / f"images/image{number:06d}.png", np.full((HEIGHT, WIDTH, 3), number / 255, np.float32))
    (folder / "precomputed.json").write_text(json.dumps({"poses": poses.tolist(), "bds": [[1.0, 5.0]] * N}))


@pytest.mark.parametrize(
    ("numbers", "kept"),
    [
        ((1, 2, 3, 4), (1, 2, 3, 4)),
        ((11, 12, 13, 14), (11, 12, 13, 14)),
        ((0, 1, 3), (0, 1, 3)),
        ((1, 3, 4, 9, 10), (1, 3, 4)),
    ],
)
def test_pictures_find_their_poses_by_number(tmp_path, numbers, kept):
    make_nrnerf(tmp_path, numbers)
    scene = load_scene(tmp_path, protocol="strict")
    assert [round(float(image.mean() * 255)) for image in scene.video.images] == list(kept)
    first = numbers[0] if len(numbers) == N else min(1, numbers[0])
    position = [-0.1 * (number - first) for number in kept]
    np.testing.assert_allclose(scene.video.cameras.camera_from_world[:, 0, 3], position, atol=1e-6)


def test_a_video_of_one_camera_has_no_held_out_targets(tmp_path):
    make_nrnerf(tmp_path, (1, 2, 3, 4))
    with pytest.raises(ValueError, match="no pictures of other cameras.*use `strict`"):
        load_scene(tmp_path)


def test_the_real_handheld_clip_is_read():
    clip = SHARED / "nrnerf_example" / "data" / "example_sequence"
    if not clip.is_dir():
        pytest.skip("the nrnerf_example clip is not on this machine")
    scene = load_scene(clip, height=48, protocol="strict", targets=[40])
    assert scene.video.images.shape == (86, 48, 64, 3) and scene.layout == "nrnerf"
    assert 20 < float(scene.video.far / scene.video.near) < 30
    check_target("test", scene.video, scene.targets[0].camera)


BAD_VIDEOS = {
    "frames that disagree with cameras": (lambda v: v._replace(images=v.images[:3]), "axis N"),
    "one frame": (lambda v: Video(v.images[:1], select(v.cameras, [0]), v.near, v.far), "expected at least 2"),
    "near beyond far": (lambda v: v._replace(near=v.far), "near < far"),
    "a colour that is NaN": (lambda v: v._replace(images=np.where(v.images > 0.99, np.nan, v.images)), r"\[0, 1\]"),
    "singular intrinsics": (
        lambda v: v._replace(cameras=v.cameras._replace(intrinsics=v.cameras.intrinsics * 0)),
        "singular",
    ),
    "a camera turned away": (
        lambda v: v._replace(cameras=v.cameras._replace(camera_from_world=turned_away(v.cameras.camera_from_world))),
        "camera 2 sees nothing",
    ),
}


def turned_away(poses):
    poses = np.array(poses)
    poses[2, [0, 2]] *= -1
    return poses


@pytest.mark.parametrize("fault", BAD_VIDEOS)
def test_a_bad_video_is_refused_with_its_cause(fault):
    spoil, message = BAD_VIDEOS[fault]
    with pytest.raises(ValueError, match=message) as caught:
        check_inputs("here", spoil(make_video()))
    assert str(caught.value).startswith("here: ")


def test_a_good_video_passes_and_a_blind_target_does_not():
    video = make_video()
    check_inputs("here", video)
    check_target("here", video, select(video.cameras, 0))
    away = Camera(video.cameras.intrinsics[2], turned_away(video.cameras.camera_from_world)[2])
    with pytest.raises(ValueError, match="here: the target camera .* sees nothing"):
        check_target("here", video, away)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "images/00001.png").unlink(), "has 4 poses for 3 pictures"),
        (lambda f: (f / "images/00001.png").write_bytes(b"\x89PNG"), "00001.png: is not a picture"),
        (lambda f: (f / "poses_bounds.npy").write_bytes(b"?"), "is not a numpy file"),
        (lambda f: np.save(f / "poses_bounds.npy", np.zeros((4, 15))), r"finite \(N, 17\)"),
        (lambda f: (f / "motion_masks/00000.png").unlink(), "has 3 files for 4 frames"),
        (lambda f: (f / "flow_i1/00000_fwd.npz").write_bytes(b""), "00000_fwd.npz: is not a numpy file"),
        (lambda f: shutil.rmtree(f / "images"), "in none of the supported layouts"),
        (shutil.rmtree, "is not a folder"),
    ],
)
def test_a_damaged_scene_is_refused_by_the_file_at_fault(folder, spoil, message):
    spoil(folder)
    with pytest.raises(ValueError, match=message) as caught:
        load_scene(folder)
    assert str(folder) in str(caught.value)


def test_options_are_checked(written, tmp_path):
    with pytest.raises(ValueError, match="`protocol` is 'fair'"):
        load_scene(written[0], protocol="fair")
    with pytest.raises(ValueError, match="`layout` is 'blender'"):
        load_scene(written[0], layout="blender")
    (tmp_path / "precomputed.json").write_text("{}")
    with pytest.raises(ValueError, match="should hold `poses`"):
        load_scene(tmp_path)


def test_a_full_disk_keeps_the_earlier_scene_and_leaves_nothing_else(folder, monkeypatch):
    def refuse(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", refuse)
    before = sorted(p.relative_to(folder) for p in folder.rglob("*"))
    with pytest.raises(OSError, match="No space left on device; free some space.*scene"):
        write_nsff(folder, "next", make_video())
    assert sorted(p.relative_to(folder) for p in folder.rglob("*")) == before
    assert os.listdir(folder.parent) == ["scene"]


def test_cameras_that_the_layout_cannot_hold_are_refused(tmp_path):
    video = make_video()
    video.cameras.intrinsics[1, 0, 2] += 3
    with pytest.raises(ValueError, match="camera 1 is another"):
        write_nsff(tmp_path / "scene", "off", video)
    assert not os.listdir(tmp_path)


def photographs(folder, count, name="images_8"):
    rng = np.random.default_rng(2)
    for i in range(count):
        write_image(folder / name / f"{i:03d}.png", rng.uniform(size=(12, 16, 3)).astype(np.float32))


def test_llff_keeps_every_eighth_photograph_from_the_inputs(tmp_path):
    photographs(tmp_path, 9)
    pose = np.array([[0, 1, 0, 0, 12], [1, 0, 0, 0, 16], [0, 0, -1, 0, 20]], float)
    np.save(tmp_path / "poses_bounds.npy", np.tile(np.concatenate([pose.reshape(-1), [1, 5]]), (9, 1)))
    scene = load_scene(tmp_path)
    assert scene.layout == "llff" and [t.time for t in scene.targets] == [0, 8]
    assert all(t.exclude == (0, 8) and t.image.shape == (12, 16, 3) for t in scene.targets)
    assert len(load_scene(tmp_path, protocol="strict").targets) == 9
    (tmp_path / "mv_images").mkdir()
    assert load_scene(tmp_path, protocol="strict").layout == "nsff"


def test_idr_cameras_are_those_its_matrices_were_made_of(tmp_path):
    photographs(tmp_path, 3, "image")
    k, pose = np.array([[20, 0.1, 8], [0, 21, 6], [0, 0, 1]]), np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]
    pose[:3, 3] = [0.5, -0.2, 7]
    world, sphere = np.eye(4), np.diag([2.0, 2, 2, 1])
    world[:3] = k @ pose[:3] * 3
    arrays = {f"world_mat_{i}": world for i in range(3)} | {f"scale_mat_{i}": sphere for i in range(3)}
    np.savez(tmp_path / "cameras_sphere.npz", **arrays)
    scene = load_scene(tmp_path)
    assert scene.layout == "idr" and [t.time for t in scene.targets] == [0]
    np.testing.assert_allclose(scene.video.cameras.intrinsics[1], k, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(scene.video.cameras.camera_from_world[1], pose, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose([scene.video.near, scene.video.far], [5, 9], rtol=1e-5)
    del arrays["world_mat_2"]
    np.savez(tmp_path / "cameras_sphere.npz", **arrays)
    with pytest.raises(ValueError, match="cameras_sphere.npz: should hold world_mat_i and scale_mat_i of 3 pictures"):
        load_scene(tmp_path)


@pytest.mark.parametrize("folder, layout, size", [("llff_fern/fern", "llff", 20), ("dtu_idr/dtu_scan24", "idr", 49)])
def test_real_photographs_load(folder, layout, size):
    path = Path(__file__).parents[2] / "shared" / "data" / folder
    if not path.exists():
        pytest.skip(f"needs shared/data/{folder} beside the repository")
    scene = load_scene(path, height=24)
    assert scene.layout == layout and scene.video.images.shape == (size, 24, 32, 3)
    assert 0 < scene.video.near < scene.video.far and len(scene.targets) in (3, 4)
