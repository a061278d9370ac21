"""A small 2-D U-Net."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax

from zestjax.base.checks import check_shapes
from zestjax.nets.conv2d import doubled_convolve2d
from zestjax.nets.layers import Block, Conv, block2d, conv2d, init_block2d, init_conv2d, norm_act, raised

OVER = "channels"  # statistics of an image would make its faintest motion look like any other's strongest


class UNet2d(NamedTuple):
    """Parameters of the 2-D U-Net; one entry of `downs` and `ups` for each level.

    Attributes:
      mix: 1x1 block from the channels in, at full resolution.
      stem: block at full resolution.
      downs: for each level, finest first, the block that halves the size and the one that follows.
      ups: for each level, finest first, the block after the size is doubled.
      last: block at full resolution, after the skips.
      head: the closing 1x1 convolution, with a bias.
    """

    mix: Block
    stem: Block
    downs: tuple[tuple[Block, Block], ...]
    ups: tuple[Block, ...]
    last: Block
    head: Conv


def init_unet2d(key: jax.Array, n_in: int, widths: Sequence[int], n_out: int) -> UNet2d:
    """Parameters of `unet2d`.

    Args:
      key: random key.
      n_in: channels in.
      widths: channels at full resolution and after each halving; `len(widths) - 1` levels.
      n_out: channels out.
    """
    levels, wide = len(widths) - 1, widths[0]
    keys = iter(jax.random.split(key, 3 * levels + 4))
    pairs = list(zip(widths, widths[1:], strict=False))
    block = lambda size, n_in, n_out: init_block2d(next(keys), size, n_in, n_out)
    downs = tuple((block(3, fine, coarse), block(3, coarse, coarse)) for fine, coarse in pairs)
    ups = tuple(block(3, coarse, fine) for fine, coarse in pairs)
    head = init_conv2d(next(keys), 1, wide, n_out)
    return UNet2d(block(1, n_in, wide), block(3, wide, wide), downs, ups, block(3, wide, wide), head)


def unet2d(params: UNet2d, x: jax.Array) -> jax.Array:
    """x (B, h, w, n_in) -> (B, h, w, n_out), any size; each image by itself.

    Strided convolutions down; nearest upsampling, a convolution and an added skip up; the last layer is linear. Each
    place is normalised over its channels.

    Raises:
      ValueError: if x does not have the channels that the first kernel takes.
    """
    check_shapes("unet2d", kernel=(params.mix.conv.kernel, "1 1 C wide"), x=(x, "B h w C"))
    block = functools.partial(block2d, over=OVER)
    x = block(params.stem, block(params.mix, x))
    skips = []
    for halve, follow in params.downs:
        skips.append(x)
        x = block(follow, block(halve, x, stride=2))
    for up, skip in zip(params.ups[::-1], skips[::-1], strict=True):
        x = doubled_convolve2d(x, up.conv.kernel)[:, : skip.shape[1], : skip.shape[2]]
        x = norm_act(up.norm, x, over=OVER) + skip
    return raised(conv2d(params.head, block(params.last, x)))
