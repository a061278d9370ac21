"""A real video and what is known of it: priors are learned from, and what is unknown takes its terms out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from stage import MINI, PAPER

from zestjax.apps.own_frames import known_of, own_frame_batches
from zestjax.apps.simulate import SimulateOptions, simulate
from zestjax.apps.train import TrainOptions, run_recipe
from zestjax.cameras import project, unproject
from zestjax.frames.known import answers_of, known_frames, shared
from zestjax.io.scenes import load_scene
from zestjax.losses.objective import PAPER_WEIGHTS
from zestjax.systems import presets
from zestjax.systems.fields import reads_frames
from zestjax.train.measures import Truth, make_measures
from zestjax.train.rays import Pixels
from zestjax.train.recipes import PAPER as PAPER_RECIPE
from zestjax.train.recipes import PRIOR_STEPS, RECIPES
from zestjax.train.terms import ANSWERS, check_answers, measurable, unmeasured

H, W = stage.SIZE
FLOW = np.broadcast_to(np.float32([[[[1.5, -0.5]]]]), (stage.FRAMES, 2, H, W, 2))
VALID = np.broadcast_to(np.arange(W) < W // 2, (stage.FRAMES, 2, H, W))
DISPARITY = np.where(np.arange(W) < 20, 1 / np.stack([stage.shot(x, t)[1] for t, x in enumerate(stage.PLACES)]), np.nan)


def known(**given):
    return known_frames(stage.video(), **given)


FULL = dict(disparity=DISPARITY, flow=FLOW, flow_valid=VALID)


def batch_of(given, system=PAPER, step=0):
    return own_frame_batches(given, stage.recipe_of(system), seed=3)(step)


def test_a_video_that_nobody_knows_anything_of_says_nothing():
    batch = batch_of(known(), MINI)
    unknown = {name for name, value in batch.truth._asdict().items() if value is None}
    assert unknown == set(Truth._fields) - {"pixels", "colour"}
    assert all(value is None for value in batch[3:])
    assert answers_of(known()) == set() and answers_of(known(**FULL)) == {"disparity", "pixel_flow"}


def test_priors_are_those_of_the_rays():
    batch = batch_of(known(**FULL))
    u, v = batch.truth.pixels.astype(int).T
    time = int(batch.inputs.time)
    np.testing.assert_array_equal(batch.truth.disparity, DISPARITY[time, v, u].astype(np.float32))
    np.testing.assert_array_equal(batch.truth.pixel_flow, np.broadcast_to([1.5, -0.5], (len(u), 2, 2)))
    np.testing.assert_array_equal(batch.truth.pixel_flow_valid[:, 1], u < W // 2)


def test_masks_mine_rays_and_are_not_learned_from():
    mined = np.zeros((stage.FRAMES, H, W), bool)
    mined[:, 3, 5] = True
    truth = batch_of(known(mined=mined)).truth
    assert truth.moving is None and (truth.pixels[stage.PIXELS.count :] == [5, 3]).all()


@pytest.mark.parametrize("name", sorted(ANSWERS))
def test_a_term_whose_answer_is_unknown_is_refused_by_name(name):
    weights, words = {"rec": 1.0, name: 0.5}, " or ".join(ANSWERS[name]).replace("_", " ")
    assert unmeasured(MINI, weights, known=()) == {name: f"targets whose {words} is known"}
    assert measurable(MINI, weights, known=()) == {"rec": 1.0}
    assert measurable(MINI, weights, known=ANSWERS[name][-1:]) == weights
    truth = Truth(np.zeros((1, 2)), np.zeros((1, 3)))
    if set(ANSWERS[name]) & set(Truth._fields):
        with pytest.raises(ValueError, match=rf"f: `{name}` \(weight 0.5\) needs .*, which are None here"):
            check_answers("f", weights, truth)


def test_an_objective_does_not_teach_what_nobody_knows():
    with pytest.raises(ValueError, match="training_objective: `geo` .* needs flow or pixel_flow, which are None"):
        objective = stage.objective(PAPER, PAPER_WEIGHTS | {"depth": 0}, blocks=1)
        jax.eval_shape(objective, stage.params_of(PAPER), batch_of(known()))


@pytest.fixture(scope="module")
def measured():
    """The paper's terms of one batch with priors, the prediction, and the batch."""
    batch, params = batch_of(known(**FULL)), stage.params_of(PAPER)
    truth = jax.tree.map(lambda x: x[::2], batch.truth)

    def run(params, inputs, truth):
        scene = PAPER.encode(params, inputs, None)
        shown = PAPER.render(params, scene, inputs, truth.pixels, jitter=truth.jitter)
        terms = make_measures(PAPER, params, scene, inputs)
        return {name: terms[name](shown, truth) for name in PAPER_WEIGHTS}, shown, scene

    return *jax.jit(run)(params, batch.inputs, truth), batch.inputs, truth


