"""Weights of earlier versions: the flat configuration of 0.1 as a recipe, today's names of its arrays, and arrays whose
meaning has grown."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from zestjax.base.parts import from_stored
from zestjax.fields.heads import Blend, Direct
from zestjax.frames import analysis
from zestjax.frames.analysis import OwnMaps
from zestjax.frames.exposure import Gains
from zestjax.frames.selection import KeyFrames, Slots
from zestjax.systems import presets
from zestjax.systems.fields import Dynamic, Static
from zestjax.systems.mixes import Density, Opacity
from zestjax.systems.sampling import Even, Guided
from zestjax.systems.swept import OwnDepths, Pyramid, Swept
from zestjax.systems.system import Space, System
from zestjax.train.rays import Pixels, Rows
from zestjax.train.recipes import Recipe

RENAMED = {
    ".geometry.": ".static.volume.",
    ".motion.": ".dynamic.volume.",
    ".static.colour.": ".static.net.head.colour.",
    ".static.views.": ".static.net.head.views.",
    ".static.": ".static.net.",
    ".dynamic.colour.": ".dynamic.net.head.colour.",
    ".dynamic.views.": ".dynamic.net.head.views.",
    ".dynamic.motion": ".dynamic.net.early",
    ".dynamic.": ".dynamic.net.",
}
"""What a name began with, and begins with now; the first that fits counts."""


STILL, MOVING = (0, 1, 2), (0,)
"""Costs of standing still and of moving, of twice as many with their surroundings, that frames had before they were
followed along the flow (`frames.along`), by their place among today's."""
_NOW = (analysis.STILL_COSTS // 2, analysis.MOVING_COSTS // 2)
_REST = 4 + analysis.FLOW_CHANNELS + 2 + 12  # channels after the costs and their summaries


@dataclasses.dataclass(frozen=True)
class Config:
    """The fields of a configuration of 0.1, with their defaults."""

    name: str
    height: int = 144
    width: int = 256
    planes: int = 32
    evidence_planes: int = 32
    spacing: str = "inverse"
    encoder: str = "frames"
    features: int = 0
    frame_widths: tuple[int, ...] = (48, 64, 96, 128)
    volume_widths: tuple[int, ...] = (8, 16, 32)
    key_frames: int = 8
    key_frame_choice: str = "nearest"
    slots: tuple[int, ...] = (-2, -1, 0, 1, 2)
    reference: str = "target"
    geometry: bool = True
    motion: bool = True
    dynamic: bool = True
    trust: bool = True
    hold_trust: bool = True
    field_width: int = 48
    field_depth: int = 3
    point_levels: int = 2
    view_levels: int = 1
    sampling: str = "guided"
    samples: int = 8
    head: str = "blend"
    conditioning: str = "pooled"
    blend: str = "opacity"
    rays: str = "rows"
    mined_rays: int = 0
    crop_rows: int = 16
    ray_blocks: int = 4
    precision: str = "float32"


def renamed(name: str) -> str:
    """Today's name of an array of 0.1."""
    for before, now in RENAMED.items():
        if name.startswith(before):
            return now + name[len(before) :]
    return name


def with_paths(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays by name, of which those of frames that were not followed along the flow are made today's: what is new is
    not seen by the net, and believed as before anything is learned. Today's are as they are."""
    found = dict(arrays)
    kernel, head = ".analysis.net.mix.conv.kernel", (".analysis.net.head.kernel", ".analysis.net.head.bias")
    for name in [name for name in found if name.endswith(kernel)]:
        last = [name.removesuffix(kernel) + part for part in head]
        planes = _planes_before(found[name], *(found.get(part) for part in last))
        if planes is None:
            continue
        costs = np.array([*STILL, *(_NOW[0] + i for i in MOVING)])
        blocks = (costs[:, None] * planes + np.arange(planes)).ravel()
        found[name] = _placed(found[name], _inputs(blocks, planes), sum(_NOW) * (planes + 4) + _REST, axis=-2)
        gains = 2 * planes + _with_surroundings()
        rows = np.concatenate([np.arange(2 * planes), gains, 2 * planes + 2 * sum(_NOW) + np.arange(_outputs(0))])
        for part in last:
            found[part] = _placed(found[part], rows, 2 * planes + _outputs(2 * sum(_NOW)), axis=-1)
    return found


def _planes_before(kernel, *heads):
    """Planes of a net of frames that were not followed along the flow, or None of any other."""
    if any(array is None or not array.ndim for array in heads) or kernel.ndim < 2:
        return None
    planes = (size := heads[0].shape[-1]) - _outputs(2 * len(STILL + MOVING))
    wanted = len(STILL + MOVING) * (planes // 2 + 4) + _REST
    odd = planes < 2 or planes % 2 or kernel.shape[-2] != wanted or any(array.shape[-1] != size for array in heads)
    return None if odd else planes // 2


def _outputs(gains):
    """Of the net's head beside those of two distributions over planes."""
    return gains + 2 + analysis.MOVING_PARTS


def _with_surroundings():
    """Today's places of the earlier costs and of their means over the surroundings, the still ones first."""
    still, moving = _NOW
    twice = lambda first, count, places: [first + i + k * count for k in range(2) for i in places]
    return np.array([*twice(0, still, STILL), *twice(2 * still, moving, MOVING)])


def _inputs(blocks, planes):
    """Today's places of the channels that the net saw."""
    first, places = sum(_NOW) * planes, _with_surroundings()
    rest = first + 4 * sum(_NOW) + np.arange(_REST)
    return np.concatenate([blocks, first + places, first + 2 * sum(_NOW) + places, rest])


def _placed(array, places, size, *, axis):
    """Zeros with the array's entries at their places along an axis."""
    shape = list(array.shape)
    shape[axis] = size
    grown = np.zeros(shape, array.dtype)
    np.moveaxis(grown, axis, 0)[places] = np.moveaxis(array, axis, 0)
    return grown


def recipe_from_config(fields: Any) -> Recipe:
    """The recipe of a configuration of 0.1.

    Args:
      fields: of JSON; it may come from anybody.

    Raises:
      ValueError: no object, unknown or missing fields, of another type, choices that this version has not, or sizes
        that no model has.
    """
    if not isinstance(fields, dict):
        raise ValueError(f"the configuration is a {type(fields).__name__}, expected an object")
    c: Config = from_stored({**fields, "part": "Config"}, [Config])
    frames = c.encoder == "frames"
    if c.encoder not in ("frames", "pyramid") or (frames and (c.features or not (c.trust and c.hold_trust))):
        raise ValueError(f"the configuration has encoder {c.encoder!r} in a form that this version has not")
    rays = Rows(c.crop_rows) if c.rays == "rows" else Pixels(c.crop_rows * c.width, c.mined_rays)
    return Recipe(_system(c, frames), rays=rays, blocks=c.ray_blocks, height=c.height, width=c.width)


def _system(c: Config, frames: bool) -> System:
    tables = OwnDepths() if frames else Pyramid(c.features)
    occupied = c.sampling == "guided"
    shared: dict[str, Any] = dict(
        volume=Swept(tables, c.volume_widths, occupied), head=Blend() if frames else Direct(), width=c.field_width,
        depth=c.field_depth, point_levels=c.point_levels, view_levels=c.view_levels,
    )  # fmt: skip
    reach = 0.15 if occupied else 1.0
    whole = System(
        Space(c.planes, c.spacing, c.reference, "pooled" if frames else "strided"),
        Static(KeyFrames(c.key_frames, c.key_frame_choice), **shared), Dynamic(Slots(c.slots), reach=reach, **shared),
        Guided() if occupied else Even(c.samples), Density() if c.blend == "density" else Opacity(),
        OwnMaps(c.evidence_planes, c.frame_widths) if frames else None, c.precision, Gains() if frames else None,
    )  # fmt: skip
    whole = whole if c.dynamic else presets.still(whole)
    whole = whole if c.geometry else presets.without_geometry_volume(whole)
    return whole if c.motion else presets.without_motion_volume(whole)
