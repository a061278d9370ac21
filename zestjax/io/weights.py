"""Trees of arrays in one safetensors file: no pickle, nothing half-written, nothing altered unnoticed.

A leaf is stored under its path in the tree, `.static.trunk[0].kernel`. The header carries the caller's metadata as JSON
and a SHA-256 over names, types, shapes, values and that metadata.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from zestjax.base.types import FilePath, Tree
from zestjax.io.files import write_bytes
from zestjax.io.reading import open_regular, parse_json

MOST_BYTES = 2**30  # of a file: a checkpoint of the largest preset has some 2 % of it
MOST_HEADER = 100_000_000  # bytes: the limit of safetensors itself
JSON = (dict, list, tuple, str, int, float, type(None))  # what JSON holds; a bool is an int

_DTYPES = {
    **{f"F{bits}": np.dtype(f"float{bits}") for bits in (16, 32, 64)},
    **{f"I{bits}": np.dtype(f"int{bits}") for bits in (8, 16, 32, 64)},
    **{f"U{bits}": np.dtype(f"uint{bits}") for bits in (8, 16, 32, 64)},
    "BF16": np.dtype(jnp.bfloat16),
    "BOOL": np.dtype(bool),
}


class WeightsError(ValueError):
    """Weights or a checkpoint could not be written, or are not the ones asked for. Names the file and the remedy."""


class DamagedFileError(WeightsError):
    """The file is truncated, was altered after it was written, or is no weights file."""


class UnreadableFileError(WeightsError):
    """There is a file of that name, and it cannot be read: the disk's fault, no permission, or no regular file."""


def save_weights(path: FilePath, params: Tree, *, metadata: Mapping[str, Any]) -> None:
    """Write a tree of arrays and its metadata to one file, atomically.

    Args:
      path: the file; an earlier one is replaced only once the new one is complete.
      params: pytree of arrays; PRNG keys, bfloat16 and scalars keep their types.
      metadata: dict of what JSON can hold, or NumPy's numbers; the full configuration belongs here.

    Raises:
      WeightsError: metadata that JSON cannot hold; or the disk is full or the place not writable: an earlier file is
        unchanged, no part of the new left.
    """
    arrays = {name: _to_numpy(leaf) for name, leaf in _named_leaves(params)}
    text = json.dumps(_plain(metadata), sort_keys=True)
    header = {"format": "zestjax", "metadata": text, "sha256": _digest(arrays, text)}
    try:
        write_bytes(path, safetensors.numpy.save(arrays, metadata=header))
    except OSError as error:
        raise WeightsError(f"{path}: could not be written: {error.strerror or error}.") from error


def _plain(value, place="metadata", kinds=(dict,)):
    """Metadata of Python's own types, NumPy's numbers with it; `place`: where in it the value stands."""
    value = value.item() if isinstance(value, np.generic) else value
    if not isinstance(value, kinds):
        wanted = "a dict" if kinds == (dict,) else "text, a number, bool, None, or a list or dict of them"
        raise WeightsError(f"save_weights: `{place}` is of type {type(value).__name__}, expected {wanted}.")
    if isinstance(value, (list, tuple)):
        return [_plain(entry, f"{place}[{i}]", JSON) for i, entry in enumerate(value)]
    if not isinstance(value, dict):
        return value
    if odd := [key for key in value if not isinstance(key, str)]:
        raise WeightsError(f"save_weights: `{place}` has the key {odd[0]!r}, expected text as keys.")
    return {key: _plain(entry, f"{place}[{key!r}]", JSON) for key, entry in value.items()}


def load_weights(
    path: FilePath, *, like: Tree = None, renewed: Callable[[dict[str, Any]], dict[str, Any]] | None = None
) -> tuple[Any, dict[str, Any]]:
    """Read what `save_weights` wrote.

    Args:
      path: the file.
      like: tree of arrays or `jax.ShapeDtypeStruct`s of the wanted structure, shapes and types; None returns a flat
        dict from leaf path to numpy array instead.
      renewed: function from the stored arrays by name to those of `like`, for files of an earlier version.

    Returns:
      (params, metadata): the tree of jax arrays with the structure of `like`, and the dict given to `save_weights`.

    Raises:
      DamagedFileError: truncated, altered, or not a file of this kind.
      WeightsError: no such file; or its leaves are not those of `like` (all differences are listed).
    """
    arrays, metadata = _read(Path(path))
    if renewed is not None:
        arrays = renewed(arrays)
    if like is None:
        return arrays, metadata
    wanted = _named_leaves(like)
    differences = _differences(arrays, wanted)
    if differences:
        shown = "; ".join(differences[:8]) + (f"; and {len(differences) - 8} more" if len(differences) > 8 else "")
        raise WeightsError(
            f"{path}: holds weights of another model or preset: {shown}. "
            "Use the preset that its metadata names, or other weights."
        )
    leaves = [_from_numpy(arrays[name], leaf) for name, leaf in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), metadata


