"""Users' files, read: the one place that opens them. What is not as it should be is a ValueError that names the file.

regular file   no folder, fifo, device or socket: those can hang, or never end
claim          the size that a header states; it is compared with what is there before memory is taken
hidden         names that systems leave behind: `.name`, `._name` of macOS's archives, `__MACOSX`, bins
"""

import contextlib
import io
import json
import math
import os
import re
import stat
import warnings
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from zestjax.base.checks import pose_hint
from zestjax.base.types import FilePath

MOST_BYTES = 2**30  # of a file: a depth map and a flow of 8K have 400 MB
CHUNK = 2**20  # bytes
MOST_JSON = 2**26  # bytes: a pose of 20 numbers has 500, so that 100,000 frames fit
NUMPY, ZIP = b"\x93NUMPY", b"PK"
MARKS = {b"\xff\xfe\0\0": "utf-32", b"\0\0\xfe\xff": "utf-32", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
HIDDEN = ("__MACOSX", "$RECYCLE.BIN", "System Volume Information", "@eaDir", "lost+found")
AGAIN = "copy or write it again."


class FileWarning(UserWarning):
    """A file was read, but perhaps does not say what its author meant."""


@contextlib.contextmanager
def open_regular(path: FilePath, *, most: int = MOST_BYTES) -> Iterator[tuple[BinaryIO, int]]:
    """Context: (file, bytes in it) of a regular file. Nothing else is ever opened.

    Raises:
      ValueError: there is none, it is no regular file, cannot be read, or has more than `most` bytes.
    """
    path = Path(path)
    try:
        _check_regular(path, path.stat(), most)
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as file:
            found = os.fstat(file.fileno())
            _check_regular(path, found, most)
            yield file, found.st_size
    except OSError as error:
        raise ValueError(f"{path}: could not be read ({error.strerror or error}); check the path.") from error


def read_regular(path: FilePath, *, most: int = MOST_BYTES) -> bytes:
    """The bytes of a regular file; raises as `open_regular`."""
    with open_regular(path, most=most) as (file, size):
        content = file.read(size)  # Python takes memory for as much as is asked for
        while len(content) <= most and (more := file.read(CHUNK)):  # it grew, or its system does not say how large
            content += more
        if len(content) > most:
            raise ValueError(_larger(path, most))
        return content


def read_array(path: FilePath, *, shape: Sequence[int | None] | None = None) -> np.ndarray:
    """The array of an .npy file: numbers, of the shape given.

    Args:
      path: the file.
      shape: see `check_numbers`.

    Raises:
      ValueError: it cannot be read, is damaged or of another kind, claims more than it has, or `check_numbers`
        refuses it.
    """
    content = read_regular(path)
    if content[: len(ZIP)] == ZIP:
        raise ValueError(f"{path}: is an archive of arrays (.npz), expected one array (.npy); save the array alone.")
    with explained(path, "is not a numpy file that can be read"):
        array = _array(content)
    return check_numbers(path, array, shape=shape)


def read_arrays(path: FilePath, *, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Arrays of an .npz file, by name, as they are stored; those of Python objects are refused.

    Args:
      path: the file.
      names: those wanted, of which some may be missing; None for all.

    Raises:
      ValueError: it cannot be read, is damaged or of another kind, or claims more than it has or than `MOST_BYTES`.
    """
    with open_regular(path) as (file, _):
        head = file.read(len(NUMPY))
        if head == NUMPY:
            raise ValueError(
                f"{path}: holds one array (.npy), expected arrays by name (.npz); save it with their names."
            )
        with explained(path, "is not a numpy file that can be read"), zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            wanted = {name: info for name, info in members.items() if names is None or name in names}
            if sum(info.file_size for info in wanted.values()) > MOST_BYTES:
                raise ValueError(f"its arrays have more than {MOST_BYTES:,} bytes")
            return {name: _array(archive.read(info)) for name, info in wanted.items()}


def check_numbers(
    path: FilePath,
    array: Any,
    *,
    shape: Sequence[int | None] | None = None,
    name: str | None = None,
    finite: bool = False,
) -> np.ndarray:
    """The array, if it holds real numbers or booleans.

    Args:
      path: file it is of, for the message.
      array: what was read.
      shape: sizes of its axes, None for one that is free; None for any shape.
      name: of the array in the file.
      finite: refuse infinities and NaN too.

    Raises:
      ValueError: text, dates, complex numbers, another shape, or values that are not finite.
    """
    array = np.asarray(array)
    what = f"`{name}`" if name else "the array"
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{path}: {what} is of type {array.dtype}, expected numbers; write it again.")
    if shape is not None and (
        array.ndim != len(shape) or any(w not in (None, h) for h, w in zip(array.shape, shape, strict=True))
    ):
        hint = pose_hint(array.shape, shape)
        wanted = " x ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{path}: {what} has shape {array.shape}, expected {wanted}; write it again.{hint}")
    if finite and not np.isfinite(array).all():
        raise ValueError(f"{path}: {what} has values that are not finite; write it again.")
    return array


def read_json(path: FilePath) -> dict[str, Any]:
    """The object (dict) of a JSON file: UTF-8 with or without a mark, or UTF-16 by its mark, whatever the locale.

    Raises:
      ValueError: it cannot be read, is no JSON, no object, nested too deeply, or has numbers that are none.
    """
    content = read_regular(path, most=MOST_JSON)
    with explained(path, "is not JSON that can be read"):
        found = parse_json(content, constant=_refused)
    if not isinstance(found, dict):
        raise ValueError(f"{path}: holds a {type(found).__name__}, expected an object with names; write it again.")
    return found


def parse_json(content: bytes, *, constant: Callable[[str], Any] | None = None) -> Any:
    """What bytes of JSON hold.

    Args:
      content: bytes in UTF-8, or in UTF-16 or UTF-32 with its mark.
      constant: function of `NaN`, `Infinity` or `-Infinity`; None for their floats.

    Raises:
      ValueError: no JSON, another encoding, nested too deeply, or an integer of thousands of digits.
    """
    encoding = next((name for mark, name in MARKS.items() if content.startswith(mark)), "utf-8-sig")
    try:
        return json.loads(content.decode(encoding), parse_constant=constant)
    except (RecursionError, MemoryError) as error:
        raise ValueError("it is nested too deeply") from error


def json_numbers(
    path: FilePath, found: Mapping[str, Any], name: str, *, shape: Sequence[int | None] | None = None
) -> np.ndarray:
    """The numbers of one name in an object of JSON, as finite float64.

    Raises:
      ValueError: there is no such name, or `check_numbers` refuses what it holds.
    """
    if name not in found:
        raise ValueError(f"{path}: has no `{name}`, only {_some(found)}; write it again.")
    with explained(path, f"`{name}` is no array of numbers"):
        array = np.asarray(found[name])
    return check_numbers(path, array, shape=shape, name=name, finite=True).astype(np.float64)


def visible(folder: FilePath) -> tuple[Path, ...]:
    """What lies in a folder but hidden names, see `in_order`; empty where there is no such folder.

    Raises:
      ValueError: the folder cannot be read.
    """
    folder = Path(folder)
    try:
        found = list(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise ValueError(f"{folder}: could not be read ({error.strerror or error}); check its permissions.") from error
    return in_order(p for p in found if not p.name.startswith(".") and p.name not in HIDDEN)


def in_order(paths: Iterable[Path]) -> tuple[Path, ...]:
    """Paths by number if their names differ in digits only, else by name: a tuple."""
    paths = sorted(paths, key=lambda path: path.name)
    if len({re.sub(r"\d+", "0", path.stem) for path in paths}) != 1:
        return tuple(paths)
    return tuple(sorted(paths, key=lambda path: [int(digits) for digits in re.findall(r"\d+", path.stem)]))


def numbers_of(paths: Sequence[Path]) -> tuple[int, ...] | None:
    """The number of each path, where the names differ in one run of digits; None where they do not tell.

    A single name's number is its last run of digits.
    """
    rows = [re.findall(r"\d+", path.stem) for path in paths]
    if len({re.sub(r"\d+", "0", path.stem) for path in paths}) != 1 or not rows[0]:
        return None
    varying = [i for i, runs in enumerate(zip(*rows, strict=True)) if len(set(map(int, runs))) > 1]
    place = varying[0] if varying else -1
    numbers = tuple(int(row[place]) for row in rows)
    return numbers if len(varying) <= 1 and len(set(numbers)) == len(numbers) else None


@contextlib.contextmanager
def silenced_stderr() -> Iterator[None]:
    """Context: what libraries in C write to file descriptor 2 is dropped: an error is said once, by us."""
    try:
        saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    except OSError:  # there is none
        yield
        return
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


def _check_regular(path, found, most):
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a fifo, a device or a socket"
        raise ValueError(f"{path}: is {kind}, expected a file; put the file there, or remove it.")
    if found.st_size > most:
        raise ValueError(_larger(path, most))


def _larger(path, most):
    return f"{path}: has more than {most:,} bytes, the most that is read of such a file; replace it."


@contextlib.contextmanager
def explained(path: FilePath, what: str) -> Iterator[None]:
    """Context: whatever damage raises leaves it as a ValueError that says what the file is not, and what to do."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy's remarks on headers of Python 2
            yield
    except Exception as error:  # the parsers of numpy, zip and tokens raise a dozen kinds
        said = " ".join(str(error).split())[:200]
        raise ValueError(f"{path}: {what} ({said or type(error).__name__}); {AGAIN}") from error


def _array(content):
    """An array from the bytes of an .npy file, whose claim is not larger than what follows."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, columns_first, dtype = read_header(stream)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are not read; save plain numbers")
    count, start = math.prod(shape), stream.tell()
    if count < 0 or count * dtype.itemsize > len(content) - start:
        raise ValueError(f"it claims {dtype} {shape}, more than the {len(content) - start:,} bytes that are there")
    if count == 0:
        return np.zeros(shape, dtype)
    return np.frombuffer(content, dtype, count, start).reshape(shape, order="F" if columns_first else "C")


def _refused(text):
    raise ValueError(f"it holds {text}, which is no number")


def _some(found):
    return ", ".join(f"`{name[:40]}`" for name in sorted(found)[:5]) or "nothing"
