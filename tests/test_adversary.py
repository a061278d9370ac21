"""Adversarial training: players over parts of one tree, patches, and the renderer against its discriminator."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import distortion_by_loop

from zestjax.base.parts import from_stored, to_stored
from zestjax.losses.adversarial import discriminator
from zestjax.solve import Adam
from zestjax.train.adversary import Adversary, Opponents
from zestjax.train.batches import PreparedClip, batch_from_clip
from zestjax.train.blocks import recomputed
from zestjax.train.learn import SHOWN, find_fault, training_objective
from zestjax.train.players import Player, alternate, played
from zestjax.train.rays import Patch, Pixels
from zestjax.train.recipes import PARTS, RECIPES, SYSTEMS, Fixed, Recipe, pairs, recipe_of

SYSTEM = dataclasses.replace(stage.PAPER, dynamic=None)
WEIGHTS = dict(rec=20.0, adv=1.0, edge=0.4, distortion=1e-3)
RECIPE = Recipe(
    SYSTEM, Fixed(pairs(WEIGHTS)), rays=Patch(12, decay=0.2), blocks=2, height=16, width=24, adversary=Adversary((4, 8))
)


class Pair(NamedTuple):
    x: Any
    y: Any


@pytest.fixture(scope="module")
def batch():
    whole = stage.prepared(SYSTEM)
    return batch_from_clip(jax.random.key(1), PreparedClip(whole.clip, whole.evidence, ()), RECIPE)


@pytest.fixture(scope="module")
def tree():
    return Opponents(stage.params_of(SYSTEM), Adversary((4, 8)).init(jax.random.key(3)))


# Players.


class Descent(NamedTuple):
    """Gradient descent with a solver's two functions."""

    rate: float

    def init_state(self, params):
        return Adam().init_state(params)

    def apply(self, params, state, grads, total):
        return params - self.rate * grads, state._replace(iter_num=state.iter_num + 1)


def test_players_move_in_turn_and_hear_those_before_them():
    """x descends (x - y)^2, then y ascends x y + what x said: against the same by hand."""
    first = Player("x", lambda t, b, said, step: ((t.x - t.y) ** 2 * b, {"gap": t.x - t.y}), Descent(0.1))
    second = Player(
        "y", lambda t, b, said, step: (-t.x * t.y + said["gap"] * t.y * jnp.float32(step + 1), {"y": t.y}), Descent(0.2)
    )
    init, step = alternate(first, second)
    tree = Pair(jnp.float32(2), jnp.float32(-1))
    turns, (x, y) = init(tree), (2.0, -1.0)
    for number in range(3):
        tree, turns, said = jax.jit(step)(tree, turns, jnp.float32(0.5))
        gap, total = x - y, 0.5 * (x - y) ** 2
        x -= 0.1 * (2 * gap * 0.5)
        moved = y - 0.2 * (-x + gap * (number + 1))
        np.testing.assert_allclose(said["total"], total, rtol=1e-6)
        assert said.keys() == {"gap", "total", "y"}
        y = moved
        np.testing.assert_allclose(tree, (x, y), rtol=1e-5)
    assert int(turns.iter_num) == 3 and int(turns.skipped) == 0


def test_a_player_whose_loss_is_lost_is_skipped_and_the_other_moves_on():
    lost = Player("x", lambda t, b, said, step: (t.x * jnp.nan, {}), Adam(learning_rate=0.1))
    well = Player("y", lambda t, b, said, step: (t.y**2, {}), Adam(learning_rate=0.1))
    init, step = alternate(lost, well)
    tree = Pair(jnp.float32(2), jnp.float32(1))
    moved, turns, said = step(tree, init(tree), None)
    assert float(moved.x) == 2 and float(moved.y) < 1 and int(turns.skipped) == 1 and np.isnan(said["total"])
    assert {"total", "y"} == said.keys()
    assert find_fault(played(lost, well), tree, None).leaves == (".x",)


# Patches.


