"""Names of types that the whole library writes in its signatures."""

import os
from typing import Any, TypeVar

import jax
import numpy as np

Array = jax.Array | np.ndarray  # of the device, of the host, or traced: what reads arrays reads all of them alike
Scalar = float | np.number | Array  # one number; an array of it has no axes, unless the docstring gives it some
Tree = Any  # a pytree: its leaves are arrays, its structure is the caller's
T = TypeVar("T")  # of what comes back as it went in, a tree of the same structure
FilePath = str | os.PathLike[str]
