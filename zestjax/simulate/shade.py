"""Colour of what a ray met: texture, light, shadow and highlight.

R        any ray axes; a vector is a tuple of three arrays, as in `cast`
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.numerics import added, rounded_once
from zestjax.base.types import Array, Scalar
from zestjax.simulate.cast import Hit, Placed, Vector, along, blocked, dot
from zestjax.simulate.textures import LEVELS, TILE
from zestjax.simulate.types import Bodies, Scene


class Surface(NamedTuple):
    """What is met: world `point` and `normal`, the normal facing the viewer; `local` unit-body coordinates;
    `face` (R) int32, the axis the face lies across; `body` (R) int32; `distance` (R) finite."""

    point: tuple
    normal: tuple
    local: tuple
    face: jax.Array
    body: jax.Array
    distance: jax.Array


def normalized(vector: Vector) -> tuple[jax.Array, ...]:
    """The vector at length 1; 0 stays 0."""
    scale = jax.lax.rsqrt(jnp.maximum(dot(vector, vector), 1e-20))
    return tuple(scale * v for v in vector)


def surface(placed: Placed, hit: Hit, origin: Vector, direction: Vector, *, boxes: int) -> Surface:
    """`Surface` where rays meet bodies; of a ray that meets nothing, finite values without meaning."""
    body = jnp.maximum(hit.body, 0)
    distance = jnp.where(hit.body < 0, 1, hit.distance)
    point = along(origin, distance, direction)
    matrix = [[placed.unit_from_world[:, i, j][body] for j in range(4)] for i in range(3)]
    local = tuple(dot(row, point) + row[3] for row in matrix)
    x, y, z = (jnp.abs(part) for part in local)
    face = jnp.where(x >= jnp.maximum(y, z), 0, jnp.where(y >= z, 1, 2)).astype(jnp.int32)
    outward = [jnp.where(body < boxes, jnp.where(face == i, jnp.sign(p), 0), p) for i, p in enumerate(local)]
    normal = normalized(tuple(dot([row[j] for row in matrix], outward) for j in range(3)))
    side = jnp.where(dot(normal, direction) > 0, -1, 1).astype(distance.dtype)
    return Surface(point, tuple(side * n for n in normal), local, face, body, distance)


def _texel_range(coordinate, side):
    """The two texels a mirrored tile coordinate lies between, and its share of the second."""
    place = rounded_once((1 - jnp.abs(jnp.mod(coordinate, 2) - 1)) * side.astype(coordinate.dtype) - 0.5)
    low = jnp.floor(place)
    first = low.astype(jnp.int32)
    return jnp.maximum(first, 0), jnp.minimum(first + 1, side - 1), place - low


def texel(atlas: Array, texture: Array, u: Array, v: Array, level: Array) -> tuple[jax.Array, ...]:
    """Bilinear lookup of a packed atlas.

    Args:
      atlas: (T,) uint32.
      texture: (R) int32.
      u: (R) tiles across, mirrored beyond [0, 1].
      v: (R) tiles down, likewise.
      level: (R) int32 times the tiles are halved.

    Returns:
      colour, a vector of (R) in [0, 1].
    """
    textures = atlas.shape[0] // sum((TILE >> k) ** 2 for k in range(LEVELS))
    starts = jnp.asarray([textures * sum((TILE >> k) ** 2 for k in range(n)) for n in range(LEVELS)], jnp.int32)
    side = jnp.right_shift(jnp.int32(TILE), level)
    base = starts[level] + texture * side * side
    top, bottom, down = _texel_range(v, side)
    left, right, across = _texel_range(u, side)
    corners = ((top, left, (1 - down) * (1 - across)), (top, right, (1 - down) * across))
    corners += ((bottom, left, down * (1 - across)), (bottom, right, down * across))
    texels = jnp.asarray(atlas).at
    words = [(texels[base + row * side + column].get(mode="promise_in_bounds"), w) for row, column, w in corners]
    byte = lambda word, k: (jnp.right_shift(word, jnp.uint32(8 * k)) & jnp.uint32(255)).astype(u.dtype)
    return tuple(added(byte(word, k) * weight for word, weight in words) / 255 for k in range(3))


def albedo(scene: Scene, bodies: Bodies, seen: Surface, footprint: Array) -> tuple[jax.Array, ...]:
    """Texture colour. footprint: (R) world width of a sample on a surface that faces the viewer."""
    q = [seen.local[i] * bodies.tiling[:, i][seen.body] for i in range(3)]
    u = jnp.where(seen.face == 0, q[2], q[0]) + bodies.offset[:, 0][seen.body]
    v = jnp.where(seen.face == 1, q[2], q[1]) + bodies.offset[:, 1][seen.body]
    texture = bodies.texture.reshape(-1)[3 * seen.body + seen.face]
    extent = jnp.sqrt(jnp.sum(bodies.shape[:, :3, :3] ** 2, axis=1))
    density = jnp.max(bodies.tiling / extent, axis=1)[seen.body] * TILE
    level = jnp.clip(jnp.round(jnp.log2(jnp.maximum(footprint * density, 1e-6))), 0, LEVELS - 1).astype(jnp.int32)
    return tuple(c * bodies.tint[:, i][seen.body] for i, c in enumerate(texel(scene.atlas, texture, u, v, level)))


def shaded(
    scene: Scene, bodies: Bodies, placed: Placed, hit: Hit, origin: Vector, direction: Vector, sample_angle: Scalar
) -> tuple[jax.Array, ...]:
    """Colours of rays, before exposure.

    Args:
      scene: `Scene`.
      bodies: all its `Bodies`.
      placed: `Placed` at the rays' time.
      hit: `Hit` of the rays.
      origin: vector of ().
      direction: vector of (R).
      sample_angle: () width of a sample at distance 1 of the ray parameter.

    Returns:
      colour, a vector of (R); 0 where nothing is met.
    """
    boxes, effects = scene.boxes.present.shape[0], scene.effects
    seen = surface(placed, hit, origin, direction, boxes=boxes)
    backwards = tuple(-d for d in normalized(direction))
    footprint = seen.distance * sample_angle * jax.lax.rsqrt(jnp.maximum(dot(seen.normal, backwards), 0.05))
    colour = albedo(scene, bodies, seen, footprint)
    towards = tuple(scene.light[i] - seen.point[i] for i in range(3))
    light = normalized(towards)
    lit = jnp.maximum(dot(seen.normal, light), 0)
    if (shadows := effects.shadows) is not None:
        start = along(seen.point, 2e-3 * seen.distance, seen.normal)
        dark = lambda: 1 - shadows * blocked(placed, start, towards, boxes=boxes).astype(lit.dtype)
        lit = lit * jax.lax.cond(shadows > 0, dark, lambda: jnp.ones_like(lit))
    brightness, shine = scene.ambient + (1 - scene.ambient) * lit, 0
    if effects.specular is not None:
        halfway = normalized(tuple(a + b for a, b in zip(light, backwards, strict=True)))
        away = 1 - jnp.maximum(dot(seen.normal, halfway), 0)
        shine = effects.specular * bodies.gloss[seen.body] * jnp.exp2(-60 * away) * lit
    return tuple(jnp.where(hit.body < 0, 0, c * brightness + shine) for c in colour)
