"""Rays through the encoded scene: samples, fields, pixels.

R S      rays and samples on a ray; P = R S points, ray by ray
coords   (R, S, 3) in the frustum of the volumes, z in [0, 1]
lengths  (R, S) what a sample stands for. Where the volumes guide, densities are per plane: a guided sample stands for
         one plane, a regular one for its interval in planes. Elsewhere it is its interval, world units
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.depth import expected_depth
from zestjax.fields.conditioning import parallax, sample_views
from zestjax.fields.dynamic import DynamicSample, dynamic_field, dynamic_views, early_flow
from zestjax.fields.static import static_field, static_views
from zestjax.frustum import cells_from_frustum, frustum_from_world, world_from_frustum
from zestjax.model import CELL_OFFSET
from zestjax.nets.positional import positional_encoding
from zestjax.numerics import matvec
from zestjax.rays import depths_from_fractions, interval_lengths, rays_from_pixels
from zestjax.rendering import FieldSamples, composite, render_blended, weights_from_density
from zestjax.resample import trilinear

FARTHEST = 1e6  # of far, as good as infinity
FLOW_REACH = {"guided": 0.15, "regular": 1.0}


class Marched(NamedTuple):
    """Samples along rays. depths: (R, S) world units. coords: (R, S, 3). points: (R, S, 3) world.
    beyond: (R, S, 3) world, one plane farther. lengths: (R, S). directions: (R, 3) unit, in the reference camera."""

    depths: jax.Array
    coords: jax.Array
    points: jax.Array
    beyond: jax.Array
    lengths: jax.Array
    directions: jax.Array


class Prediction(NamedTuple):
    """What rays show and the samples behind it; leaves of an absent dynamic field are None.

    colour, static_colour, dynamic_colour: (R, 3). depth: (R,) world units; depth_of_dynamic: of the
    dynamic field alone. opacity, dynamicness: (R,) in [0, 1].
    blend: (R, S) in (0, 1). weights: (R, S) of both fields together. dynamic_weights: (R, S) of the dynamic field
    in the blend. dynamic_alone: (R, S) of the dynamic field by itself. dynamic: `DynamicSample` of (R, S, ...).
    marched: `Marched`.
    """

    colour: jax.Array
    static_colour: jax.Array
    dynamic_colour: jax.Array | None
    depth: jax.Array
    depth_of_dynamic: jax.Array | None
    opacity: jax.Array
    dynamicness: jax.Array
    blend: jax.Array | None
    weights: jax.Array
    dynamic_weights: jax.Array | None
    dynamic_alone: jax.Array | None
    dynamic: DynamicSample | None
    marched: Marched


def guided_coordinates(guides, pixels):
    """Coordinates at which a ray is sampled: the surfaces of its four nearest cells, and their blend.

    Args:
      guides: (G, h, w) surface coordinates of each cell, one map per volume.
      pixels: (R, 2) target pixels; cell j is centred on pixel 4 j + 3/2.

    Returns:
      (R, 5 G) sorted.
    """
    height, width = guides.shape[1:]
    place = (pixels - CELL_OFFSET) / 4
    last = jnp.array([[max(width - 2, 0), max(height - 2, 0)]], place.dtype)
    base = jnp.clip(jnp.floor(place), 0, last)
    across, down = jnp.moveaxis(jnp.clip(place - base, 0, 1), -1, 0)[:, None]
    column, row = jnp.moveaxis(base.astype(jnp.int32), -1, 0)
    right, below = jnp.minimum(column + 1, width - 1), jnp.minimum(row + 1, height - 1)
    corner = lambda r, c: guides[:, r, c]
    a, b, c, d = corner(row, column), corner(row, right), corner(below, column), corner(below, right)
    mixed = (a * (1 - across) + b * across) * (1 - down) + (c * (1 - across) + d * across) * down
    return jnp.sort(jnp.concatenate([a, b, c, d, mixed]).T, axis=-1)


def march(encoding, camera, near, far, pixels, *, config, jitter=None):
    """Samples of each ray, guided by the volumes or regular.

    Args:
      encoding: `model.Encoding`.
      camera: the target's `Camera`.
      near: () world units.
      far: () world units.
      pixels: (R, 2).
      config: `presets.Config`.
      jitter: (R, S) in [0, 1) places of regular samples in their strata, or None for the middles.

    Returns:
      `Marched`.
    """
    rays = rays_from_pixels(camera, pixels)
    if encoding.guides is not None:
        fractions = guided_coordinates(encoding.guides, pixels)
    else:
        place = jnp.full((pixels.shape[0], config.samples), 0.5, pixels.dtype) if jitter is None else jitter
        fractions = (jnp.arange(config.samples, dtype=pixels.dtype)[None] + place) / config.samples
    depths = depths_from_fractions(fractions, near, far, spacing=config.spacing)
    farther = depths_from_fractions(fractions + 1 / max(config.planes - 1, 1), near, far * 1.5, spacing=config.spacing)
    farther = jnp.clip(farther, -FARTHEST * far, FARTHEST * far)  # one plane past the last may be at infinity
    along = lambda z: rays.origins[:, None] + z[..., None] * rays.directions[:, None]
    points = along(depths)
    coords = frustum_from_world(encoding.frustum, points, spacing=config.spacing)
    norm = jnp.sqrt(jnp.sum(rays.directions**2, axis=-1, keepdims=True))
    if encoding.guides is not None:
        lengths = jnp.ones_like(depths)
    elif any(v is not None and v.logits is not None for v in (encoding.geometry, encoding.motion)):
        lengths = interval_lengths(fractions, 0.0, 1.0) * (config.planes - 1)
    else:
        lengths = interval_lengths(depths, near, far) * norm
    rotation = encoding.frustum.camera.camera_from_world[:3, :3]
    return Marched(depths, coords, points, along(farther), lengths, matvec(rotation, rays.directions / norm))


def look_up(volume, coords):
    """(P, channels) of a `Volume`'s cells at frustum coordinates (P, 3); no channels without a volume."""
    if volume is None:
        return jnp.zeros((coords.shape[0], 0), coords.dtype)
    return trilinear(volume.cells, cells_from_frustum(coords, *volume.cells.shape[:3]))


