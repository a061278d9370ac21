"""A recipe's choices by name."""

import pytest

from zestjax.train.recipes import RECIPES, SYSTEMS, TINY, Pixels, Rows, recipe_of
from zestjax.train.settings import with_setting, with_settings


def test_a_choice_is_set_by_its_path_and_keeps_its_type():
    assert with_setting(TINY, "rate.peak", "1e-3").rate.peak == 1e-3
    assert with_setting(TINY, "rays.count", "4").rays == Rows(4)
    assert with_setting(TINY, "system.frames.widths", "[4,6]").system.frames.widths == (4, 6)
    both = with_settings(TINY, (("rate.peak", "1e-3"), ("blocks", "1")))
    assert (both.rate.peak, both.blocks) == (1e-3, 1) and both.system == TINY.system
    assert with_setting(RECIPES["paper"], "weights.every", "1000").weights.every == 1000


def test_what_a_recipe_already_has_changes_nothing():
    for preset in RECIPES:
        for system in SYSTEMS:
            recipe = recipe_of(preset, system=system)
            assert with_setting(recipe, "blocks", str(recipe.blocks)) == recipe


def test_a_weight_of_nothing_takes_its_term_out():
    weights = dict(with_setting(TINY, "weights.dynamic_rec", "0").weights.terms)
    assert "dynamic_rec" not in weights and weights.keys() | {"dynamic_rec"} == dict(TINY.weights.terms).keys()
    assert dict(with_setting(TINY, "weights.dynamic_rec", "2.5").weights.terms)["dynamic_rec"] == 2.5


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("rate.pek", "1", ("no `rate.pek`", "rate has peak, floor, warmup")),
        ("speed", "1", ("a recipe has", "rays")),
        ("rate.peak.x", "1", ("rate.peak has the value 0.002 and no parts",)),
        ("rays", "8", ("whole part", "count")),
        ("rays.count", "many", ("rays.count=many", "Rows has `count` many")),
        ("rays.count", "0", ("rays.count=0", "from 1")),
        ("rays.count", "2.5", ("2.5", "cannot be")),
        ("rate.peak", "NaN", ("peak", "NaN")),
        ("weights.colour", "1", ("no `weights.colour`", "dynamic_rec")),
        ("weights.rec", "much", ("expected a number from 0",)),
        ("weights.rec", "-1", ("expected a number from 0",)),
        ("", "1", ("a recipe has",)),
    ],
)
def test_what_is_not_there_is_refused_with_what_is(name, text, words):
    with pytest.raises(ValueError) as caught:
        with_setting(TINY, name, text)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_a_term_that_a_system_cannot_measure_is_refused_with_what_it_needs():
    assert isinstance(RECIPES["paper"].rays, Pixels)
    with pytest.raises(ValueError, match="weights.frame_ce=1: the term needs"):
        with_setting(RECIPES["paper"], "weights.frame_ce", "1")
