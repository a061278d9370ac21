"""One target of a clip, with everything that is known about it."""

import jax
import numpy as np
import pytest
import stage
from stage import MINI, PAPER

from zestjax.frames.assembly import footage, video_evidence
from zestjax.frames.evidence import Evidence
from zestjax.train import batches
from zestjax.train.batches import PreparedClip, batch_from_clip, clip_from_arrays, frame_batch, prepare_clip
from zestjax.train.rays import Pixels, Rows

RECIPE = stage.recipe_of(MINI)


@pytest.fixture(scope="module")
def drawn():
    """Twenty batches of the stage."""
    return [batch_from_clip(jax.random.key(i), stage.prepared(), RECIPE) for i in range(20)]


def test_a_batch_is_a_function_of_its_key(drawn):
    again = batch_from_clip(jax.random.key(0), stage.prepared(), RECIPE)
    jax.tree.map(np.testing.assert_array_equal, again, drawn[0])
    assert len({float(b.truth.pixels[0, 1]) for b in drawn}) > 3
    assert {float(b.inputs.time) for b in drawn} == {2.0, 3.0, float(stage.prepared().holes[0])}


def test_all_batches_have_one_structure(drawn):
    shapes = lambda b: jax.tree.map(lambda x: (x.shape, str(x.dtype)), b)
    assert all(shapes(b) == shapes(drawn[0]) for b in drawn)


def test_the_crop_shows_whole_rows_of_the_target(drawn):
    for found in drawn:
        u, v = found.truth.pixels.reshape(4, 24, 2).transpose(2, 0, 1).astype(int)
        np.testing.assert_array_equal(u, np.broadcast_to(np.arange(24), (4, 24)))
        assert 0 <= v.min() and v.max() < 16 and (np.diff(v, axis=0) == 1).all()
        time, x = int(found.inputs.time), -float(found.inputs.camera.camera_from_world[0, 3])
        image, depth, moving, _ = stage.shot(x, time)
        rows = slice(v[0, 0], v[0, 0] + 4)
        np.testing.assert_allclose(found.truth.colour, image[rows].reshape(-1, 3), atol=0.5 / 255 + 1e-6)
        np.testing.assert_allclose(found.truth.depth, depth[rows].reshape(-1), rtol=1e-6)
        np.testing.assert_array_equal(found.truth.moving, moving[rows].reshape(-1))


def test_uniform_rays_are_spread_over_the_image_and_mined_where_it_moves():
    truth = stage.batch(PAPER).truth
    count = stage.PIXELS.count
    assert len(truth.pixels) == count + stage.PIXELS.mined
    assert len(np.unique(truth.pixels[:count], axis=0)) == count and np.ptp(truth.pixels[:count, 1]) > 10
    assert (truth.moving[count:] == 1).all()
    image = stage.shot(0.1, 2)[0]
    assert truth.jitter.shape == (len(truth.pixels), PAPER.sampler.samples) and 0.4 < truth.jitter.mean() < 0.6
    u, v = truth.pixels.astype(int).T
    np.testing.assert_allclose(truth.colour, image[v, u], atol=0.5 / 255 + 1e-6)


def test_a_hole_is_no_input_and_its_own_time_has_no_slot(drawn):
    hole = stage.prepared().holes[0]
    for found in drawn:
        assert hole not in found.inputs.key.times
        here = found.inputs.slots.times == hole
        assert not np.asarray(found.inputs.slots.valid)[here].any()


def test_nothing_is_known_of_a_holes_flow(drawn):
    kinds = {bool(b.truth.known.any()): b for b in drawn}
    frame, view = kinds[False], kinds[True]
    assert not frame.truth.flow.any() and not frame.truth.flow_valid.any()
    np.testing.assert_array_equal(frame.truth.static_valid, 1 - frame.truth.moving)
    np.testing.assert_array_equal(view.truth.known, 1)
    np.testing.assert_array_equal(view.truth.flow_valid, view.truth.moving)


def test_the_cards_flow_is_its_motion():
    truth = stage.batch().truth
    moving = truth.moving > 0
    np.testing.assert_allclose(
        truth.flow[moving], np.broadcast_to([[0.1, 0, 0], [-0.1, 0, 0]], (moving.sum(), 2, 3)), atol=1e-3
    )
    assert not truth.flow[~moving].any()


def planes_by_hand(depth, count, spacing):
    if spacing == "depth":
        return (depth - stage.NEAR) / (stage.FAR - stage.NEAR) * (count - 1)
    return (1 / stage.NEAR - 1 / depth) / (1 / stage.NEAR - 1 / stage.FAR) * (count - 1)


