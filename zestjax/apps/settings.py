"""Settings: how weights are run, as shares of how they were trained; what none of them needs is training.

share    of what the system at hand has: 0.5 of 32 planes are 16, so that one table serves weights of every size
axis     one field of a `Setting`; `AXES` has the values that a search tries, cheap to dear
"""

import dataclasses
import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from zestjax.systems.fields import Choices
from zestjax.systems.sampling import Even
from zestjax.systems.system import System

AXES = {
    "planes": (0.25, 0.5, 0.75, 1.0, 1.5),
    "views": (0.25, 0.5, 0.75, 1.0, 1.5),
    "samples": (0.0, 0.5, 1.0, 2.0),
    "precision": ("bfloat16", "float32"),
    "scale": (0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0, 1.25, 1.5),
}
"""Every second step about halves or doubles what an axis costs; past the ends nothing was gained or left."""
AS_TRAINED = 0.9  # of the settings drawn: even samples of guided weights cost more and were 6 dB worse
LEAST_SIDE = 16  # pixels of a picture's shorter side: with less, an analysed frame has fewer than four cells


@dataclasses.dataclass(frozen=True)
class Setting:
    """How weights are run.

    planes: share of the volumes' planes. views: share of the key-frames. samples: even samples on a ray, a share of the
    planes or of the samples that the system has; 0: as trained. precision: of the networks. scale: of both sides of the
    picture, and with it of the volumes.
    """

    planes: float = 1.0
    views: float = 1.0
    samples: float = 0.0
    precision: str = "float32"
    scale: float = 1.0

    def of(self, system: System) -> System:
        """The system, run so; what a system lacks is left as it is."""
        space, frames = system.space, getattr(system.static, "frames", None)
        changes: dict = {}
        static: Any = system.static
        if self.planes != 1:
            changes["space"] = replace(space, planes=count_of(space.planes, self.planes, least=2))
        if self.views != 1 and frames is not None and takes_any_views(system):
            fewer = replace(frames, count=count_of(frames.count, self.views, least=2))
            changes["static"] = replace(static, frames=fewer)
        if self.samples:
            changes["sampler"] = evenly(system.sampler, space.planes, self.samples)
        if self.precision != "float32" and system.precision == "float32" and isinstance(system.static, Choices):
            changes["precision"] = self.precision
        return replace(system, **changes)

    def named(self, system: System) -> str:
        """In words, of a system: what it changes."""
        now, said = self.of(system), []
        if now.space.planes != system.space.planes:
            said.append(f"{now.space.planes} planes")
        if (views := now.static.frames.count) != system.static.frames.count:
            said.append(f"{views} views")
        if now.sampler != system.sampler:
            said.append(f"{getattr(now.sampler, 'samples', 'other')} even samples")
        if now.precision != system.precision:
            said.append(now.precision)
        if self.scale != 1:
            said.append(f"{self.scale:.4g} of the size")
        return ", ".join(said) or "as trained"

    @property
    def family(self) -> "Setting":
        """The setting at full size."""
        return replace(self, scale=1.0)


TRAINED = Setting()


def evenly(sampler, planes: int, share: float):
    """Even samples on a ray, a share of those that a sampler has or, of one that the volumes guide, of their planes."""
    if not sampler.guided:
        return replace(sampler, samples=count_of(sampler.samples, share, least=2))
    return Even(count_of(planes, share, least=2), "plane")


def count_of(have: int, share: float, *, least: int) -> int:
    """A share of a number of planes, frames or samples, in whole ones."""
    return max(min(least, have), round(have * share))


def takes_any_views(system: System) -> bool:
    """Whether the static field's head looks at each view by itself, and so takes any number of them."""
    head = getattr(system.static, "head", None)
    return head is not None and head.looks


def distinct(settings, system: System) -> list[Setting]:
    """The settings of a list that differ for a system, in order."""
    found: dict = {}
    for setting in settings:
        found.setdefault((setting.of(system), setting.scale), setting)
    return list(found.values())


def scales() -> list[Setting]:
    """The settings that change the size alone: the curve along which every other one is moved."""
    return [Setting(scale=scale) for scale in AXES["scale"]]


def begun_with(count: int, seed: int) -> list[Setting]:
    """So many settings to begin with: first those of a single change, then such as are drawn."""
    single = [changed for share in (0.5, 0.75, 1.5) for changed in (Setting(views=share), Setting(planes=share))]
    single.append(Setting(precision="bfloat16"))
    return [*single, *drawn(max(0, count - len(single)), seed)][:count]


def drawn(count: int, seed: int) -> list[Setting]:
    """Settings drawn from all axes together; rays as trained, which nothing beat so far, in most."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        picked = {name: values[rng.integers(len(values))] for name, values in AXES.items()}
        if rng.random() < AS_TRAINED:
            picked["samples"] = 0.0
        found.append(Setting(**picked))
    return found


def neighbours(setting: Setting) -> list[Setting]:
    """The settings a step away in planes, views or size, or in two of them; in a mixed order."""
    one = {name: list(_steps(setting, name)) for name in ("planes", "views", "scale")}
    found = [replace(setting, **{name: value}) for name, values in one.items() for value in values]
    for first, second in itertools.combinations(one, 2):
        pairs = itertools.product(one[first], one[second])
        found += [replace(setting, **{first: a, second: b}) for a, b in pairs]
    own = [round(1000 * share) for share in (setting.planes, setting.views, setting.scale)]
    return [found[i] for i in np.random.default_rng(own).permutation(len(found))]


def _steps(setting, name):
    """The values beside a setting's own on an axis."""
    values, own = AXES[name], getattr(setting, name)
    place = values.index(own) if own in values else int(np.argmin([abs(value - own) for value in values]))
    return (values[i] for i in (place - 1, place + 1) if 0 <= i < len(values))
