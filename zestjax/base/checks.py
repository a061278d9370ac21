"""Checks of arguments: of shapes, types and options. They run while JAX traces, and cost nothing once compiled."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np


def check_shapes(where: str, /, **arrays: tuple[Any, str]) -> dict[str, int]:
    """Match each array's trailing axes to a spec; raise with the axis's name.

    Args:
      where: name of the calling function, used in the message.
      **arrays: `name=(array, "... S C")`. A leading `...` frees the batch axes, which need only broadcast against
        each other; a word is an axis that must have one size everywhere; a digit is literal.

    Returns:
      dict from axis name to size.

    Raises:
      ValueError: naming the function, the argument, the axis and both sizes.
    """
    sizes, first, batches = {}, {}, {}
    for name, (array, spec) in arrays.items():
        axes, shape = spec.split(), jnp.shape(array)
        free = bool(axes) and axes[0] == "..."
        axes = axes[1:] if free else axes
        if len(shape) < len(axes) or (len(shape) > len(axes) and not free):
            raise ValueError(f"{where}: `{name}` should be ({spec}), got shape {shape}.")
        if free:
            batches[name] = shape[: len(shape) - len(axes)]
        for axis, size in zip(axes, shape[len(shape) - len(axes) :], strict=True):
            want = int(axis) if axis.isdigit() else sizes.setdefault(axis, size)
            if size != want and axis.isdigit():
                raise ValueError(f"{where}: `{name}` should be ({spec}), got shape {shape}.{pose_hint(shape, axes)}")
            if size != want:
                source = f" from `{first[axis]}`" if axis in first else ""
                raise ValueError(
                    f"{where}: axis {axis} of `{name}` is {size}, expected {want}{source} "
                    f"({name} should be ({spec}), got shape {shape})."
                )
            first.setdefault(axis, name)
    _check_batches(where, batches)
    return sizes


def pose_hint(shape: Sequence[int], wanted: Sequence[str | int | None]) -> str:
    """A sentence on what a 3x4 pose lacks where a 4x4 one is wanted, else nothing; `wanted`: sizes of the axes."""
    meant = tuple(shape[-2:]) == (3, 4) and [str(size) for size in wanted[-2:]] == ["4", "4"]
    return " A 3x4 pose needs the row 0 0 0 1 under it." if meant else ""


def _check_batches(where, batches):
    try:
        np.broadcast_shapes(*batches.values())
    except ValueError:
        listed = ", ".join(f"{shape} of `{name}`" for name, shape in batches.items())
        raise ValueError(f"{where}: batch axes that do not broadcast: {listed}.") from None


def check_option(where: str, /, **options: tuple[Any, Sequence[Any]]) -> None:
    """Refuse a value that is not one of the listed ones: `check_option("f", head=(head, ("blend", "direct")))`.

    Raises:
      ValueError: naming the function, the option, the value and the valid ones.
    """
    for name, (value, valid) in options.items():
        if value not in valid:
            listed = ", ".join(repr(v) for v in valid)
            raise ValueError(f"{where}: `{name}` is {value!r}, expected one of {listed}.")


def check_types(where: str, /, **values: tuple[Any, type]) -> None:
    """Refuse a value that is not of its type: `check_types("f", video=(video, Video))`.

    Raises:
      ValueError: naming the function, the argument and both types.
    """
    for name, (value, wanted) in values.items():
        if not isinstance(value, wanted):
            raise ValueError(f"{where}: `{name}` should be a `{wanted.__name__}`, got `{type(value).__name__}`.")


def traced(tree: Any) -> bool:
    """Whether anything of a tree has no values yet, because JAX is tracing it."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def check_known(where: str, /, **trees: Any) -> None:
    """Refuse what has no values yet because it is being traced, where a choice depends on the values.

    Raises:
      ValueError: naming the function and the argument.
    """
    for name, tree in trees.items():
        if traced(tree):
            raise ValueError(
                f"{where}: `{name}` is traced, expected an array with values: this is done on the host; call it "
                "outside `jit`, `grad` and `vmap`."
            )


def check_counts(where: str, /, **counts: tuple[Any, int, int]) -> None:
    """Refuse what is no whole number of a range: `check_counts("Space", planes=(planes, 2, 512))`.

    Raises:
      ValueError: naming the function, the argument, its value and the range.
    """
    for name, (value, least, most) in counts.items():
        if type(value) is not int or not least <= value <= most:
            raise ValueError(f"{where}: `{name}` is {value!r}, expected an integer from {least} to {most}.")
