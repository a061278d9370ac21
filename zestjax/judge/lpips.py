"""LPIPS (Zhang et al. 2018) with AlexNet: how different two pictures look to a network that was trained on photographs.

The weights are the user's: AlexNet's from torchvision, the linear heads from the authors (version 0.1). Nothing is
scored without them.

layer      one of the five activations that are compared
head       (C,) weights >= 0 of a layer's channels
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from zestjax.base.checks import check_shapes
from zestjax.base.numerics import added, safe_norm
from zestjax.base.types import Array
from zestjax.metrics import mean_where
from zestjax.nets.layers import Conv

# AlexNet's, as LPIPS takes it: (size of the kernel, channels in, channels out).
LAYERS = ((11, 3, 64), (5, 64, 192), (3, 192, 384), (3, 384, 256), (3, 256, 256))
STRIDES, PADDING = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
POOLED = (1, 2)  # layers whose input is pooled
LEAST_SIDE = 31  # pixels, of which the second pooling leaves one place
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of inputs in [-1, 1], as the heads were trained
IMAGES = ("NHWC", "HWIO", "NHWC")


class LpipsParams(NamedTuple):
    """convolutions: five `Conv`. heads: five (C,)."""

    convolutions: tuple[Conv, ...]
    heads: tuple[jax.Array, ...]


def lpips_like() -> LpipsParams:
    """Shapes and types of `LpipsParams`."""
    array = lambda *shape: jnp.zeros(shape, jnp.float32)

    def made():
        convolutions = tuple(Conv(array(size, size, *channels), array(channels[1])) for size, *channels in LAYERS)
        return LpipsParams(convolutions, tuple(array(out) for *_, out in LAYERS))

    return jax.eval_shape(made)


def alexnet_activations(params: LpipsParams, image: Array) -> list[jax.Array]:
    """AlexNet's five activations after the ReLU, of one image (H, W, 3) in [0, 1]: a list of (h, w, C)."""
    row = lambda values: jnp.asarray(values, image.dtype)[None, None]
    x = ((2 * jnp.asarray(image) - 1 - row(SHIFT)) / row(SCALE))[None]
    found = []
    for i, layer in enumerate(params.convolutions):
        if i in POOLED:
            x = lax.reduce_window(x, -jnp.inf, lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "VALID")
        padding, stride = [(PADDING[i], PADDING[i])] * 2, (STRIDES[i],) * 2
        x = lax.conv_general_dilated(x, layer.kernel, stride, padding, dimension_numbers=IMAGES)
        assert layer.bias is not None  # `lpips_like` has one
        x = jax.nn.relu(x + layer.bias[None, None, None])
        found.append(x[0])
    return found


def lpips_maps(params: LpipsParams, image: Array, truth: Array) -> list[jax.Array]:
    """The distance at every place of every layer: a list of (h, w)."""
    unit = lambda x: x / (safe_norm(x, axis=-1, keepdims=True) + 1e-10)  # as published
    pairs = zip(*(alexnet_activations(params, picture) for picture in (image, truth)), strict=True)
    return [
        jnp.sum(jnp.square(unit(a) - unit(b)) * head[None, None], axis=-1)
        for (a, b), head in zip(pairs, params.heads, strict=True)
    ]


def lpips(params: LpipsParams, image: Array, truth: Array, *, mask: Array | None = None) -> jax.Array:
    """LPIPS distance of two pictures, 0 for equal ones.

    Source: LPIPS (Zhang et al. 2018) eq. 1, weights of version 0.1.
    Differs from the reference: images are in [0, 1]; released ZeST-NeRF feeds such to a network that expects [-1, 1],
      which lowers its figures.

    Args:
      params: `LpipsParams`.
      image: (H, W, 3) in [0, 1], H and W at least 31.
      truth: (H, W, 3) in [0, 1].
      mask: (H, W) or None: the distance is then the mean over its pixels of the layers' maps, bilinearly enlarged.

    Returns:
      () >= 0; NaN when the mask is empty.

    Raises:
      ValueError: shapes do not match, or an image is too small.
    """
    sizes = check_shapes("lpips", image=(image, "H W 3"), truth=(truth, "H W 3"))
    if min(sizes["H"], sizes["W"]) < LEAST_SIDE:
        raise ValueError(f"lpips: `image` is {sizes['H']}x{sizes['W']} (HxW), expected at least 31x31.")
    maps = lpips_maps(params, image, truth)
    if mask is None:
        return added(jnp.mean(m) for m in maps)
    enlarged = [jax.image.resize(m, (sizes["H"], sizes["W"]), "bilinear") for m in maps]
    return mean_where(added(enlarged), mask, where="lpips")
