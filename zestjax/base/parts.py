"""A part: a frozen value of choices with a pure function. Systems and recipes are expressions of parts.

part    a frozen dataclass: compared and hashed by value, so that it can be a static argument of a compiled function
stored  what a file holds of a part: {"part": its class's name, and its fields}; a tuple is a list
"""

import dataclasses
import typing
from collections.abc import Iterable
from typing import Any

from zestjax.base.types import T

MOST_NUMBER = 2**16  # of a stored integer: planes, channels or pixels; a larger one is damage
MOST_ENTRIES = 256  # of a stored list, for the same reason
MOST_DEPTH = 16  # of parts within parts: a system has four; Python's own limit would be a traceback


@typing.dataclass_transform(frozen_default=True)
def part(cls: type[T]) -> type[T]:
    """Make a class a part; its fields are the choices, and what its `__post_init__` refuses cannot be built."""
    return dataclasses.dataclass(frozen=True)(cls)


def to_stored(value: Any) -> Any:
    """A part, or anything that a part may hold, as JSON can hold it.

    Raises:
      TypeError: a field holds something else than numbers, texts, None, tuples and parts.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: to_stored(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"part": type(value).__name__, **fields}
    if isinstance(value, tuple):
        return [to_stored(entry) for entry in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"to_stored: a part holds a {type(value).__name__}, expected numbers, texts, tuples or parts.")


def from_stored(stored: Any, known: Iterable[type]) -> Any:
    """The part that `to_stored` wrote.

    Args:
      stored: of JSON; it may come from anybody.
      known: the classes that it may name; nothing else is ever made of it.

    Raises:
      ValueError: a part that is not known, a field that its part does not have or that is missing, a value of another
        type than the field's, or of a size that no model has.
    """
    return _read(stored, {cls.__name__: cls for cls in known}, 0)


def _read(stored: Any, known: dict[str, type], depth: int) -> Any:
    if depth > MOST_DEPTH:
        raise ValueError(f"parts lie within parts more than {MOST_DEPTH} deep")
    if isinstance(stored, list):
        if len(stored) > MOST_ENTRIES:
            raise ValueError(f"a list has {len(stored)} entries, more than {MOST_ENTRIES}")
        return tuple(_read(entry, known, depth + 1) for entry in stored)
    if isinstance(stored, dict):
        return _part(stored, known, depth)
    if type(stored) is int and abs(stored) > MOST_NUMBER:
        raise ValueError(f"a number is {str(stored)[:40]}, more than {MOST_NUMBER}")
    return stored


def _part(stored: dict, known: dict[str, type], depth: int) -> Any:
    name = stored.get("part")
    if not isinstance(name, str) or name not in known:
        raise ValueError(f"a part is {str(name)[:80]!r}, expected one of {', '.join(known)}")
    cls, given = known[name], {field: value for field, value in stored.items() if field != "part"}
    fields: Any = {f.name: f for f in dataclasses.fields(typing.cast(Any, cls))}
    if unknown := sorted(given.keys() - fields.keys()):
        raise ValueError(f"{name} has fields that this version does not know: {', '.join(unknown)[:200]}")
    hints, values = typing.get_type_hints(cls), {}
    for field, value in given.items():
        values[field] = _read(value, known, depth + 1)
        if not _fits(values[field], hints[field]):
            raise ValueError(f"{name} has `{field}` {str(value)[:80]}, which cannot be")
    try:
        return cls(**values)
    except TypeError as error:
        raise ValueError(f"{name}: {error}") from error


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of a field's type. A protocol admits any part: what it lacks is an error where it is used."""
    options, inner = typing.get_args(hint), typing.get_origin(hint)
    if hint is Any or hint in (int, float, str, bool, type(None)):
        return hint is Any or type(value) is hint or (hint is float and type(value) is int)
    if inner is tuple:
        entries = options[:1] * len(value) if isinstance(value, tuple) and options[1:] == (...,) else options
        return isinstance(value, tuple) and len(entries) == len(value) and all(map(_fits, value, entries))
    if options:  # a union
        return any(_fits(value, option) for option in options)
    if getattr(hint, "_is_protocol", False):
        return dataclasses.is_dataclass(value) and not isinstance(value, type)
    return isinstance(value, hint)
