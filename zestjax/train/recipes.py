"""Recipes: how a system is trained, as values. A run's file holds its recipe whole.

step     number of updates already made, from 0
"""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any, ClassVar

import jax

from zestjax.base.checks import check_counts, check_option
from zestjax.base.parts import part
from zestjax.frames.selection import KeyFrames
from zestjax.losses.objective import PAPER_WEIGHTS, present
from zestjax.solve import Adam
from zestjax.systems import presets
from zestjax.systems.mvsnerf import MVSNERF, Ends, MvsNerf
from zestjax.systems.system import Params, System
from zestjax.train.adversary import ADV, Adversary, Opponents, opponents_of, patch_measures
from zestjax.train.blocks import over_clips
from zestjax.train.learn import SIMULATED_WEIGHTS, stage_weights, train_step, training_objective
from zestjax.train.players import Player, alternate, played
from zestjax.train.rays import MOST_RAYS, Patch, Pixels, Rays, Rows
from zestjax.train.schedules import PRIORS, cosine, decayed_priors
from zestjax.train.terms import measurable

MOST_CLIPS = 2**8  # of a step: a file may not ask for more
CLIP_NORM = 1.0  # of a step's gradient: a scene that is hard throws no run off
PRIOR_STEPS = 30_000  # the released configuration's: a prior's weight falls so often, rays are mined so long


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


@part
class Recipe:
    """How a system is trained. system. weights: `Fixed` or `Decaying`. rate: `Cosine`. rays: `Rows`, `Pixels` or
    `Patch`. blocks: parts in which rays are computed. height, width: of the clips it was made for, pixels. adversary:
    whom its patches must please, where `adv` has a weight. clips: targets of a step, whose objective is their mean."""

    system: System
    weights: Fixed | Decaying = Fixed(pairs(SIMULATED_WEIGHTS))
    rate: Cosine = Cosine()
    rays: Rays = Rows()
    blocks: int = 4
    height: int = 144
    width: int = 256
    adversary: Adversary | None = None
    clips: int = 1

    def __post_init__(self):
        check_counts("Recipe", blocks=(self.blocks, 1, MOST_RAYS), clips=(self.clips, 1, MOST_CLIPS))
        check_counts("Recipe", height=(self.height, 1, MOST_RAYS), width=(self.width, 1, MOST_RAYS))
        if (ADV in present(dict(self.weights.terms))) != (self.adversary is not None):
            raise ValueError("Recipe: a weight of `adv` and an `adversary` need each other; give both or neither.")
        if self.adversary is not None:
            self.adversary.check(self.rays)
            if self.clips != 1:
                raise ValueError(f"Recipe: `clips` is {self.clips}, an `adversary` judges 1 a step; give 1.")

    @property
    def own(self) -> dict[str, Callable]:
        """Measures of its patches, by term."""
        return patch_measures(self.rays.side) if isinstance(self.rays, Patch) else {}

    def init(self, key: jax.Array) -> Params | Opponents:
        """All that it trains: the system's parameters, or `Opponents`."""
        params = self.system.init(key)
        if self.adversary is None:
            return params
        return Opponents(params, self.adversary.init(jax.random.fold_in(key, 1)))

    def objective(self) -> Callable:
        """`learn.training_objective` of its weights, `blocks.over_clips`; of opponents, `players.played`."""
        if self.adversary is not None:
            return played(*self.opponents(steps=1))
        of_one = training_objective(
            self.system, weights=self.weights(0), blocks=self.blocks, own=self.own, whole=bool(self.own)
        )
        return over_clips(of_one, self.clips)

    def opponents(self, *, steps: int) -> tuple[Player, Player]:
        """The players of a run of so many steps, where there is an adversary."""
        assert self.adversary is not None and isinstance(self.rays, Patch)
        return opponents_of(
            self.system, self.adversary, self._solver(steps), weights=self.weights, rays=self.rays,
            own=self.own, blocks=self.blocks,
        )  # fmt: skip

    def _solver(self, steps: int) -> Adam:
        return Adam(learning_rate=lambda step: self.rate(step, steps=steps), clip_norm=CLIP_NORM)

    def trainer(self, *, steps: int, axes: tuple[str, ...] = ()) -> tuple[Callable, Callable]:
        """(init(params) -> opt_state, step(params, opt_state, batch) -> (params, opt_state, terms)) of a run of so many
        steps, params as of `init`; jit the step with donated params and opt_state. axes: see `learn.train_step`."""
        if self.adversary is not None:
            return alternate(*self.opponents(steps=steps))
        solver = self._solver(steps)
        weights = self.weights if self.weights.changes else None
        return solver.init_state, train_step(self.objective(), solver, weights=weights, axes=axes)

    def stage(self, stage: str) -> "Recipe":
        """The recipe of one of `learn.STAGES`."""
        return self.weighted(stage_weights(stage, weights=dict(self.weights.terms)))

    def weighted(self, weights: dict[str, Any]) -> "Recipe":
        """The recipe with other weights; without `adv` nobody must be pleased."""
        adversary = self.adversary if ADV in present(weights) else None
        return replace(self, weights=replace(self.weights, terms=pairs(weights)), adversary=adversary)

    def of(self, system: System, *, known: Collection[str] | None = None) -> "Recipe":
        """The recipe of another system: of its weights, those whose terms it can measure; known: see `terms`."""
        weights = measurable(system, dict(self.weights.terms), own=self.terms, known=known)
        return replace(self, system=system).weighted(weights)

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms that it measures itself."""
        return (*self.own, *([ADV] if self.adversary is not None else []))


ZEST = Recipe(presets.ZEST)
TINY = Recipe(presets.TINY, rays=Rows(8), blocks=2, height=32, width=48)
PAPER = Recipe(
    presets.PAPER, Decaying(pairs(PAPER_WEIGHTS)), Cosine(5e-4, 1e-7, 0), Pixels(1024, 512, PRIOR_STEPS), 8, 288, 512
)
RECIPES = {"tiny": TINY, "small": ZEST, "paper": PAPER}
_NSFF = replace(PAPER, rate=Cosine(1e-3, 1e-5, 50), weights=replace(PAPER.weights, every=1000))
NSFF = {
    "tiny": replace(_NSFF, system=presets.nsff(width=16, depth=2, levels=(4, 1), samples=8), rays=Pixels(96, 32, 1000),
                    blocks=2, height=32, width=48),
    "small": replace(_NSFF, system=presets.nsff(width=64, depth=5, levels=(7, 2), samples=48),
                     rays=Pixels(384, 128, 1000), blocks=2, height=72, width=128),
    "paper": replace(PAPER, system=presets.NSFF),
}  # fmt: skip
"""NSFF's: per scene (`train --system nsff --scenes PATH`), or of many. The published schedule is of 300,000 steps,
`small`'s of some thousands: priors fade after 1,000."""