@pytest.mark.parametrize(("height", "width"), [(12, 40), (40, 12), (31, 17)])
def test_a_patch_is_a_square_of_distinct_evenly_spaced_pixels(height, width):
    rays, spans = Patch(9, least=0.5, most=1.0, decay=0.07), []
    for step in (0, 10, 1000):
        for seed in range(20):
            pixels = rays.draw(np.random.default_rng(seed), np.zeros((height, width), bool), step)
            rows, columns = (x.reshape(9, 9) for x in np.unravel_index(pixels, (height, width)))
            assert len(np.unique(pixels)) == 81
            assert (rows == rows[:, :1]).all() and (columns == columns[:1]).all()
            spacings = [np.diff(rows[:, 0]), np.diff(columns[0])]
            assert all(np.ptp(gaps) <= 1 and gaps.min() >= 1 for gaps in spacings)
            assert abs(spacings[0].mean() - spacings[1].mean()) <= 2 / 8
            spans.append((step, (rows[-1, 0] - rows[0, 0]) / (min(height, width) - 1)))
    mean = {step: np.mean([span for at, span in spans if at == step]) for step in (0, 10, 1000)}
    assert mean[0] > 0.9 and mean[1000] < mean[0]


def test_a_patch_larger_than_the_picture_is_refused():
    with pytest.raises(ValueError, match="`side` is 17, the target has 16 x 24 pixels"):
        Patch(17).draw(np.random.default_rng(0), np.zeros((16, 24), bool), 0)
    with pytest.raises(ValueError, match="`least` is 0.9 and `most` 0.5"):
        Patch(8, least=0.9, most=0.5)


# Recomputed blocks.


def test_recomputed_blocks_are_the_function_itself_and_its_gradient():
    x, shared = jax.random.normal(jax.random.key(0), (12, 3)), jnp.float32(1.5)
    fn = lambda shared, x: {"a": jnp.sin(shared * x), "b": x[:, 0] ** 2 * shared}
    total = lambda f: lambda s, x: sum(jnp.sum(leaf) ** 2 for leaf in f(s, x).values())
    for count in (1, 3, 12):
        whole = recomputed(fn, count)
        jax.tree.map(np.testing.assert_allclose, whole(shared, x), fn(shared, x))
        ours, theirs = (jax.grad(total(f), argnums=(0, 1))(shared, x) for f in (whole, fn))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), ours, theirs)
    with pytest.raises(ValueError, match="12 rays have no 5 equal blocks"):
        recomputed(fn, 5)(shared, x)


def test_recomputed_blocks_need_one_blocks_memory():
    def fn(shared, x):
        for _ in range(8):
            x = jnp.tanh(x @ shared)
        return x

    temporaries = {}
    for count in (1, 8):
        loss = lambda s, x, count=count: jnp.sum(recomputed(fn, count)(s, x) ** 2)
        compiled = jax.jit(jax.grad(loss)).lower(jnp.ones((16, 16)), jnp.ones((4096, 16))).compile()
        temporaries[count] = compiled.memory_analysis().temp_size_in_bytes
    assert temporaries[8] < 0.4 * temporaries[1]


# The renderer and its discriminator.


def test_the_renderers_terms_are_those_of_the_formulas(tree, batch):
    still = batch._replace(truth=batch.truth._replace(jitter=None))
    said = {}
    _, terms = jax.jit(lambda t, b: RECIPE.opponents(steps=1)[0].objective(t, b, said, 0))(tree, still)
    seen = stage.forward(SYSTEM)(tree.model, still.inputs, still.evidence, still.truth.pixels)
    colour, truth = (np.asarray(x, np.float64) for x in (seen.colour, still.truth.colour))
    np.testing.assert_allclose(terms["rec"], np.mean((colour - truth) ** 2), rtol=1e-4)
    scores = np.asarray(discriminator(tree.discriminator, seen.colour.reshape(1, 12, 12, 3)), np.float64)
    np.testing.assert_allclose(terms["adv"], np.mean((scores - 1) ** 2), rtol=1e-3)
    disparity, picture = 1 / np.asarray(seen.depth, np.float64).reshape(12, 12), truth.reshape(12, 12, 3)
    disparity /= disparity.mean()
    edge = 0.0
    for axis in (0, 1):
        weight = np.exp(-np.abs(np.diff(picture, axis=axis)).mean(-1))
        edge += np.mean(np.abs(np.diff(disparity, axis=axis)) * weight)
    np.testing.assert_allclose(terms["edge"], edge, rtol=1e-3)
    depths, near, far = np.asarray(seen.marched.depths, np.float64), stage.NEAR, stage.FAR
    middle = ((depths[:, 1:] + depths[:, :-1]) / 2 - near) / (far - near)
    edges = np.concatenate([np.zeros((144, 1)), middle, np.ones((144, 1))], 1)
    distortion = np.mean([distortion_by_loop(w, e) for w, e in zip(np.asarray(seen.weights), edges, strict=True)])
    np.testing.assert_allclose(terms["distortion"], distortion, rtol=1e-3)
    np.testing.assert_allclose(terms[SHOWN], seen.colour, atol=1e-5)


