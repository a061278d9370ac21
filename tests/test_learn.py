"""A training step: its gradient, its terms, what it leaves out, and that it learns."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import adam_by_loop, normal
from stage import MINI, PAPER, STILL

from zestjax import learn
from zestjax.analysis import FrameMaps
from zestjax.batches import frame_batch
from zestjax.encoding import Volume
from zestjax.learn import (
    FRAME_WEIGHTS,
    MOVER_SHARE,
    Fault,
    find_fault,
    frames_only,
    make_train_step,
    scene_terms,
    stage_weights,
    train_step,
)
from zestjax.losses.objective import PAPER_WEIGHTS, Terms, measured, weighted_sum
from zestjax.measures import RAY_TERMS, SCENE_TERMS, make_measures, measurable


class Caught:
    """A solver that hands back the gradient in place of new parameters."""

    @staticmethod
    def apply(params, state, grads, value):
        return grads, value


def plain_objective(config, weights):
    """The mean over the blocks of rays of the whole objective, written without blocks or held tables."""

    def total(params, batch):
        whole = jnp.zeros(())
        for block in range(config.ray_blocks):
            truth = jax.tree.map(lambda x, b=block: jnp.split(jnp.asarray(x), config.ray_blocks)[b], batch.truth)
            maps = stage.frame_maps(params.analysis, stage.dequantised(batch.evidence))
            encoding = stage.model.encode(params, batch.inputs, maps, config=config)
            prediction = stage.render_rays(params, encoding, batch.inputs, truth.pixels, config=config)
            measures = make_measures(params, encoding, batch.inputs, config=config)
            chosen = lambda names: Terms(**{n: getattr(weights, n) for n in names})
            terms = measured(measures, prediction, truth, chosen(RAY_TERMS))
            scene = scene_terms(maps, (encoding.geometry, encoding.motion), batch, weights)
            whole += weighted_sum(terms, chosen(RAY_TERMS)) + weighted_sum(scene, chosen(SCENE_TERMS))
        return whole / config.ray_blocks

    return total


def assert_all_finite(tree):
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(tree))


def test_the_blocked_gradient_is_the_plain_gradient_of_the_same_objective():
    params, batch = stage.params_of(MINI), stage.batch()
    grads, value, terms = jax.jit(train_step(MINI, solver=Caught))(params, None, batch)
    plain = jax.jit(jax.value_and_grad(plain_objective(MINI, FRAME_WEIGHTS)))
    expected_value, expected = plain(params, batch)
    np.testing.assert_allclose(value, expected_value, rtol=1e-5)
    np.testing.assert_allclose(terms["total"], expected_value, rtol=1e-5)
    largest = max(float(jnp.abs(g).max()) for g in jax.tree.leaves(expected))
    assert largest > 0
    for ours, theirs in zip(jax.tree.leaves(grads), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=2e-3, atol=1e-5 * largest)


def test_a_few_steps_on_one_batch_reduce_the_loss():
    step, init = stage.step()
    params, batch = stage.params_of(MINI), stage.batch()
    state, losses = init(params), []
    for _ in range(25):
        params, state, terms = step(params, state, batch)
        losses.append(float(terms["total"]))
        assert_all_finite(terms)
    assert losses[-1] < 0.8 * losses[0], losses
    assert_all_finite(params)


def broken(batch):
    """Every frame is one and the same colour, none is valid, and nothing is known."""
    zero = functools.partial(jax.tree.map, jnp.zeros_like)
    plain = lambda f: f._replace(images=jnp.full_like(f.images, 0.5), valid=zero(f.valid))
    inputs = batch.inputs._replace(key=plain(batch.inputs.key), slots=plain(batch.inputs.slots))
    truth = batch.truth
    truth = truth._replace(
        known=zero(truth.known), flow_valid=zero(truth.flow_valid), static_valid=zero(truth.static_valid)
    )
    return batch._replace(inputs=inputs, truth=truth, frame_valid=zero(batch.frame_valid))


def away(batch):
    """No camera sees anything that the target does."""
    turn = np.diag([-1.0, 1, -1, 1]).astype(np.float32)
    look = lambda f: f._replace(
        cameras=f.cameras._replace(camera_from_world=turn @ np.asarray(f.cameras.camera_from_world))
    )
    inputs = batch.inputs._replace(key=look(batch.inputs.key), slots=look(batch.inputs.slots))
    return batch._replace(inputs=inputs)


@pytest.mark.parametrize("change", [broken, away])
def test_a_step_is_finite_on_frames_that_show_nothing(change):
    step, init = stage.step()
    params = stage.params_of(MINI)
    after, state, terms = step(params, init(params), change(stage.batch()))
    assert_all_finite((after, terms))
    assert state.skipped == 0  # the gradient was finite, too


def plain(batch):
    return batch


@pytest.mark.parametrize("change", [plain, broken, away])
def test_a_step_of_the_papers_system_with_all_its_losses_is_finite(change):
    step, init = stage.paper_step()
    params = stage.params_of(PAPER)
    after, state, terms = step(params, init(params), change(stage.batch(PAPER)))
    assert {n for n, v in terms.items() if v is not None} == {
        n for n, w in PAPER_WEIGHTS._asdict().items() if w is not None
    } | {"total"}
    assert_all_finite((after, terms))
    assert state.skipped == 0
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), params, after)
    parts = (changed.geometry, changed.motion, changed.static, changed.dynamic)
    assert change is not plain or all(any(jax.tree.leaves(part)) for part in parts)


def traced(config, weights):
    """Operations of a step's program."""
    step = train_step(config, weights=measurable(config, weights), solver=Caught)
    return stage.operations(step, stage.params_of(config), None, stage.batch(config))


