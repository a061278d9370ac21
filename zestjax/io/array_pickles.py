"""Arrays out of a numpy pickle, without running anything that the file contains.

Python lists a pickle's instructions without following them. The interpreter here follows those that build dicts and
float32 arrays, and refuses every other, and every name but numpy's own three: nothing that a file names is ever
imported or called.

instruction   one step of a pickle: it puts a value on a stack, or makes one of those on top of it
"""

import enum
import pickletools
from typing import Any

import numpy as np


class _Thing(enum.Enum):
    """What a file names or has begun. No file can write one."""

    CLASS = enum.auto()
    MAKER = enum.auto()
    TYPE = enum.auto()
    FLOAT32 = enum.auto()
    ARRAY = enum.auto()


NAMES = {
    "numpy ndarray": _Thing.CLASS,
    "numpy dtype": _Thing.TYPE,
    "numpy.core.multiarray _reconstruct": _Thing.MAKER,
    "numpy._core.multiarray _reconstruct": _Thing.MAKER,  # its name since numpy 2
}
VALUES = ("BINUNICODE", "BININT", "BININT1", "BININT2", "BINBYTES", "SHORT_BINBYTES")
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
UNREADABLE = (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError)


class ArrayPickleError(ValueError):
    """Not a pickle, a damaged one, or one that holds more than arrays in dicts."""


def read_array_pickle(content: bytes) -> dict[str, Any]:
    """Dicts of float32 arrays, as they were pickled in protocol 3.

    Args:
      content: bytes. Memory stays within a small multiple of them.

    Returns:
      dict from str to array or dict; an array is read-only.

    Raises:
      ArrayPickleError: saying what the pickle asks for that is no array, or that it is damaged. Names no file.
    """
    try:
        found = _run(content)
    except ArrayPickleError:
        raise
    except UNREADABLE as error:
        raise ArrayPickleError(f"is damaged, or no pickle of arrays ({type(error).__name__}: {error})") from error
    if not isinstance(found, dict):
        raise ArrayPickleError("holds no arrays by name")
    return found


def _run(content):
    stack, marks, memo = [], [], {}
    for instruction, argument, _ in pickletools.genops(content):
        match instruction.name:
            case "PROTO":
                pass
            case "STOP":
                return stack.pop()
            case name if name in VALUES:
                stack.append(argument)
            case name if name in CONSTANTS:
                stack.append(CONSTANTS[name])
            case "EMPTY_DICT":
                stack.append({})
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "MARK":
                marks.append(len(stack))
            case "TUPLE":
                stack.append(tuple(_cut(stack, marks.pop())))
            case "TUPLE1" | "TUPLE2" | "TUPLE3" as name:
                stack.append(tuple(_cut(stack, len(stack) - int(name[-1]))))
            case "SETITEM":
                _put(_cut(stack, len(stack) - 2), stack[-1])
            case "SETITEMS":
                _put(_cut(stack, marks.pop()), stack[-1])
            case "GLOBAL":
                stack.append(_named(argument))
            case "REDUCE":
                stack.append(_begun(*_cut(stack, len(stack) - 2)))
            case "BUILD":
                stack.append(_filled(*_cut(stack, len(stack) - 2)))
            case name:
                raise ArrayPickleError(f"uses the instruction {name}, which no array needs")
    raise ValueError("it has no end")


def _cut(stack, start):
    """What lies on the stack from `start`, taken off."""
    if start < 0:
        raise ValueError("it takes more than it has put down")
    taken = stack[start:]
    del stack[start:]
    return taken


def _put(items, into):
    keys, values = items[::2], items[1::2]
    if not isinstance(into, dict) or not all(isinstance(key, str) for key in keys):
        raise ValueError("an item is no array by name")
    into.update(zip(keys, values, strict=True))


def _named(name):
    if name not in NAMES:
        raise ArrayPickleError(f"asks for `{name.replace(' ', '.')}`, which is no array and is not run")
    return NAMES[name]


def _begun(thing, arguments):
    if thing is _Thing.MAKER:
        return _Thing.ARRAY
    if thing is _Thing.TYPE and arguments[0] == "f4":
        return _Thing.FLOAT32
    raise ValueError("something that is no float32 array is made")


def _filled(thing, state):
    """An array of its (version, shape, type, whether columns come first, bytes); or a type with its byte order."""
    if thing is _Thing.FLOAT32 and state[1] == "<":
        return _Thing.FLOAT32
    _, shape, kind, columns_first, content = state
    if thing is not _Thing.ARRAY or kind is not _Thing.FLOAT32 or not isinstance(content, bytes):
        raise ValueError("something that is no float32 array is filled")
    return np.frombuffer(content, "<f4").reshape(shape, order="F" if columns_first else "C")
