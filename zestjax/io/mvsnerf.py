"""MVSNeRF's published weights, from the released PyTorch file or from the same arrays in an npz.

published names   `fn/nerf.pts_linears.0.weight` (the field) and `mvs/feature.conv0.0.conv.weight` (the volume's nets)
"""

from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_option
from zestjax.base.types import FilePath
from zestjax.fields.trunk import ColourHead, Trunk
from zestjax.io.torch_files import read_named_arrays
from zestjax.io.weights import WeightsError
from zestjax.nets.cost_regulariser import CostRegulariser
from zestjax.nets.feature_pyramid import FeaturePyramid
from zestjax.nets.layers import Block, Conv, Dense, Norm, Statistics
from zestjax.systems.mvsnerf import STATISTICS, MvsNerf, MvsNerfField, MvsNerfParams

REMEDY = "give MVSNeRF's released checkpoint (mvsnerf-v0)."
PARTS = {"fn": "network_fn_state_dict", "mvs": "network_mvs_state_dict"}


def read_mvsnerf(path: FilePath, *, statistics: str = "batch") -> MvsNerfParams:
    """Published weights as `mvsnerf.MvsNerfParams`.

    Args:
      path: the released PyTorch file, or an npz of its arrays under the published names.
      statistics: of the norms: those of the images at hand, `batch`, as the published system always runs; or the
        `stored` ones, which it never used.

    Raises:
      WeightsError: no such file, not one of these, or arrays missing or of other shapes.
    """
    check_option("read_mvsnerf", statistics=(statistics, STATISTICS))
    arrays = _published(path)
    try:
        params = mvsnerf_params(arrays, statistics=statistics)
    except (KeyError, ValueError, TypeError) as error:
        raise WeightsError(f"{path}: lacks or misshapes {error}; {REMEDY}") from error
    shapes = lambda tree: [(jax.tree_util.keystr(k), v.shape) for k, v in jax.tree_util.tree_leaves_with_path(tree)]
    expected = shapes(mvsnerf_like(statistics=statistics))
    if wrong := [
        f"`{name}` is {have}, expected {want}"
        for (name, have), (_, want) in zip(shapes(params), expected, strict=True)
        if have != want
    ]:
        raise WeightsError(f"{path}: {'; '.join(wrong[:4])}; {REMEDY}")
    return params


def mvsnerf_like(*, statistics: str = "batch") -> MvsNerfParams:
    """Shapes and types of `read_mvsnerf`'s result."""
    return jax.eval_shape(MvsNerf(statistics=statistics).init, jax.random.key(0))


def _published(path):
    """Arrays by published name."""
    saved = read_named_arrays(path)
    if Path(path).suffix != ".npz":
        if not all(isinstance(saved.get(key), dict) for key in PARTS.values()):
            raise WeightsError(f"{path}: holds no {' and '.join(PARTS.values())}; {REMEDY}")
        saved = {f"{part}/{name}": array for part, key in PARTS.items() for name, array in dict(saved[key]).items()}
    if wrong := [name for name, x in saved.items() if not isinstance(x, np.ndarray) or x.dtype.kind not in "biuf"]:
        raise WeightsError(f"{path}: `{str(wrong[0])[:80]}` is no array of numbers; {REMEDY}")
    return saved


def mvsnerf_params(arrays: Mapping[str, np.ndarray], *, statistics: str = "batch") -> MvsNerfParams:
    """`MvsNerfParams` of arrays by published name; see `read_mvsnerf`.

    Kernels come as (out, in, ...), of transposed convolutions as (in, out, ...).

    Raises:
      KeyError: a name that is missing.
    """
    get = lambda name: jnp.asarray(arrays[name], jnp.float32)

    def dense(name):
        return Dense(get(f"fn/nerf.{name}.weight").T, get(f"fn/nerf.{name}.bias"))

    def block(conv, norm, *, transposed=False):
        kernel = get(f"mvs/{conv}.weight")
        channels = (0, 1) if transposed else (1, 0)
        part = lambda name: get(f"mvs/{norm}.{name}")
        stored = Statistics(part("running_mean"), part("running_var")) if statistics == "stored" else None
        kernel = kernel.transpose(*range(2, kernel.ndim), *channels)
        return Block(Conv(kernel, None), Norm(part("weight"), part("bias"), stored))

    names = [f"feature.conv{i}.{j}" for i, count in enumerate((2, 3, 3)) for j in range(count)]
    head = Conv(get("mvs/feature.toplayer.weight").transpose(2, 3, 1, 0), get("mvs/feature.toplayer.bias"))
    features = FeaturePyramid(tuple(block(f"{name}.conv", f"{name}.bn") for name in names), head)
    level = lambda i: block(f"cost_reg_2.conv{i}.conv", f"cost_reg_2.conv{i}.bn")
    up = lambda i: block(f"cost_reg_2.conv{i}.0", f"cost_reg_2.conv{i}.1", transposed=True)
    downs = tuple((level(i), level(i + 1)) for i in (1, 3, 5))
    regulariser = CostRegulariser(level(0), downs, (up(11), up(9), up(7)), None)
    trunk = Trunk(tuple(dense(f"pts_linears.{i}") for i in range(6)), dense("pts_bias"))
    colour = ColourHead(dense("feature_linear"), dense("views_linears.0"), dense("rgb_linear"))
    return MvsNerfParams(features, regulariser, MvsNerfField(trunk, dense("alpha_linear"), colour))