def total(count):
    return sum(count.values())


def test_a_loss_without_weight_is_not_in_the_program():
    whole = traced(PAPER, PAPER_WEIGHTS)
    without = {name: traced(PAPER, PAPER_WEIGHTS._replace(**{name: 0})) for name in ("geo", "cyc", "sp")}
    assert all(total(count) < total(whole) for count in without.values())
    assert total(traced(PAPER, PAPER_WEIGHTS._replace(geo=None))) == total(without["geo"])
    # Without a loss on warped renders, the field is not followed to its neighbours at all.
    still = traced(PAPER, PAPER_WEIGHTS._replace(pho=0, cyc=0))
    assert total(still) < 0.8 * total(whole)


def test_a_static_scene_learns_without_a_dynamic_branch():
    assert total(traced(STILL, FRAME_WEIGHTS)) < 0.75 * total(traced(MINI, FRAME_WEIGHTS))
    out = jax.eval_shape(train_step(STILL, solver=Caught), stage.params_of(STILL), None, stage.batch(STILL))
    assert out[0].dynamic is None and out[0].motion is None
    learned = {"rec", "static_rec", "depth_ce", "frame_ce", "frame_mask", "total"}
    assert {n for n, v in out[2].items() if v is not None} == learned


@pytest.mark.parametrize("geometry, motion", [(True, False), (False, True), (False, False)])
@pytest.mark.parametrize("base", [MINI, PAPER], ids=["mini", "paper"])
def test_every_ablation_has_a_step(base, geometry, motion):
    config = dataclasses.replace(base, geometry=geometry, motion=motion)
    weights = PAPER_WEIGHTS if base is PAPER else FRAME_WEIGHTS
    step, params = train_step(config, weights=measurable(config, weights), solver=Caught), stage.params_of(config)
    grads, _, terms = jax.eval_shape(step, params, None, stage.batch(base))
    assert jax.tree.structure(grads) == jax.tree.structure(params) and terms["rec"].shape == ()


# What is known of a scene before any ray.


def scene_case():
    logits, moving = normal(0, 2, 3, 4, 6), normal(1, 2, 6, 8)
    maps = FrameMaps(None, logits, None, None, moving)
    geometry, motion = (Volume(None, normal(s, 5, 3, 4)) for s in (2, 3))
    batch = stage.batch()._replace(
        static_planes=np.full((3, 4), 1.25, np.float32), static_planes_valid=np.ones((3, 4), np.float32),
        moving_planes=np.full((3, 4), 2.0, np.float32), moving_planes_valid=np.eye(3, 4, dtype=np.float32),
        frame_planes=np.full((2, 3, 4), 4.5, np.float32),
        frame_moving=np.linspace(0, 1, 96, dtype=np.float32).reshape(2, 6, 8),
        frame_valid=np.array([1, 0], np.float32),
    )  # fmt: skip
    return maps, (geometry, motion), batch


def test_scene_terms_are_those_of_a_loop():
    maps, encoded, batch = scene_case()
    terms = scene_terms(maps, encoded, batch, FRAME_WEIGHTS)
    wide = lambda x: np.asarray(x, np.float64)
    log = lambda x, axis: wide(x) - np.log(np.exp(wide(x)).sum(axis, keepdims=True))
    still, moved = log(encoded[0].logits, 0), log(encoded[1].logits, 0)
    expected = -np.mean(0.75 * still[1] + 0.25 * still[2]) - np.mean(np.diagonal(moved[2]))
    np.testing.assert_allclose(terms.depth_ce, expected, rtol=1e-5)
    frames = log(maps.logits, -1)[0]
    moving = wide(batch.frame_moving)[0].reshape(3, 2, 4, 2).mean((1, 3))
    share = (1 + (MOVER_SHARE - 1) * moving) / MOVER_SHARE
    expected = -np.average((frames[..., 4] + frames[..., 5]) / 2, weights=share)
    np.testing.assert_allclose(terms.frame_ce, expected, rtol=1e-5)
    logits = wide(maps.moving_logits)[0]
    np.testing.assert_allclose(
        terms.frame_mask, np.mean(np.log1p(np.exp(logits)) - wide(batch.frame_moving)[0] * logits), rtol=1e-5
    )


