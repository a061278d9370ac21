"""Exposures that drift: found from the frames, and evened out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from stage import MINI

from zestjax import novel_view
from zestjax.apps.train import prepared_from_arrays
from zestjax.base.parts import from_stored, to_stored
from zestjax.frames.assembly import footage
from zestjax.frames.exposure import Exposure, Gains, evened, exposed_as_target
from zestjax.simulate.bench import bench_scene
from zestjax.simulate.footage import bench_video
from zestjax.systems.presets import PARTS, ZEST
from zestjax.train.batches import batch_from_clip, prepare_clip

COUNT, SIZE = 6, (48, 64)
DRIFT = np.log(1 + 0.2 * np.sin(np.arange(COUNT)[:, None] / 2 + np.array([0.0, 0.5, 1.0])))
EVEN = dataclasses.replace(MINI, exposure=Gains())


def painted(gains=None, noise=0.0, mover=False):
    """(COUNT, H, W, 3) uint8 of a texture that slides by a pixel a frame, times exp(gains)."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    frames = []
    for t in range(COUNT):
        x = u + t
        shown = 0.35 + 0.1 * np.stack([np.sin(x / 3 + v / 5), np.cos(x / 4 - v / 3), np.sin(x / 5) * np.cos(v / 4)], -1)
        if mover:
            shown[10:30, 5 * t + 5 : 5 * t + 22] = 0.7
        shown = shown * np.exp(gains[t]) if gains is not None else shown
        frames.append(shown + noise * rng.normal(size=shown.shape))
    return np.round(255 * np.clip(frames, 0, 1)).astype(np.uint8)


def centred(gains):
    return gains - gains.mean(0)


@pytest.mark.parametrize("options", [{}, {"noise": 0.01}, {"mover": True}], ids=["plain", "noisy", "a mover"])
def test_gains_are_found_channel_by_channel(options):
    found = Gains()(footage(painted(DRIFT, **options)))
    np.testing.assert_allclose(found.gains, centred(DRIFT), atol=0.012)
    np.testing.assert_allclose(found.links, np.diff(DRIFT, axis=0), atol=0.012)


def test_what_does_not_drift_is_left_as_it_is():
    seen = footage(painted())
    found = Gains()(seen)
    assert found.gains is None and np.abs(found.links).max() < 0.005
    assert evened(seen, found) is seen and evened(seen, None) is seen
    assert Gains(least=0.0)(seen).gains is not None


def test_zest_bench_drifts_where_it_says_so():
    size = dict(height=72, width=128)
    dusk = Gains()(footage(bench_video("dusk", **size).images))
    true = np.log(np.asarray(bench_scene("dusk", **size).scene.effects.exposure, np.float64))
    assert np.abs(dusk.gains - centred(true)).max() < 0.08 and np.abs(np.diff(dusk.gains - true, axis=0)).mean() < 0.01
    assert Gains()(footage(bench_video("walker", **size).images)).gains is None


def test_gains_do_not_read_what_is_excluded():
    images = painted(DRIFT)
    spoilt = images.copy()
    spoilt[2] = 255 - spoilt[2]
    first, other = (Gains()(footage(x), exclude=(2,)) for x in (images, spoilt))
    np.testing.assert_array_equal(first.gains, other.gains)
    np.testing.assert_allclose(first.gains[2], (first.gains[1] + first.gains[3]) / 2, atol=1e-6)
    seen = footage(images)
    again = Gains()(seen, exclude=(2,), known=Gains()(seen))
    np.testing.assert_array_equal(again.gains, first.gains)
    others = [0, 1, 3, 4, 5]
    drift = centred(DRIFT[others])
    np.testing.assert_allclose(first.gains[others] - first.gains[others].mean(0), drift, atol=0.015)


@pytest.mark.parametrize("fill", [0, 255, 128])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_frames_that_do_not_tell_have_no_gains(fill, count):
    seen = footage(np.full((count, *SIZE, 3), fill, np.uint8))
    assert Gains()(seen).gains is None and Gains()(seen, exclude=range(count)).gains is None


def test_photographs_from_far_apart_do_not_tell():
    rng = np.random.default_rng(1)
    found = Gains(least=0.0)(footage(rng.integers(0, 255, (4, 144, 192, 3), dtype=np.uint8)))
    assert found.gains is None and np.isnan(found.links).any()


def test_evened_frames_have_one_exposure():
    seen = footage(painted(DRIFT))
    plain = evened(seen, Gains()(seen))
    bright = np.asarray(plain.half).mean((1, 2))
    assert (
        np.ptp(np.log(bright), axis=0).max() < 0.03 < np.ptp(np.log(np.asarray(seen.half).mean((1, 2))), axis=0).min()
    )
    assert np.asarray(plain.half).max() <= 1 and plain.flow is seen.flow


def drifting(exposure=DRIFT):
    """The stage's `Video` with a drift, dimmed so that nothing is cut off."""
    video = stage.video()
    gains = np.exp(exposure - exposure.max(0))[:, None, None]
    return video._replace(images=(video.images * gains).astype(np.float32)), gains


