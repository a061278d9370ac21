"""A small 2-D U-Net."""

from typing import NamedTuple

import jax

from zestjax.checks import check_shapes
from zestjax.nets.conv2d import doubled_convolve2d
from zestjax.nets.layers import Block, Conv, block2d, conv2d, init_block2d, init_conv2d, norm_act


class UNet2d(NamedTuple):
    """Parameters of the 2-D U-Net; one entry of `downs` and `ups` for each level.

    Attributes:
      stem: block at full resolution.
      downs: for each level, finest first, the block that halves the size and the one that follows.
      ups: for each level, finest first, the block after the size is doubled.
      head: the closing 1x1 convolution, with a bias.
    """

    stem: Block
    downs: tuple[tuple[Block, Block], ...]
    ups: tuple[Block, ...]
    head: Conv


def init_unet2d(key, n_in, widths, n_out):
    """Parameters of `unet2d`.

    Args:
      key: random key.
      n_in: channels in.
      widths: channels at full resolution and after each halving; `len(widths) - 1` levels.
      n_out: channels out.
    """
    levels = len(widths) - 1
    keys = jax.random.split(key, 3 * levels + 2)
    pairs = list(zip(widths, widths[1:], strict=False))
    downs = tuple(
        (init_block2d(keys[3 * i], 3, fine, coarse), init_block2d(keys[3 * i + 1], 3, coarse, coarse))
        for i, (fine, coarse) in enumerate(pairs)
    )
    ups = tuple(init_block2d(keys[3 * i + 2], 3, coarse, fine) for i, (fine, coarse) in enumerate(pairs))
    return UNet2d(init_block2d(keys[-2], 3, n_in, widths[0]), downs, ups, init_conv2d(keys[-1], 1, widths[0], n_out))


def unet2d(params, x):
    """x (B, h, w, n_in) -> (B, h, w, n_out), any size; each image is normalised by its own statistics.

    Strided convolutions down; nearest upsampling, a convolution and an added skip up; the last layer is linear.

    Raises:
      ValueError: if x does not have the channels that the first kernel takes.
    """
    check_shapes("unet2d", kernel=(params.stem.conv.kernel, "3 3 C wide"), x=(x, "B h w C"))
    x = block2d(params.stem, x, instance=True)
    skips = []
    for halve, follow in params.downs:
        skips.append(x)
        x = block2d(follow, block2d(halve, x, stride=2, instance=True), instance=True)
    for block, skip in zip(params.ups[::-1], skips[::-1], strict=True):
        x = doubled_convolve2d(x, block.conv.kernel)[:, : skip.shape[1], : skip.shape[2]]
        x = norm_act(block.norm, x, instance=True) + skip
    return conv2d(params.head, x)
