"""Recipes: how a system is trained, as values. A run's file holds its recipe whole.

step     number of updates already made, from 0
"""

from dataclasses import replace
from typing import Any, ClassVar, Protocol

import numpy as np

from zestjax.base.checks import check_counts, check_option
from zestjax.base.parts import part
from zestjax.losses.objective import PAPER_WEIGHTS
from zestjax.solve import Adam
from zestjax.systems import presets
from zestjax.systems.system import System
from zestjax.train.learn import SIMULATED_WEIGHTS, stage_weights, train_step, training_objective
from zestjax.train.schedules import PRIORS, cosine, decayed_priors
from zestjax.train.terms import measurable

CLIP_NORM = 1.0  # of a step's gradient: a scene that is hard throws no run off
PRIOR_STEPS = 30_000  # the released configuration's: a prior's weight falls so often, rays are mined so long
MOST_RAYS = 2**16  # of a step: a file may not ask for more


def pairs(weights: dict[str, Any]) -> tuple[tuple[str, float], ...]:
    """Weights as a part holds them."""
    return tuple((name, float(weight)) for name, weight in weights.items())


@part
class Fixed:
    """The same weights all along. terms: (name, weight)."""

    terms: tuple[tuple[str, float], ...]

    changes: ClassVar[bool] = False

    def __call__(self, step) -> dict[str, Any]:
        """Weights at a step."""
        return dict(self.terms)


@part
class Decaying:
    """The weights of the `priors` fall to a tenth every `every` steps: what made them is not exact.

    Source: ZeST-NeRF section 3.5. Reference: ZeST-NeRF train.py.
    """

    terms: tuple[tuple[str, float], ...]
    priors: tuple[str, ...] = PRIORS
    every: int = PRIOR_STEPS

    changes: ClassVar[bool] = True

    def __call__(self, step) -> dict[str, Any]:
        """Weights at a step."""
        return decayed_priors(dict(self.terms), step, decay=self.every, terms=self.priors)


@part
class Cosine:
    """Adam's rate: up to `peak` in `warmup` steps, then along half a cosine to `floor`; see `schedules.cosine`."""

    peak: float = 2e-3
    floor: float = 2e-5
    warmup: int = 50

    def __call__(self, step, *, steps: int):
        """The rate of a step of so many."""
        last = max(steps, self.warmup + 1)
        return cosine(step, peak=self.peak, floor=self.floor, steps=last, warmup=self.warmup)


class Rays(Protocol):
    """Which pixels of a target a step looks at."""

    def draw(self, rng: np.random.Generator, moving: np.ndarray, step: int) -> np.ndarray:
        """(R,) flat indices into a target whose moving pixels (H, W) are known."""
        ...


@part
class Rows:
    """`count` whole rows, neighbours."""

    count: int = 16

    jittered: ClassVar[bool] = False

    def __post_init__(self):
        check_counts("Rows", count=(self.count, 1, MOST_RAYS))

    def draw(self, rng, moving, step):
        """See `Rays`."""
        height, width = moving.shape
        if self.count > height:
            raise ValueError(f"Rows: `count` is {self.count}, the target has {height} rows; take fewer.")
        first = rng.integers(0, height - self.count + 1)
        return np.arange(first * width, (first + self.count) * width)


@part
class Pixels:
    """`count` pixels anywhere, and `mined` more of those that move, up to step `mined_until` (0: always); samples are
    jittered in their strata. Source: ZeST-NeRF section 4 (1024 rays and 512 more while the priors are on)."""

    count: int = 1024
    mined: int = 512
    mined_until: int = 0

    jittered: ClassVar[bool] = True

    def __post_init__(self):
        check_counts("Pixels", count=(self.count, 1, MOST_RAYS), mined=(self.mined, 0, MOST_RAYS))

    def draw(self, rng, moving, step):
        """See `Rays`."""
        if self.count > moving.size:
            raise ValueError(f"Pixels: `count` is {self.count}, the target has {moving.size} pixels; take fewer.")
        anywhere = rng.choice(moving.size, self.count, replace=False)
        if self.mined_until and step >= self.mined_until:
            return anywhere
        mined = np.flatnonzero(moving) if moving.any() else np.arange(moving.size)
        return np.concatenate([anywhere, rng.choice(mined, self.mined)])


