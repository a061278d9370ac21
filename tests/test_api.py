"""The conventions of the public functions of layers 0-7: options keyword-only, `key` first, documented."""

import importlib
import inspect
import pkgutil

import zestjax

CORE = [
    name
    for _, name, _ in pkgutil.walk_packages(zestjax.__path__, "zestjax.")
    if name.split(".")[1] not in ("apps", "cli") and "__main__" not in name
]


def public(kind):
    """(qualified name, object) of the public functions or classes that the core's modules define."""
    found = {}
    for name in CORE:
        module = importlib.import_module(name)
        for attribute, value in vars(module).items():
            if not attribute.startswith("_") and kind(value) and getattr(value, "__module__", "") == name:
                found[f"{name.removeprefix('zestjax.')}.{attribute}"] = value
    return sorted(found.items())


def is_function(value):
    return callable(value) and not inspect.isclass(value) and inspect.isroutine(inspect.unwrap(value))


FUNCTIONS = public(is_function)
CLASSES = public(inspect.isclass)


def test_every_public_function_and_type_is_documented():
    bare = [name for name, value in FUNCTIONS + CLASSES if not (value.__doc__ or "").strip()]
    # A NamedTuple without a docstring gets a generated one that repeats its fields.
    bare += [name for name, value in CLASSES if (value.__doc__ or "").startswith(f"{value.__name__}(")]
    assert not bare


def test_every_module_says_what_it_is():
    bare = [name for name in CORE if not (importlib.import_module(name).__doc__ or "").strip()]
    packages = {name for name in CORE if hasattr(importlib.import_module(name), "__path__")}
    assert not [name for name in bare if name not in packages]


def signature(fn):
    return inspect.signature(inspect.unwrap(fn)).parameters


def test_options_are_keyword_only():
    """`render(raw, z, d, noise)` cannot land `noise` in `white_background`."""
    loose = lambda fn: [p.name for p in signature(fn).values() if p.default is not p.empty and p.kind < p.KEYWORD_ONLY]
    assert not {name: loose(fn) for name, fn in FUNCTIONS if loose(fn)}


def test_a_random_function_takes_its_key_first():
    late = lambda names: "key" in names[1:] or bool({"rng", "rng_key", "prng_key"} & set(names))
    assert not [name for name, fn in FUNCTIONS if late(list(signature(fn)))]


def methods(cls):
    """(name, function) of the public methods and properties that a class defines itself."""
    for name, value in vars(cls).items():
        function = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
        if not name.startswith("_") and inspect.isfunction(function):
            yield name, function


def test_public_functions_are_typed():
    """Every argument and every result, of the methods of public classes too: pyright checks what has a type."""
    functions = [(name, inspect.unwrap(value)) for name, value in FUNCTIONS]
    functions += [(f"{name}.{method}", function) for name, value in CLASSES for method, function in methods(value)]
    untyped = {}
    for name, function in functions:
        found = inspect.signature(function)
        bare = [p.name for p in found.parameters.values() if p.annotation is p.empty and p.name not in ("self", "cls")]
        bare += ["its result"] if found.return_annotation is found.empty else []
        untyped |= {name: bare} if bare else {}
    assert not untyped
