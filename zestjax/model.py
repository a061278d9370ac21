"""The whole forward model: frames to volumes to fields to pixels.

V        source frames: K key-frames, then the slots of the target time
R S P    rays, samples on a ray, points (P = R S)
coordinate  plane coordinate z of the frustum in [0, 1]; the frustum is the reference camera's
maps     what each frame says about itself (`analysis.FrameMaps`); None with the `pyramid` encoder
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.analysis import AnalysisParams, init_analysis, plane_moments
from zestjax.cameras import Camera, resized, scaled
from zestjax.encoding import SweepViews, Volume, VolumeParams, encode_volume, init_volume
from zestjax.evidence import cell_values, half_images, pooled
from zestjax.fields.conditioning import SourceViews
from zestjax.fields.dynamic import DynamicParams, init_dynamic
from zestjax.fields.static import StaticParams, init_static
from zestjax.frustum import Frustum
from zestjax.nets.feature_pyramid import feature_pyramid
from zestjax.planesweep import plane_depths

CELL_OFFSET = 1.5  # of a quarter-resolution cell's centre, image pixels


class ZestParams(NamedTuple):
    """All learned parameters; a part that the preset does not use is None."""

    analysis: AnalysisParams | None
    geometry: VolumeParams | None
    motion: VolumeParams | None
    static: StaticParams
    dynamic: DynamicParams | None


class Frames(NamedTuple):
    """images: (V, H, W, 3). cameras: `Camera` (V, ...). valid: (V,) 1 or 0. times: (V,) frame times."""

    images: jax.Array
    cameras: Camera
    valid: jax.Array
    times: jax.Array


class Inputs(NamedTuple):
    """key, slots: `Frames`. camera: the target's `Camera`, of the images' size. time: () target frame time.
    duration: () frames of the video. near, far: () world units."""

    key: Frames
    slots: Frames
    camera: Camera
    time: jax.Array | np.floating
    duration: jax.Array | np.floating
    near: jax.Array | np.floating
    far: jax.Array | np.floating


class Encoding(NamedTuple):
    """What rays are rendered from. geometry, motion: `Volume` or None. key, slots: `SourceViews` or None.
    frustum: the volumes' `Frustum`. guides: (G, h, w) coordinates of likely surfaces of each cell, or None."""

    geometry: Volume | None
    motion: Volume | None
    key: SourceViews | None
    slots: SourceViews | None
    frustum: Frustum
    guides: jax.Array | None


