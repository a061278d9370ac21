"""The 3-D U-Net that turns a cost volume into an encoding volume."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_shapes
from zestjax.nets.conv3d import conv3d, conv3d_transpose
from zestjax.nets.layers import Block, Dense, dense, init_block3d, init_dense, lowered, norm_act, raised


class CostRegulariser(NamedTuple):
    """Parameters of the 3-D U-Net; one entry of `downs` and `ups` for each level.

    Attributes:
      stem: block at full resolution.
      downs: for each level, finest first, the block that halves the size and the one that follows.
      ups: for each level, finest first, the transposed block that doubles the size.
      head: an affine map of the channels, or None.
    """

    stem: Block
    downs: tuple[tuple[Block, Block], ...]
    ups: tuple[Block, ...]
    head: Dense | None


def init_cost_regulariser(
    key: jax.Array, n_in: int, *, widths: Sequence[int] = (8, 16, 32, 64), n_out: int | None = None
) -> CostRegulariser:
    """Parameters of `cost_regulariser`.

    Args:
      key: random key.
      n_in: channels of the cost volume.
      widths: channels at full resolution and after each halving; `len(widths) - 1` levels.
      n_out: channels out of a closing affine map; None: no such map, and `widths[0]` channels out.
    """
    levels = len(widths) - 1
    keys = jax.random.split(key, 3 * levels + 2)
    pairs = list(zip(widths, widths[1:], strict=False))
    downs = tuple(
        (init_block3d(keys[3 * i], fine, coarse), init_block3d(keys[3 * i + 1], coarse, coarse))
        for i, (fine, coarse) in enumerate(pairs)
    )
    ups = tuple(init_block3d(keys[3 * i + 2], coarse, fine) for i, (fine, coarse) in enumerate(pairs))
    head = None if n_out is None else init_dense(keys[-1], widths[0], n_out)
    return CostRegulariser(init_block3d(keys[-2], n_in, widths[0]), downs, ups, head)


def cost_regulariser(
    params: CostRegulariser, volume: jax.Array, *, lowering: str = "auto", legacy_abs: bool = False
) -> jax.Array:
    """Encoding volume of a cost volume: down, up, and added skips.

    Sizes that the levels do not divide are padded with their last cells and cropped again.

    Args:
      params: a `CostRegulariser`; levels and widths are read off it.
      volume: (D, h, w, C).
      lowering: "auto", or "plain" for XLA's convolutions throughout; see `conv3d`.
      legacy_abs: as in `norm_act`.

    Returns:
      (D, h, w, widths[0]), or n_out channels where the parameters have a head.

    Raises:
      ValueError: if the volume does not have the channels that the first kernel takes.

    Source: ZeST-NeRF sec. 3, table of the 3-D U-Net.
    Differs from the reference: 8 channels out as in the released code (the table prints 32); any size is taken.
    """
    check_shapes("cost_regulariser", kernel=(params.stem.conv.kernel, "3 3 3 C wide"), volume=(volume, "D h w C"))
    act = lambda block, x: norm_act(block.norm, x, legacy_abs=legacy_abs)
    conv = lambda block, x, stride=1: act(block, conv3d(x, block.conv.kernel, stride=stride, lowering=lowering))
    size, step = volume.shape[:3], 2 ** len(params.downs)
    padding = [(0, -n % step) for n in size]
    x = lowered(volume, params.stem.conv.kernel)
    x = conv(params.stem, jnp.pad(x, [*padding, (0, 0)], mode="edge"))
    skips = []
    for halve, follow in params.downs:
        skips.append(x)
        x = conv(follow, conv(halve, x, 2))
    for double, skip in zip(params.ups[::-1], skips[::-1], strict=True):
        x = act(double, conv3d_transpose(x, double.conv.kernel, lowering=lowering)) + skip
    x = x[: size[0], : size[1], : size[2]]
    return raised(x if params.head is None else dense(params.head, x))