@pytest.mark.parametrize("size", [1e4, -1e4, 0.0])
def test_scene_terms_are_finite_with_finite_gradients(size):
    maps, encoded, batch = scene_case()

    def summed(scale):
        scaled = jax.tree.map(lambda x: scale * x, (maps, encoded))
        terms = scene_terms(*scaled, batch, FRAME_WEIGHTS)
        return terms.depth_ce + terms.frame_ce + terms.frame_mask

    assert_all_finite(jax.jit(jax.value_and_grad(summed))(jnp.float32(size)))


def rates(count, *, steps, peak=2e-3, floor=2e-5, warmup=50):
    """The learning rate of each step, written out."""
    for step in range(count):
        done = min((step - warmup) / (max(steps, warmup + 1) - warmup), 1)
        half = (1 + np.cos(np.pi * done)) / 2
        yield peak * (step + 1) / warmup if step < warmup else floor + (peak - floor) * half


@pytest.mark.parametrize(
    "count, options",
    [
        (14, dict(steps=10, warmup=3, peak=0.3, floor=0.02)), (8, dict(steps=6, warmup=0, peak=0.1)),
        (120, dict(steps=100)), (55, dict(steps=20)),
    ],
    ids=["all told", "no warmup", "as it comes", "shorter than its warmup"],
)  # fmt: skip
def test_the_compiled_step_keeps_its_schedule(monkeypatch, count, options):
    """Adam by hand at rates by hand, of gradients clipped by hand; the batch is the gradient."""
    gradients = lambda params, batch: ({"w": batch}, Terms(rec=params["w"][0]), jnp.sum(params["w"]))
    monkeypatch.setattr(learn, "step_gradients", lambda config, **_: gradients)
    init, step = make_train_step(None, **options)
    params = {"w": jnp.zeros(2)}
    state, reached = init(params), []
    batches = normal(0, count, 2) * np.where(np.arange(count) % 3, 0.3, 5)[:, None].astype(np.float32)
    for batch in batches:
        params, state, terms = step(params, state, batch)
        reached.append(np.asarray(params["w"]))
    assert set(terms) == {*Terms._fields, "total"}
    wide = np.asarray(batches, np.float64)
    clipped = wide / np.maximum(np.linalg.norm(wide, axis=1, keepdims=True), 1)
    expected = [adam_by_loop(clipped[:, i], 0, rate=list(rates(count, **options)), path=True) for i in range(2)]
    np.testing.assert_allclose(reached, np.transpose(expected), rtol=1e-4, atol=1e-5 * np.abs(expected).max())


# Stages.


def test_the_frames_stage_changes_the_analysis_alone_and_has_no_rays_in_its_program():
    weights = stage_weights("frames")
    assert frames_only(weights) and not frames_only(FRAME_WEIGHTS)
    step, params, batch = train_step(MINI, weights=weights, solver=Caught), stage.params_of(MINI), frames()
    grads, _, terms = jax.jit(step)(params, None, batch)
    assert {n for n, v in terms.items() if v is not None} == {"frame_ce", "frame_mask", "total"}
    largest = lambda tree: max(float(jnp.abs(g).max()) for g in jax.tree.leaves(tree))
    assert largest(grads.analysis) > 0 and largest(grads._replace(analysis=None)) == 0
    assert total(stage.operations(step, params, None, batch)) < 0.5 * total(traced(MINI, FRAME_WEIGHTS))


def frames():
    return frame_batch(jax.random.key(0), [stage.prepared()], MINI)


def test_the_frames_stage_learns():
    step, init = stage.step(MINI, stage_weights("frames"))
    params, batch = stage.params_of(MINI), frames()
    state, losses = init(params), []
    for _ in range(40):
        params, state, terms = step(params, state, batch)
        losses.append(float(terms["total"]))
    assert losses[-1] < 0.8 * losses[0], losses


def test_the_views_stage_holds_the_analysis():
    step = train_step(MINI, weights=stage_weights("views"), solver=Caught)
    grads, _, terms = jax.jit(step)(stage.params_of(MINI), None, stage.batch())
    assert terms["frame_ce"] is None and terms["dynamic_rec"] is not None
    assert all((g == 0).all() for g in jax.tree.leaves(grads.analysis))
    assert any((g != 0).any() for g in jax.tree.leaves(grads.motion))


def test_a_stage_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="stage_weights: `stage` is 'half'"):
        stage_weights("half")


def test_what_is_not_finite_of_a_step_is_named_by_loss_frame_and_parameter():
    batch, params = stage.batch(MINI), stage.params_of(MINI)
    sound = find_fault(params, batch, config=MINI)
    assert sound == Fault((), (), int(batch.inputs.time))
    colour = np.array(batch.truth.colour)
    colour[0] = np.nan
    fault = find_fault(params, batch._replace(truth=batch.truth._replace(colour=colour)), config=MINI)
    assert "rec" in fault.terms and "flow3d" not in fault.terms
    assert fault.frame == int(batch.inputs.time) and any("static" in leaf for leaf in fault.leaves)
    assert "loss rec" in str(fault) and f"target frame {fault.frame}" in str(fault)
