"""What changes with the step: the learning rate and the weights of the priors. Functions of the step, no state.

step   () int from 0: the number of updates already made. A Python int, or an array inside a compiled step.
"""

from collections.abc import Collection, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_option
from zestjax.base.types import Scalar

PRIORS = ("geo", "depth")


def cosine(step: Scalar, *, peak: float, floor: float, steps: int, warmup: int = 0) -> jax.Array:
    """Learning rate that rises linearly to `peak`, then falls along half a cosine to `floor`.

    Source: ZeST-NeRF section 4 (Adam, 5e-4); the cosine to 1e-7 is the released configuration's.

    Args:
      step: () int.
      peak: rate at the end of the warm-up.
      floor: rate from step `steps` on.
      steps: length of the whole schedule, > warmup.
      warmup: updates over which the rate rises from peak / warmup to peak.

    Returns:
      () float32 rate, > 0.

    Raises:
      ValueError: if `steps` is not above `warmup`, or `warmup` is negative.
    """
    if not 0 <= warmup < steps:
        raise ValueError(f"cosine: `warmup` is {warmup} and `steps` {steps}, expected 0 <= warmup < steps.")
    step = jnp.asarray(step).astype(jnp.float32)
    progress = jnp.clip((step - warmup) / (steps - warmup), 0, 1)
    falling = floor + (peak - floor) * (1 + jnp.cos(jnp.pi * progress)) / 2
    return jnp.where(step < warmup, peak * (step + 1) / max(warmup, 1), falling)


def decayed_priors(
    weights: Mapping[str, Any],
    step: Scalar,
    *,
    decay: float,
    shape: str = "staircase",
    end: int | None = None,
    terms: Collection[str] = PRIORS,
) -> dict[str, Any]:
    """Loss weights at a step: those of the priors fade, since the networks that made them are not exact.

    Source: ZeST-NeRF section 3.5 ("decay their contribution to zero during training").
    Reference: ZeST-NeRF train.py: a factor of ten less every `decay` steps, never 0.

    Args:
      weights: mapping of numbers; None and the Python number 0 stay as they are.
      step: () int. With a Python int the weights are Python floats, and from `end` on the Python number 0,
        which takes the term out of the compiled program.
      decay: steps over which a prior's weight falls to a tenth, > 0.
      shape: "staircase" (as published) or "smooth", the exponential through its corners.
      end: step from which the priors' weights are exactly 0; None is never.
      terms: names of the weights that fade, those that there are.

    Returns:
      A dict like `weights`.

    Raises:
      ValueError: if `shape` is unknown or `decay` not positive.
    """
    check_option("decayed_priors", shape=(shape, ("staircase", "smooth")))
    if decay <= 0:
        raise ValueError(f"decayed_priors: `decay` is {decay}, expected a number of steps above 0.")
    known = isinstance(step, int | np.integer)
    xp = np if known else jnp
    periods = (step if known else jnp.asarray(step).astype(jnp.float32)) / decay
    factor = 0.1 ** (xp.floor(periods) if shape == "staircase" else periods)
    if end is not None:
        factor = xp.where(xp.asarray(step) < end, factor, 0)
    factor = (float(factor) or 0) if known else factor
    fade = lambda weight: (
        weight if weight is None or (isinstance(weight, int | float) and not weight) else weight * factor
    )
    return {name: fade(weight) if name in terms else weight for name, weight in weights.items()}
