"""The total loss: the only place in the package where a loss meets its weight.

terms      a mapping from the name of a loss to its number; any names will do
weights    a mapping from names to numbers
measures   a mapping from names to functions `measure(prediction, batch) -> ()`, pure and unweighted
absent     a term without a weight, or whose weight is None or the number 0, Python's or NumPy's: it is not traced, so
           the compiled program does not contain it. A weight that is an array, even one holding 0, is always computed.

The names in use:
  The paper's: rec (reconstruction), pho (warped colour), w (confidence to one), b (blend entropy), cyc (flow
  there and back), min (flow magnitude), sp (flow smooth in space), temp (flow smooth in time), geo (optical
  flow prior), depth (depth prior).
  From a simulator's exact answers: depth_ce (cross-entropy over the volumes' planes), static_rec (render of the
  static field alone), frame_ce and frame_mask (each input frame's own depth and moving pixels), mask (dynamicness
  against the motion mask), dynamic_rec (reconstruction of what moves alone), flow3d (scene flow).
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

NUMBER = int | float | np.number | np.bool_  # a NumPy scalar is a number; an array of no axes is an array
PAPER_WEIGHTS = dict(
    rec=1.0, pho=1.0, w=0.1, b=1e-3, cyc=1.0, min=0.1, sp=0.1, temp=0.1, geo=0.02, depth=0.04
)  # the released configuration's


def absent(weight: Any) -> bool:
    """Whether a weight takes its term out of the program: None, or a Python or NumPy number equal to 0."""
    return weight is None or (isinstance(weight, NUMBER) and weight == 0)


def present(weights: Mapping[str, Any]) -> dict[str, Any]:
    """The weights that are not absent."""
    return {name: weight for name, weight in weights.items() if not absent(weight)}


def weighted_sum(terms: Mapping[str, Any], weights: Mapping[str, Any]) -> jax.Array:
    """sum_k weights_k * terms_k over the terms whose weight is not absent.

    Args:
      terms: of () arrays.
      weights: of numbers or () arrays.

    Returns:
      () scalar, 0 if every term is absent.

    Raises:
      ValueError: naming a term that has a weight but no value.
    """
    total = None
    for name, weight in present(weights).items():
        term = terms.get(name)
        if term is None:
            raise ValueError(f"weighted_sum: term `{name}` has weight {weight} but no value; give None or 0 instead.")
        part = term * (float(weight) if isinstance(weight, NUMBER) else jnp.asarray(weight).astype(term.dtype))
        total = part if total is None else total + part
    return jnp.zeros((), jnp.float32) if total is None else total


def measured(measures: Mapping[str, Callable], prediction: Any, batch: Any, weights: Mapping[str, Any]) -> dict:
    """Evaluate each loss that has a weight.

    Args:
      measures: see the header.
      prediction: passed on.
      batch: passed on.
      weights: see the header.

    Returns:
      The terms that are not absent.

    Raises:
      ValueError: naming a term that has a weight but no measure.
    """
    values = {}
    for name, weight in present(weights).items():
        if name not in measures:
            raise ValueError(f"measured: term `{name}` has weight {weight} but no measure; give None or 0 instead.")
        values[name] = measures[name](prediction, batch)
    return values


def make_objective(
    predict: Callable, measures: Mapping[str, Callable], *, weights: Mapping[str, Any] | None = None
) -> Callable[..., tuple[jax.Array, dict[str, Any]]]:
    """Bind a model and its losses into what a solver wants.

    Args:
      predict: `predict(params, batch) -> prediction`, pure.
      measures: see the header.
      weights: which terms exist: one that is absent here stays absent, whatever is passed later. Needed where weights
        are arguments of a compiled function, which turns a Python 0 into an array. It is also the default of the
        objective's weights.

    Returns:
      `objective(params, batch, weights) -> (total, terms)`: differentiable in params and in weights; `terms` holds
      the unweighted numbers, for logs.
    """
    declared = None if weights is None else present(weights)

    def objective(params: Any, batch: Any, weights: Mapping[str, Any] | None = declared):
        if weights is None:
            raise ValueError("objective: no `weights`, neither here nor in make_objective.")
        if declared is not None:
            weights = {name: weights.get(name) for name in declared}
        terms = measured(measures, predict(params, batch), batch, weights)
        return weighted_sum(terms, weights), terms

    return objective
