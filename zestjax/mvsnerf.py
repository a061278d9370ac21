"""MVSNeRF (Chen et al. 2021) as it was published: the system whose weights show that the parts here compute the same.

It is put together from the functions that ZeST-NeRF's own form uses; what is particular to it has a keyword there
(`legacy_abs`, `order`, `mvsnerf_cost_volume`), or is here.

V          source views, the first is the reference: the volume fills its frustum
padding    cells that the volume reaches beyond the reference's image on every side
coords     (..., 3) x, y, z in [0, 1] inside the padded volume; z linear in depth
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.assembly import colours_of, positions, taken
from zestjax.cameras import Camera, project, scaled
from zestjax.checks import check_shapes
from zestjax.cost_volume import mvsnerf_cost_volume, quarter_colours
from zestjax.depth import expected_depth
from zestjax.fields.trunk import ColourHead, Trunk, direct_colour, init_colour_head, init_trunk, trunk
from zestjax.frustum import Frustum, cells_from_frustum, frustum_from_world
from zestjax.inputs import check_exclude, check_inputs, check_view
from zestjax.nets.cost_regulariser import CostRegulariser, cost_regulariser, init_cost_regulariser
from zestjax.nets.feature_pyramid import FeaturePyramid, feature_pyramid, imagenet_normalised, init_feature_pyramid
from zestjax.nets.layers import Dense, dense, init_dense
from zestjax.nets.positional import positional_encoding
from zestjax.novel_view import View
from zestjax.numerics import matvec
from zestjax.planesweep import homographies, plane_depths
from zestjax.rays import pixel_grid, rays_from_pixels
from zestjax.rendering import composite, weights_from_density
from zestjax.resample import bilinear, trilinear
from zestjax.selection import key_frames

LEVELS = 10
BLOCK_RAYS = 512  # rendered together: memory does not grow with the image


@dataclasses.dataclass(frozen=True)
class MvsNerfConfig:
    """The published choices. height: rows of a view where a user asks for no size. views: sources of a view.
    planes, padding: of the volume. samples: per ray."""

    name: str = "mvsnerf"
    height: int = 256
    views: int = 3
    planes: int = 128
    padding: int = 24
    samples: int = 128


class MvsNerfField(NamedTuple):
    """trunk: `Trunk`. density: `Dense` to 1. colour: `ColourHead`, whose direction is not encoded."""

    trunk: Trunk
    density: Dense
    colour: ColourHead


class MvsNerfParams(NamedTuple):
    """features: `FeaturePyramid`. regulariser: `CostRegulariser`. field: `MvsNerfField`."""

    features: FeaturePyramid
    regulariser: CostRegulariser
    field: MvsNerfField


class Sources(NamedTuple):
    """images: (V, H, W, 3) in [0, 1]. cameras: `Camera` (V, ...). near, far: () of the reference, world units."""

    images: jax.Array
    cameras: Camera
    near: jax.Array
    far: jax.Array


class FieldOutput(NamedTuple):
    """density: (P,) >= 0, per sample and not per unit of length. colour: (P, 3) in [0, 1]."""

    density: jax.Array
    colour: jax.Array


class Rendered(NamedTuple):
    """Of R rays. colour: (R, 3). depth: (R,) sum of weights times depths. opacity: (R,)."""

    colour: jax.Array
    depth: jax.Array
    opacity: jax.Array


def init_mvsnerf(key, *, views=3, width=128, depth=6):
    """`MvsNerfParams` of the published shapes."""
    keys = jax.random.split(key, 5)
    features = init_feature_pyramid(keys[0])
    regulariser = init_cost_regulariser(keys[1], 3 * views + features.head.kernel.shape[-1])
    n_point, n_condition = 3 * (1 + 2 * LEVELS), regulariser.stem.norm.scale.shape[0] + 4 * views
    base = init_trunk(keys[2], n_point, n_condition, width=width, depth=depth)
    field = MvsNerfField(base, init_dense(keys[3], width, 1), init_colour_head(keys[4], width, 3))
    return MvsNerfParams(features, regulariser, field)


def reference(sources):
    """The first camera."""
    return jax.tree.map(lambda leaf: leaf[0], sources.cameras)


def cost(params, sources, *, planes, padding):
    """The published cost volume of the sources: (planes, h + 2 padding, w + 2 padding, 3 V + C).

    Raises:
      ValueError: on a wrong shape, or an image size that is not a multiple of 4.
    """
    check_shapes("mvsnerf.cost", images=(sources.images, "V H W 3"), intrinsics=(sources.cameras.intrinsics, "V 3 3"))
    features = feature_pyramid(params.features, sources.images, legacy_abs=True)
    cameras = scaled(sources.cameras, 0.25, 0.25)
    depths = plane_depths(sources.near, sources.far, planes)
    warps = homographies(jax.tree.map(lambda leaf: leaf[0], cameras), cameras, depths)
    colours = quarter_colours(imagenet_normalised(sources.images))
    return mvsnerf_cost_volume(features, colours, warps, padding=padding)


def volume(params, sources, *, planes, padding):
    """The encoding volume (planes, h + 2 padding, w + 2 padding, 8).

    Reference: MVSNeRF models.py `MVSNet`.
    Differs from the reference: sizes that are no multiple of 8 are padded, where it stops.
    """
    return cost_regulariser(params.regulariser, cost(params, sources, planes=planes, padding=padding), legacy_abs=True)


def volume_coords(sources, points, *, padding):
    """World points (..., 3) to coords.

    Reference: MVSNeRF utils.py `get_ndc_coordinate`.
    Differs from the reference: none; like it, a look-up lies up to 0.75 cells beside the feature it was made from.
    """
    height, width = sources.images.shape[1:3]
    frustum = Frustum(reference(sources), sources.near, sources.far, height, width)
    coords = frustum_from_world(frustum, points)
    x, y = ((coords[..., i] * (n // 4) + padding) / (n // 4 + 2 * padding) for i, n in enumerate((width, height)))
    return jnp.stack([x, y, coords[..., 2]], axis=-1)


def look_up(volume, coords):
    """(..., C) of a volume at coords; from its outer cells it fades to 0 over one cell."""
    planes, rows, columns = volume.shape[:3]
    cells = cells_from_frustum(coords, planes, rows, columns) + 1
    return trilinear(jnp.pad(volume, [(1, 1), (1, 1), (1, 1), (0, 0)]), cells, border="zero")


def view_colours(sources, points):
    """(P, 4 V): each view's colour where points (P, 3) project to, and 1 where that is inside; else its border repeats.

    Reference: MVSNeRF utils.py `build_color_volume`.
    Differs from the reference: a point behind a camera is not inside its image.
    """
    height, width = sources.images.shape[1:3]

    def view(image, camera):
        pixels, _, front = project(camera, points)
        u, v = pixels[..., 0], pixels[..., 1]
        inside = front & (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
        colour = bilinear(image, jnp.where(front[..., None], pixels, 0), border="clamp").values
        return jnp.concatenate([colour, inside[..., None].astype(colour.dtype)], axis=-1)

    values = jax.vmap(view)(sources.images, sources.cameras)
    return jnp.moveaxis(values, 0, 1).reshape(len(points), -1)


def field(params, coords, features, direction):
    """Density and colour of P points.

    Args:
      params: `MvsNerfField`.
      coords: (P, 3).
      features: (P, 8 + 4 V), of the volume and then of the views.
      direction: (P, 3) unit, in the reference camera's axes.

    Returns:
      `FieldOutput`.

    Reference: MVSNeRF models.py `Renderer_ours`.
    """
    state = trunk(params.trunk, positional_encoding(coords, levels=LEVELS, order="mvsnerf"), features)
    density = jax.nn.relu(dense(params.density, state)[:, 0])
    return FieldOutput(density, direct_colour(params.colour, state, direction))


def render(params, built, sources, camera, pixels, *, depths=None, padding, samples=None):
    """Rays through pixels of a target camera.

    Args:
      params: `MvsNerfParams`.
      built: `volume` of the sources.
      sources: `Sources`.
      camera: the target's `Camera`.
      pixels: (R, 2).
      depths: (R, S) of the samples, or None: S even ones from near to far.
      padding: of `built`.
      samples: S, without `depths`.

    Returns:
      `Rendered`.

    Reference: MVSNeRF renderer.py `rendering`, `raw2alpha`: an interval's length is not part of its opacity.
    """
    if depths is None:
        depths = jnp.broadcast_to(plane_depths(sources.near, sources.far, samples), (len(pixels), samples))
    rays = rays_from_pixels(camera, pixels)
    points = (rays.origins[:, None] + depths[..., None] * rays.directions[:, None]).reshape(-1, 3)
    unit = rays.directions / jnp.linalg.norm(rays.directions, axis=-1, keepdims=True)
    turned = matvec(reference(sources).camera_from_world[:3, :3][None], unit)
    coords = volume_coords(sources, points, padding=padding)
    features = jnp.concatenate([look_up(built, coords), view_colours(sources, points)], axis=-1)
    found = field(params.field, coords, features, jnp.repeat(turned, depths.shape[1], axis=0))
    density, colour = (x.reshape(*depths.shape, *x.shape[1:]) for x in found)
    weights = weights_from_density(density, jnp.ones(depths.shape[1:], density.dtype))
    shown = composite(weights, colour)
    return Rendered(shown.values, expected_depth(weights, depths, background=0.0), shown.opacity)


def prepare(params, video, *, config, exclude=()):
    """The `Video` on the host: nothing is known of a scene before a view is asked for; see `novel_view.prepare`.

    Raises:
      ValueError: if no view can be predicted from the video, or it has no such frame to exclude; see `zestjax.inputs`.
    """
    del params, config
    video = check_inputs("mvsnerf.prepare", video, quantised=True)
    check_exclude("mvsnerf.prepare", len(video.images), exclude)
    return video


def render_view(params, video, camera, time, *, config, exclude=()):
    """A view from the sources nearest to its camera; arguments and result as of `novel_view.render_view`.

    The scene is taken to stand still: `time` only settles which of two sources that are equally near is taken.

    Args:
      params: `MvsNerfParams`.
      video: `Video`.
      camera: the target's `Camera`.
      time: int.
      config: `MvsNerfConfig`.
      exclude: frames that must not be sources.

    Returns:
      `View`, without what moves.

    Raises:
      ValueError: before anything is compiled, if the video cannot give the view (see `zestjax.inputs`); fewer sources
        than the weights were made for, or an image size that is not a multiple of 4.
    """
    where = "mvsnerf.render_view"
    video = check_inputs(where, video, quantised=True)
    time, exclude = check_view(where, video, camera, time, exclude=exclude)
    if (left := len(video.images) - len(exclude)) < config.views:
        raise ValueError(f"mvsnerf: a view needs {config.views} source frames, {left} are left; give more frames.")
    centre = positions(jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], camera))[0]
    found = key_frames(positions(video.cameras), config.views, target=centre, time=time, exclude=exclude)
    images = colours_of(jnp.asarray(video.images[found.frames]))
    return _render_image(
        params, Sources(images, taken(video.cameras, found.frames), video.near, video.far), camera, config
    )


@functools.partial(jax.jit, static_argnames="config")
def _render_image(params, sources, camera, config):
    height, width = sources.images.shape[1:3]
    built = volume(params, sources, planes=config.planes, padding=config.padding)
    pixels = pixel_grid(height, width).reshape(-1, 2)
    blocks = -(-len(pixels) // BLOCK_RAYS)
    pixels = jnp.pad(pixels, [(0, blocks * BLOCK_RAYS - len(pixels)), (0, 0)], mode="edge")

    def block(pixels):
        return render(params, built, sources, camera, pixels, padding=config.padding, samples=config.samples)

    drawn = jax.lax.map(block, pixels.reshape(blocks, BLOCK_RAYS, 2))
    colour, depth, opacity = (
        x.reshape(-1, *x.shape[2:])[: height * width].reshape(height, width, *x.shape[2:]) for x in drawn
    )
    shown = jnp.clip(colour, 0, 1)
    return View(shown, shown, None, depth, opacity, jnp.zeros_like(depth), None)
