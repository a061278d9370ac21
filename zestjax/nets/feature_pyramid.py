"""The 2-D feature network that every view passes through before the plane sweep."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_option, check_shapes
from zestjax.base.types import Array
from zestjax.nets.layers import Block, Conv, block2d, conv2d, init_block2d, init_conv2d, raised

STRIDES = (1, 1, 2, 1, 1, 2, 1, 1)  # the paper's table: two halvings make the quarter that volumes have
# Of RGB in [0, 1], as torchvision's networks, and so MVSNeRF's published weights, expect them.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)


class FeaturePyramid(NamedTuple):
    """Parameters of the feature network.

    Attributes:
      blocks: eight convolution-norm-act blocks; the third and sixth have kernel 5 and stride 2.
      head: the closing 1x1 convolution, with a bias.
    """

    blocks: tuple[Block, ...]
    head: Conv


def init_feature_pyramid(
    key: jax.Array, *, widths: tuple[int, int, int] = (8, 16, 32), n_in: int = 3
) -> FeaturePyramid:
    """Parameters of `feature_pyramid`.

    Args:
      key: random key.
      widths: channels at full, half and quarter resolution; the last is the number of features.
      n_in: channels of the images.
    """
    full, half, quarter = widths
    channels = (n_in, full, full, half, half, half, quarter, quarter, quarter)
    keys = jax.random.split(key, 9)
    blocks = (init_block2d(keys[i], 3 if STRIDES[i] == 1 else 5, channels[i], channels[i + 1]) for i in range(8))
    return FeaturePyramid(tuple(blocks), init_conv2d(keys[8], 1, quarter, quarter))


def imagenet_normalised(images: jax.Array) -> jax.Array:
    """Images (..., 3) in [0, 1], centred and scaled by ImageNet's statistics."""
    shape = (1,) * (images.ndim - 1) + (3,)
    mean, deviation = (jnp.asarray(v, images.dtype).reshape(shape) for v in (IMAGENET_MEAN, IMAGENET_DEVIATION))
    return (images - mean) / deviation


def feature_pyramid(
    params: FeaturePyramid, images: Array, *, normalise: str | None = "imagenet", legacy_abs: bool = False
) -> jax.Array:
    """Features of every view at a quarter of its size; feature pixel j sits on image pixel 4 j.

    The norms see all views as one batch, so a view's features depend on the views it comes with.

    Args:
      params: a `FeaturePyramid`; widths are read off it.
      images: (V, H, W, 3) in [0, 1]; any size.
      normalise: "imagenet": centre and scale the colours by ImageNet's statistics; None: images come as they are.
      legacy_abs: as in `norm_act`.

    Returns:
      (V, ceil(H / 4), ceil(W / 4), C).

    Raises:
      ValueError: on an unknown `normalise`, or images without the channels that the first kernel takes.

    Source: ZeST-NeRF sec. 3, table of the feature network.
    Differs from the reference: kernel 5 layers have padding 2 (the table says dilation), the activation is leaky,
      and a 1x1 convolution closes the net, all as in the released code.
    """
    check_option("feature_pyramid", normalise=(normalise, ("imagenet", None)))
    check_shapes("feature_pyramid", kernel=(params.blocks[0].conv.kernel, "3 3 C wide"), images=(images, "V H W C"))
    images = jnp.asarray(images)
    x = imagenet_normalised(images) if normalise == "imagenet" else images
    for block, stride in zip(params.blocks, STRIDES, strict=True):
        x = block2d(block, x, stride=stride, legacy_abs=legacy_abs)
    return raised(conv2d(params.head, x))
