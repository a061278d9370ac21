"""A training step: its gradient, its terms, what it leaves out, and that it learns."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import adam_by_loop, normal
from stage import MINI, PAPER, STILL

from zestjax.encoding import Volume
from zestjax.frames.analysis import FrameMaps
from zestjax.losses.objective import PAPER_WEIGHTS, measured, weighted_sum
from zestjax.solve import Adam
from zestjax.systems import presets
from zestjax.train.batches import frame_batch
from zestjax.train.blocks import in_blocks
from zestjax.train.learn import SIMULATED_WEIGHTS, Fault, find_fault, stage_weights, train_step
from zestjax.train.measures import RAYS, make_measures
from zestjax.train.recipes import Cosine, Recipe
from zestjax.train.terms import MOVER_SHARE, scene_terms, weights_of


class Caught:
    """A solver that hands back the gradient in place of new parameters."""

    @staticmethod
    def apply(params, state, grads, value):
        return grads, value


def plain_objective(system, weights, blocks=stage.BLOCKS):
    """The mean over the blocks of rays of the whole objective, written without blocks or held tables."""

    def total(params, batch):
        whole = jnp.zeros(())
        for block in range(blocks):
            truth = jax.tree.map(lambda x, b=block: jnp.split(jnp.asarray(x), blocks)[b], batch.truth)
            maps = stage.maps_of(params, batch.evidence)
            scene = system.encode(params, batch.inputs, maps)
            prediction = system.render(params, scene, batch.inputs, truth.pixels, jitter=truth.jitter)
            of_rays = weights_of(RAYS, weights)
            terms = measured(make_measures(system, params, scene, batch.inputs), prediction, truth, of_rays)
            volumes = tuple(seen.volume for seen in (scene.static, scene.dynamic))
            known = scene_terms(maps, volumes, batch, weights)
            whole += weighted_sum(terms, of_rays) + weighted_sum(known, weights_of(known, weights))
        return whole / blocks

    return total


def assert_all_finite(tree):
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(tree))


def assert_same_gradient(ours, theirs):
    largest = max(float(jnp.abs(g).max()) for g in jax.tree.leaves(theirs))
    assert largest > 0
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-5 * largest)


def test_the_blocked_gradient_is_the_plain_gradient_of_the_same_objective():
    params, batch = stage.params_of(MINI), stage.batch()
    grads, terms, value = jax.jit(stage.gradients(MINI))(params, batch)
    plain = jax.jit(jax.value_and_grad(plain_objective(MINI, SIMULATED_WEIGHTS)))
    expected_value, expected = plain(params, batch)
    np.testing.assert_allclose(value, expected_value, rtol=1e-5)
    np.testing.assert_allclose(weighted_sum(terms, SIMULATED_WEIGHTS), expected_value, rtol=1e-5)
    assert_same_gradient(grads, expected)


def test_the_objective_has_a_gradient_in_its_weights():
    params, batch, weights = stage.params_of(STILL), stage.batch(STILL), dict(rec=2.0, frame_ce=0.5)
    taught = stage.objective(STILL, weights)
    slopes, terms = jax.jit(jax.grad(taught, argnums=2, has_aux=True))(params, batch, weights)
    for name in weights:
        np.testing.assert_allclose(slopes[name], terms[name], rtol=1e-5)
    doubled = jax.jit(taught)(params, batch, jax.tree.map(lambda w: 2 * w, weights))[0]
    np.testing.assert_allclose(doubled, 2 * jax.jit(taught)(params, batch)[0], rtol=1e-5)


def test_jaxopts_interface_takes_the_objective_that_trains():
    """`Adam.update` on the objective is the training step."""
    params, batch, objective = stage.params_of(MINI), stage.batch(), stage.objective(MINI)
    options = dict(learning_rate=3e-3, clip_norm=1.0, eps=1e-3)  # not the sign of what is rounding
    solver, plain = Adam(fun=objective, has_aux=True, **options), Adam(**options)
    ours, theirs = jax.jit(train_step(objective, plain)), jax.jit(solver.update)
    mine, kept, its, state = params, plain.init_state(params), params, solver.init_state(params, batch)
    for _ in range(2):
        mine, kept, _ = ours(mine, kept, batch)
        its, state = theirs(its, state, batch)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), mine, its)


def quadratic(shared, held, block):
    """(value, aux) of a loss that is written down."""
    residual = held * (block @ shared) - 1
    return jnp.mean(residual**2), {"mean": jnp.mean(residual)}


@pytest.mark.parametrize("count", [1, 2, 4])
def test_blocks_are_a_way_to_compute_and_no_other_function(count):
    shared, held, data = normal(0, 3), jnp.float32(0.7), normal(1, 8, 3)
    blocked = jax.value_and_grad(in_blocks(quadratic, count), has_aux=True)
    (value, aux), grad = jax.jit(blocked)(shared, held, data)
    (expected, told), slope = jax.value_and_grad(quadratic, has_aux=True)(shared, held, data)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    np.testing.assert_allclose(grad, slope, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(aux["mean"], told["mean"], atol=1e-6)
    scaled = jax.grad(lambda s: 3 * in_blocks(quadratic, count)(s, held, data)[0])(shared)
    np.testing.assert_allclose(scaled, 3 * slope, rtol=1e-4, atol=1e-6)
    mapped = jax.vmap(jax.grad(lambda s: in_blocks(quadratic, count)(s, held, data)[0]))(jnp.stack([shared, shared]))
    np.testing.assert_allclose(mapped[1], slope, rtol=1e-4, atol=1e-6)


def test_blocks_do_not_say_that_a_term_has_no_gradient():
    """What the blocks' gradient leaves out is refused: a zero would be wrong in silence."""
    one_term = lambda s: in_blocks(quadratic, 2, where="here")(s, jnp.float32(1), normal(1, 8, 3))[1]["mean"]
    with pytest.raises(ValueError, match="here: only the total has a gradient in 2 blocks"):
        jax.grad(one_term)(normal(0, 3))
    with pytest.raises(ValueError, match="here: 8 rays have no 3 equal blocks"):
        in_blocks(quadratic, 3, where="here")(normal(0, 3), jnp.float32(1), normal(1, 8, 3))


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
    assert terms.keys() == {*PAPER_WEIGHTS, "total"}
    assert_all_finite((after, terms))
    assert state.skipped == 0
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), params, after)
    parts = (*changed.static, *changed.dynamic)
    assert change is not plain or all(any(jax.tree.leaves(part)) for part in parts)


