"""Arrays out of a PyTorch file, without PyTorch and without running anything that the file contains.

A PyTorch file is a pickle beside raw storages. The pickle is read by an interpreter that knows the handful of names by
which tensors are described, and refuses every other: nothing that a file names is ever imported or called.

storage   flat values of one type; a tensor is a window on one: offset, shape and strides, in values
"""

import collections
import io
import math
import pickle
import pickletools
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from zestjax.base.types import FilePath
from zestjax.io.reading import check_numbers, read_arrays, read_regular
from zestjax.io.weights import WeightsError

STORAGES = {
    "FloatStorage": np.dtype("<f4"), "DoubleStorage": np.dtype("<f8"), "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"), "IntStorage": np.dtype("<i4"), "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"), "ByteStorage": np.dtype("u1"), "BoolStorage": np.dtype(bool),
    "BFloat16Storage": np.dtype(jnp.bfloat16),
}  # fmt: skip
UNUSED = ("BYTEARRAY8", "NEXT_BUFFER", "READONLY_BUFFER", "FRAME", "EXT1", "EXT2", "EXT4", "INST", "OBJ", "NEWOBJ_EX")
LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
UNREADABLE = (
    pickle.UnpicklingError, EOFError, KeyError, IndexError, ValueError, TypeError, AttributeError, MemoryError,
    OverflowError, zipfile.BadZipFile, RuntimeError, OSError, struct.error, zlib.error,
)  # fmt: skip


class TorchFileError(ValueError):
    """Not a PyTorch file, a damaged one, or one that holds more than arrays in lists and dicts."""