_SVS = Recipe(
    presets.SVS, Fixed(pairs(dict(rec=20.0, adv=1.0, edge=0.4, distortion=1e-3))), Cosine(5e-4, 1e-7, 0),
    Patch(64), 8, 288, 512, Adversary(),
)  # fmt: skip
_FEW: dict[str, Any] = dict(planes=32, features=16, widths=(8, 16, 32), samples=48, frames=KeyFrames(4))
_LEAST: dict[str, Any] = dict(planes=8, features=4, widths=(4, 8), samples=8, frames=KeyFrames(3))
SVS = {
    "tiny": replace(
        _SVS, rate=Cosine(2e-3, 2e-5, 20), rays=Patch(16, decay=3e-3), blocks=2, height=32, width=48,
        system=presets.still(presets.published(**_LEAST, width=16, depth=2, point_levels=2, view_levels=1)),
        adversary=Adversary((8, 16)),
    ),
    "small": replace(
        _SVS, rate=Cosine(1e-3, 1e-5, 50), rays=Patch(32, decay=1.4e-3), blocks=2, height=144, width=256,
        system=presets.still(presets.published(**_FEW, width=64, depth=4, point_levels=7, view_levels=2)),
        adversary=Adversary((32, 64, 128)),
    ),
    "paper": _SVS,
}  # fmt: skip
"""SVS's (Menendez et al. 2022). Weights and rates as in the ZeST-NeRF authors' configuration, but for LPIPS, which
needs weights of others. `small` and `tiny` take the key-frames nearest to the target."""

_MVSNERF = Recipe(MVSNERF, Fixed(pairs(dict(rec=1.0))), Cosine(5e-4, 1e-7, 0), Pixels(1024, 0), 8, 288, 512)


def _mvsnerf(planes: int, samples: int, **field: Any) -> System:
    return replace(MVSNERF, space=replace(MVSNERF.space, planes=planes), static=MvsNerf(**field), sampler=Ends(samples))


MVSNERFS = {
    "tiny": replace(_MVSNERF, system=_mvsnerf(8, 8, padding=2, width=16, depth=2), rate=Cosine(2e-3, 2e-5, 20),
                    rays=Pixels(128, 0), blocks=2, height=32, width=48),
    "small": replace(_MVSNERF, system=_mvsnerf(32, 48, padding=8, width=64, depth=4), rate=Cosine(1e-3, 1e-5, 50),
                     blocks=2, height=144, width=256),
    "paper": _MVSNERF,
}  # fmt: skip
"""MVSNeRF's (Chen et al. 2021): one term, and the published rate and number of rays."""

SYSTEMS = ("zest", "mvsnerf", "svs", "nsff", "zest-geometry", "zest-motion", "zest-none")
PARTS = (*presets.PARTS, MvsNerf, Ends, Recipe, Fixed, Decaying, Cosine, Rows, Pixels, Patch, Adversary)
"""The parts that a file may name."""


def recipe_of(preset: str, *, system: str = "zest", precision: str = "float32") -> Recipe:
    """The recipe of a preset, of one of `SYSTEMS`, at a precision, with the preset's weights: a system may not be able
    to measure all of them (`Recipe.of`).

    Raises:
      ValueError: for an unknown name, listing the valid ones.
    """
    check_option("recipe_of", preset=(preset, tuple(RECIPES)), system=(system, SYSTEMS))
    recipe = {"mvsnerf": MVSNERFS, "svs": SVS, "nsff": NSFF}.get(system, RECIPES)[preset]
    ablated = presets.ABLATED.get(system, lambda whole: whole)(recipe.system)
    return replace(recipe, system=replace(ablated, precision=precision))
