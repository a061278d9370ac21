"""Putting scenes together on the host, body by body.

Layout axes are those of the rig's middle camera at time 0: x right, y down, z forward. Lengths are the
scene's units. A `Layout` collects bodies and pads them to fixed counts, so that every scene of one layout
size runs in one compiled program.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from zestjax.simulate.types import Bodies, Effects, Motion, Scene

BOXES, BALLS = 20, 10  # rows of a scene's tables, so that all scenes share one program: room and the largest crowd fit


class Body(NamedTuple):
    """One body in plain numbers; see `Bodies` and `Motion` for the fields."""

    shape: np.ndarray
    textures: tuple
    hollow: bool = False
    tile: float = 1.0
    offset: tuple = (0.0, 0.0)
    tint: tuple = (1.0, 1.0, 1.0)
    gloss: float = 0.0
    position: tuple = (0.0, 0.0, 0.0)
    turn: float = 0.0
    parent: int | None = None
    velocity: tuple = (0.0, 0.0, 0.0)
    sway: tuple = (0.0, 0.0, 0.0)
    spin: tuple = (0.0, 0.0, 0.0)
    swing: tuple = (0.0, 0.0, 0.0)
    strain: tuple = ((0.0, 0.0, 0.0),) * 3
    rate: float = 0.0
    phase: float = 0.0


def affine(*, linear: np.ndarray | None = None, offset: Sequence[float] | np.ndarray = (0, 0, 0)) -> np.ndarray:
    """(4, 4) float32 matrix."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = np.eye(3) if linear is None else linear
    matrix[:3, 3] = offset
    return matrix


def turned(angle: float) -> np.ndarray:
    """(3, 3) rotation about the vertical axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)


def sized(half: Sequence[float] | np.ndarray, *, offset: Sequence[float] | np.ndarray = (0, 0, 0)) -> np.ndarray:
    """Shape of a body of half-lengths `half` whose middle is at `offset` in its joint."""
    return affine(linear=np.diag(np.asarray(half, np.float32)), offset=offset)


class Layout:
    """Collects bodies; `scene` gives the arrays.

    `box` and `ball` return the body's handle, which serves as the `parent` of another body.
    """

    def __init__(self):
        self._boxes, self._balls = [], []

    def box(self, **fields: Any) -> tuple[str, int]:
        """Add a box; the fields are `Body`'s."""
        return self._add(self._boxes, "box", fields)

    def ball(self, **fields: Any) -> tuple[str, int]:
        """Add a ball or an ellipsoid; the fields are `Body`'s."""
        return self._add(self._balls, "ball", fields)

    def room_for(self, *, boxes: int = 0, balls: int = 0) -> bool:
        """Would so many more bodies fit?"""
        return len(self._boxes) + boxes <= BOXES and len(self._balls) + balls <= BALLS

    @staticmethod
    def _add(bodies, kind, fields):
        bodies.append(Body(**fields))
        return kind, len(bodies) - 1

    def scene(
        self,
        *,
        atlas: np.ndarray,
        light: Sequence[float] | np.ndarray,
        ambient: float,
        effects: Effects,
        boxes: int = BOXES,
        balls: int = BALLS,
        mid_time: float = 0.0,
        unit: float = 1.0,
    ) -> Scene:
        """The `Scene`.

        Args:
          atlas: packed texels.
          light: position, layout units.
          ambient: share of light from everywhere.
          effects: `Effects`.
          boxes: how many to pad to with absent ones.
          balls: likewise.
          mid_time: the time at which bodies with a velocity or a spin pass their given position.
          unit: world units per layout unit.

        Raises:
          ValueError: where more bodies were added than fit.
        """
        for kind, count, most in (("boxes", len(self._boxes), boxes), ("balls", len(self._balls), balls)):
            if count > most:
                raise ValueError(f"Layout.scene: {count} {kind}, expected at most {most}.")
        index = lambda handle: -1 if handle is None else handle[1] + (boxes if handle[0] == "ball" else 0)
        table = lambda bodies, count: _table(bodies, count, index, mid_time, unit)
        light = np.asarray(light, np.float32) * np.float32(unit)
        return Scene(table(self._boxes, boxes), table(self._balls, balls), atlas, light, np.float32(ambient), effects)


def _scaled(matrix, unit, *, offset_only=False):
    matrix = np.array(matrix, np.float32)
    matrix[:3, 3 if offset_only else slice(None)] *= unit
    return matrix


def _row(body, index, mid_time, unit):
    """One body's fields of `Bodies`, less its motion, and of `Motion`."""
    extent = np.linalg.norm(np.asarray(body.shape)[:3, :3], axis=0)
    position = np.asarray(body.position) - mid_time * turned(body.turn) @ np.asarray(body.velocity)
    motion = {
        "joint": _scaled(affine(linear=turned(body.turn), offset=position), unit, offset_only=True),
        "parent": np.int32(index(body.parent)),
        "velocity": np.asarray(body.velocity) * unit,
        "sway": np.asarray(body.sway) * unit,
    } | {name: getattr(body, name) for name in ("spin", "swing", "strain", "rate", "phase")}
    look = {
        "shape": _scaled(body.shape, unit),
        "present": True,
        "texture": np.asarray(body.textures if len(body.textures) == 3 else body.textures * 3, np.int32),
        "tiling": extent / body.tile,
    } | {name: getattr(body, name) for name in ("hollow", "offset", "tint", "gloss")}
    return look, motion


def _table(bodies, count, index, mid_time, unit):
    """`Bodies` of `count` rows, the ones not in use absent."""
    absent, still = _row(Body(sized((1, 1, 1)), (0,)), index, mid_time, unit)
    rows = [_row(body, index, mid_time, unit) for body in bodies]
    looks, motions = zip(*rows, *[(absent | {"present": False}, still)] * (count - len(bodies)), strict=True)
    return Bodies(**_stacked(looks), motion=Motion(**_stacked(motions)))


def _stacked(rows) -> dict[str, Any]:
    """Columns of rows of one set of names; floats as float32."""
    columns = {name: np.stack([np.asarray(row[name]) for row in rows]) for name in rows[0]}
    return {name: c.astype(np.float32) if c.dtype == np.float64 else c for name, c in columns.items()}
