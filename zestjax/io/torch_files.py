"""Arrays out of a PyTorch file, without PyTorch and without running anything that the file contains.

A PyTorch file is a pickle beside raw storages. The pickle is read by an interpreter that knows the handful of names by
which tensors are described, and refuses every other: nothing that a file names is ever imported or called.

storage   flat values of one type; a tensor is a window on one: offset, shape and strides, in values
"""

import collections
import io
import pickle
import zipfile
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from zestjax.io.weights import WeightsError

STORAGES = {
    "FloatStorage": np.dtype("<f4"), "DoubleStorage": np.dtype("<f8"), "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"), "IntStorage": np.dtype("<i4"), "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"), "ByteStorage": np.dtype("u1"), "BoolStorage": np.dtype(bool),
    "BFloat16Storage": np.dtype(jnp.bfloat16),
}  # fmt: skip
LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
UNREADABLE = (
    pickle.UnpicklingError, EOFError, KeyError, IndexError, ValueError, TypeError, AttributeError, MemoryError,
    OverflowError, zipfile.BadZipFile, NotImplementedError, RecursionError,
)  # fmt: skip


class TorchFileError(ValueError):
    """Not a PyTorch file, a damaged one, or one that holds more than arrays in lists and dicts."""


def read_torch(path):
    """What a file holds, its tensors as numpy arrays.

    Args:
      path: written by `torch.save`, in today's zip format or that of PyTorch before 1.6.

    Returns:
      dicts, lists, tuples and numbers as they were saved, with an array for every tensor and parameter.

    Raises:
      TorchFileError: naming the file, and what it asks for that is no array.
      OSError: the file cannot be read.
    """
    path = Path(path)
    content = path.read_bytes()
    try:
        return _read_zip(content) if content[:2] == b"PK" else _read_legacy(content)
    except TorchFileError as error:
        raise TorchFileError(f"{path}: {error}") from None
    except UNREADABLE as error:
        raise TorchFileError(
            f"{path}: is not a PyTorch file, or a damaged one ({type(error).__name__}: {error}); download it again."
        ) from error


def read_named_arrays(path):
    """A dict of a PyTorch file, or of an npz, which is how such a file's arrays are handed on without PyTorch.

    Raises:
      WeightsError: the file cannot be read, is damaged, or holds no dict.
    """
    path = Path(path)
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as stored:
                return dict(stored)
        found = read_torch(path)
    except OSError as error:
        raise WeightsError(f"{path}: could not be read ({error.strerror or error}); check the path.") from error
    except (ValueError, zipfile.BadZipFile) as error:
        raise WeightsError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    if not isinstance(found, dict):
        raise WeightsError(f"{path}: holds no arrays by name; save a state_dict.")
    return found


def _read_zip(content):
    archive = zipfile.ZipFile(io.BytesIO(content))
    (pickled,) = (name for name in archive.namelist() if name.rpartition("/")[2] == "data.pkl")
    folder = pickled.removesuffix("data.pkl")

    def storage(dtype, key, size):
        return _values(archive.read(f"{folder}data/{key}"), dtype, size)

    return _Arrays(io.BytesIO(archive.read(pickled)), storage).load()


def _read_legacy(content):
    """Pickles of a magic number, a version and the writer's machine, then the object, its storages' names and bytes."""
    stream, stored = io.BytesIO(content), {}
    plain = lambda: _Arrays(stream, None).load()
    if plain() != LEGACY_MAGIC:
        raise TorchFileError("does not begin as a PyTorch file does; give one that `torch.save` wrote.")
    for _ in ("version", "machine"):
        plain()

    def storage(dtype, key, size):
        return stored.setdefault(key, np.zeros(size, dtype))

    saved = _Arrays(stream, storage).load()
    for key in plain():
        size, values = int.from_bytes(stream.read(8), "little"), stored[key]
        values[:] = _values(stream.read(size * values.dtype.itemsize), values.dtype, size)
    return saved


def _values(content, dtype, size):
    values = np.frombuffer(content, dtype)
    if len(values) != size:
        raise ValueError(f"a storage holds {len(values)} values, expected {size}")
    return values


class _Storage(NamedTuple):
    """Names a storage's type in the pickle; holds nothing that a file could alter."""

    dtype: np.dtype


def _tensor(values, offset, shape, strides, *_):
    """A window on a storage; refuses one that reaches outside."""
    if len(shape) != len(strides) or min((offset, *shape, *strides), default=0) < 0:
        raise ValueError(f"a tensor of shape {shape} and strides {strides}")
    last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
    if 0 not in shape and last >= len(values):
        raise ValueError(f"a tensor reaches value {last} of a storage of {len(values)}")
    if 0 in shape:
        return np.zeros(shape, values.dtype)
    bytes_apart = [step * values.dtype.itemsize for step in strides]
    return np.lib.stride_tricks.as_strided(values[offset:], shape, bytes_apart, writeable=False)


KNOWN = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
    ("torch", "Size"): tuple,
    **{("torch", name): _Storage(dtype) for name, dtype in STORAGES.items()},
}


class _Arrays(pickle.Unpickler):
    def __init__(self, stream, storage):
        super().__init__(stream)
        self._storage = storage

    def find_class(self, module_name, global_name):
        if (module_name, global_name) not in KNOWN:
            raise TorchFileError(
                f"asks for `{module_name}.{global_name}`, which is no array and is not run; save a state_dict."
            )
        return KNOWN[module_name, global_name]

    def persistent_load(self, pid):
        if self._storage is None or pid[0] != "storage":
            raise ValueError("a storage where none belongs")
        _, kind, key, _, size, *_ = pid
        return self._storage(kind.dtype, key, size)
