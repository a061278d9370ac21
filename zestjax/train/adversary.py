"""A renderer against a patch discriminator: SVS's training (Menendez et al. 2022).

patch    (side, side, 3) colours of a step's rays, true or rendered
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_counts
from zestjax.base.numerics import safe_divide
from zestjax.base.parts import part
from zestjax.losses.adversarial import (
    DiscriminatorParams,
    discriminator,
    discriminator_loss,
    generator_loss,
    init_discriminator,
)
from zestjax.losses.regularisers import edge_aware_depth_loss
from zestjax.solve import Adam
from zestjax.systems.fields import MOST_WIDTH
from zestjax.systems.system import Params, System
from zestjax.train.learn import SHOWN, training_objective
from zestjax.train.players import Player
from zestjax.train.rays import Patch

ADV = "adv"  # the term in which the renderer meets the discriminator


class Opponents(NamedTuple):
    """model: `Params`. discriminator: `DiscriminatorParams`."""

    model: Params
    discriminator: DiscriminatorParams


@part
class Adversary:
    """A patch discriminator. widths: channels after each halving. rate: of its Adam, constant, the ZeST-NeRF authors'.
    spectral: bound its slope."""

    widths: tuple[int, ...] = (32, 64, 128, 256)
    rate: float = 1e-4
    spectral: bool = True

    def __post_init__(self):
        check_counts("Adversary", widths=(len(self.widths), 1, 8))
        check_counts("Adversary", **{f"widths[{i}]": (w, 1, MOST_WIDTH) for i, w in enumerate(self.widths)})
        if not 0 < self.rate < 1:
            raise ValueError(f"Adversary: `rate` is {self.rate}, expected 0 < rate < 1.")

    def check(self, rays: Any) -> None:
        """Refuse rays of which it could not judge.

        Raises:
          ValueError: they are no patch, or one of which its last norm would see a single cell.
        """
        if not isinstance(rays, Patch):
            raise ValueError(f"Adversary: `rays` is a {type(rays).__name__}, expected a Patch.")
        if rays.side <= (least := 2 ** len(self.widths)):
            raise ValueError(
                f"Adversary: `side` of the patch is {rays.side}, expected more than {least} of {len(self.widths)} "
                "`widths`; take a larger patch or fewer widths."
            )

    def init(self, key: jax.Array) -> DiscriminatorParams:
        """Parameters."""
        return init_discriminator(key, widths=self.widths)

    def scores(self, params: DiscriminatorParams, patches: jax.Array) -> jax.Array:
        """(B, h, w) of patches (B, side, side, 3)."""
        return discriminator(params, patches, spectral=self.spectral)


def patch_of(x: jax.Array, side: int) -> jax.Array:
    """(side, side, ...) of (side * side, ...) rays."""
    return x.reshape(side, side, *x.shape[1:])


def patch_measures(side: int) -> dict[str, Callable]:
    """What only a patch shows: `edge`, the disparity is smooth where the true colours are.

    Source: Monodepth2 (Godard et al. 2019), eq. 3; weight 0.4 in the ZeST-NeRF authors' configuration of SVS.
    """

    def edge(prediction, truth):
        return edge_aware_depth_loss(patch_of(1 / prediction.depth, side), patch_of(truth.colour, side))

    return {"edge": edge}


def opponents_of(
    system: System,
    adversary: Adversary,
    solver: Any,
    *,
    weights: Callable,
    rays: Patch,
    own: Mapping[str, Callable],
    blocks: int,
) -> tuple[Player, Player]:
    """The renderer and the discriminator as players over `Opponents`.

    Args:
      system: `System`.
      adversary: `Adversary`.
      solver: the renderer's.
      weights: of a step, `adv` among them.
      rays: the patch.
      own: measures of the patch, by term.
      blocks: see `learn.training_objective`.

    Returns:
      (`Player`, `Player`). Beside its terms the first reports SHOWN, the rendered patch, which the second judges: the
      renderer's picture before this step. The second reports the means of its scores, 1 for true and 0 for rendered
      where it is never wrong, and `contrast`, the rendered patch's deviation over the true one's.

    Source: LSGAN (Mao et al. 2017), eq. 9.
    """
    declared = weights(0)

    def renderer(tree, batch, said, step):
        measures = {**own, ADV: lambda p, t: generator_loss(verdict(tree, p.colour))}
        objective = training_objective(system, weights=declared, blocks=blocks, own=measures, whole=True)
        return objective(tree.model, batch, weights(step))

    def judge(tree, batch, said, step):
        real, rendered = verdict(tree, batch.truth.colour), verdict(tree, said[SHOWN])
        contrast = safe_divide(jnp.std(said[SHOWN]), jnp.std(batch.truth.colour))
        terms = {"score_true": jnp.mean(real), "score_rendered": jnp.mean(rendered), "contrast": contrast}
        return discriminator_loss(real, rendered), jax.lax.stop_gradient(terms)

    def verdict(tree, colour):
        patch = patch_of(jnp.asarray(colour).astype(jnp.float32), rays.side)
        return adversary.scores(tree.discriminator, patch[None])

    return Player("model", renderer, solver), Player("discriminator", judge, Adam(learning_rate=adversary.rate))