def caught(system, weights=None):
    """A step that hands back its gradient."""
    return train_step(stage.objective(system, weights), Caught)


def traced(system, weights):
    """Operations of a step's program."""
    return stage.operations(caught(system, weights), stage.params_of(system), None, stage.batch(system))


def total(count):
    return sum(count.values())


def test_a_loss_without_weight_is_not_in_the_program():
    whole = traced(PAPER, PAPER_WEIGHTS)
    without = {name: traced(PAPER, PAPER_WEIGHTS | {name: 0}) for name in ("geo", "cyc", "sp")}
    assert all(total(count) < total(whole) for count in without.values())
    assert total(traced(PAPER, PAPER_WEIGHTS | {"geo": None})) == total(without["geo"])
    # Without a loss on warped renders, the field is not followed to its neighbours at all.
    still = traced(PAPER, PAPER_WEIGHTS | {"pho": 0, "cyc": 0})
    assert total(still) < 0.8 * total(whole)


def test_a_static_scene_learns_without_a_dynamic_branch():
    of_still, of_all = stage.usual_weights(STILL), stage.usual_weights(MINI)
    assert total(traced(STILL, of_still)) < 0.75 * total(traced(MINI, of_all))
    grads, _, terms = jax.eval_shape(caught(STILL), stage.params_of(STILL), None, stage.batch(STILL))
    assert grads.dynamic is None
    assert terms.keys() == {"rec", "static_rec", "depth_ce", "frame_ce", "frame_mask", "total"}


@pytest.mark.parametrize("name", ["without_motion_volume", "without_geometry_volume", "without_volumes"])
@pytest.mark.parametrize("base", [MINI, PAPER], ids=["mini", "paper"])
def test_every_ablation_has_a_step(base, name):
    system = getattr(presets, name)(base)
    weights = PAPER_WEIGHTS if base is PAPER else stage.usual_weights(system)
    params = stage.params_of(system)
    grads, _, terms = jax.eval_shape(caught(system, weights), params, None, stage.batch(system))
    assert jax.tree.structure(grads) == jax.tree.structure(params) and terms["rec"].shape == ()


# What is known of a scene before any ray.


def scene_case():
    logits, moving = normal(0, 2, 3, 4, 6), normal(1, 2, 6, 8)
    maps = FrameMaps(logits, None, None, moving)
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
    terms = scene_terms(maps, encoded, batch, SIMULATED_WEIGHTS)
    wide = lambda x: np.asarray(x, np.float64)
    log = lambda x, axis: wide(x) - np.log(np.exp(wide(x)).sum(axis, keepdims=True))
    still, moved = log(encoded[0].logits, 0), log(encoded[1].logits, 0)
    expected = -np.mean(0.75 * still[1] + 0.25 * still[2]) - np.mean(np.diagonal(moved[2]))
    np.testing.assert_allclose(terms["depth_ce"], expected, rtol=1e-5)
    frames = log(maps.logits, -1)[0]
    moving = wide(batch.frame_moving)[0].reshape(3, 2, 4, 2).mean((1, 3))
    share = (1 + (MOVER_SHARE - 1) * moving) / MOVER_SHARE
    expected = -np.average((frames[..., 4] + frames[..., 5]) / 2, weights=share)
    np.testing.assert_allclose(terms["frame_ce"], expected, rtol=1e-5)
    logits = wide(maps.moving_logits)[0]
    np.testing.assert_allclose(
        terms["frame_mask"], np.mean(np.log1p(np.exp(logits)) - wide(batch.frame_moving)[0] * logits), rtol=1e-5
    )


