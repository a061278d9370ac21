"""Which losses a system can be taught by, and those that need no ray.

term     a loss by its name
maps     what each frame says about itself (`analysis.FrameMaps`)
volumes  (static, dynamic) `Volume` of a target, each None where there is none
"""

from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from zestjax.encoding import Volume
from zestjax.frames.analysis import FrameMaps
from zestjax.frames.cells import pooled
from zestjax.losses.means import mean_over_valid
from zestjax.losses.objective import present
from zestjax.losses.supervision import depth_cross_entropy_loss
from zestjax.systems.system import System, swept
from zestjax.train import measures

MOVER_SHARE = 4  # a cell that moves counts so many times one that does not, in the frames' depths


def _depth_ce(volumes, batch):
    """Depths of the volumes' surfaces."""
    log = lambda logits: jax.nn.log_softmax(jnp.moveaxis(logits, 0, -1), axis=-1)
    known = ((batch.static_planes, batch.static_planes_valid), (batch.moving_planes, batch.moving_planes_valid))
    total = jnp.zeros((), batch.static_planes.dtype)
    for volume, (planes, valid) in zip(volumes, known, strict=True):
        if volume is not None and volume.logits is not None:
            total += depth_cross_entropy_loss(log(volume.logits), planes, valid=valid)
    return total


def _frame_ce(maps, batch):
    """Depths of the frames' surfaces."""
    moving = pooled(batch.frame_moving[..., None], 2)[..., 0]
    valid = batch.frame_valid[:, None, None] * (1 + (MOVER_SHARE - 1) * moving) / MOVER_SHARE
    return depth_cross_entropy_loss(jax.nn.log_softmax(maps.logits, axis=-1), batch.frame_planes, valid=valid)


def _frame_mask(maps, batch):
    """The frames' moving pixels."""
    logits, moving = maps.moving_logits, batch.frame_moving
    return mean_over_valid("frame_mask", jax.nn.softplus(logits) - logits * moving, valid=batch.frame_valid)


VOLUMES = {"depth_ce": _depth_ce}
FRAMES = {"frame_ce": _frame_ce, "frame_mask": _frame_mask}


class Kind(NamedTuple):
    """Terms that need the same. terms: functions by name. needs: in words. met: whether a system has it."""

    terms: Mapping[str, Callable]
    needs: str
    met: Callable[[System], bool]


def _neighbours(system):
    """How many of t + 1 and t - 1 a system looks at."""
    offsets = getattr(getattr(system.dynamic, "frames", None), "offsets", ())
    return sum(sign in offsets for sign in measures.DIRECTIONS)


KINDS = (
    Kind(measures.STATIC, "", lambda system: True),
    Kind(measures.DYNAMIC, "a dynamic field", lambda system: system.dynamic is not None),
    Kind(measures.NEIGHBOUR, "a dynamic field with slots next to the target time, -1 or 1",
         lambda system: _neighbours(system) > 0),
    Kind(measures.BOTH_NEIGHBOURS, "a dynamic field with slots on both sides of the target time, -1 and 1",
         lambda system: _neighbours(system) == len(measures.DIRECTIONS)),
    Kind(VOLUMES, "volumes whose cells have logits, `Swept(occupied=True)`",
         lambda system: any(volume.occupied for volume in swept(system))),
    Kind(FRAMES, "the frames' own maps, `OwnMaps`", lambda system: system.frames is not None),
)  # fmt: skip
OWN = "a measure of that name, given as one of `own`"
ANSWERS = {
    "static_rec": ("static",), "dynamic_rec": ("moving",), "mask": ("moving",), "flow3d": ("flow",),
    "depth": ("depth", "disparity"), "geo": ("flow", "pixel_flow"), "depth_ce": ("depth",), "frame_ce": ("depth",),
    "frame_mask": ("moving",),
}  # fmt: skip
"""Which of `measures.Truth`'s answers a term compares with, any of those named; the other terms need none."""


def unmeasured(
    system: System, weights: Mapping[str, Any], *, own: Collection[str] = (), known: Collection[str] | None = None
) -> dict[str, str]:
    """What of some weights a training step of a system cannot measure.

    Args:
      system: `System`.
      weights: by term.
      own: names of terms that are measured otherwise.
      known: answers of `ANSWERS` that the targets have; None: all of them, as simulated ones do.

    Returns:
      {name of a weight that is not absent: what its term needs}.
    """
    there = set(own).union(*(kind.terms for kind in KINDS if kind.met(system)))
    needs = {name: kind.needs for kind in KINDS for name in kind.terms}
    lost = {name: needs.get(name, OWN) for name in present(weights) if name not in there}
    for name in present(weights):
        answers = ANSWERS.get(name, ()) if name not in own else ()
        if known is not None and answers and not set(answers) & set(known):
            lost.setdefault(name, f"targets whose {' or '.join(answers).replace('_', ' ')} is known")
    return lost


def check_weights(where: str, system: System, weights: Mapping[str, Any], *, own: Collection[str] = ()) -> None:
    """Refuse a weight of what a training step cannot measure: it would train without a word and without the term.

    Args:
      where: name of the calling function, used in the message.
      system: `System`.
      weights: by term.
      own: names of terms that are measured otherwise.

    Raises:
      ValueError: naming the terms, their weights and what they need; or there is no term at all.
    """
    if not present(weights):
        raise ValueError(f"{where}: no term has a weight, so nothing would be learned; give at least one.")
    if lost := unmeasured(system, weights, own=own):
        listed = "; ".join(f"`{name}` (weight {weights[name]}) needs {need}" for name, need in lost.items())
        raise ValueError(
            f"{where}: terms that this system cannot measure: {listed}. Leave them out (`terms.measurable` keeps the "
            "others), or change the system."
        )


def measurable(
    system: System, weights: Mapping[str, Any], *, own: Collection[str] = (), known: Collection[str] | None = None
) -> dict[str, Any]:
    """Those of some weights whose terms a training step of this system can measure, on targets of which that is known;
    see `unmeasured`."""
    lost = unmeasured(system, weights, own=own, known=known)
    return {name: weight for name, weight in present(weights).items() if name not in lost}


def check_answers(where: str, weights: Mapping[str, Any], truth: Any) -> None:
    """Refuse a weight of a term whose answer is not known of these rays: its gradient would be of nothing.

    Raises:
      ValueError: naming the term, its weight and the answer that it needs.
    """
    for name, weight in present(weights).items():
        answers = [answer for answer in ANSWERS.get(name, ()) if answer in truth._fields]
        if answers and all(getattr(truth, answer) is None for answer in answers):
            raise ValueError(f"{where}: `{name}` (weight {weight}) needs {' or '.join(answers)}, which are None here.")


def frames_only(weights: Mapping[str, Any]) -> bool:
    """Whether nothing is asked of any view, so that volumes and rays are not in the program."""
    return set(present(weights)) <= set(FRAMES)


def weights_of(terms: Mapping[str, Any], weights: Mapping[str, Any]) -> dict[str, Any]:
    """The weights of those terms that are not absent."""
    return {name: weight for name, weight in present(weights).items() if name in terms}


def scene_terms(
    maps: FrameMaps | None, volumes: tuple[Volume | None, Volume | None], batch: Any, weights: Mapping[str, Any]
) -> dict[str, jax.Array]:
    """What is known of a scene before any ray: depths of the volumes and of the frames, moving pixels; the terms whose
    weights are not absent."""
    found = {name: VOLUMES[name](volumes, batch) for name in weights_of(VOLUMES, weights)}
    return found | {name: FRAMES[name](maps, batch) for name in weights_of(FRAMES, weights)}
