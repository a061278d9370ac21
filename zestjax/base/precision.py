"""The precisions a model can be run at, each a choice with a price.

network   of the learned parameters and of everything between a network's input and its output
geometry  of cameras, planes, samples, volumes' statistics, compositing and losses: float32 at least, always

A network computes in the precision of its parameters (`nets.layers`), so a precision is a cast of trees. Training keeps
its own parameters in float32 and casts them inside the step: gradients and moments are float32.
"""

import jax.numpy as jnp

from zestjax.base.trees import tree_cast
from zestjax.base.types import T

NETWORK = {"float32": jnp.float32, "bfloat16": jnp.bfloat16, "float64": jnp.float64}
PRECISIONS = tuple(NETWORK)  # float64 is for checks: then the geometry beside the network is float64 too


def network_at(precision: str, params: T) -> T:
    """Parameters as a network of that precision holds them.

    Raises:
      ValueError: float64 where JAX has it switched off.
    """
    if precision == "float64" and jnp.result_type(float) != jnp.float64:
        raise ValueError(
            "network_at: precision `float64` needs 64-bit JAX: call jax.config.update('jax_enable_x64', True) first."
        )
    return tree_cast(params, NETWORK[precision])


def geometry_at(precision: str, data: T) -> T:
    """Data (cameras, images, maps) as the geometry beside a network of that precision computes with them."""
    return tree_cast(data, jnp.float64 if precision == "float64" else jnp.float32)
