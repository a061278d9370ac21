"""The frontier beside a file of weights: what each setting cost and gave where it was measured, as JSON.

cost     of a frame, 1: as trained on the same machine
gain     decibels (PSNR, full image) on those as trained, the mean over the targets
curve    cost and gain of the settings that change the size alone: along it every other setting is moved
"""

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.apps.settings import TRAINED, Setting
from zestjax.apps.weights import shipped_weights
from zestjax.io.files import write_bytes
from zestjax.io.reading import read_json

NAME = "frontier.json"


class Point(NamedTuple):
    """setting: `Setting`. cost: of a frame, 1: as trained. gain: dB on as trained; gain_low, gain_high: its interval.
    working_mb: held while a frame is rendered, beyond what is held before, None where it was not told."""

    setting: Setting
    cost: float
    gain: float
    gain_low: float
    gain_high: float
    working_mb: float | None


class Frontier(NamedTuple):
    """points: of all settings measured to the end, cheap to dear. psnr: dB as trained, of those targets. seconds: of a
    frame as trained where it was measured; prepare_seconds: of its video. told: dict of where and on what."""

    points: tuple[Point, ...]
    psnr: float
    seconds: float
    prepare_seconds: float
    told: dict

    @property
    def curve(self) -> tuple[Point, ...]:
        """The points that change the size alone, small to large."""
        found = [p for p in self.points if p.setting.family == TRAINED]
        return tuple(sorted(found, key=lambda p: p.setting.scale))

    def moved(self, point: Point, scale: float) -> Point:
        """A point brought to another size along the curve; beyond its ends, along its last stretch."""
        own, there = self._at(point.setting.scale), self._at(scale)
        rise, factor = there[1] - own[1], np.exp(there[0] - own[0])
        area = (scale / point.setting.scale) ** 2
        return Point(
            dataclasses.replace(point.setting, scale=scale), float(point.cost * factor), point.gain + rise,
            point.gain_low + rise, point.gain_high + rise,
            None if point.working_mb is None else point.working_mb * area,
        )  # fmt: skip

    def _at(self, scale):
        """(log cost, gain) of the curve at a size."""
        where = np.log([p.setting.scale for p in self.curve])
        place = int(np.clip(np.searchsorted(where, np.log(scale)) - 1, 0, len(where) - 2))
        share = (np.log(scale) - where[place]) / (where[place + 1] - where[place])
        ends = [(np.log(p.cost), p.gain) for p in self.curve[place : place + 2]]
        return tuple(float(a + share * (b - a)) for a, b in zip(*ends, strict=True))


def write_frontier(path: Path, frontier: Frontier) -> None:
    """Write a frontier, a setting a line."""
    settings = [dataclasses.asdict(p.setting) | {k: v for k, v in p._asdict().items() if k != "setting"}
                for p in frontier.points]  # fmt: skip
    short = lambda value: round(value, 4) if isinstance(value, float) else value
    lines = ",\n".join(f"  {json.dumps({k: short(v) for k, v in line.items()})}" for line in settings)
    head = {**frontier.told, "psnr": frontier.psnr, "seconds": frontier.seconds,
            "prepare_seconds": frontier.prepare_seconds}  # fmt: skip
    text = json.dumps({k: short(v) for k, v in head.items()}, indent=1).removesuffix("\n}")
    write_bytes(path, f'{text},\n "settings": [\n{lines}\n ]\n}}\n'.encode())


def read_frontier(path: Path) -> Frontier:
    """Read a frontier.

    Raises:
      ValueError: it cannot be read, or is not one.
    """
    found = read_json(path)
    try:
        told = {k: v for k, v in found.items() if k not in ("settings", "psnr", "seconds", "prepare_seconds")}
        if not all(isinstance(told[name], int) and told[name] > 0 for name in ("height", "width", "video_frames")):
            raise ValueError("expected `height`, `width` and `video_frames` in whole numbers")
        points = sorted((_point(line) for line in found["settings"]), key=lambda p: p.cost)
        psnr, seconds, prepare = (float(found[name]) for name in ("psnr", "seconds", "prepare_seconds"))
        read = Frontier(tuple(points), psnr, seconds, prepare, told)
        if len(read.curve) < 2 or not all(p.cost > 0 and p.setting.scale > 0 for p in points):
            raise ValueError("expected the weights as trained at two sizes or more, all costs above 0")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{path}: is no frontier ({error}); write it again with `zestjax frontier`.") from error
    return read


def _point(line):
    planes, views, samples, scale = (float(line[name]) for name in ("planes", "views", "samples", "scale"))
    cost, gain, low, high = (float(line[name]) for name in ("cost", "gain", "gain_low", "gain_high"))
    memory = None if line["working_mb"] is None else float(line["working_mb"])
    return Point(Setting(planes, views, samples, str(line["precision"]), scale), cost, gain, low, high, memory)


def frontier_of(weights: Path) -> tuple[Frontier, bool]:
    """The frontier that lies beside a file of weights, or else that of the shipped ones; whether it is the file's own.

    Raises:
      ValueError: what lies there is no frontier.
    """
    own = Path(weights).parent / NAME
    shipped = shipped_weights().parent / NAME
    return (read_frontier(own), True) if own.is_file() else (read_frontier(shipped), False)
