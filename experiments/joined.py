"""Weights made of two runs of one system: its static part of one, its dynamic part of the other.

    python experiments/joined.py --static A.safetensors --dynamic B.safetensors --out W.safetensors

What frames say of themselves must be the same in both. The shipped weights are made so (`zestjax/weights/README.md`):
more training of both fields made what stands still better and what moves worse.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np

from zestjax.apps.train import run_name
from zestjax.apps.weights import open_weights
from zestjax.base.parts import to_stored
from zestjax.io.weights import save_weights
from zestjax.train.recipes import RECIPES


def joined(still, moving, out):
    """Write the static part of the first file with the dynamic part of the second.

    Raises:
      ValueError: they are of different systems, or their frames say different things of themselves.
    """
    first, second = open_weights(still), open_weights(moving)
    if first.system != second.system:
        raise ValueError(f"{moving}: is of another system than {still}; give two runs of one.")
    pairs = zip(*(jax.tree.leaves(model.params.analysis) for model in (first, second)), strict=True)
    if not all(np.array_equal(a, b) for a, b in pairs):
        raise ValueError(f"{moving}: what its frames say of themselves is not as in {still}; train one from the other.")
    recipe = dataclasses.replace(RECIPES[first.preset], system=first.system)  # not of the last stage alone
    metadata = first.metadata | {"dynamic": run_name(moving), "recipe": to_stored(recipe)}
    save_weights(out, first.params._replace(dynamic=second.params.dynamic), metadata=metadata)


def main():
    """See above."""
    parser = argparse.ArgumentParser(description="Weights made of two runs of one system.")
    for name in ("static", "dynamic", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    options = parser.parse_args()
    joined(options.static, options.dynamic, options.out)
    print(options.out)


if __name__ == "__main__":
    main()