def test_the_depth_prior_is_compared_by_disparity_where_it_is_finite(measured):
    terms, shown, _, _, truth = measured
    there = np.isfinite(truth.disparity)
    ours, theirs = (
        -1 / np.asarray(shown.depth_of_dynamic, np.float64)[there],
        -truth.disparity[there].astype(np.float64),
    )
    white = lambda x: (x - np.sort(x)[(len(x) - 1) // 2]) / np.abs(x - np.sort(x)[(len(x) - 1) // 2]).mean()
    np.testing.assert_allclose(terms["depth"], np.abs(white(ours) - white(theirs)).mean(), rtol=1e-3)


def test_the_flow_prior_is_where_a_pixel_goes(measured):
    """By hand: the dynamic field's expected points, moved, in the neighbours' cameras."""
    terms, shown, scene, inputs, truth = measured
    wide = lambda x: np.asarray(x, np.float64)
    weights, place = wide(shown.dynamic_alone), PAPER.place(scene, inputs)
    errors = []
    for i, (sign, flow) in enumerate(((1, shown.dynamic.flow_forward), (-1, shown.dynamic.flow_backward))):
        slot = inputs.slots.times.tolist().index(float(inputs.time) + sign)
        if not inputs.slots.valid[slot]:
            continue
        moved = wide(place.world(shown.marched.coords + flow))
        point = (weights[..., None] * moved).sum(1) / np.maximum(weights.sum(1), 1e-6)[:, None]
        camera = jax.tree.map(lambda x, s=slot: jnp.asarray(x[s]), inputs.slots.cameras)
        seen = project(camera, jnp.asarray(point, jnp.float32))
        good = (truth.pixel_flow_valid[:, i] > 0) & np.asarray(seen.in_front)
        wanted = truth.pixels + truth.pixel_flow[:, i]
        errors.append(np.abs(wide(seen.pixels) - wanted)[good].mean())
    assert errors
    np.testing.assert_allclose(terms["geo"], sum(errors) / 2, rtol=0.02)


def test_the_true_flow_as_a_prior_says_the_same_as_the_true_flow():
    """In pixels, of a simulated target: one loss, whichever way it is told."""
    batch, params = stage.batch(PAPER), stage.params_of(PAPER)
    truth = jax.tree.map(lambda x: x[::3], batch.truth)._replace(jitter=None)
    point, flows, valid = unproject(batch.inputs.camera, truth.pixels, truth.depth), [], []
    for i, sign in enumerate((1, -1)):
        slot = batch.inputs.slots.times.tolist().index(float(batch.inputs.time) + sign)
        camera = jax.tree.map(lambda x, s=slot: jnp.asarray(x[s]), batch.inputs.slots.cameras)
        moved = project(camera, point + truth.flow[:, i])
        flows.append(moved.pixels - truth.pixels)
        valid.append(moved.in_front.astype(np.float32))
    told = truth._replace(pixel_flow=np.stack(flows, 1), pixel_flow_valid=np.stack(valid, 1))

    @jax.jit
    def geo(inputs, truth):
        scene = PAPER.encode(params, inputs, None)
        shown = PAPER.render(params, scene, inputs, truth.pixels)
        return make_measures(PAPER, params, scene, inputs)["geo"](shown, truth)

    np.testing.assert_allclose(geo(batch.inputs, told), geo(batch.inputs, truth), rtol=1e-4)


def test_scenes_learned_from_together_know_what_all_of_them_know():
    both = shared([known(**FULL), known(disparity=DISPARITY)])
    assert [answers_of(frames) for frames in both] == [{"disparity"}] * 2
    assert both[0].flow is None and both[1].disparity is DISPARITY


@pytest.mark.parametrize(
    "given, words",
    [
        (dict(flow=FLOW), "`flow` and `flow_valid` belong together"),
        (dict(disparity=DISPARITY[1:]), "axis N of `disparity` is 5, expected 6"),
        (dict(moving=np.zeros((stage.FRAMES, 4, W), bool)), "axis H of `moving` is 4"),
    ],
)
def test_what_does_not_belong_to_the_frames_is_refused(given, words):
    with pytest.raises(ValueError, match=f"known_frames: {words}"):
        known(**given)


# From files to the paper's recipe.


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A simulated scene on disk, with masks, disparity and optical flow."""
    place = tmp_path_factory.mktemp("known") / "scene"
    simulate(SimulateOptions(place, scene="walker", size=(32, 48), frames=6, quiet=True))
    return place


def test_a_scenes_priors_reach_the_rays(folder):
    scene = load_scene(folder)
    found = known_of(scene)
    assert answers_of(found) == {"disparity", "pixel_flow"} and found.mined.any()
    assert (
        found.flow.shape == (6, 2, 32, 48, 2) and not found.flow_valid[0, 1].any() and not found.flow_valid[5, 0].any()
    )
    np.testing.assert_array_equal(found.flow[2, 0], scene.flow_forward.vectors[2])


def test_the_papers_recipe_is_the_papers(capsys):
    recipe = PAPER_RECIPE
    assert dict(recipe.weights.terms) == PAPER_WEIGHTS and len(PAPER_WEIGHTS) == 10
    assert recipe.rays == Pixels(1024, 512, PRIOR_STEPS) and recipe.rays.jittered
    assert (recipe.rate.peak, recipe.rate.floor) == (5e-4, 1e-7)
    np.testing.assert_allclose(recipe.rate(0, steps=1000), 5e-4, rtol=1e-6)
    faded = recipe.weights(PRIOR_STEPS)
    assert faded == pytest.approx(PAPER_WEIGHTS | {"geo": 0.002, "depth": 0.004})
    both = TrainOptions("unused", preset="paper", scenes=("a",))
    assert dict(run_recipe(recipe, both, known={"disparity", "pixel_flow"}).weights.terms) == PAPER_WEIGHTS
    assert not capsys.readouterr().err
    assert dict(run_recipe(recipe, both, known={"disparity"}).weights.terms).keys() == PAPER_WEIGHTS.keys() - {"geo"}
    assert "learns without geo (needs targets whose flow or pixel flow is known)" in capsys.readouterr().err
    assert dict(RECIPES["small"].of(MINI, known=()).weights.terms) == {"rec": 20.0, "b": 1e-3}


@pytest.mark.parametrize("source", ["clips", "scene"])
def test_a_step_of_the_papers_recipe_reports_exactly_its_ten_terms(source, folder):
    """At a size for tests; `test_studies` trains the preset itself."""
    recipe = dataclasses.replace(
        stage.recipe_of(PAPER), weights=PAPER_RECIPE.weights, rate=PAPER_RECIPE.rate, rays=Pixels(96, 8)
    )
    batch = (
        stage.batch(PAPER) if source == "clips" else own_frame_batches(known_of(load_scene(folder)), recipe, seed=0)(0)
    )
    init, step = recipe.trainer(steps=10)
    params = stage.params_of(PAPER)
    params, state, terms = jax.jit(step)(params, init(params), batch)
    assert terms.keys() == {*PAPER_WEIGHTS, "total"} and all(np.isfinite(x) for x in terms.values())
    assert state.skipped == 0


def test_a_scene_is_learned_by_heart_in_one_frustum_from_all_its_frames():
    """NSFF reads no frame: none is held back, and where its points are does not change from step to step."""
    recipe = dataclasses.replace(
        stage.recipe_of(PAPER), system=presets.nsff(width=8, depth=2, levels=(2, 1), samples=4)
    )
    read = lambda system: [reads_frames(field) for field in (system.static, system.dynamic)]
    assert read(recipe.system) == [False, False] and read(PAPER) == [True, True]
    assert read(presets.GEOMETRY) == [True, False] and read(presets.STILL) == [True, False]
    batch_at, seen = own_frame_batches(known(**FULL), recipe, seed=0, exclude=(5,)), {}
    for step in range(24):
        batch = batch_at(step)
        seen[int(batch.inputs.time)] = batch
        assert batch.inputs.key.times.tolist() == [0.0] and batch.evidence is None
    assert set(seen) == set(range(5))
    first, last = (recipe.system.space.frustum(seen[time].inputs) for time in (0, 4))
    jax.tree.map(np.testing.assert_array_equal, first, last)
    there = dict(zip(seen[4].inputs.slots.times.tolist(), seen[4].inputs.slots.valid.tolist(), strict=True))
    assert there == {2.0: 1, 3.0: 1, 5.0: 0, 6.0: 0}
