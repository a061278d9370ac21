"""Layers that every network here is made of: affine maps, 2-D convolutions, batch statistics with an activation.

Vocabulary:
  kernel: the weights of a linear map; its last two axes are channels in and channels out.
  norm-act: centre and scale by the statistics of the batch at hand (or stored ones), scale and offset, leaky ReLU.

Parameters are arrays only and float32 unless the caller casts them; what a layer is, is read off their shapes. Cast to
half precision they take their input down with them; a batch's statistics are found in float32 even then.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from zestjax.base.checks import check_option, check_shapes
from zestjax.base.numerics import matmul
from zestjax.nets.conv2d import convolve2d

FEW_ROWS = 4096  # of a norm's statistics, of which a mean may be a product: its error grows with them, see `_mean`


class Dense(NamedTuple):
    """An affine map of the last axis.

    Attributes:
      kernel: (in, out).
      bias: (out,).
    """

    kernel: jax.Array
    bias: jax.Array


class Conv(NamedTuple):
    """A 2-D or 3-D convolution.

    Attributes:
      kernel: (size, size, in, out), or (size, size, size, in, out); size odd.
      bias: (out,), or None where a norm follows.
    """

    kernel: jax.Array
    bias: jax.Array | None


class Statistics(NamedTuple):
    """Stored statistics of published weights.

    Attributes:
      mean: (C,).
      variance: (C,), >= 0.
    """

    mean: jax.Array
    variance: jax.Array


class Norm(NamedTuple):
    """What follows the division by the standard deviation.

    Attributes:
      scale: (C,).
      offset: (C,).
      statistics: used instead of the batch's; None, as everything trained here has it: the batch's.
    """

    scale: jax.Array
    offset: jax.Array
    statistics: Statistics | None = None


class Block(NamedTuple):
    """Convolution, then norm-act.

    Attributes:
      conv: without a bias, which the norm would remove.
      norm: its norm.
    """

    conv: Conv
    norm: Norm


def _normal(key, shape):
    """Normal draws, flat and then shaped: a 4-D draw takes seconds to compile on a CPU, and gives the same numbers."""
    return jax.random.normal(key, (math.prod(shape),)).reshape(shape)


def init_dense(key: jax.Array, n_in: int, n_out: int, *, scale: float = 1.0) -> Dense:
    """A `Dense` with normal kernel of variance 2 scale^2 / n_in (He) and bias 0."""
    return Dense(jax.random.normal(key, (n_in, n_out)) * (scale * (2 / n_in) ** 0.5), jnp.zeros(n_out))


def init_conv2d(key: jax.Array, size: int, n_in: int, n_out: int, *, bias: bool = True) -> Conv:
    """A 2-D `Conv` of odd `size` with normal kernel of variance 2 / (size^2 n_in); bias 0, or None."""
    kernel = _normal(key, (size, size, n_in, n_out)) * (2 / (size**2 * n_in)) ** 0.5
    return Conv(kernel, jnp.zeros(n_out) if bias else None)


def init_conv3d(key: jax.Array, n_in: int, n_out: int) -> Conv:
    """A 3-D `Conv` of size 3 without bias; normal kernel of variance 2 / (27 n_in)."""
    return Conv(_normal(key, (3, 3, 3, n_in, n_out)) * (2 / (27 * n_in)) ** 0.5, None)


def init_norm(channels: int) -> Norm:
    """A `Norm` of scale 1 and offset 0."""
    return Norm(jnp.ones(channels), jnp.zeros(channels))


def init_block2d(key: jax.Array, size: int, n_in: int, n_out: int) -> Block:
    """A 2-D `Block`."""
    return Block(init_conv2d(key, size, n_in, n_out, bias=False), init_norm(n_out))


def init_block3d(key: jax.Array, n_in: int, n_out: int) -> Block:
    """A 3-D `Block` of size 3."""
    return Block(init_conv3d(key, n_in, n_out), init_norm(n_out))


def lowered(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """x in the kernel's precision where that is a half one; as it is beside any other."""
    return x.astype(kernel.dtype) if jnp.finfo(kernel.dtype).bits < 32 else x


def raised(x: jax.Array) -> jax.Array:
    """x in float32 where it is of a half precision: what leaves a network."""
    return x.astype(jnp.float32) if jnp.finfo(x.dtype).bits < 32 else x


