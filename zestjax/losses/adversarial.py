"""Least-squares adversarial losses and the patch discriminator that SVS trains with.

patches  (B, H, W, 3)  RGB in [0, 1], rendered or real
scores   any shape     the discriminator's verdict: trained to 1 on real patches, 0 on rendered ones
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import safe_divide
from zestjax.base.types import Array
from zestjax.nets.layers import Conv, Norm, conv2d, init_conv2d, init_norm, norm_act

SLOPE = 0.2  # of the leaky rectifiers


class DiscriminatorParams(NamedTuple):
    """convs: `Conv` of stride 2, then one of stride 1 to a single channel. norms: `Norm` after all but the first
    and the last. Depth and widths are in the shapes."""

    convs: tuple[Conv, ...]
    norms: tuple[Norm, ...]


def init_discriminator(
    key: jax.Array, *, widths: tuple[int, ...] = (32, 64, 128, 256), channels: int = 3
) -> DiscriminatorParams:
    """Parameters of a patch discriminator.

    Args:
      key: random key.
      widths: channels after each stride-2 convolution.
      channels: of the patches.

    Returns:
      `DiscriminatorParams`.
    """
    sizes = (channels, *widths, 1)
    keys = jax.random.split(key, len(sizes) - 1)
    convs = tuple(init_conv2d(k, 3, a, b) for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True))
    return DiscriminatorParams(convs, tuple(init_norm(width) for width in widths[1:]))


def discriminator(params: DiscriminatorParams, patches: jax.Array, *, spectral: bool = True) -> jax.Array:
    """Scores of overlapping parts of each patch.

    Reference: ZeST-NeRF networks.py, the discriminator of GRAF (Schwarz et al. 2020).

    Args:
      params: `DiscriminatorParams`.
      patches: (B, H, W, C) in [0, 1].
      spectral: divide each kernel by its largest singular value, which bounds the slope of the network.

    Returns:
      (B, h, w), h = H / 2^layers rounded up.

    Raises:
      ValueError: if `patches` is not (B, H, W, C).

    Differs from the reference: kernels of 3, not 4; a map of scores, not one, so that any patch size fits; the
    singular value is found anew each time, so that there is no hidden state.
    """
    check_shapes("discriminator", patches=(patches, "B H W C"))
    bounded = lambda conv: conv._replace(kernel=conv.kernel / spectral_norm(conv.kernel)) if spectral else conv
    first, *middle, last = params.convs
    x = jax.nn.leaky_relu(conv2d(bounded(first), 2 * patches - 1, stride=2), SLOPE)
    for conv, norm in zip(middle, params.norms, strict=True):
        x = norm_act(norm, conv2d(bounded(conv), x, stride=2), slope=SLOPE, over="element")
    return jnp.squeeze(conv2d(bounded(last), x), axis=-1)


def spectral_norm(kernel: jax.Array, *, iterations: int = 8) -> jax.Array:
    """Largest singular value of a kernel as a matrix (..., out), by power iteration from a fixed vector.

    Args:
      kernel: (..., out).
      iterations: of the power method; no gradient passes through them, only through the final quotient.

    Returns:
      () > 0.
    """
    matrix = kernel.reshape(-1, kernel.shape[-1])
    held = jax.lax.stop_gradient(matrix)
    unit = lambda x: safe_divide(x, jnp.sqrt(jnp.sum(x * x)))
    right = unit(1 + jnp.arange(matrix.shape[1]).astype(matrix.dtype) / matrix.shape[1])
    right = jax.lax.fori_loop(0, iterations, lambda _, x: unit(held.T @ (held @ x)), right)
    left = unit(held @ right)
    return jnp.maximum(left @ (matrix @ right), jnp.finfo(kernel.dtype).eps)


def discriminator_loss(real: Array, rendered: Array) -> jax.Array:
    """What the discriminator minimises: ((D(real) - 1)^2 + D(rendered)^2) / 2.

    Source: LSGAN (Mao et al. 2017), eq. 9.

    Args:
      real: scores of true patches.
      rendered: scores of rendered ones; stop their gradient where the renderer is not to be trained.

    Returns:
      () mean.
    """
    return (jnp.mean((real - 1) ** 2) + jnp.mean(rendered**2)) / 2


def generator_loss(rendered: Array) -> jax.Array:
    """What the renderer minimises: (D(rendered) - 1)^2.

    Source: LSGAN (Mao et al. 2017), eq. 9, without its factor of a half.

    Args:
      rendered: scores of rendered patches.

    Returns:
      () mean.
    """
    return jnp.mean((rendered - 1) ** 2)
