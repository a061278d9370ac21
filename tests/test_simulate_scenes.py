"""Random scenes, training clips and zest-bench."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.cameras import Camera, centre
from zestjax.simulate.bench import BENCH, bench_scene
from zestjax.simulate.clips import shot, training_clip
from zestjax.simulate.footage import answers, held_out, input_video
from zestjax.simulate.random import random_scene
from zestjax.simulate.render import seen_surface
from zestjax.simulate.truth import motion_mask
from zestjax.simulate.types import Effects

SIZE = dict(height=18, width=32)


@pytest.fixture(scope="module")
def clips():
    """Clips of keys 0, 1 and 0 again, and how many programs `shot` had after each."""
    made, programs = [], []
    for seed in (0, 1, 0):
        made.append(training_clip(jax.random.key(seed), frames=4, targets=3, **SIZE))
        programs.append(shot._cache_size())  # pyright: ignore[reportAttributeAccessIssue]
    return made, programs


def test_a_clip_is_a_function_of_its_key(clips):
    first, other, again = clips[0]
    for name, a, b, c in zip(first._fields, first, other, again, strict=True):
        np.testing.assert_array_equal(a, c, err_msg=name)
        assert a.dtype == b.dtype and a.shape == b.shape, name
    assert not np.array_equal(first.images, other.images)


def test_random_scenes_share_one_program(clips):
    programs = clips[1]
    assert programs[0] == programs[1] == programs[2]
    a, b = (random_scene(jax.random.key(seed), frames=4, targets=3, **SIZE) for seed in (2, 3))
    assert jax.tree.map(np.shape, a) == jax.tree.map(np.shape, b)


def test_a_clip_s_answers_agree(clips):
    for clip in clips[0][:2]:
        assert clip.images.shape == (4, 18, 32, 3) and clip.target_scene_flow.shape == (3, 2, 18, 32, 3)
        for depth in (clip.depth, clip.target_depth, clip.target_static_depth):
            assert np.isfinite(depth).all() and depth.min() >= clip.near > 0 and depth.max() <= clip.far
        assert (clip.target_static_depth >= clip.target_depth * (1 - 1e-4)).all()
        still = ~clip.target_moving
        length = np.linalg.norm(clip.target_scene_flow.astype(np.float32), axis=-1).max(1)
        assert (length[still] <= 2e-4 * clip.target_depth[still]).all()
        assert (length[clip.target_moving] > 0).all()


def test_a_target_is_never_the_camera_that_took_its_frame(clips):
    for clip in clips[0][:2]:
        taken = Camera(clip.intrinsics[clip.target_time], clip.camera_from_world[clip.target_time])
        wanted = Camera(clip.target_intrinsics, clip.target_camera_from_world)
        assert (jnp.linalg.norm(centre(taken) - centre(wanted), axis=-1) > 1e-6).all()


def test_a_clip_needs_two_frames():
    with pytest.raises(ValueError, match="`frames` is 1, expected at least 2"):
        training_clip(jax.random.key(0), frames=1)


@pytest.fixture(scope="module")
def surfaces():
    """Per scene of zest-bench: (times, cameras) of what the rig sees, small."""

    @jax.jit
    @partial(jax.vmap, in_axes=(None, 0, 0))
    def seen(scene, camera, time):
        frame = seen_surface(scene, camera, time, **SIZE)
        return frame.depth, motion_mask(scene, frame, time)

    found = {}
    for name in BENCH:
        simulated = bench_scene(name, **SIZE)
        scene = jax.tree.map(jnp.asarray, simulated.scene._replace(effects=Effects()))
        cameras = jax.tree.map(lambda leaf: jnp.tile(leaf[jnp.array([0, 4, 7, 11])], (3, 1, 1)), simulated.rig)
        found[name] = simulated, *seen(scene, cameras, jnp.repeat(jnp.array([1.0, 11, 22]), 4))
    return found


def test_zest_bench_is_nine_scenes_of_one_protocol(surfaces):
    assert len(BENCH) == 9
    for simulated, depth, _ in surfaces.values():
        assert simulated.frames == 24 and simulated.rig.intrinsics.shape == (12, 3, 3)
        np.testing.assert_array_equal(simulated.taken, np.arange(24) % 12)
        assert simulated.near < depth.min() and depth.max() < simulated.far
        assert 5 not in held_out(simulated, 17) and len(held_out(simulated, 17)) == 11


def test_one_scene_stands_still_one_moves_all_over_and_the_others_in_part(surfaces):
    share = {name: float(jnp.mean(moving)) for name, (_, _, moving) in surfaces.items()}
    assert share["still_life"] == 0 and share["swell"] > 0.99
    assert all(0.02 < share[name] < 0.4 for name in BENCH if name not in ("still_life", "swell"))


def test_an_unknown_scene_is_refused_with_the_names():
    with pytest.raises(ValueError, match="bench_scene.*'walk'.*'walker'"):
        bench_scene("walk")


def test_footage_is_the_input_video_and_the_truth_at_other_cameras():
    simulated = bench_scene("walker", **SIZE)
    video, shown = input_video(simulated), answers(simulated, [0, 5], [0, 9])
    assert video.images.shape == (24, 18, 32, 3) and shown.flow.shape == (2, 2, 18, 32, 2)
    np.testing.assert_allclose(shown.images[0], video.images[0], atol=1e-6)  # the scene has no noise
    assert not shown.visible[0, 1].any() and shown.visible[0, 0].any()  # before the first frame there is none
    np.testing.assert_array_equal(shown.cameras.camera_from_world[1], simulated.rig.camera_from_world[9])
