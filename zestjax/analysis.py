"""Each input frame's own coarse depth and moving pixels: what decides which source view may be trusted at a point.

V        frames
h w      cells, a quarter of the image; 2h 2w are its half-resolution pixels
E        planes, uniform in inverse depth, the nearest first
coordinate  plane coordinate in [0, 1], linear in inverse depth: 0 at the near bound, 1 at the far one (a frustum's z)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.nets.unet2d import UNet2d, init_unet2d, unet2d

MOVING_PARTS = 4  # a mask value for each half-resolution pixel of a cell


class AnalysisParams(NamedTuple):
    """net: 2-D U-Net over the cost channels of a frame (planes are channels)."""

    net: UNet2d


class FrameMaps(NamedTuple):
    """What a frame tells about itself; the cache of a scene.

    features: (V, h, w, C) learned, without range.
    logits: (V, h, w, E) of the visible surface's plane.
    coordinate: (V, h, w) plane coordinate of the visible surface, in [0, 1].
    tolerance: (V, h, w) its uncertainty, > 0, in plane coordinates.
    moving_logits: (V, 2h, 2w) of the pixel showing something that moves.
    """

    features: jax.Array
    logits: jax.Array
    coordinate: jax.Array
    tolerance: jax.Array
    moving_logits: jax.Array


def init_analysis(key, *, planes, features, widths):
    """Parameters for E planes and C features; `widths` are the U-Net's."""
    n_in = 2 * planes + 12 + 5
    return AnalysisParams(init_unet2d(key, n_in, widths, planes + MOVING_PARTS + features))


def _channels(evidence):
    static, moving, colours = (x.astype(jnp.float32) for x in evidence)
    planes = jnp.linspace(0, 1, static.shape[-1], dtype=static.dtype)
    best = lambda cost: planes[jnp.argmin(cost, axis=-1)]
    extra = [static.min(-1), moving.min(-1), best(static), best(moving), static.mean(-1)]
    return jnp.concatenate([2 * static - 1, 2 * moving - 1, 4 * colours - 2, jnp.stack(extra, -1)], -1)


def frame_maps(params, evidence):
    """Depth, moving pixels and features of each frame from its evidence.

    Args:
      params: `AnalysisParams`.
      evidence: `evidence.Evidence` with a leading axis V.

    Returns:
      `FrameMaps`.

    Source: zestjax: a coarse depth and a motion mask for every input frame.
    """
    channels = _channels(evidence)
    planes = evidence.static.shape[-1]
    out = unet2d(params.net, channels)
    # The evidence is a prior that the net corrects: low cost is high probability from the first step.
    logits = out[..., :planes] - 4 * jnp.minimum(channels[..., :planes], 1)
    moving, features = out[..., planes : planes + MOVING_PARTS], out[..., planes + MOVING_PARTS :]
    coordinate, tolerance = plane_moments(logits)
    v, h, w, _ = moving.shape
    moving = jnp.moveaxis(moving.reshape(v, h, w, 2, 2), 3, 2).reshape(v, 2 * h, 2 * w)
    return FrameMaps(features, logits, coordinate, tolerance, moving)


def plane_moments(logits, *, reach=2):
    """Sub-plane coordinate of the mode of a distribution over planes, and its spread.

    The mean is taken within `reach` planes of the mode: the mean of two surfaces is on neither.

    Args:
      logits: (..., E).
      reach: planes on either side of the mode that the mean is taken over.

    Returns:
      coordinate (...,) in [0, 1] and tolerance (...,) in plane coordinates, at least 0.7 planes.
    """
    planes = logits.shape[-1]
    index = jnp.arange(planes, dtype=logits.dtype).reshape((1,) * (logits.ndim - 1) + (planes,))
    mode = jax.lax.stop_gradient(jnp.argmax(logits, axis=-1).astype(logits.dtype))
    near = jnp.abs(index - mode[..., None]) <= reach
    probability = jax.nn.softmax(jnp.where(near, logits, -1e9), axis=-1)
    mean = jnp.sum(probability * index, axis=-1)
    variance = jnp.sum(probability * (index - mean[..., None]) ** 2, axis=-1)
    whole = jax.nn.softmax(logits, axis=-1)
    outside = 1 - jnp.sum(jnp.where(near, whole, 0), axis=-1)
    tolerance = (0.7 + jnp.sqrt(variance + 1e-6) + 2 * outside) / (planes - 1)
    return mean / (planes - 1), tolerance