def test_depths_are_planes_of_the_volumes_and_of_the_frames():
    found = stage.batch()
    np.testing.assert_allclose(found.static_planes, planes_by_hand(stage.WALL, MINI.space.planes, "inverse"), rtol=1e-5)
    wall, card = (planes_by_hand(z, MINI.frames.planes, "inverse") for z in (stage.WALL, stage.CARD))
    assert set(np.round(found.frame_planes, 3).ravel()) == set(np.round(np.float32([wall, card]), 3))
    paper = stage.batch(PAPER)
    np.testing.assert_allclose(paper.static_planes, planes_by_hand(stage.WALL, PAPER.space.planes, "depth"), rtol=1e-5)
    assert paper.evidence is None


def test_cells_and_half_pixels_cover_any_size():
    ramp = np.broadcast_to(np.arange(9.0), (2, 13, 9))
    assert batches._cells(ramp).shape == (2, 4, 3)
    np.testing.assert_array_equal(batches._cells(ramp)[0, 0], [2, 6, 8])
    mask = np.zeros((1, 5, 6), bool)
    mask[0, :2, :1] = True
    half = batches._half_mask(mask, (2, 2))
    assert half.shape == (1, 4, 4) and half[0, 0, 0] == 0.5 and half.sum() == 0.5


def test_hidden_frames_are_neither_inputs_nor_targets():
    whole = stage.prepared()
    hidden = PreparedClip(whole.clip, whole.evidence, whole.holes, (0, 1))
    for seed in range(8):
        inputs = batch_from_clip(jax.random.key(seed), hidden, RECIPE).inputs
        assert not {0, 1} & set(inputs.key.times[inputs.key.valid > 0])
        assert not np.asarray(inputs.slots.valid)[np.isin(inputs.slots.times, [0, 1])].any()


def test_a_holes_pixels_influence_no_other_frames_evidence():
    whole = stage.prepared()
    images = whole.clip.images.copy()
    images[whole.holes[0]] = 0
    found = prepare_clip(jax.random.key(0), whole.clip._replace(images=images), MINI)
    assert found.holes == whole.holes
    others = np.delete(np.arange(stage.FRAMES), whole.holes[0])
    for name, a, b in zip(Evidence._fields, found.evidence, whole.evidence, strict=True):
        np.testing.assert_array_equal(a[others], b[others])
        assert name not in ("static", "best", "colours") or not np.array_equal(a[whole.holes[0]], b[whole.holes[0]])


def test_a_frame_with_nothing_to_compare_with_says_nothing():
    seen, cameras = footage(stage.video().images), stage.video().cameras
    found = video_evidence(seen, cameras, stage.NEAR, stage.FAR, planes=6, frames=[2], exclude=(0, 1, 3, 4, 5))
    assert isinstance(found, Evidence) and all((cost == 255).all() for cost in found[:6]) and (found.sure == 0).all()


def test_a_stored_clip_that_lacks_a_field_is_refused():
    arrays = stage.clip()._asdict()
    assert clip_from_arrays(arrays).far == stage.FAR
    del arrays["depth"], arrays["near"]
    with pytest.raises(ValueError, match="depth, near"):
        clip_from_arrays(arrays)


def test_a_crop_that_cannot_be_shared_among_the_blocks_is_refused():
    with pytest.raises(ValueError, match="96 rays have no 5 equal blocks"):
        jax.eval_shape(stage.objective(MINI, blocks=5), stage.params_of(MINI), stage.batch())


def test_rays_that_a_target_does_not_have_are_refused():
    moving, rng = np.zeros((4, 6), bool), np.random.default_rng(0)
    with pytest.raises(ValueError, match="Rows: `count` is 5, the target has 4 rows"):
        Rows(5).draw(rng, moving, 0)
    with pytest.raises(ValueError, match="Pixels: `count` is 25, the target has 24 pixels"):
        Pixels(25, 0).draw(rng, moving, 0)


def test_rays_are_mined_while_the_priors_are_on():
    moving, rays = np.eye(6, dtype=bool), Pixels(12, 4, 10)
    sizes = [len(rays.draw(np.random.default_rng(0), moving, step)) for step in (0, 9, 10, 99)]
    assert sizes == [16, 16, 12, 12]


def test_a_batch_of_frames_holds_each_frame_with_its_own_truth():
    whole = stage.prepared()
    found = frame_batch(jax.random.key(3), [whole, whole], MINI)
    assert len(found.frame_planes) == 2 * batches.FRAMES_PER_CLIP == len(found.evidence.static)
    for i, evidence in enumerate(found.evidence.colours):
        frame = next(k for k in range(stage.FRAMES) if np.array_equal(whole.evidence.colours[k], evidence))
        depth = batches._cells(whole.clip.depth[frame])
        np.testing.assert_allclose(found.frame_planes[i], planes_by_hand(depth, MINI.frames.planes, "inverse"), 1e-4)
        np.testing.assert_array_equal(found.frame_moving[i].sum(), whole.clip.moving[frame].mean() * 8 * 12)
    assert (found.frame_valid == 1).all()
    with pytest.raises(ValueError, match="the system asks nothing of single frames"):
        frame_batch(jax.random.key(0), [stage.prepared(PAPER)], PAPER)
