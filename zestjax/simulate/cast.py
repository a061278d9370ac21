"""Ray casting: which body a ray meets first, in closed form.

A vector is a tuple of three plain arrays (x, y, z), so that a whole intersection fuses into one loop over
the rays; stacked in one array, it is three times slower.

    B        bodies, boxes first; the caster sees their matrices and two flags
    R        any ray axes
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.types import Array, Scalar

NOTHING = jnp.inf  # the distance of a ray that meets nothing: further than all that it could meet
Vector = Sequence[Array] | Array  # (x, y, z), see above; or an array's row of three


class Placed(NamedTuple):
    """Bodies at one time: `unit_from_world` (B, 4, 4), `present` (B,) bool, `hollow` (B,) bool."""

    unit_from_world: Array
    present: Array
    hollow: Array


class Hit(NamedTuple):
    """distance: (R) ray parameter, infinite where nothing is met. body: (R) int32, -1 where nothing is met."""

    distance: jax.Array
    body: jax.Array


def dot(a: Vector, b: Vector) -> Array:
    """Inner product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def along(origin: Vector, distance: Scalar, direction: Vector) -> tuple[jax.Array, ...]:
    """The point `origin + distance * direction`."""
    return tuple(o + distance * d for o, d in zip(origin, direction, strict=True))


def _box_crossing(origin, direction):
    """Ray parameters (in, out) at the unit box; in > out where the ray misses it."""
    inverse = [1 / jnp.where(jnp.abs(d) < 1e-12, 1e-12, d) for d in direction]
    low = [(-1 - o) * i for o, i in zip(origin, inverse, strict=True)]
    high = [(1 - o) * i for o, i in zip(origin, inverse, strict=True)]
    near = [jnp.minimum(a, b) for a, b in zip(low, high, strict=True)]
    far = [jnp.maximum(a, b) for a, b in zip(low, high, strict=True)]
    return reduce(jnp.maximum, near), reduce(jnp.minimum, far)


def _ball_crossing(origin, direction):
    """Ray parameters (in, out) at the unit ball; in > out where the ray misses it."""
    squared = dot(direction, direction)
    middle = -dot(origin, direction) / squared
    closest = along(origin, middle, direction)
    inside = (1 - dot(closest, closest)) / squared
    half = jnp.sqrt(jnp.maximum(inside, 0))
    return jnp.where(inside > 0, middle - half, NOTHING), middle + half


def _folded(placed, origin, direction, boxes, step, start):
    """Fold `step(carry, (near, far), body)` over the boxes, then the balls; absent bodies at the end cost nothing."""
    total = placed.present.shape[0]
    for crossing, first, stop in ((_box_crossing, 0, boxes), (_ball_crossing, boxes, total)):

        def one(body, carry, crossing=crossing):
            matrix = placed.unit_from_world[body]
            local = tuple(dot(matrix[i], origin) + matrix[i, 3] for i in range(3))
            return step(carry, crossing(local, tuple(dot(matrix[i], direction) for i in range(3))), body)

        numbers = jnp.arange(first, stop, dtype=jnp.int32) + 1
        last = jnp.max(jnp.where(placed.present[first:stop], numbers, first), initial=first)
        start = jax.lax.fori_loop(jnp.int32(first), last, one, start) if stop > first else start
    return start


def nearest_hit(placed: Placed, origin: Vector, direction: Vector, *, boxes: int, start: float = 1e-3) -> Hit:
    """The first body along each ray.

    Args:
      placed: `Placed`.
      origin: vector of () or (R).
      direction: vector of (R), of any length: it is the unit of the ray parameter.
      boxes: how many of the bodies, from the first, are boxes.
      start: hits nearer than this do not count.

    Returns:
      `Hit`.
    """

    def step(best, crossing, body):
        near, far = crossing
        at = jnp.where(placed.hollow[body], far, near)
        better = (near < far) & (at > start) & (at < best.distance) & placed.present[body]
        return Hit(jnp.where(better, at, best.distance), jnp.where(better, body, best.body))

    missed = Hit(jnp.full_like(direction[0], NOTHING), jnp.full(direction[0].shape, -1, jnp.int32))
    return _folded(placed, origin, direction, boxes, step, missed)


def blocked(placed: Placed, origin: Vector, direction: Vector, *, boxes: int) -> jax.Array:
    """(R) bool: does a body that is not hollow stand between `origin` and `origin + direction`?"""

    def step(found, crossing, body):
        near, far = crossing
        return found | ((near < far) & (far > 0) & (near < 1) & placed.present[body] & ~placed.hollow[body])

    return _folded(placed, origin, direction, boxes, step, jnp.zeros(direction[0].shape, bool))