def read_torch(path: FilePath) -> Any:
    """What a file holds, its tensors as numpy arrays.

    Args:
      path: written by `torch.save`, in today's zip format or that of PyTorch before 1.6.

    Returns:
      dicts, lists, tuples and numbers as they were saved, with an array for every tensor and parameter. Memory stays
      within a small multiple of the file's size.

    Raises:
      TorchFileError: naming the file, and what it asks for that is no array, or why it cannot be read.
    """
    path = Path(path)
    try:
        content = read_regular(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python's remarks on text in the pickle
            return _read_zip(content) if content[:2] == b"PK" else _read_legacy(content)
    except TorchFileError as error:
        raise TorchFileError(f"{path}: {error}") from None
    except UNREADABLE as error:
        if str(error).startswith(f"{path}: "):
            raise TorchFileError(str(error)) from error
        raise TorchFileError(
            f"{path}: is not a PyTorch file, or a damaged one ({type(error).__name__}: {error}); download it again."
        ) from error


def read_named_arrays(path: FilePath) -> dict[str, np.ndarray]:
    """A dict of a PyTorch file, or of an npz, which is how such a file's arrays are handed on without PyTorch.

    Raises:
      WeightsError: the file cannot be read, is damaged, or holds no dict.
    """
    path = Path(path)
    try:
        if path.suffix == ".npz":
            return {name: check_numbers(path, array, name=name) for name, array in read_arrays(path).items()}
        found = read_torch(path)
    except ValueError as error:
        raise WeightsError(str(error)) from error
    if not isinstance(found, dict):
        raise WeightsError(f"{path}: holds no arrays by name; save a state_dict.")
    return found


def _read_zip(content):
    archive = zipfile.ZipFile(io.BytesIO(content))
    (pickled,) = (name for name in archive.namelist() if name.rpartition("/")[2] == "data.pkl")
    folder = pickled.removesuffix("data.pkl")

    def read(name):
        info = archive.getinfo(name)
        if info.compress_type != zipfile.ZIP_STORED or info.file_size > len(content):
            raise ValueError(f"`{name[:80]}` is compressed, which PyTorch never does, or claims more than is there")
        return archive.read(info)

    def bytes_of(dtype, key, size):
        return _values(read(f"{folder}data/{key}"), dtype, size)

    return _load(io.BytesIO(read(pickled)), _Storages(bytes_of, len(content)))


def _read_legacy(content):
    """Pickles of a magic number, a version and the writer's machine, then the object, its storages' names and bytes."""
    stream = io.BytesIO(content)
    storages = _Storages(lambda dtype, key, size: np.zeros(size, dtype), len(content))
    plain = lambda: _load(stream, None)
    if plain() != LEGACY_MAGIC:
        raise TorchFileError("does not begin as a PyTorch file does; give one that `torch.save` wrote.")
    for _ in ("version", "machine"):
        plain()
    saved = _load(stream, storages)
    for key in plain():
        size, values = int.from_bytes(stream.read(8), "little"), storages.found[key]
        values[:] = _values(stream.read(size * values.itemsize), values.dtype, size)
    return saved


def _values(content, dtype, size):
    values = np.frombuffer(content, dtype)
    if len(values) != size:
        raise ValueError(f"a storage holds {len(values)} values, expected {size}")
    return values


class _Storages:
    """The storages of a file by key, each read once, and together no larger than the file."""

    def __init__(self, read, most):
        self.found, self._read, self._left = {}, read, most

    def get(self, dtype, key, size):
        if type(size) is not int or not isinstance(key, str) or size < 0:
            raise ValueError(f"a storage `{str(key)[:80]}` of size {str(size)[:80]}")
        if key not in self.found:
            self._left -= size * dtype.itemsize
            if self._left < 0:
                raise ValueError(f"its storages claim more than the file has: one of {size} values")
            self.found[key] = self._read(dtype, key, size)
        if (self.found[key].dtype, len(self.found[key])) != (dtype, size):
            raise ValueError(f"a storage `{key[:80]}` of two types or sizes")
        return _Values(self.found[key])


class _Storage(NamedTuple):
    """Names a storage's type in the pickle; holds nothing that a file could alter."""

    dtype: np.dtype


class _Values(NamedTuple):
    """A storage, as only `_Storages` makes one: flat and contiguous. A tensor is never taken for it."""

    flat: np.ndarray


class _Call(NamedTuple):
    """A function that a file may call, and cannot alter."""

    function: Callable

    def __call__(self, *arguments):
        return self.function(*arguments)


def _tensor(values, offset, shape, strides, *_):
    """A window on a storage; refuses one that reaches outside, or repeats values."""
    if not isinstance(values, _Values) or not isinstance(shape, tuple) or not isinstance(strides, tuple):
        raise ValueError("a tensor that is no window on a storage")
    if any(type(n) is not int or n < 0 for n in (offset, *shape, *strides)) or len(shape) != len(strides):
        raise ValueError(f"a tensor of shape {str(shape)[:80]} and strides {str(strides)[:80]}")
    flat = values.flat
    last = offset + sum((n - 1) * step for n, step in zip(shape, strides, strict=True))
    if 0 not in shape and (last >= len(flat) or math.prod(shape) > len(flat)):
        raise ValueError(f"a tensor of {math.prod(shape)} values reaches value {last} of a storage of {len(flat)}")
    if 0 in shape:
        return np.zeros(shape, flat.dtype)
    bytes_apart = [step * flat.itemsize for step in strides]
    return np.lib.stride_tricks.as_strided(flat[offset:], shape, bytes_apart, writeable=False)


KNOWN = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _Call(_tensor),
    ("torch._utils", "_rebuild_parameter"): _Call(lambda tensor, *_: tensor),
    ("torch", "Size"): tuple,
    **{("torch", name): _Storage(dtype) for name, dtype in STORAGES.items()},
}


def _load(stream, storages):
    """The object of one pickle; its instructions are looked through before any is followed."""
    start = stream.tell()
    for instruction, argument, place in pickletools.genops(stream):
        notes = instruction.name in ("PUT", "LONG_BINPUT")  # the interpreter takes memory for as many as the number
        if notes and (argument or 0) > (place or 0):
            raise ValueError(f"it notes value {argument} within {place} bytes")
        if instruction.name in UNUSED:
            raise ValueError(f"it uses the instruction {instruction.name}, which PyTorch never writes")
    stream.seek(start)
    return _Arrays(stream, storages).load()


class _Arrays(pickle.Unpickler):
    def __init__(self, stream, storages):
        super().__init__(stream)
        self._storages = storages

    def find_class(self, module_name, global_name):
        if (module_name, global_name) not in KNOWN:
            raise TorchFileError(
                f"asks for `{module_name}.{global_name}`, which is no array and is not run; save a state_dict."
            )
        return KNOWN[module_name, global_name]

    def persistent_load(self, pid):
        if self._storages is None or not isinstance(pid, tuple) or len(pid) < 5 or pid[0] != "storage":
            raise ValueError("a storage where none belongs")
        _, kind, key, _, size, *_ = pid
        if not isinstance(kind, _Storage):
            raise ValueError("a storage of no type")
        return self._storages.get(kind.dtype, key, size)
