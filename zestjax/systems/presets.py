"""The systems that have a name. Each is an expression; `dataclasses.replace` makes any other.

`ZEST` is ours, for two cores; `tiny` is it shrunk for tests; `PAPER` is the published system at full size, with the
published form of every part.
"""

from dataclasses import replace
from typing import Any

from zestjax.fields.heads import Blend, Direct
from zestjax.frames.analysis import OwnMaps
from zestjax.frames.exposure import Gains
from zestjax.frames.selection import KeyFrames, Slots
from zestjax.systems.fields import Dynamic, Static, reads_frames
from zestjax.systems.mixes import Density, Opacity
from zestjax.systems.sampling import Even, Guided
from zestjax.systems.swept import OwnDepths, Pyramid, Swept
from zestjax.systems.system import Space, System

NSFF_REACH = 0.2  # frustum units: from one frame to the next nothing crosses more of a scene
SAMPLES = 8  # of a ray that nothing guides, in the ablation: about as many as a guided one has

ZEST = System(Space(32), Static(), Dynamic(), Guided(), Opacity(), OwnMaps(32), exposure=Gains())

_SMALL: dict[str, Any] = dict(width=16, depth=2, volume=Swept(widths=(4, 8)))
TINY = System(Space(8), Static(KeyFrames(4), **_SMALL), Dynamic(**_SMALL), frames=OwnMaps(8, (8, 12)), exposure=Gains())


def published(
    *, planes: int, features: int, widths: tuple[int, ...], samples: int, frames: KeyFrames, **field: Any
) -> System:
    """The published system at any size. planes: of the volumes. features, widths: of what is swept. samples: of a ray.
    frames: of the static field. field: sizes of both fields, see `fields.Choices`."""
    volume = Swept(Pyramid(features), widths, occupied=False)
    field |= dict(volume=volume, head=Direct())
    return System(
        Space(planes, "depth", camera="key_frame", cells="strided"),
        Static(frames, **field), Dynamic(Slots((-2, -1, 1, 2)), reach=1.0, **field), Even(samples), frames=None,
    )  # fmt: skip


PAPER = published(
    planes=128, features=32, widths=(8, 16, 32, 64), samples=128, frames=KeyFrames(8, "spread"),
    width=256, depth=8, point_levels=10, view_levels=4,
)  # fmt: skip
SVS = replace(PAPER, dynamic=None)


def alone(field: Any) -> Any:
    """A `Static` or `Dynamic` that reads no frame."""
    return replace(field, volume=None, head=Direct())


def still(system: System) -> System:
    """The system of a scene in which nothing moves."""
    return _guided_or_even(system, dynamic=None)


def without_geometry_volume(system: System) -> System:
    """The static field stands alone: the ablation's `zest-motion`."""
    return _guided_or_even(system, static=alone(system.static))


def without_motion_volume(system: System) -> System:
    """The dynamic field stands alone: the ablation's `zest-geometry`."""
    return system if system.dynamic is None else _guided_or_even(system, dynamic=alone(system.dynamic))


def without_volumes(system: System) -> System:
    """Both fields stand alone: the ablation's `zest-none`."""
    dynamic = None if system.dynamic is None else alone(system.dynamic)
    return _guided_or_even(system, static=alone(system.static), dynamic=dynamic)


def _guided_or_even(system, **changes):
    """The system with fields changed; where no volume is left, rays are sampled evenly and no frame is asked."""
    if not any(reads_frames(changes.get(name, getattr(system, name))) for name in ("static", "dynamic")):
        changes |= dict(frames=None, exposure=None, sampler=Even(SAMPLES) if system.sampler.guided else system.sampler)
    return replace(system, **changes)


def nsff(*, width: int, depth: int, levels: tuple[int, int], samples: int) -> System:
    """Both fields without volumes in the first frame's frustum: a scene learned by heart (Li et al. 2021)."""
    shared: Any = dict(
        volume=None, head=Direct(), width=width, depth=depth, point_levels=levels[0], view_levels=levels[1]
    )
    return System(
        Space(2, camera="key_frame", cells="strided"), Static(KeyFrames(1, "spread"), **shared),
        Dynamic(Slots((-2, -1, 1, 2)), reach=NSFF_REACH, **shared), Even(samples), frames=None,
    )  # fmt: skip


GEOMETRY, MOTION, NEITHER = without_motion_volume(ZEST), without_geometry_volume(ZEST), without_volumes(ZEST)
STILL, NSFF = still(ZEST), nsff(width=256, depth=8, levels=(10, 4), samples=128)
ABLATED = {
    "zest": lambda system: system,
    "zest-geometry": without_motion_volume,
    "zest-motion": without_geometry_volume,
    "zest-none": without_volumes,
}
"""What each system of the paper's ablation makes of the whole one."""
PARTS = (
    System, Space, Static, Dynamic, KeyFrames, Slots, Swept, OwnDepths, Pyramid, OwnMaps, Blend, Direct, Guided, Even,
    Opacity, Density, Gains,
)  # fmt: skip
"""The parts that a file may name."""