def _flat(x):
    return x.reshape(-1, *x.shape[2:])


def query_static(params, encoding, marched, *, config):
    """`StaticSample` of all P points."""
    point = positional_encoding(_flat(marched.coords), levels=config.point_levels)
    samples = views = None
    if encoding.key is not None:
        points = _flat(marched.points)[None]
        samples = sample_views(encoding.key, points)
        if params.static.views is not None:
            shift = parallax(encoding.key.cameras, points, _flat(marched.beyond)[None])
            there = encoding.key.valid > 0  # an empty slot repeats a real frame, whose camera and time say nothing
            shift, times = jnp.where(there[:, None], shift, 0), jnp.where(there, encoding.key.times, 0)
            views = static_views(samples, shift, times)
    volume = look_up(encoding.geometry, _flat(marched.coords))
    return static_field(params.static, point, encoded_directions(marched, config), volume, samples, views)


def encoded_directions(marched, config):
    """(P, Q) encoded viewing direction of each sample."""
    encoded = positional_encoding(marched.directions, levels=config.view_levels)
    samples = marched.depths.shape[1]
    return jnp.broadcast_to(encoded[:, None], (encoded.shape[0], samples, encoded.shape[1])).reshape(
        -1, encoded.shape[1]
    )


def query_dynamic(params, encoding, coords, directions, time, duration, *, config):
    """`DynamicSample` of points at a time.

    Args:
      params: `ZestParams`.
      encoding: `model.Encoding`.
      coords: (P, 3).
      directions: (P, Q) encoded.
      time: () frame time.
      duration: () frames of the video.
      config: `presets.Config`.

    Reference: ZeST-NeRF networks.py; time is normalised to [-1, 1) over the video.
    """
    place = jnp.broadcast_to(2 * time / duration - 1, (coords.shape[0], 1)).astype(coords.dtype)
    point = positional_encoding(jnp.concatenate([coords, place], axis=-1), levels=config.point_levels)
    volume, reach = look_up(encoding.motion, coords), FLOW_REACH[config.sampling]
    samples = views = early = None
    if encoding.slots is not None:
        world = lambda c: world_from_frustum(encoding.frustum, c, spacing=config.spacing)
        if params.dynamic.motion is not None:
            early = early_flow(params.dynamic, point, volume, reach=reach)
            times = encoding.slots.times[:, None, None]
            step = jnp.where(times > 0, early[None, :, :3], early[None, :, 3:]) * jnp.abs(times)
            # Where to look is learned from the flow's own losses: no gradient through the gathers.
            samples = sample_views(encoding.slots, jax.lax.stop_gradient(world(coords[None] + step)))
            views = dynamic_views(samples, encoding.slots.times)
        else:
            samples = sample_views(encoding.slots, world(coords)[None])
    return dynamic_field(params.dynamic, point, directions, volume, samples, views, reach=reach, early=early)


