"""The total loss: the only place in the package where a loss meets its weight.

Terms      one number per loss; used for values, for weights, and (as callables) for how each is measured
absent     a term whose weight is None or the number 0, Python's or NumPy's: it is not traced, so the compiled program
           does not contain it. A weight that is an array, even one holding 0, is always computed.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

NUMBER = int | float | np.number | np.bool_  # a NumPy scalar is a number; an array of no axes is an array


class Terms(NamedTuple):
    """One entry per loss; None is an absent one.

    The paper's: rec (reconstruction), pho (warped colour), w (confidence to one), b (blend entropy), cyc (flow
    there and back), min (flow magnitude), sp (flow smooth in space), temp (flow smooth in time), geo (optical
    flow prior), depth (depth prior).
    From a simulator's exact answers: depth_ce (cross-entropy over the volumes' planes), static_rec (render of the
    static field alone), frame_ce and frame_mask (each input frame's own depth and moving pixels), mask (dynamicness
    against the motion mask), dynamic_rec (reconstruction of what moves alone), flow3d (scene flow).
    Other systems': distortion (weights lie together), edge (edge-aware disparity), adv (a discriminator's verdict).
    """

    rec: Any = None
    pho: Any = None
    w: Any = None
    b: Any = None
    cyc: Any = None
    min: Any = None
    sp: Any = None
    temp: Any = None
    geo: Any = None
    depth: Any = None
    depth_ce: Any = None
    static_rec: Any = None
    frame_ce: Any = None
    frame_mask: Any = None
    mask: Any = None
    dynamic_rec: Any = None
    flow3d: Any = None
    distortion: Any = None
    edge: Any = None
    adv: Any = None


PAPER_WEIGHTS = Terms(
    rec=1.0, pho=1.0, w=0.1, b=1e-3, cyc=1.0, min=0.1, sp=0.1, temp=0.1, geo=0.02, depth=0.04
)  # the released configuration's
STATIC_WEIGHTS = Terms(rec=1.0)


def absent(weight):
    """Whether a weight takes its term out of the program: None, or a Python or NumPy number equal to 0."""
    return weight is None or (isinstance(weight, NUMBER) and weight == 0)


def present(weights):
    """The `Terms` of weights with None for all that are absent."""
    return Terms(*(None if absent(weight) else weight for weight in weights))


def weighted_sum(terms, weights):
    """sum_k weights_k * terms_k over the terms whose weight is not absent.

    Args:
      terms: `Terms` of () arrays.
      weights: `Terms` of numbers or () arrays.

    Returns:
      () scalar, 0 if every term is absent.

    Raises:
      ValueError: naming a term that has a weight but no value.
    """
    total = None
    for name, term, weight in zip(Terms._fields, terms, weights, strict=True):
        if absent(weight):
            continue
        if term is None:
            raise ValueError(f"weighted_sum: term `{name}` has weight {weight} but no value; give None or 0 instead.")
        part = term * (float(weight) if isinstance(weight, NUMBER) else jnp.asarray(weight).astype(term.dtype))
        total = part if total is None else total + part
    return jnp.zeros((), jnp.float32) if total is None else total


def measured(measures, prediction, batch, weights):
    """`Terms` of the losses whose weight is not absent, None elsewhere.

    Args:
      measures: `Terms` of callables `measure(prediction, batch) -> ()`, or None.
      prediction: passed on.
      batch: passed on.
      weights: `Terms`.

    Returns:
      `Terms`.

    Raises:
      ValueError: naming a term that has a weight but no measure.
    """
    values = []
    for name, measure, weight in zip(Terms._fields, measures, weights, strict=True):
        if not absent(weight) and measure is None:
            raise ValueError(f"measured: term `{name}` has weight {weight} but no measure; give None or 0 instead.")
        values.append(None if absent(weight) else measure(prediction, batch))
    return Terms(*values)


def make_objective(predict, measures, *, weights=None):
    """Bind a model and its losses into what a solver wants.

    Args:
      predict: `predict(params, batch) -> prediction`, pure.
      measures: `Terms` of callables `measure(prediction, batch) -> ()`, pure and unweighted; None where a
        model has no such loss.
      weights: `Terms` that says which terms exist: one that is absent here stays absent, whatever is passed
        later. Needed where weights are arguments of a compiled function, which turns a Python 0 into an array.
        It is also the default of the objective's weights.

    Returns:
      `objective(params, batch, weights) -> (total, terms)`: differentiable in params and in weights; `terms` is
      the unweighted `Terms`, for logs.
    """
    declared = weights

    def objective(params, batch, weights=declared):
        if weights is None:
            raise ValueError("objective: no `weights`, neither here nor in make_objective.")
        if declared is not None:
            weights = Terms(*(None if absent(there) else here for there, here in zip(declared, weights, strict=True)))
        terms = measured(measures, predict(params, batch), batch, weights)
        return weighted_sum(terms, weights), terms

    return objective
