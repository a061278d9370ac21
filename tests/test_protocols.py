"""What each protocol shows and asks: no target is among its inputs, told by the digests of the pictures."""

# pyright: reportArgumentType=false, reportOptionalMemberAccess=false

import hashlib

import numpy as np
import pytest
from test_io_scenes import RIG, N, make_targets, make_video, rig_camera

from zestjax.apps.scenes import open_scene
from zestjax.io.nsff import write_nsff
from zestjax.io.scenes import FIXED_VIEW_FRAMES, PROTOCOLS, Target, load_scene
from zestjax.train.recipes import TINY

LEAKS = {"held-out": False, "strict": False, "paper": True, "fixed-view": False}


def digests(scene, exclude=()):
    """Of the pictures that may be looked at."""
    return {digest(image) for i, image in enumerate(scene.video.images) if i not in set(exclude)}


def digest(image):
    return hashlib.sha256(np.round(255 * np.asarray(image, np.float64)).astype(np.uint8).tobytes()).hexdigest()


def leaking(scene):
    """Targets whose picture is among the inputs that serve them."""
    return [t for t in scene.targets if digest(t.image) in digests(scene, t.exclude)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Eighteen frames, each by one of the rig's three cameras; the others' pictures of four times and more."""
    rng, place = np.random.default_rng(3), tmp_path_factory.mktemp("scene") / "toy"
    later = [
        Target(time, "cam00", rig_camera(0), rng.random((12, 20, 3)).astype(np.float32))
        for time in range(N, 18)
        if time % RIG
    ]
    write_nsff(place, "toy", make_video(18), held_out=[*make_targets(), *later])
    return place


def test_every_protocol_is_here():
    assert LEAKS.keys() == set(PROTOCOLS)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_no_target_of_a_folder_is_among_its_inputs(folder, protocol):
    scene = load_scene(folder, protocol=protocol)
    assert len(scene.targets)
    assert len(leaking(scene)) == (len(scene.targets) if LEAKS[protocol] else 0)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_no_target_of_zest_bench_is_among_its_inputs(protocol):
    scene = open_scene("bench:walker", TINY, size=(32, 48), protocol=protocol, targets=(2, 7)).scene
    assert len(leaking(scene)) == (2 if LEAKS[protocol] else 0)


def test_a_fixed_view_is_the_first_frames_camera_at_the_times_of_others(folder):
    scene = load_scene(folder, protocol="fixed-view")
    assert len(scene.video.images) == FIXED_VIEW_FRAMES == 12
    assert [t.time for t in scene.targets] == [t for t in range(12) if t % RIG]
    for target in scene.targets:
        np.testing.assert_allclose(target.camera.camera_from_world, scene.video.cameras.camera_from_world[0], atol=1e-5)
        assert target.camera_name == "cam00"
    whole = load_scene(folder)
    np.testing.assert_array_equal(scene.video.images, whole.video.images[:12])


def test_a_fixed_view_of_zest_bench_is_the_same(folder):
    opened = open_scene("bench:walker", TINY, size=(32, 48), protocol="fixed-view")
    scene, first = opened.scene, opened.scene.video.cameras.camera_from_world[0]
    assert len(scene.video.images) == 12 and opened.ceiling is None
    assert [t.time for t in scene.targets] == list(range(1, 12))  # a rig of twelve, each takes one
    for target in scene.targets:
        np.testing.assert_array_equal(target.camera.camera_from_world, first)
    assert {t.camera_name for t in scene.targets} == {"cam01"}
    with pytest.raises(ValueError, match="no target 0; its times are 1 to 11"):
        open_scene("bench:walker", TINY, size=(32, 48), protocol="fixed-view", targets=(0,))


def test_photographs_alone_have_no_fixed_view(tmp_path):
    write_nsff(tmp_path / "toy", "toy", make_video())
    with pytest.raises(ValueError, match="has no pictures of other cameras .* for `fixed-view`; use `strict`"):
        load_scene(tmp_path / "toy", protocol="fixed-view")