def last_resort(field):
    """(R, 3) what a ray shows where everything lets it through: its samples' colours, by density."""
    share = field.density + 1e-6
    return jnp.sum(share[..., None] * field.colour, axis=-2) / jnp.sum(share, axis=-1)[..., None]


def filled(colour, opacity, behind):
    """A ray's colour (R, 3) with what lies behind it (R, 3) where it lets light through; a mean of colours always, also
    where the opacity (R,) of two fields that share their samples is above 1."""
    opacity = opacity[:, None]
    return colour / jnp.maximum(opacity, 1) + jnp.maximum(1 - opacity, 0) * behind


def render_rays(params, encoding, inputs, pixels, *, config, jitter=None):
    """Render pixels of the target.

    Args:
      params: `ZestParams`.
      encoding: `model.Encoding` of `inputs`.
      inputs: `model.Inputs`.
      pixels: (R, 2) column and row in the target image.
      config: `presets.Config`.
      jitter: see `march`.

    Returns:
      `Prediction`.

    Source: ZeST-NeRF eq. 6, eq. 7, eq. 8, eq. 9.
    """
    marched = march(encoding, inputs.camera, inputs.near, inputs.far, pixels, config=config, jitter=jitter)
    rays, samples = marched.depths.shape
    grid = lambda x: x.reshape(rays, samples, *x.shape[1:])
    still = jax.tree.map(grid, query_static(params, encoding, marched, config=config))
    static = FieldSamples(still.density, still.colour)
    if params.dynamic is None:
        return _static_prediction(static, marched, filled=encoding.guides is not None)
    moving = query_dynamic(
        params,
        encoding,
        _flat(marched.coords),
        encoded_directions(marched, config),
        inputs.time,
        inputs.duration,
        config=config,
    )
    moving = jax.tree.map(grid, moving)
    dynamic = FieldSamples(moving.density, moving.colour)
    blend = jax.nn.sigmoid(still.blend_logit + moving.blend_logit)
    out = render_blended(static, dynamic, blend, marched.lengths, marched.depths, form=config.blend)
    colour, static_colour = out.colour, out.static_colour
    if encoding.guides is not None:
        behind = last_resort(static)
        colour = filled(colour, out.opacity, behind)
        static_colour = filled(static_colour, jnp.sum(out.static_weights, -1), behind)
    return Prediction(
        colour, static_colour, out.dynamic_colour, out.depth, out.dynamic_depth, out.opacity, out.dynamicness, blend,
        out.weights.static + out.weights.dynamic, out.weights.dynamic, out.dynamic_weights, moving, marched,
    )  # fmt: skip


def _static_prediction(static, marched, *, filled):
    """The `Prediction` of a scene in which nothing moves; `filled` where rays that see nothing show a last resort."""
    weights = weights_from_density(static.density, marched.lengths)
    shown = composite(weights, static.colour, background=last_resort(static) if filled else None)
    depth, none = expected_depth(weights, marched.depths), jnp.zeros_like(shown.opacity)
    colour = shown.values
    return Prediction(colour, colour, None, depth, None, shown.opacity, none, None, weights, None, None, None, marched)
