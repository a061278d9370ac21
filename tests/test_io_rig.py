"""Held-out pictures as others publish them: twelve cameras at each time, numbered from 1, and no word on their poses.

The folders are made by hand, by LLFF's convention as its authors state it, and not by zestjax's writer.
"""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from zestjax.io.nsff import read_nsff
from zestjax.io.scenes import load_scene

RIG, HEIGHT, WIDTH, FOCAL = 12, 24, 32, 30.0
ANY = lambda time, camera: True
NAMES = [f"cam{camera + 1:02d}" for camera in range(RIG)]
SERIAL = [f"cam_{number}" for number in (7, 19, 20, 118, 119, 204, 311, 2041, 2042, 30001, 30007, 30019)]


def pose(camera):
    """(4, 4) world from camera, with x right, y down, z forward; every camera of the rig stands and looks elsewhere."""
    angle = 0.02 * camera
    world = np.eye(4)
    world[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    world[:3, 3] = [0.3 * camera, -0.1 * camera % 0.4, 0.05 * camera]
    return world


def row(camera):
    """A row of poses_bounds.npy: columns down, right, backwards, position, (height, width, focal); near and far."""
    right, down, forward, position = pose(camera)[:3].T
    return np.concatenate([np.stack([down, right, -forward, position, [HEIGHT, WIDTH, FOCAL]], 1).ravel(), [1, 9]])


@cache
def texture(*seed):
    coarse = np.random.default_rng(seed).uniform(0, 255, (6, 8, 3))
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


@cache
def photograph(time, camera, *, alike=0.0):
    """What a camera sees: its own view, and a part that moves. With `alike` towards 1 the views are nearly the same."""
    picture = (1 - alike) * texture(1, camera) + alike * texture(2)
    picture[8:16, 8:16] = texture(3, time)[:8, :8]
    return np.clip(picture, 0, 255).round().astype(np.uint8)


def publish(
    folder, *, names=NAMES, frames=24, there=ANY, suffix=".png", shrink=1, alike=0.0, shows=lambda time, camera: camera
):
    """Write a scene. names: of the rig's cameras. there: which pictures. shows: whose picture stands under a name."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, 80] if suffix == ".jpg" else []
    (folder / "images").mkdir(parents=True)
    np.save(folder / "poses_bounds.npy", [row(time % RIG) for time in range(frames)])
    for time in range(frames):
        cv2.imwrite(str(folder / f"images/{time:05d}.png"), photograph(time, time % RIG, alike=alike))
        (folder / f"mv_images/{time:05d}").mkdir(parents=True)
        for camera in (camera for camera in range(RIG) if there(time, camera)):
            picture = photograph(time, shows(time, camera), alike=alike)
            picture = cv2.resize(picture, (WIDTH // shrink, HEIGHT // shrink), interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / f"mv_images/{time:05d}/{names[camera]}{suffix}"), picture, quality)
    return folder


def own_missing(time, camera):
    return camera != time % RIG


def assert_right(folder, *, names=NAMES, frames=24, there=ANY):
    """Every picture there but the frames' own is a target, with the pose of the camera that took it."""
    found = {(entry.time, entry.camera_name): entry for entry in read_nsff(folder).held_out}
    cameras = range(min(RIG, frames))
    wanted = {(t, names[c]): c for t in range(frames) for c in cameras if c != t % RIG and there(t, c)}
    assert found.keys() == wanted.keys()
    for name, camera in wanted.items():
        assert found[name].image.stem == name[1] and found[name].image.parent.name == f"{name[0]:05d}"
        np.testing.assert_allclose(found[name].camera.camera_from_world, np.linalg.inv(pose(camera)), atol=1e-5)
    return len(found)


@pytest.mark.parametrize(
    "names",
    [
        NAMES,
        [f"cam{camera:02d}" for camera in range(RIG)],
        [f"camera-{3 * camera + 5}" for camera in range(RIG)],
        SERIAL,
        [f"2019_cam{camera + 1}_undistorted" for camera in range(RIG)],
    ],
    ids=["from 1", "from 0", "every third", "serial numbers", "other words and no zeros"],
)
def test_cameras_keep_their_order_whatever_their_numbers(tmp_path, names):
    assert assert_right(publish(tmp_path / "scene", names=names), names=names) == 264


@pytest.mark.parametrize("options", [{"suffix": ".jpg"}, {"shrink": 2}, {"suffix": ".jpg", "shrink": 2}], ids=str)
def test_pictures_may_be_compressed_again_and_smaller(tmp_path, options):
    assert assert_right(publish(tmp_path / "scene", **options)) == 264


@pytest.mark.parametrize("frames, targets", [(25, 275), (13, 143), (7, 42)])
def test_the_video_need_not_show_whole_turns_of_the_rig(tmp_path, frames, targets):
    """A camera that took no frame has no pose, so that its pictures are no targets."""
    assert assert_right(publish(tmp_path / "scene", frames=frames), frames=frames) == targets


@pytest.mark.parametrize("frames", [24, 13, 7])
@pytest.mark.parametrize("absent", [0, 4, 11])
def test_a_camera_without_any_picture_leaves_the_others_their_poses(tmp_path, absent, frames):
    there = lambda time, camera: camera != absent
    assert_right(publish(tmp_path / "scene", there=there, frames=frames), there=there, frames=frames)


@pytest.mark.parametrize("names", [NAMES, SERIAL], ids=["from 1", "serial numbers"])
def test_where_only_the_frames_own_pictures_are_missing_they_tell_the_order(tmp_path, names):
    assert assert_right(publish(tmp_path / "scene", there=own_missing, names=names), names=names) == 264


def test_pictures_may_be_missing_here_and_there(tmp_path):
    chance = np.random.default_rng(0).uniform(size=(24, RIG))
    for name, there in (
        ("with", lambda time, camera: chance[time, camera] > 0.3),
        ("without", lambda time, camera: chance[time, camera] > 0.1 and own_missing(time, camera)),
    ):
        assert_right(publish(tmp_path / name, there=there), there=there)


def test_numbering_that_begins_at_another_camera_is_followed(tmp_path):
    names = NAMES[5:] + NAMES[:5]
    assert assert_right(publish(tmp_path / "scene", names=names), names=names) == 264


@pytest.mark.parametrize("suffix, alike", [(".png", 0.995), (".jpg", 0.9)])
def test_cameras_that_see_nearly_the_same_are_still_told_apart(tmp_path, suffix, alike):
    for name, names in (("one", NAMES), ("two", NAMES[1:] + NAMES[:1])):
        assert assert_right(publish(tmp_path / name, names=names, alike=alike, suffix=suffix), names=names) == 264


def test_pictures_that_are_all_the_same_do_not_contradict_the_order(tmp_path):
    assert assert_right(publish(tmp_path / "scene", alike=1.0)) == 264


SHUFFLED = [NAMES[camera] for camera in np.random.default_rng(1).permutation(RIG)]
SWAPPED = [*NAMES[:6], NAMES[7], NAMES[6], *NAMES[8:]]
UNCERTAIN = lambda time, camera: camera in ((time + 3) % RIG, (time + 7) % RIG)
REFUSED = {
    "shuffled": ({"names": SHUFFLED}, "not in the order in which 12 cameras took the frames: frame 0 is cam"),
    "shuffled, own missing": ({"names": SHUFFLED, "there": own_missing}, "not in the order"),
    "two cameras swapped": ({"names": SWAPPED}, "frame 6 is cam08.png, not cam07.png"),
    "other every time": ({"shows": lambda time, camera: (camera * 5 + time) % RIG}, "not in the order"),
    "of another scene": ({"shows": lambda time, camera: camera + 50}, "frame 0 is none of them, not cam01.png"),
    "one wrong picture": (
        {"shows": lambda time, camera: 50 if (time, camera) == (2, 2) else camera},
        "frame 2 is none of them, not cam03.png",
    ),
    "two of twelve, never the frame": ({"there": UNCERTAIN}, "cannot be told"),
    "one time only": (
        {"there": lambda time, camera: time == 3 and camera > 3},
        "frame 3 is none of them, not cam08.png",
    ),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_what_the_photographs_contradict_or_leave_open_is_refused(tmp_path, fault):
    options, message = REFUSED[fault]
    folder = publish(tmp_path / "scene", **options)
    with pytest.raises(ValueError, match=message) as caught:
        load_scene(folder)
    assert str(caught.value).startswith(f"{folder / 'mv_images'}: ") and "use the protocol `strict`" in str(
        caught.value
    )
    assert len(load_scene(folder, protocol="strict").targets) == 24


@pytest.mark.parametrize(
    ("name", "message"),
    [("left.png", "left.png: has no number that tells its camera"), ("cam1.jpg", "has the number of cam0?1")],
)
def test_a_name_that_tells_no_camera_is_refused(tmp_path, name, message):
    folder = publish(tmp_path / "scene", frames=7)
    cv2.imwrite(str(folder / "mv_images/00001" / name), photograph(1, 0))
    with pytest.raises(ValueError, match=message):
        load_scene(folder)


def test_targets_show_what_their_camera_saw(tmp_path):
    scene = load_scene(publish(tmp_path / "scene"), targets=[5])
    assert [target.camera_name for target in scene.targets] == [*NAMES[:5], *NAMES[6:]]
    for target in scene.targets:
        camera, image = int(target.camera_name[3:]) - 1, np.asarray(target.image)
        np.testing.assert_allclose(image, photograph(5, camera)[..., ::-1] / np.float32(255), atol=1e-6)
        assert np.abs(image - scene.video.images[5]).mean() > 0.05
        np.testing.assert_allclose(target.camera.camera_from_world, np.linalg.inv(pose(camera)), atol=1e-5)


def test_a_picture_that_cannot_be_read_is_named(tmp_path):
    folder = publish(tmp_path / "scene", frames=7)
    Path(folder / "mv_images/00001/cam04.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match="00001/cam04.png: is not a picture"):
        load_scene(folder)
