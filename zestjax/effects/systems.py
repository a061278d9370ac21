"""A system without what a scene does not call for: what is off is not in the compiled program.

on       names of effects, of `found.EFFECTS`
"""

from collections.abc import Collection
from dataclasses import replace
from typing import Any

from zestjax.effects.found import EFFECTS
from zestjax.frames.known import KnownFrames
from zestjax.systems.fields import reads_frames
from zestjax.systems.presets import still
from zestjax.systems.sampling import Guided
from zestjax.systems.system import System

SURFACES = 2  # that a ray of a still scene is sampled at where one thing hides another: three gained nothing


def system_for(system: System, on: Collection[str]) -> System:
    """A system with only the effects that are on; their weights are those of the whole one, see `params_for`.

    motion: without it there is no dynamic field, no motion volume, and no frame's moving pixels are asked for.
    disocclusion: rays are guided to what hides and to what it hides: by the two volumes, or, without motion, at the two
    likeliest surfaces of the one. exposure: without it frames are taken as they are. The other effects are not the
    system's.

    Args:
      system: `System`.
      on: see the header.

    Returns:
      `System`; with every effect on the same.
    """
    if "motion" not in on and can_stand_still(system):
        system = still(system)
        if "disocclusion" in on and isinstance(system.sampler, Guided):
            system = replace(system, sampler=replace(system.sampler, modes=SURFACES))
    return system if "exposure" in on else replace(system, exposure=None)


def can_stand_still(system: System) -> bool:
    """Whether the static field can show a scene by itself: not where the dynamic one alone reads the frames."""
    return system.dynamic is not None and (reads_frames(system.static) or not reads_frames(system.dynamic))


def params_for(system: System, params: Any) -> Any:
    """`system.Params` of a whole system, without those of parts that `system` lacks."""
    params = params if system.dynamic is not None else params._replace(dynamic=None)
    return params if system.frames is not None else params._replace(analysis=None)


def priors_for(known: KnownFrames, on: Collection[str]) -> KnownFrames:
    """`KnownFrames` without the priors that are off: their losses are then not in the program."""
    known = known if "flow_prior" in on else known._replace(flow=None, flow_valid=None)
    return known if "depth_prior" in on else known._replace(disparity=None)


def kept(on: Collection[str], *, without: Collection[str] = ()) -> tuple[str, ...]:
    """The effects that are on, in the order of `EFFECTS`."""
    return tuple(name for name in EFFECTS if name in on and name not in without)