def test_the_renderers_gradient_does_not_depend_on_the_blocks(tree, batch):
    grads = []
    for blocks in (1, 4):
        renderer = dataclasses.replace(RECIPE, blocks=blocks).opponents(steps=1)[0]
        loss = lambda t, b, renderer=renderer: renderer.objective(t, b, {}, 0)[0]
        grads.append(jax.jit(jax.grad(loss))(tree, batch))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-5), *grads)
    assert any(np.any(leaf) for leaf in jax.tree.leaves(grads[0].discriminator))  # a player's gradient is its part's


def test_each_step_moves_both_and_a_discriminator_alone_learns_to_tell(tree, batch):
    init, step = dataclasses.replace(RECIPE, adversary=Adversary((4, 8), rate=1e-2)).trainer(steps=30)
    step = jax.jit(step)
    held, first = tree, None
    turns = init(held)
    for _ in range(30):
        after, turns, said = step(held, turns, batch)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
        first = said if first is None else first
        held = held._replace(discriminator=after.discriminator)  # the renderer stays: a picture easy to tell
    assert said["discriminator"] < first["discriminator"] and said["score_true"] > said["score_rendered"]
    moved = jax.tree.map(lambda a, b: bool(np.any(a != b)), after, tree)
    assert any(jax.tree.leaves(moved.model)) and any(jax.tree.leaves(moved.discriminator))
    assert {"total", "rec", "adv", "edge", "distortion", "contrast"} <= said.keys()


def test_a_recipe_without_the_weight_has_no_discriminator(tree, batch):
    plain = RECIPE.weighted({name: w for name, w in WEIGHTS.items() if name != "adv"})
    assert plain.adversary is None and not isinstance(plain.init(jax.random.key(0)), Opponents)
    program = str(jax.make_jaxpr(plain.objective())(tree.model, batch))
    assert "12,12,3" in program and len(program) < len(str(jax.make_jaxpr(RECIPE.objective())(tree, batch)))
    _, terms = jax.jit(plain.objective())(tree.model, batch)
    assert terms.keys() == {"rec", "edge", "distortion", SHOWN}


@pytest.mark.parametrize(("changes", "words"), [
    (dict(adversary=None), "a weight of `adv` and an `adversary` need each other"),
    (dict(weights=Fixed(pairs(dict(rec=1.0)))), "a weight of `adv` and an `adversary` need each other"),
    (dict(rays=Pixels(64, 0)), "`rays` is a Pixels, expected a Patch"),
    (dict(rays=Patch(4)), "`side` of the patch is 4, expected more than 4 of 2 `widths`"),
])  # fmt: skip
def test_a_recipe_that_cannot_be_played_is_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(RECIPE, **changes)


def test_an_adversary_of_odd_sizes_is_refused():
    for odd, words in {(): "widths", (0,): "widths"}.items():
        with pytest.raises(ValueError, match=words):
            Adversary(odd)
    with pytest.raises(ValueError, match="`rate` is 2"):
        Adversary(rate=2)


@pytest.mark.parametrize("system", SYSTEMS)
def test_every_named_recipe_is_stored_and_read(system):
    for preset in RECIPES:
        recipe = recipe_of(preset, system=system)
        assert from_stored(to_stored(recipe), PARTS) == recipe == recipe.of(recipe.system).weighted(
            dict(recipe.weights.terms)
        ) or system.startswith("zest-")
        training_objective(recipe.system, weights=dict(rec=1.0))


def test_terms_of_a_patch_need_a_patch():
    with pytest.raises(ValueError, match="`edge` .* needs a measure of that name"):
        training_objective(SYSTEM, weights=dict(rec=1.0, edge=0.1))
