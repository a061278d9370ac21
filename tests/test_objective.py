"""Weights meet losses in one place, and a weight of 0 leaves nothing behind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import normal

from zestjax.losses.objective import PAPER_WEIGHTS, absent, make_objective, measured, weighted_sum

PARAMS, BATCH = {"w": normal(0, 16, 16), "v": normal(1, 16, 16)}, normal(2, 8, 16)


def predict(params, batch):
    """Two branches, so that a term can be the only one that needs one."""
    return {"cheap": batch @ params["w"], "dear": jnp.sin(batch @ params["v"] @ params["v"])}


MEASURES = dict(
    rec=lambda prediction, batch: jnp.mean((prediction["cheap"] - batch) ** 2),
    pho=lambda prediction, batch: jnp.mean(jnp.exp(-(prediction["dear"] ** 2))),
)


def counted(fn):
    """Floating-point operations of a compiled function of the parameters and the batch."""
    return (fn.lower(PARAMS, BATCH).compile().cost_analysis() or {})["flops"]


def flops(weights):
    """Floating-point operations of the compiled objective and its gradient."""
    fn = jax.jit(jax.value_and_grad(make_objective(predict, MEASURES, weights=weights), has_aux=True))
    return counted(fn)


def test_the_total_is_the_weighted_sum_of_the_terms():
    total, terms = make_objective(predict, MEASURES)(PARAMS, BATCH, dict(rec=2.0, pho=jnp.float32(0.5)))
    np.testing.assert_allclose(total, 2 * terms["rec"] + 0.5 * terms["pho"], rtol=1e-6)
    np.testing.assert_allclose(terms["rec"], jnp.mean((BATCH @ PARAMS["w"] - BATCH) ** 2), rtol=1e-5)


def test_a_term_of_weight_zero_and_what_only_it_needs_are_not_in_the_program():
    alone = make_objective(lambda p, b: {"cheap": b @ p["w"]}, MEASURES, weights=dict(rec=1.0))
    bare = counted(jax.jit(jax.value_and_grad(alone, has_aux=True)))
    assert flops(dict(rec=1.0, pho=0)) == flops(dict(rec=1.0)) == bare
    assert flops(dict(rec=1.0, pho=1e-3)) > 2 * bare


def test_a_term_of_weight_zero_is_not_even_traced():
    def never(prediction, batch):
        raise AssertionError("traced")

    objective = make_objective(predict, MEASURES | {"pho": never})
    assert objective(PARAMS, BATCH, dict(rec=1.0, pho=0.0))[1].keys() == {"rec"}
    count = lambda weights: len(
        jax.make_jaxpr(lambda p: make_objective(predict, MEASURES)(p, BATCH, weights))(PARAMS).eqns
    )
    assert count(dict(rec=1.0)) < count(dict(rec=1.0, pho=1.0))


def test_a_term_declared_absent_stays_absent_when_weights_are_arguments():
    objective = make_objective(predict, MEASURES, weights=dict(rec=1.0, pho=0))
    terms = jax.jit(objective)(PARAMS, BATCH, dict(rec=1.0, pho=0))[1]
    assert terms.keys() == {"rec"}


def test_weights_can_be_swept_by_vmap_and_differentiated():
    objective = make_objective(predict, MEASURES)
    weights = dict(rec=jnp.array([0.0, 1.0]), pho=jnp.array([1.0, 2.0]))
    totals, terms = jax.vmap(lambda w: objective(PARAMS, BATCH, w))(weights)
    np.testing.assert_allclose(totals, weights["rec"] * terms["rec"] + weights["pho"] * terms["pho"], rtol=1e-6)
    slope = jax.grad(lambda w: objective(PARAMS, BATCH, w)[0])(dict(rec=1.0, pho=1.0))
    np.testing.assert_allclose(slope["rec"], terms["rec"][0], rtol=1e-5)


def test_nothing_to_weigh_is_zero():
    assert weighted_sum(dict(), dict()) == 0


def test_the_published_weights_are_those_of_the_paper():
    published = {"cyc": 1.0, "min": 0.1, "sp": 0.1, "temp": 0.1, "b": 1e-3, "w": 0.1, "depth": 0.04, "geo": 0.02}
    ours = dict(PAPER_WEIGHTS)
    assert all(ours.pop(name) == weight for name, weight in published.items())
    assert {name: weight for name, weight in ours.items() if not absent(weight)} == {"rec": 1.0, "pho": 1.0}


def test_a_weight_without_a_loss_is_named():
    with pytest.raises(ValueError, match="term `cyc` has weight 1.0 but no measure"):
        make_objective(predict, MEASURES)(PARAMS, BATCH, {"cyc": 1.0, **PAPER_WEIGHTS, "w": None, "b": 0})
    with pytest.raises(ValueError, match="term `geo` has weight 0.5 but no value"):
        weighted_sum(dict(), dict(geo=0.5))
    with pytest.raises(ValueError, match="no `weights`"):
        make_objective(predict, MEASURES)(PARAMS, BATCH)


def test_any_name_will_do():
    """A loss of one's own is weighed as the others are."""
    own = MEASURES | {"sharpness": lambda prediction, batch: jnp.max(prediction["cheap"])}
    total, terms = make_objective(predict, own)(PARAMS, BATCH, dict(rec=1.0, sharpness=0.25))
    assert terms.keys() == {"rec", "sharpness"}
    np.testing.assert_allclose(total, terms["rec"] + 0.25 * terms["sharpness"], rtol=1e-6)
    with pytest.raises(ValueError, match="term `sharpnes` has weight 1.0 but no measure"):
        measured(own, None, None, dict(sharpnes=1.0))