def test_a_view_has_the_exposure_of_its_time():
    """As the view of the even video, times the gain of its time: the frames are flat in time but for the drift."""
    params, (video, gains) = stage.params_of(EVEN), drifting()
    scene = novel_view.prepare(params, video, system=EVEN)
    truth = (DRIFT - DRIFT.mean(0)).astype(np.float32)
    scene = scene._replace(exposure=Exposure(scene.exposure.links, truth))
    camera = jax.tree.map(jnp.asarray, stage.camera(0.1))
    inputs = {}
    for time in (1, 4):
        view = jax.jit(lambda s, c, t: novel_view.render_view(params, s, c, t, system=EVEN).colour)
        inputs[time] = np.asarray(view(scene, camera, time))
        eager = novel_view.render_view(params, scene, camera, time, system=EVEN).colour
        np.testing.assert_allclose(eager, inputs[time], atol=2e-6)
    assert inputs[1].mean() / inputs[4].mean() == pytest.approx(float(gains[1].mean() / gains[4].mean()), rel=0.1)


def test_the_inputs_of_a_target_have_its_exposure():
    frames, (video, gains) = np.array([0, 3, 5, 2]), drifting()
    batch = stage.batch()
    key = batch.inputs.key._replace(images=video.images[frames[:3]], valid=np.ones(3))
    slots = batch.inputs.slots._replace(images=video.images[frames[3:]], valid=np.ones(1))
    inputs = batch.inputs._replace(key=key, slots=slots, time=np.float32(2))
    found = exposed_as_target(inputs, frames, Exposure(np.diff(DRIFT, axis=0), centred(DRIFT).astype(np.float32)))
    even = stage.video().images * gains[2]
    for part, of in ((found.key, frames[:3]), (found.slots, frames[3:])):
        np.testing.assert_allclose(part.images, np.minimum(even[of], 1), atol=1e-5)
    assert exposed_as_target(inputs, frames, None) is inputs
    assert exposed_as_target(inputs, frames, Exposure(np.zeros((5, 3)), None)) is inputs


def test_a_video_without_drift_is_computed_by_the_program_of_a_system_that_never_asks():
    params, video = stage.params_of(MINI), stage.video()
    camera = jax.tree.map(jnp.asarray, stage.camera(0.1))
    args = {}
    for system in (MINI, EVEN):
        scene = novel_view.prepare(params, video, system=system)
        view = lambda c, scene=scene, system=system: novel_view.render_view(params, scene, c, 2, system=system).colour
        args[system] = jax.jit(view).lower(camera).as_text()
    assert args[MINI] == args[EVEN]


def test_a_step_sees_the_frames_as_a_view_does():
    images, _ = drifting()
    clip = stage.clip()._replace(images=np.round(255 * images.images).astype(np.uint8))
    prepared = prepare_clip(jax.random.key(1), clip, EVEN)
    plain = prepare_clip(jax.random.key(1), clip, MINI)
    gains = (DRIFT - DRIFT.mean(0)).astype(np.float32)
    prepared = prepared._replace(exposure=Exposure(np.diff(DRIFT, axis=0), gains))
    recipe = dataclasses.replace(stage.recipe_of(MINI), system=EVEN)
    ours, theirs = (batch_from_clip(jax.random.key(0), x, recipe).inputs for x in (prepared, plain))
    time, frames = int(ours.time), np.asarray(ours.key.times, int)
    factors = np.exp(gains[time] - gains[frames])[:, None, None]
    np.testing.assert_allclose(ours.key.images, np.minimum(theirs.key.images * factors, 1), atol=1e-5)


def test_the_part_is_stored_and_old_files_have_none():
    assert from_stored(to_stored(ZEST), PARTS) == ZEST and ZEST.exposure == Gains()
    stored = to_stored(ZEST)
    del stored["exposure"]
    assert from_stored(stored, PARTS).exposure is None


def drifting_clip():
    """The stage's clip, of 48 x 64 frames, with a drift that they tell themselves."""
    images = stage.video((48, 64)).images * np.exp(DRIFT - DRIFT.max(0))[:, None, None]
    return stage.clip()._replace(images=np.round(255 * images).astype(np.uint8))


def test_a_system_that_asks_nothing_else_of_frames_has_them_evened_in_training_as_in_rendering():
    alone = dataclasses.replace(stage.PAPER, exposure=Gains())
    prepared = prepare_clip(jax.random.key(1), drifting_clip(), alone)
    assert prepared.evidence is None and prepared.exposure.gains is not None
    assert prepare_clip(jax.random.key(1), drifting_clip(), stage.PAPER).exposure is None


def test_a_stored_clip_is_evened_as_the_system_has_it():
    clip, gains = drifting_clip(), (DRIFT - DRIFT.mean(0)).astype(np.float32)
    stored = {"holes": np.array([3]), "exposure_links": np.diff(gains, axis=0), "exposure_gains": gains}
    found = prepared_from_arrays(jax.random.key(1), clip._asdict() | stored, stage.PAPER)
    assert found.exposure is None  # it does not ask: prepared anew