@part
class Recipe:
    """How a system is trained. system. weights: `Fixed` or `Decaying`. rate: `Cosine`. rays: `Rows` or `Pixels`.
    blocks: parts in which rays are computed. height, width: of the clips it was made for, pixels."""

    system: System
    weights: Fixed | Decaying = Fixed(pairs(SIMULATED_WEIGHTS))
    rate: Cosine = Cosine()
    rays: Rays = Rows()
    blocks: int = 4
    height: int = 144
    width: int = 256

    def __post_init__(self):
        check_counts("Recipe", blocks=(self.blocks, 1, MOST_RAYS))
        check_counts("Recipe", height=(self.height, 1, MOST_RAYS), width=(self.width, 1, MOST_RAYS))

    def objective(self):
        """`learn.training_objective` of its weights."""
        return training_objective(self.system, weights=self.weights(0), blocks=self.blocks)

    def trainer(self, *, steps: int):
        """(init(params) -> opt_state, step(params, opt_state, batch) -> (params, opt_state, terms)) of a run of so many
        steps; jit the step with donated params and opt_state."""
        solver = Adam(learning_rate=lambda step: self.rate(step, steps=steps), clip_norm=CLIP_NORM)
        weights = self.weights if self.weights.changes else None
        return solver.init_state, train_step(self.objective(), solver, weights=weights)

    def stage(self, stage: str) -> "Recipe":
        """The recipe of one of `learn.STAGES`."""
        return self.weighted(stage_weights(stage, weights=dict(self.weights.terms)))

    def weighted(self, weights: dict[str, Any]) -> "Recipe":
        """The recipe with other weights."""
        return replace(self, weights=replace(self.weights, terms=pairs(weights)))

    def of(self, system: System, *, known=None) -> "Recipe":
        """The recipe of another system: of its weights, those whose terms it can measure; known: see `terms`."""
        return replace(self, system=system).weighted(measurable(system, dict(self.weights.terms), known=known))


ZEST = Recipe(presets.ZEST)
TINY = Recipe(presets.TINY, rays=Rows(8), blocks=2, height=32, width=48)
PAPER = Recipe(
    presets.PAPER, Decaying(pairs(PAPER_WEIGHTS)), Cosine(5e-4, 1e-7, 0), Pixels(1024, 512, PRIOR_STEPS), 8, 288, 512
)
RECIPES = {"tiny": TINY, "small": ZEST, "paper": PAPER}
_NSFF = replace(PAPER, rate=Cosine(1e-3, 1e-5, 50), weights=replace(PAPER.weights, every=1000))
NSFF_RECIPES = {
    "tiny": replace(_NSFF, system=presets.nsff(width=16, depth=2, levels=(4, 1), samples=8), rays=Pixels(96, 32, 1000),
                    blocks=2, height=32, width=48),
    "small": replace(_NSFF, system=presets.nsff(width=64, depth=5, levels=(7, 2), samples=48),
                     rays=Pixels(384, 128, 1000), blocks=2, height=72, width=128),
    "paper": replace(PAPER, system=presets.NSFF),
}  # fmt: skip
"""NSFF's, per scene: `train --system nsff --scenes PATH`. The published schedule is of 300,000 steps, `small`'s of some
thousands: priors fade after 1,000."""
SYSTEMS = (*presets.ABLATED, "nsff")
PARTS = (*presets.PARTS, Recipe, Fixed, Decaying, Cosine, Rows, Pixels)
"""The parts that a file may name."""


def recipe_of(preset: str, *, system: str = "zest", precision: str = "float32") -> Recipe:
    """The recipe of a preset, of one of `SYSTEMS`, at a precision, with the preset's weights: a system may not be able
    to measure all of them (`Recipe.of`).

    Raises:
      ValueError: for an unknown name, listing the valid ones.
    """
    check_option("recipe_of", preset=(preset, tuple(RECIPES)), system=(system, SYSTEMS))
    recipe = NSFF_RECIPES[preset] if system == "nsff" else RECIPES[preset]
    ablated = presets.ABLATED.get(system, lambda whole: whole)(recipe.system)
    return replace(recipe, system=replace(ablated, precision=precision))
