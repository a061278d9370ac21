"""LPIPS's weights: AlexNet's from torchvision's file and the linear heads from the authors' into one file of ours."""

from pathlib import Path

import jax
import jax.numpy as jnp

from zestjax.io.torch_files import read_named_arrays
from zestjax.io.weights import WeightsError, load_weights, save_weights
from zestjax.lpips import LpipsParams, lpips_like
from zestjax.nets.layers import Conv

FEATURES = (0, 3, 6, 8, 10)  # torchvision's numbers of the convolutions
KIND = "lpips-alexnet"
REMEDY = "give torchvision's AlexNet (its state_dict) and LPIPS's heads for it (version 0.1, `alex`)."


def read_lpips(alexnet, heads):
    """`LpipsParams` of two files, each a PyTorch file or an npz of the same names.

    Args:
      alexnet: `features.N.weight` (out, in, h, w) and `.bias`.
      heads: `linI.model.1.weight` (1, C, 1, 1).

    Raises:
      WeightsError: a file that cannot be read, or lacks an array, or has one of another shape.
    """
    body, linear = read_named_arrays(alexnet), read_named_arrays(heads)
    try:
        kernels = [body[f"features.{i}.weight"].transpose(2, 3, 1, 0) for i in FEATURES]
        biases = [body[f"features.{i}.bias"] for i in FEATURES]
        rows = [linear[f"lin{i}.model.1.weight"].reshape(-1) for i in range(len(FEATURES))]
    except (KeyError, ValueError, AttributeError) as error:
        raise WeightsError(f"{alexnet}, {heads}: lack or misshape {error}; {REMEDY}") from error
    convolutions = tuple(Conv(*map(_float, pair)) for pair in zip(kernels, biases, strict=True))
    params = LpipsParams(convolutions, tuple(map(_float, rows)))
    shapes = lambda tree: [leaf.shape for leaf in jax.tree.leaves(tree)]
    if shapes(params) != shapes(lpips_like()):
        raise WeightsError(f"{alexnet}, {heads}: hold {shapes(params)}, expected {shapes(lpips_like())}; {REMEDY}")
    return params


def import_lpips(alexnet, heads, out):
    """Write LPIPS's weights as a file that `evaluate --lpips` takes.

    Returns:
      str, the summary line.

    Raises:
      WeightsError: see `read_lpips`; or the file could not be written.
    """
    params = read_lpips(alexnet, heads)
    save_weights(out, params, metadata={"kind": KIND, "from": [Path(alexnet).name, Path(heads).name]})
    return f"import-lpips: {sum(leaf.size for leaf in jax.tree.leaves(params)):,} values: {out}"


def load_lpips(path):
    """`LpipsParams` that `import_lpips` wrote.

    Raises:
      WeightsError: no such file, a damaged one, or one of something else.
    """
    return load_weights(path, like=lpips_like())[0]


def _float(array):
    return jnp.asarray(array, jnp.float32)
