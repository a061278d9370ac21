"""A loss that is weighted is measured, or refused by name: none vanishes from a training step."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from stage import MINI, PAPER, STILL

from zestjax.cli import main
from zestjax.learn import FRAME_WEIGHTS, find_fault, make_train_step, step_gradients, train_step
from zestjax.losses.objective import PAPER_WEIGHTS, Terms, absent, present, weighted_sum
from zestjax.measures import FRAME_TERMS, RAY_TERMS, SCENE_TERMS, check_weights, measurable, unmeasured

EVERY = Terms(*(1.0 for _ in Terms._fields))
REGULAR = dataclasses.replace(MINI, sampling="regular")
NEITHER = dataclasses.replace(MINI, geometry=False, motion=False)
CONFIGS = {
    "mini": MINI,
    "still": STILL,
    "paper": PAPER,
    "regular": REGULAR,
    "neither": NEITHER,
    "paper, still": dataclasses.replace(PAPER, dynamic=False),
    "motion alone": dataclasses.replace(MINI, geometry=False),
    "still and motion alone": dataclasses.replace(MINI, geometry=False, dynamic=False),
    "before": dataclasses.replace(MINI, slots=(-1, 0)),
    "now": dataclasses.replace(MINI, slots=(0,)),
}


@pytest.mark.parametrize(
    "name, config, needs",
    [
        ("distortion", MINI, "a measure of your own"),
        ("edge", MINI, "a measure of your own"),
        ("adv", PAPER, "a measure of your own"),
        ("depth_ce", PAPER, "volumes that guide the sampling"),
        ("depth_ce", REGULAR, "volumes that guide the sampling"),
        ("depth_ce", NEITHER, "volumes that guide the sampling"),
        ("frame_ce", PAPER, "the frames' own analysis"),
        ("frame_mask", NEITHER, "the frames' own analysis"),
        ("flow3d", STILL, "a dynamic field"),
        ("mask", STILL, "a dynamic field"),
        ("temp", CONFIGS["before"], "slots on both sides of the target time"),
        ("cyc", CONFIGS["now"], "slots next to the target time"),
    ],
)
def test_a_weight_whose_term_cannot_be_measured_is_refused_with_what_it_needs(name, config, needs):
    for weight in (0.5, np.float32(0.5), jnp.float32(0.0)):  # an array of 0 is no absent weight
        weights = Terms(rec=1.0)._replace(**{name: weight})
        for ask in (
            lambda w: train_step(config, weights=w, solver=None),
            lambda w: make_train_step(config, steps=10, weights=w),
            lambda w: step_gradients(config, weights=w),
        ):
            with pytest.raises(ValueError, match=rf"train_step: terms that cannot .*`{name}` \(weight .*needs {needs}"):
                ask(weights)
    train_step(config, weights=Terms(rec=1.0)._replace(**{name: 0}), solver=None)


def test_all_that_are_lost_are_named_together():
    with pytest.raises(ValueError, match="`frame_ce`.*`distortion`.*`adv`"):
        check_weights("f", PAPER, Terms(rec=1.0, adv=1.0, distortion=0.5, frame_ce=0.1))


def test_a_step_that_learns_from_nothing_is_refused():
    with pytest.raises(ValueError, match="train_step: no term has a weight"):
        train_step(MINI, weights=Terms(rec=0), solver=None)


@pytest.mark.parametrize("name", CONFIGS)
def test_what_is_said_to_be_measurable_is_measured_and_the_rest_is_not(name):
    """Every term alone: those that a configuration can measure are reported as numbers, the others refused."""
    config = CONFIGS[name]
    weights = measurable(config, EVERY)
    assert {n for n, w in weights._asdict().items() if w is None} == unmeasured(config).keys()
    params = jax.eval_shape(lambda key: stage.model.init_params(key, config), jax.random.key(0))
    of_paper = config.encoder == "pyramid"
    batch = stage.batch(PAPER if of_paper else MINI)
    if config.slots not in (MINI.slots, PAPER.slots):
        return  # the stage has no such frames; the refusals above say what is needed
    _, terms, total = jax.eval_shape(step_gradients(config, weights=weights), params, batch)
    assert {n for n, v in terms._asdict().items() if v is not None} == set(Terms._fields) - unmeasured(config).keys()
    assert total.shape == ()


def test_every_term_is_somewhere_measured_or_said_to_be_a_users_own():
    assert set(RAY_TERMS) | set(SCENE_TERMS) | unmeasured(MINI).keys() == set(Terms._fields)
    assert set(FRAME_TERMS) < set(SCENE_TERMS)


def test_the_usual_weights_are_those_that_a_configuration_can_measure():
    usual = lambda config: jax.eval_shape(step_gradients(config), stage.params_of(config), stage.batch(config))[1]
    there = lambda terms: {n for n, v in terms._asdict().items() if v is not None}
    assert there(usual(MINI)) == there(present(FRAME_WEIGHTS))
    assert there(usual(STILL)) == {"rec", "static_rec", "depth_ce", "frame_ce", "frame_mask"}
    assert not there(present(PAPER_WEIGHTS)) & unmeasured(PAPER).keys()


@pytest.mark.parametrize("zero", [0, 0.0, False, np.float32(0), np.float64(0), np.int64(0), np.bool_(False), -0.0])
def test_a_zero_takes_a_term_out_whatever_its_type(zero):
    assert absent(zero)
    nan = Terms(rec=jnp.float32(2.0), pho=jnp.float32(np.nan))
    assert weighted_sum(nan, Terms(rec=1.0, pho=zero)) == 2.0
    assert weighted_sum(Terms(rec=nan.rec), Terms(rec=1.0, pho=zero)) == 2.0


@pytest.mark.parametrize(
    "kind", [float, np.float32, np.float64, np.int64, jnp.float32, lambda x: np.array(x, np.float64)]
)
def test_a_weight_may_be_any_number(kind):
    half = weighted_sum(Terms(rec=jnp.asarray(3, jnp.bfloat16)), Terms(rec=kind(2)))
    assert half == 6 and half.dtype == jnp.bfloat16


def test_a_fault_is_looked_for_by_a_program_that_is_compiled_once(caplog):
    params, batch = stage.params_of(MINI), stage.batch()
    weights = Terms(rec=1.0, b=0.5)
    find_fault(params, batch, config=MINI, weights=weights)
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        found = find_fault(params, batch, config=MINI, weights=weights._replace(b=0.25))
    assert not found.terms and not [r for r in caplog.records if "Compiling" in r.getMessage()]


def test_training_says_which_terms_its_system_lacks(capsys, tmp_path):
    arguments = ["train", "--preset", "tiny", "--system", "zest-none", "--steps", "1", "--stage", "frames"]
    assert main([*arguments, "--out", str(tmp_path / "run")]) == 2
    assert "error: train_step: no term has a weight" in capsys.readouterr().err