def read_metadata(path: FilePath) -> dict[str, Any]:
    """The metadata dict of a weights file, verified as by `load_weights`.

    Raises:
      WeightsError: as `load_weights`.
    """
    return load_weights(path)[1]


def _named_leaves(tree):
    """[(path in the tree, leaf)] in the tree's order."""
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]]


def _is_key(leaf):
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_numpy(leaf):
    """A contiguous array: safetensors stores the memory as it lies."""
    array = np.asarray(
        jax.random.key_data(leaf) if _is_key(leaf) else leaf if hasattr(leaf, "dtype") else jnp.asarray(leaf)
    )
    return np.ascontiguousarray(array).reshape(array.shape)


def _from_numpy(array, leaf):
    if _is_key(leaf):
        implementations = []
        jax.eval_shape(lambda key: implementations.append(jax.random.key_impl(key)), leaf)
        return jax.random.wrap_key_data(jnp.asarray(array), impl=implementations[0])
    return jnp.asarray(array)


def _differences(arrays, wanted):
    """Sentences on how the stored arrays differ from the wanted leaves; empty when they match."""
    names = [name for name, _ in wanted]
    found = [f"`{name}` is missing" for name in names if name not in arrays]
    found += [f"`{name}` is not wanted" for name in arrays if name not in set(names)]
    for name, leaf in wanted:
        if name in arrays:
            spec = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
            dtype = spec.dtype if hasattr(spec, "dtype") else jnp.asarray(spec).dtype
            have, want = arrays[name], (np.shape(spec), dtype)
            if (have.shape, have.dtype) != want:
                found.append(f"`{name}` is {have.dtype} {have.shape}, expected {want[1]} {want[0]}")
    return found


def _digest(arrays, text):
    """SHA-256 over everything that must not change, in the order of the names."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"\n{name} {array.dtype.name} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _read(path):
    """The stored arrays by name and the metadata, verified. The header is looked at before the rest is read."""
    try:
        with open_regular(path, most=MOST_BYTES) as (file, size):
            content = _head(path, file, size)
            header = _header(path, content)
            content += file.read(size - len(content))
    except DamagedFileError:
        raise
    except ValueError as error:
        raise UnreadableFileError(str(error)) from error
    try:
        stored = dict(safetensors.deserialize(content))
        arrays = {
            name: np.frombuffer(entry["data"], _DTYPES[entry["dtype"]]).reshape(entry["shape"])
            for name, entry in stored.items()
        }
    except (ValueError, KeyError, TypeError, OverflowError, MemoryError, safetensors.SafetensorError) as error:
        raise _damaged(path, size) from error
    text = header["metadata"]
    if header.get("sha256") != _digest(arrays, text):
        raise DamagedFileError(
            f"{path}: was altered after it was written (its checksum differs); copy or write it again."
        )
    return arrays, _metadata(path, text)


def _head(path, file, size):
    """The file's first bytes, up to the end of its header, if their number can be right."""
    start = file.read(8)
    length = int.from_bytes(start, "little")
    if len(start) != 8 or length > min(size - 8, MOST_HEADER):
        raise _damaged(path, size)
    return start + file.read(length)


def _header(path, content):
    """The header's own metadata: a dict of strings, if zestjax wrote it."""
    try:
        header = parse_json(content[8:])
    except ValueError as error:
        raise _damaged(path, len(content)) from error
    found = header.get("__metadata__") if isinstance(header, dict) else None
    if not isinstance(found, dict) or found.get("format") != "zestjax" or not isinstance(found.get("metadata"), str):
        raise DamagedFileError(f"{path}: is a safetensors file that zestjax did not write; give weights that it wrote.")
    return found


def _metadata(path, text):
    try:
        metadata = parse_json(text.encode())
    except ValueError as error:
        raise WeightsError(f"{path}: its metadata is not JSON ({error}); give weights that zestjax wrote.") from error
    if not isinstance(metadata, dict):
        raise WeightsError(f"{path}: its metadata is a {type(metadata).__name__}, expected an object; write it again.")
    return metadata


def _damaged(path, size):
    return DamagedFileError(f"{path}: is truncated or not a safetensors file ({size:,} bytes); copy or write it again.")
