"""A loss that is weighted is measured, or refused by name: none vanishes from a training step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from stage import MINI, PAPER, STILL

from zestjax.apps.cli import main
from zestjax.frames.selection import Slots
from zestjax.losses.objective import PAPER_WEIGHTS, absent, present, weighted_sum
from zestjax.systems import presets
from zestjax.systems.sampling import Even
from zestjax.systems.swept import Swept
from zestjax.train.learn import SIMULATED_WEIGHTS, find_fault, training_objective
from zestjax.train.recipes import Recipe
from zestjax.train.terms import KINDS, check_weights, frames_only, measurable, unmeasured

EVERY = dict.fromkeys([name for kind in KINDS for name in kind.terms], 1.0)
REGULAR = dataclasses.replace(
    MINI, sampler=Even(8), static=dataclasses.replace(MINI.static, volume=Swept(widths=(4, 8), occupied=False)),
    dynamic=dataclasses.replace(MINI.dynamic, volume=Swept(widths=(4, 8), occupied=False)),
)  # fmt: skip
NEITHER = presets.without_volumes(MINI)
looking = lambda *offsets: dataclasses.replace(MINI, dynamic=dataclasses.replace(MINI.dynamic, frames=Slots(offsets)))
SYSTEMS = {
    "mini": MINI,
    "still": STILL,
    "paper": PAPER,
    "regular": REGULAR,
    "neither": NEITHER,
    "paper, still": presets.still(PAPER),
    "motion alone": presets.without_geometry_volume(MINI),
    "still and motion alone": presets.still(presets.without_geometry_volume(MINI)),
    "before": looking(-1, 0),
    "now": looking(0),
}


@pytest.mark.parametrize(
    "name, system, needs",
    [
        ("edge", MINI, "a measure of that name"),
        ("rcc", PAPER, "a measure of that name"),
        ("depth_ce", PAPER, "volumes whose cells have logits"),
        ("depth_ce", REGULAR, "volumes whose cells have logits"),
        ("depth_ce", NEITHER, "volumes whose cells have logits"),
        ("frame_ce", PAPER, "the frames' own maps"),
        ("frame_mask", NEITHER, "the frames' own maps"),
        ("flow3d", STILL, "a dynamic field"),
        ("mask", STILL, "a dynamic field"),
        ("temp", SYSTEMS["before"], "a dynamic field with slots on both sides of the target time"),
        ("cyc", SYSTEMS["now"], "a dynamic field with slots next to the target time"),
    ],
)
def test_a_weight_whose_term_cannot_be_measured_is_refused_with_what_it_needs(name, system, needs):
    for weight in (0.5, np.float32(0.5), jnp.float32(0.0)):  # an array of 0 is no absent weight
        with pytest.raises(ValueError, match=rf"training_objective: terms .*`{name}` \(weight .*needs {needs}"):
            training_objective(system, weights={"rec": 1.0, name: weight})
    with pytest.raises(ValueError, match=f"`{name}`"):
        stage.recipe_of(system).weighted({"rec": 1.0, name: 0.5}).trainer(steps=10)
    training_objective(system, weights={"rec": 1.0, name: 0})


def test_all_that_are_lost_are_named_together():
    with pytest.raises(ValueError, match="`adv`.*`edge`.*`frame_ce`"):
        check_weights("f", PAPER, dict(rec=1.0, adv=1.0, edge=0.5, frame_ce=0.1))


def test_a_step_that_learns_from_nothing_is_refused():
    with pytest.raises(ValueError, match="training_objective: no term has a weight"):
        training_objective(MINI, weights=dict(rec=0))


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_is_said_to_be_measurable_is_measured_and_the_rest_is_not(name):
    """All terms at once: those that a system can measure are reported as numbers, the others refused."""
    system = SYSTEMS[name]
    weights, params, batch = measurable(system, EVERY), stage.params_of(system), stage.batch(system)
    total, terms = jax.eval_shape(stage.objective(system, weights), params, batch)
    assert set(terms) == set(EVERY) - unmeasured(system, EVERY).keys() and total.shape == ()
    for lost in unmeasured(system, EVERY):
        with pytest.raises(ValueError, match=f"`{lost}`"):
            training_objective(system, weights={"rec": 1.0, lost: 1.0})


def test_a_loss_of_ones_own_is_taught_beside_the_others():
    sharp = lambda prediction, truth: jnp.mean(jnp.abs(prediction.colour[1:] - prediction.colour[:-1]))
    given = dict(weights=dict(rec=1.0, sharp=0.5), own={"sharp": sharp}, blocks=2)
    total, terms = jax.jit(training_objective(MINI, **given))(stage.params_of(MINI), stage.batch())
    assert terms.keys() == {"rec", "sharp"} and terms["sharp"] > 0
    np.testing.assert_allclose(total, terms["rec"] + 0.5 * terms["sharp"], rtol=1e-6)
    assert "sharp" not in find_fault(training_objective(MINI, **given), stage.params_of(MINI), stage.batch()).terms


def test_the_usual_weights_are_those_that_a_system_can_measure():
    assert dict(Recipe(MINI).weights.terms) == SIMULATED_WEIGHTS
    assert dict(Recipe(MINI).of(STILL).weights.terms).keys() == {
        "rec", "static_rec", "depth_ce", "frame_ce", "frame_mask",
    }  # fmt: skip
    assert not unmeasured(PAPER, PAPER_WEIGHTS) and present(dict(a=0, b=None, c=2.0)) == {"c": 2.0}
    assert frames_only(dict(frame_ce=1.0, rec=0)) and not frames_only(SIMULATED_WEIGHTS)


@pytest.mark.parametrize("zero", [0, 0.0, False, np.float32(0), np.float64(0), np.int64(0), np.bool_(False), -0.0])
def test_a_zero_takes_a_term_out_whatever_its_type(zero):
    assert absent(zero)
    nan = dict(rec=jnp.float32(2.0), pho=jnp.float32(np.nan))
    assert weighted_sum(nan, dict(rec=1.0, pho=zero)) == 2.0
    assert weighted_sum(dict(rec=nan["rec"]), dict(rec=1.0, pho=zero)) == 2.0


@pytest.mark.parametrize(
    "kind", [float, np.float32, np.float64, np.int64, jnp.float32, lambda x: np.array(x, np.float64)]
)
def test_a_weight_may_be_any_number(kind):
    half = weighted_sum(dict(rec=jnp.asarray(3, jnp.bfloat16)), dict(rec=kind(2)))
    assert half == 6 and half.dtype == jnp.bfloat16


def test_a_fault_is_looked_for_by_a_program_that_is_compiled_once(caplog):
    params, batch = stage.params_of(MINI), stage.batch()
    objective = stage.objective(MINI, dict(rec=1.0, b=0.5))
    find_fault(objective, params, batch)
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        found = find_fault(objective, params, batch)
    assert not found.terms and not [r for r in caplog.records if "Compiling" in r.getMessage()]


def test_training_says_which_terms_its_system_lacks(capsys, tmp_path):
    arguments = ["train", "--preset", "tiny", "--system", "zest-none", "--steps", "1", "--stage", "frames"]
    assert main([*arguments, "--out", str(tmp_path / "run")]) == 2
    assert "needs a system whose frames are analysed" in capsys.readouterr().err