def add_bias(x: jax.Array, bias: jax.Array) -> jax.Array:
    """x (..., C) + bias (C,), written as a product with ones so that the gradient's sum is a matrix product too."""
    ones = jnp.ones((x.size // x.shape[-1], 1), x.dtype)
    return x + (ones @ bias[None]).reshape(x.shape)


def dense(params: Dense, x: jax.Array) -> jax.Array:
    """x (..., in) @ kernel + bias -> (..., out).

    Raises:
      ValueError: if the last axis of x is not what the kernel takes.
    """
    check_shapes("dense", kernel=(params.kernel, "in out"), bias=(params.bias, "out"), x=(x, "... in"))
    return add_bias(lowered(x, params.kernel) @ params.kernel, params.bias)


def conv2d(params: Conv, x: jax.Array, *, stride: int = 1) -> jax.Array:
    """Zero-padded convolution x (B, H, W, in) -> (B, ceil(H / stride), ceil(W / stride), out).

    Output pixel j sits on input pixel `stride` j, whatever the (odd) kernel size.

    Args:
      params: a 2-D `Conv`.
      x: (B, H, W, in).
      stride: 1 or 2.

    Raises:
      ValueError: if the channels of x are not what the kernel takes, or on another stride.
    """
    check_shapes("conv2d", kernel=(params.kernel, "size size in out"), x=(x, "B H W in"))
    check_option("conv2d", stride=(stride, (1, 2)))
    x = lowered(x, params.kernel)
    if params.kernel.shape[0] == 1:
        out = x[:, ::stride, ::stride] @ params.kernel[0, 0]
    else:
        out = convolve2d(x, params.kernel, stride)
    return out if params.bias is None else add_bias(out, params.bias)


def norm_act(
    params: Norm,
    x: jax.Array,
    *,
    slope: float = 0.01,
    over: str = "batch",
    epsilon: float = 1e-5,
    legacy_abs: bool = False,
) -> jax.Array:
    """Standardise each channel by its batch's statistics, scale and offset, leaky ReLU; x (..., C) -> (..., C).

    Mean and biased variance are centred, in two passes.

    Args:
      params: a `Norm` of C channels; its `statistics`, if it has any, take the place of the batch's.
      x: (..., C).
      slope: of the activation below 0.
      over: what shares statistics. `batch`: every axis but the last, so that views of one scene are normalised
        together; `element`: the same for each element of the leading axis by itself; `channels`: the channels of each
        place, which keeps how strong a signal is against its surroundings.
      epsilon: added to the variance.
      legacy_abs: scale by |scale| + epsilon, as the fused norm that the published weights were trained with does.

    Raises:
      ValueError: if x does not have C channels, or on another `over`.
    """
    check_shapes("norm_act", scale=(params.scale, "C"), offset=(params.offset, "C"), x=(x, "... C"))
    check_option("norm_act", over=(over, ("batch", "element", "channels")))
    scale = jnp.abs(params.scale) + epsilon if legacy_abs else params.scale
    if params.statistics is not None:
        rate = lax.rsqrt(params.statistics.variance + epsilon) * scale
        out = add_bias(x * add_bias(jnp.zeros_like(x), rate), params.offset - params.statistics.mean * rate)
        return jnp.where(out > 0, out, slope * out)
    if over == "channels":
        wide = raised(x)
        centred = wide - jnp.mean(wide, axis=-1, keepdims=True)
        unit = centred * lax.rsqrt(jnp.mean(jnp.square(centred), axis=-1, keepdims=True) + epsilon)
        unit = unit.astype(x.dtype)
        out = add_bias(unit * add_bias(jnp.zeros_like(x), scale), params.offset)
        return jnp.where(out > 0, out, slope * out)
    groups = x.shape[0] if over == "element" else 1
    flat = x.reshape(groups, -1, x.shape[-1])
    wide = (raised(part) for part in (scale, params.offset, flat))
    return _norm_act(slope, epsilon, *wide).reshape(x.shape).astype(x.dtype)


def _mean(x):
    """Mean over rows, x (G, N, C) -> (G, 1, C): of few as a product, which is faster on a CPU but adds row after row:
    statistics of 260,000 rows would come out 1e-3 off in float32. Of many as a sum."""
    if x.shape[1] > FEW_ROWS:
        return jnp.mean(x, axis=1, keepdims=True)
    return matmul(jnp.full((x.shape[0], 1, x.shape[1]), 1 / x.shape[1], x.dtype), x)


def _standardise(slope, epsilon, scale, offset, x) -> jax.Array:
    return _norm_act_fwd(slope, epsilon, scale, offset, x)[0]


def _norm_act_fwd(slope, epsilon, scale, offset, x):
    mean = _mean(x)
    rate = lax.rsqrt(_mean(jnp.square(x - mean)) + epsilon)
    out = (x - mean) * (rate * scale[None, None]) + offset[None, None]
    return jnp.where(out > 0, out, slope * out), (scale, offset, x, mean, rate)


def _norm_act_bwd(slope, epsilon, saved, d_out):
    scale, offset, x, mean, rate = saved
    unit = (x - mean) * rate
    d_out = jnp.where(unit * scale[None, None] + offset[None, None] > 0, d_out, slope * d_out)
    d_offset, d_scale = _mean(d_out), _mean(d_out * unit)
    d_x = (d_out - d_offset - unit * d_scale) * (rate * scale[None, None])
    rows = x.shape[1]
    return d_scale.sum((0, 1)) * rows, d_offset.sum((0, 1)) * rows, d_x


_norm_act = jax.custom_vjp(_standardise, nondiff_argnums=(0, 1))
_norm_act.defvjp(_norm_act_fwd, _norm_act_bwd)


def block2d(
    params: Block, x: jax.Array, *, stride: int = 1, over: str = "batch", legacy_abs: bool = False
) -> jax.Array:
    """`conv2d`, then `norm_act`."""
    return norm_act(params.norm, conv2d(params.conv, x, stride=stride), over=over, legacy_abs=legacy_abs)