@pytest.mark.parametrize("size", [1e4, -1e4, 0.0])
def test_scene_terms_are_finite_with_finite_gradients(size):
    maps, encoded, batch = scene_case()

    def summed(scale):
        scaled = jax.tree.map(lambda x: scale * x, (maps, encoded))
        terms = scene_terms(*scaled, batch, SIMULATED_WEIGHTS)
        return terms["depth_ce"] + terms["frame_ce"] + terms["frame_mask"]

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
def test_the_compiled_step_keeps_its_schedule(count, options):
    """Adam by hand at rates by hand, of gradients clipped by hand; the batch is the gradient."""
    steps, rate = options.pop("steps"), Cosine(**options)
    objective = lambda params, batch: (jnp.sum(params["w"] * batch), {"rec": params["w"][0]})
    solver = Adam(learning_rate=lambda step: rate(step, steps=steps), clip_norm=1.0)
    init, step = solver.init_state, jax.jit(train_step(objective, solver))
    params = {"w": jnp.zeros(2)}
    state, reached = init(params), []
    batches = normal(0, count, 2) * np.where(np.arange(count) % 3, 0.3, 5)[:, None].astype(np.float32)
    for batch in batches:
        params, state, terms = step(params, state, batch)
        reached.append(np.asarray(params["w"]))
    assert terms.keys() == {"rec", "total"}
    wide = np.asarray(batches, np.float64)
    clipped = wide / np.maximum(np.linalg.norm(wide, axis=1, keepdims=True), 1)
    options = options | {"steps": steps}
    expected = [adam_by_loop(clipped[:, i], 0, rate=list(rates(count, **options)), path=True) for i in range(2)]
    np.testing.assert_allclose(reached, np.transpose(expected), rtol=1e-4, atol=1e-5 * np.abs(expected).max())


# Stages.


FRAMES, VIEWS = (stage_weights(name, weights=SIMULATED_WEIGHTS) for name in ("frames", "views"))


def test_the_frames_stage_changes_the_analysis_alone_and_has_no_rays_in_its_program():
    step, params, batch = caught(MINI, FRAMES), stage.params_of(MINI), frames()
    grads, _, terms = jax.jit(step)(params, None, batch)
    assert terms.keys() == {"frame_ce", "frame_mask", "total"}
    largest = lambda tree: max(float(jnp.abs(g).max()) for g in jax.tree.leaves(tree))
    assert largest(grads.analysis) > 0 and largest(grads._replace(analysis=None)) == 0
    assert total(stage.operations(step, params, None, batch)) < 0.5 * total(traced(MINI, SIMULATED_WEIGHTS))


def frames():
    return frame_batch(jax.random.key(0), [stage.prepared()], MINI)


def test_the_frames_stage_learns():
    step, init = stage.step(MINI, FRAMES)
    params, batch = stage.params_of(MINI), frames()
    state, losses = init(params), []
    for _ in range(40):
        params, state, terms = step(params, state, batch)
        losses.append(float(terms["total"]))
    assert losses[-1] < 0.8 * losses[0], losses


def test_the_views_stage_holds_the_analysis():
    grads, _, terms = jax.jit(caught(MINI, VIEWS))(stage.params_of(MINI), None, stage.batch())
    assert "frame_ce" not in terms and "dynamic_rec" in terms
    assert all((g == 0).all() for g in jax.tree.leaves(grads.analysis))
    assert any((g != 0).any() for g in jax.tree.leaves(grads.dynamic.volume))


def test_a_recipes_stage_is_that_of_its_weights():
    assert dict(Recipe(MINI).stage("frames").weights.terms) == FRAMES


def test_a_stage_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="stage_weights: `stage` is 'half'"):
        stage_weights("half", weights=SIMULATED_WEIGHTS)


def test_what_is_not_finite_of_a_step_is_named_by_loss_frame_and_parameter():
    batch, params = stage.batch(MINI), stage.params_of(MINI)
    sound = find_fault(stage.objective(MINI), params, batch)
    assert sound == Fault((), (), (int(batch.inputs.time),))
    colour = np.array(batch.truth.colour)
    colour[0] = np.nan
    fault = find_fault(stage.objective(MINI), params, batch._replace(truth=batch.truth._replace(colour=colour)))
    assert "rec" in fault.terms and "flow3d" not in fault.terms
    assert fault.frames == (int(batch.inputs.time),) and any("static" in leaf for leaf in fault.leaves)
    assert "loss rec" in str(fault) and f"target frame {fault.frames[0]}" in str(fault)
