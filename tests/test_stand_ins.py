"""Frames that stand in, in training, for those that a clip lacks."""

import dataclasses

import jax
import numpy as np
import pytest
import stage
from stage import MINI

from zestjax import novel_view
from zestjax.apps import clips
from zestjax.apps.train import prepared_from_arrays
from zestjax.frames import between
from zestjax.frames.assembly import dequantised
from zestjax.frames.selection import Slots
from zestjax.model import predict
from zestjax.train.batches import batch_from_clip, prepare_clip
from zestjax.train.stand_ins import stand_in_at

RECIPE = stage.recipe_of(MINI)
KEY = jax.random.key(1)  # draws a hole between other frames


@pytest.fixture
def trusting(monkeypatch):
    """Frames stand in whatever their flow: the stage is 16 x 24 pixels."""
    monkeypatch.setattr(between, "LEAST_SURE", -1.0)


def drawn(prepared, recipe=RECIPE):
    """A batch whose target is a hole."""
    for seed in range(50):
        found = batch_from_clip(jax.random.key(seed), prepared, recipe)
        if int(found.inputs.time) in prepared.holes:
            return found
    raise AssertionError("no target is a hole")


def test_a_step_sees_what_a_rendered_view_sees(trusting):
    """Inputs, evidence and colours of a hole's batch are those of `render_view` without that frame."""
    prepared = prepare_clip(KEY, stage.clip(), MINI)
    assert prepared.stand_ins is not None
    batch, params = drawn(prepared), stage.params_of(MINI)
    assert 1 == batch.inputs.slots.valid[list(MINI.dynamic.frames.offsets).index(0)]
    video = stage.video()._replace(images=stage.clip().images)
    scene = novel_view.prepare(params, video, system=MINI)
    time = int(batch.inputs.time)
    view = novel_view.render_view(params, scene, batch.inputs.camera, time, system=MINI, exclude=prepared.holes)
    maps = MINI.frames(params.analysis, dequantised(batch.evidence))
    shown = predict(params, batch.inputs, maps, batch.truth.pixels, system=MINI).colour
    u, v = batch.truth.pixels.astype(int).T
    np.testing.assert_allclose(shown, np.asarray(view.colour)[v, u], atol=2e-6)


def test_the_frame_that_is_missing_is_not_read(trusting):
    first = prepare_clip(KEY, stage.clip(), MINI)
    images = stage.clip().images.copy()
    images[list(first.holes)] = 0
    spoilt = prepare_clip(KEY, stage.clip()._replace(images=images), MINI)
    jax.tree.map(np.testing.assert_array_equal, spoilt.stand_ins, first.stand_ins)
    ours, theirs = drawn(first), drawn(spoilt)
    jax.tree.map(np.testing.assert_array_equal, (ours.inputs, ours.evidence), (theirs.inputs, theirs.evidence))


def test_nobody_learns_a_stand_ins_depths_from_the_frame_that_it_stands_in_for(trusting):
    batch = drawn(prepare_clip(KEY, stage.clip(), MINI))
    slots = np.asarray(batch.inputs.slots.valid)
    at = len(batch.inputs.key.valid) + list(MINI.dynamic.frames.offsets).index(0)
    assert batch.frame_valid[at] == 0 and slots.sum() == batch.frame_valid[-len(slots) :].sum() + 1


def test_where_the_flow_is_not_sure_nothing_stands_in(monkeypatch):
    monkeypatch.setattr(between, "LEAST_SURE", 2.0)
    prepared = prepare_clip(KEY, stage.clip(), MINI)
    assert prepared.stand_ins is None
    assert 0 == drawn(prepared).inputs.slots.valid[list(MINI.dynamic.frames.offsets).index(0)]


@pytest.mark.parametrize(("offsets", "stands"), [((-2, 0, 2), True), ((-3, 0, 3), False), ((-1, 1), False)])
def test_a_system_that_looks_elsewhere_has_no_stand_in(trusting, offsets, stands):
    prepared = prepare_clip(KEY, stage.clip(), MINI)
    system = dataclasses.replace(MINI, dynamic=dataclasses.replace(MINI.dynamic, frames=Slots(offsets)))
    args = prepared.stand_ins, prepared.holes[0], stage.clip().images, stage.video().cameras
    assert (stand_in_at(*args, system=system) is not None) == stands
    assert stand_in_at(*args, system=stage.STILL) is None
    batch = drawn(prepared, dataclasses.replace(RECIPE, system=system))
    assert len(batch.evidence.sure) == len(batch.inputs.key.valid) + len(offsets)


def test_stored_clips_keep_their_stand_ins(trusting, monkeypatch, tmp_path):
    monkeypatch.setattr(clips, "render_clip", lambda spec, index: stage.clip())
    spec = clips.ClipSpec(0, *stage.SIZE, stage.FRAMES, 2, MINI.frames.planes)
    clips.evidence_folder(tmp_path, spec.planes).mkdir()
    clips.make_clip(spec, tmp_path, 0)
    folders = tmp_path, clips.evidence_folder(tmp_path, spec.planes)
    read = [clips.read_clip(clips.clip_path(folder, 0), clips.origin_of(spec, 0)) for folder in folders]
    found = prepared_from_arrays(None, read[0] | read[1], MINI)
    whole = prepare_clip(clips.hole_key(0, 0), stage.clip(), MINI)
    assert found.stand_ins is not None and found.holes == whole.holes
    jax.tree.map(np.testing.assert_array_equal, found.stand_ins, whole.stand_ins)
