"""The weights that come with the package."""

import jax
import numpy as np

from zestjax.apps.weights import open_weights, shipped_weights
from zestjax.systems import presets
from zestjax.train.recipes import RECIPES


def test_shipped_weights_are_small_finite_and_of_the_preset_they_name():
    model = open_weights()
    assert model.name == "zest" and model.preset == "small"
    assert model.system == presets.ZEST and model.recipe == RECIPES["small"]
    assert shipped_weights().stat().st_size < 8e6
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model.params))


def test_shipped_weights_say_how_they_were_made():
    metadata = open_weights().metadata
    assert {"seed", "steps", "step", "seconds", "start", "data", "jax"} <= metadata.keys()
    assert "/" not in str(metadata["start"])
