"""Sines and cosines of a coordinate at octave frequencies."""

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_option
from zestjax.nets.layers import raised


def positional_encoding(x: jax.Array, *, levels: int, order: str = "frequency_major") -> jax.Array:
    """x (..., P) -> (..., P (1 + 2 levels)): x itself, then sin and cos of 2^k x for k = 0 .. levels - 1.

    Scaling by 2^k is exact, so the highest level is as accurate as the sine itself. Lower precisions than float32
    are raised to it: in bfloat16 the upper levels would be noise.

    Args:
      x: (..., P), of order 1; there is no factor pi.
      levels: number of frequencies, >= 0.
      order: "frequency_major": for each k, the sines of all coordinates, then their cosines;
        "mvsnerf": the sines of all k, then the cosines of all k, as that code's published weights expect.

    Raises:
      ValueError: on an unknown order.

    Source: ZeST-NeRF sec. 3 (10 levels for points and time, 4 for directions).
    """
    check_option("positional_encoding", order=(order, ("frequency_major", "mvsnerf")))
    x = raised(x)
    octaves = jnp.concatenate([x[..., None, :] * 2**k for k in range(levels)] or [x[..., None, :][..., :0, :]], axis=-2)
    waves = [jnp.sin(octaves), jnp.cos(octaves)]
    axis = -1 if order == "frequency_major" else -2
    waves = jnp.concatenate(waves, axis=axis)
    return jnp.concatenate([x, waves.reshape(*x.shape[:-1], -1)], axis=-1)