def init_params(key, config):
    """Parameters of a preset.

    Args:
      key: random key.
      config: `presets.Config`.

    Returns:
      `ZestParams`.
    """
    keys = jax.random.split(key, 5)
    frames = config.encoder == "frames"
    trusted = frames and config.trust
    guided = config.sampling == "guided"
    pyramid = None if frames else (config.features // 4, config.features // 2, config.features)
    concatenated = config.conditioning == "concatenated"

    def volume(key, views, slots):
        return init_volume(
            key, features=config.features, views=views, widths=config.volume_widths, slots=slots,
            colours="all" if concatenated else "mean", trusted=trusted, pyramid_widths=pyramid, occupied=guided,
        )  # fmt: skip

    def field(key, build, active, views, axes, **extra):
        channels = (config.volume_widths[0] + guided) * active
        per_view = (4 * views * active or 1 * (not active)) if concatenated or not active else None
        return build(
            key, n_point=axes * (1 + 2 * config.point_levels), n_direction=3 * (1 + 2 * config.view_levels),
            n_volume=channels, n_views=per_view, width=config.field_width, depth=config.field_depth,
            head=config.head if active else "direct", **extra,
        )  # fmt: skip

    slots = len(config.slots)
    motion = config.motion_volume
    sizes = dict(planes=config.evidence_planes, features=config.features, widths=config.frame_widths)
    return ZestParams(
        init_analysis(keys[0], **sizes) if config.analysed else None,
        volume(keys[1], config.key_frames, False) if config.geometry else None,
        volume(keys[2], slots, True) if motion else None,
        field(keys[3], init_static, config.geometry, config.key_frames, 3),
        field(keys[4], init_dynamic, motion, slots, 4, slots=slots) if config.dynamic else None,
    )


def cells_of(size):
    """Cells that cover `size` pixels: half-resolution pixels, made even, in pairs."""
    return (size + 3) // 4


def split_maps(maps, count):
    """`FrameMaps` of V frames into those of the first `count` and the rest."""
    return jax.tree.map(lambda x: x[:count], maps), jax.tree.map(lambda x: x[count:], maps)


def _inverse_depth(coordinate, near, far):
    return (1 - coordinate) / near + coordinate / far


def _sweep_views(params, frames, maps, time, near, far, config):
    """Tables at volume resolution: from the frames' analysis, or from the volume's own feature net."""
    if config.encoder == "pyramid":
        features = feature_pyramid(params.pyramid, frames.images)
        colours = frames.images[:, ::4, ::4]
        tables = jnp.concatenate([features, colours], axis=-1)
        return SweepViews(tables, scaled(frames.cameras, 0.25, 0.25), frames.valid, frames.times - time)
    parts = [maps.features, cell_values(half_images(frames.images))]
    if config.trust:
        maps = jax.lax.stop_gradient(maps) if config.hold_trust else maps
        moving = pooled(jax.nn.sigmoid(maps.moving_logits)[..., None], 2)
        depth = _inverse_depth(maps.coordinate, near, far)
        parts += [moving, depth[..., None], (maps.tolerance * (1 / near - 1 / far))[..., None]]
    cameras = resized(frames.cameras, 0.25, 0.25)
    return SweepViews(jnp.concatenate(parts, -1), cameras, frames.valid, frames.times - time)


def _source_views(frames, maps, time, near, far, config):
    """Full-resolution tables for the rays; the maps are constants there, so no gradient is scattered into them."""
    tables = frames.images
    if maps is not None and config.trust:
        size = tables.shape[:3]
        maps = jax.lax.stop_gradient(maps)
        depth = _inverse_depth(maps.coordinate, near, far)
        tolerance = maps.tolerance * (1 / near - 1 / far)
        moving = _grown(jax.nn.sigmoid(maps.moving_logits), size[1:], factor=2)
        grown = [moving, *(_grown(x, size[1:], factor=4) for x in (depth, tolerance))]
        tables = jnp.concatenate([tables, jnp.stack(grown, -1)], axis=-1)
    return SourceViews(tables, frames.cameras, frames.valid, frames.times - time)


def _grown(x, size, *, factor):
    """(V, h, w) maps to image size (H, W): linear between cell centres, cells being `factor` pixels wide."""
    grown = jax.image.resize(x, (x.shape[0], factor * x.shape[1], factor * x.shape[2]), "linear")
    return grown[:, : size[0], : size[1]]


def reference_frustum(inputs, config):
    """`Frustum` of the volumes, at their resolution, and that camera."""
    image = inputs.key.images.shape[1:3]
    camera = inputs.camera if config.reference == "target" else jax.tree.map(lambda x: x[0], inputs.key.cameras)
    if config.encoder == "pyramid":
        camera, size = scaled(camera, 0.25, 0.25), (-(-image[0] // 4), -(-image[1] // 4))
    else:
        camera, size = resized(camera, 0.25, 0.25), tuple(cells_of(n) for n in image)
    return Frustum(camera, inputs.near, inputs.far, *size)


def _guides(volumes):
    """(G, h, w) coordinates of the surfaces that each volume believes in."""
    moments = [plane_moments(jnp.moveaxis(v.logits, 0, -1))[0] for v in volumes if v is not None]
    return jax.lax.stop_gradient(jnp.stack(moments))


def volumes(params, inputs, maps, *, config):
    """The geometry and the motion `Volume` of one target, each None where the preset has none; see `encode`.

    Source: ZeST-NeRF eq. 2, eq. 3.
    """
    near, far = inputs.near, inputs.far
    frustum = reference_frustum(inputs, config)
    depths = plane_depths(near, far, config.planes, spacing=config.spacing)
    of_key, of_slots = (None, None) if maps is None else split_maps(maps, inputs.key.images.shape[0])

    def volume(part, frames, maps, slots):
        return encode_volume(
            part, _sweep_views(part, frames, maps, inputs.time, near, far, config), frustum.camera,
            (frustum.height, frustum.width), depths, slots=slots,
            colours="all" if config.conditioning == "concatenated" else "mean",
            trusted=config.encoder == "frames" and config.trust,
        )  # fmt: skip

    geometry = volume(params.geometry, inputs.key, of_key, False) if config.geometry else None
    motion = volume(params.motion, inputs.slots, of_slots, True) if config.motion_volume else None
    return geometry, motion


def assemble(inputs, maps, encoded, *, config):
    """`Encoding` of `volumes`' result: adds the tables that rays read and the guides, none of which is learned."""
    geometry, motion = encoded
    of_key, of_slots = (None, None) if maps is None else split_maps(maps, inputs.key.images.shape[0])
    views = lambda frames, maps: _source_views(frames, maps, inputs.time, inputs.near, inputs.far, config)
    guided = config.sampling == "guided" and (geometry is not None or motion is not None)
    return Encoding(
        geometry, motion,
        None if geometry is None else views(inputs.key, of_key),
        None if motion is None else views(inputs.slots, of_slots),
        reference_frustum(inputs, config), _guides(encoded) if guided else None,
    )  # fmt: skip


def encode(params, inputs, maps, *, config):
    """Volumes and view tables of one target.

    Args:
      params: `ZestParams`.
      inputs: `Inputs`.
      maps: `FrameMaps` of the key-frames, then the slots, or None with the `pyramid` encoder.
      config: `presets.Config`; what it switches off is not in the program.

    Returns:
      `Encoding`.
    """
    return assemble(inputs, maps, volumes(params, inputs, maps, config=config), config=config)
