"""Learning rates and prior weights as functions of the step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.losses.objective import PAPER_WEIGHTS, absent
from zestjax.train import schedules


def test_cosine_rises_to_its_peak_and_falls_to_its_floor():
    rate = jax.jit(jax.vmap(lambda step: schedules.cosine(step, peak=1e-3, floor=1e-6, steps=110, warmup=10)))
    rates = np.asarray(rate(jnp.arange(200)))
    np.testing.assert_allclose(rates[:10], 1e-3 * np.arange(1, 11) / 10, rtol=1e-5)
    np.testing.assert_allclose(rates[60], (1e-3 + 1e-6) / 2, rtol=1e-4)
    np.testing.assert_allclose(rates[110:], 1e-6, rtol=1e-3)
    assert (np.diff(rates[10:]) <= 0).all() and (rates > 0).all()


def test_cosine_without_warmup_starts_at_its_peak():
    np.testing.assert_allclose(schedules.cosine(0, peak=5e-4, floor=1e-7, steps=10), 5e-4, rtol=1e-6)


def test_published_priors_lose_nine_tenths_at_each_stair():
    at = lambda step: schedules.decayed_priors(PAPER_WEIGHTS, step, decay=30_000)
    assert at(29_999) == PAPER_WEIGHTS
    np.testing.assert_allclose(at(30_000)["geo"], 0.002)
    np.testing.assert_allclose(at(60_000)["depth"], 0.0004)
    assert at(60_000) | {"geo": 0.02, "depth": 0.04} == PAPER_WEIGHTS


def test_a_prior_past_its_end_is_absent():
    gone = schedules.decayed_priors(PAPER_WEIGHTS, 100, decay=10, end=100)
    assert absent(gone["geo"]) and absent(gone["depth"]) and not absent(gone["rec"])
    assert not absent(schedules.decayed_priors(PAPER_WEIGHTS, 99, decay=10, end=100)["geo"])


@pytest.mark.parametrize("shape", ["staircase", "smooth"])
def test_a_traced_step_gives_the_same_weights(shape):
    weight = lambda step: schedules.decayed_priors(PAPER_WEIGHTS, step, decay=7, shape=shape, end=40)["geo"]
    traced = jax.jit(jax.vmap(weight))
    known = [weight(step) for step in range(50)]
    np.testing.assert_allclose(traced(jnp.arange(50)), known, rtol=1e-4, atol=1e-12)


def test_an_absent_prior_stays_absent():
    without = PAPER_WEIGHTS | {"geo": None, "depth": 0}
    assert schedules.decayed_priors(without, jnp.int32(3), decay=10) == without


def test_impossible_schedules_are_refused():
    with pytest.raises(ValueError, match="cosine: `warmup` is 10 and `steps` 10"):
        schedules.cosine(0, peak=1.0, floor=0.0, steps=10, warmup=10)
    with pytest.raises(ValueError, match="decayed_priors: `decay` is 0"):
        schedules.decayed_priors(PAPER_WEIGHTS, 0, decay=0)
    with pytest.raises(ValueError, match="'staircase', 'smooth'"):
        schedules.decayed_priors(PAPER_WEIGHTS, 0, decay=1, shape="linear")
