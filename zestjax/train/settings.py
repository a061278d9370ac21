"""Settings: one choice of a recipe by its dotted name, as a command line gives it.

name   fields from the `Recipe` on, `rate.peak` or `rays.count`; or `weights.TERM`, a term's weight
value  text: a number, `true`, `false`, `null`, `[8,12]`, or a word; of a term's weight 0 takes it out of the program
"""

import ast
import dataclasses
import json
from collections.abc import Iterable, Iterator
from typing import Any

from zestjax.base.parts import from_stored, to_stored
from zestjax.train.recipes import Recipe
from zestjax.train.terms import KINDS, unmeasured

WORDS = {"true": True, "false": False, "null": None}


def with_settings(recipe: Recipe, settings: Iterable[tuple[str, str]]) -> Recipe:
    """The recipe with other choices, (name, value) each; see `with_setting`."""
    for name, text in settings:
        recipe = with_setting(recipe, name, text)
    return recipe


def with_setting(recipe: Recipe, name: str, text: str) -> Recipe:
    """The recipe with another choice.

    Args:
      recipe: `Recipe`.
      name: dotted, see above.
      text: the value.

    Raises:
      ValueError: no such name, with those that there are; or a value that the choice cannot have.
    """
    stored: Any = to_stored(recipe)
    path = name.split(".")
    if path[0] == "weights" and len(path) == 2 and path[1] not in _choices(stored["weights"]):
        return _with_weight(recipe, path[1], text)
    place, above = stored, stored
    for depth, field in enumerate(path):
        choices = _choices(place)
        if field not in choices:
            has = f"{', '.join(choices)}" if choices else f"the value {json.dumps(place)} and no parts"
            raise ValueError(f"with_setting: no `{name}`; {'.'.join(path[:depth]) or 'a recipe'} has {has}.")
        above, place = place, place[field]
    if isinstance(place, dict):
        raise ValueError(
            f"with_setting: `{name}` is a whole part; set one of its choices: {', '.join(_choices(place))}."
        )
    above[path[-1]] = _value(text)
    try:
        return from_stored(stored, set(_parts(recipe)))
    except ValueError as error:
        raise ValueError(f"with_setting: {name}={text}: {str(error).rstrip('.')}.") from error


def _with_weight(recipe, term, text):
    """The recipe with another weight of a term."""
    known = sorted({name for kind in KINDS for name in kind.terms}.union(recipe.terms))
    if term not in known:
        raise ValueError(f"with_setting: no `weights.{term}`; terms are {', '.join(known)}.")
    weight = _value(text)
    if type(weight) not in (int, float) or weight < 0:
        raise ValueError(f"with_setting: weights.{term}={text}: expected a number from 0.")
    if lost := unmeasured(recipe.system, {term: weight}, own=recipe.terms):
        raise ValueError(f"with_setting: weights.{term}={text}: the term needs {lost[term]}; change the system.")
    weights = dict(recipe.weights.terms) | {term: weight}
    return recipe.weighted({name: value for name, value in weights.items() if value or name != term})


def _choices(stored):
    """Names that can be set in a stored part."""
    return [field for field in stored if field not in ("part", "terms")] if isinstance(stored, dict) else []


def _value(text):
    """A text's value; what is neither a number, a list nor one of `WORDS` stays a text, also `NaN`."""
    if text in WORDS:
        return WORDS[text]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        return text


def _parts(value: Any) -> Iterator[type]:
    """The classes of the parts of a part."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield type(value)
        for field in dataclasses.fields(value):
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, tuple):
        for entry in value:
            yield from _parts(entry)
