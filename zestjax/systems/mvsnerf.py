"""MVSNeRF (Chen et al. 2021) as it was published: a field and a sampler of its own make it a system like the others.

It is put together from the functions that ZeST-NeRF's own form uses; what is particular to it has a keyword there
(`legacy_abs`, `order`, `mvsnerf_cost_volume`), or is here.

V          source views, the first is the reference: the volume fills its frustum
padding    cells that the volume reaches beyond the reference's image on every side
coords     (..., 3) x, y, z in [0, 1] inside the padded volume; z linear in depth
"""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import check_counts, check_option, check_shapes
from zestjax.base.parts import part
from zestjax.base.types import Array
from zestjax.cameras import Camera, project, scaled
from zestjax.cost_volume import mvsnerf_cost_volume, quarter_colours
from zestjax.fields.static import StaticSample
from zestjax.fields.trunk import ColourHead, Trunk, direct_colour, init_colour_head, init_trunk, trunk
from zestjax.frames.analysis import FrameMaps
from zestjax.frames.selection import KeyFrames
from zestjax.frustum import Frustum, cells_from_frustum, frustum_from_world
from zestjax.nets.cost_regulariser import CostRegulariser, cost_regulariser, init_cost_regulariser
from zestjax.nets.feature_pyramid import FeaturePyramid, feature_pyramid, imagenet_normalised, init_feature_pyramid
from zestjax.nets.layers import Dense, Norm, Statistics, dense, init_dense
from zestjax.nets.positional import positional_encoding
from zestjax.planesweep import homographies, plane_depths
from zestjax.resample import bilinear, trilinear
from zestjax.systems.fields import MOST_LAYERS, MOST_WIDTH, Seen, flat, gridded
from zestjax.systems.system import Space, System
from zestjax.video import Inputs

LEVELS = 10  # octaves of a point's encoding, as published
STATISTICS = ("batch", "stored")
MOST_PADDING, MOST_SAMPLES = 1024, 4096  # of what fits a machine: a file of weights may not ask for more


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
    near: Array | np.floating
    far: Array | np.floating


class FieldOutput(NamedTuple):
    """density: (P,) >= 0, per sample and not per unit of length. colour: (P, 3) in [0, 1]."""

    density: jax.Array
    colour: jax.Array


def init_mvsnerf(key: jax.Array, *, views: int = 3, width: int = 128, depth: int = 6) -> MvsNerfParams:
    """`MvsNerfParams` of the published shapes."""
    keys = jax.random.split(key, 5)
    features = init_feature_pyramid(keys[0])
    regulariser = init_cost_regulariser(keys[1], 3 * views + features.head.kernel.shape[-1])
    n_point, n_condition = 3 * (1 + 2 * LEVELS), regulariser.stem.norm.scale.shape[0] + 4 * views
    base = init_trunk(keys[2], n_point, n_condition, width=width, depth=depth)
    field = MvsNerfField(base, init_dense(keys[3], width, 1), init_colour_head(keys[4], width, 3))
    return MvsNerfParams(features, regulariser, field)


def reference(sources: Sources) -> Camera:
    """The first camera."""
    return jax.tree.map(lambda leaf: leaf[0], sources.cameras)


def cost(params: MvsNerfParams, sources: Sources, *, planes: int, padding: int) -> jax.Array:
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


def volume(params: MvsNerfParams, sources: Sources, *, planes: int, padding: int) -> jax.Array:
    """The encoding volume (planes, h + 2 padding, w + 2 padding, 8).

    Reference: MVSNeRF models.py `MVSNet`.
    Differs from the reference: sizes that are no multiple of 8 are padded, where it stops.
    """
    return cost_regulariser(params.regulariser, cost(params, sources, planes=planes, padding=padding), legacy_abs=True)


def volume_coords(sources: Sources, points: Array, *, padding: int) -> jax.Array:
    """World points (..., 3) to coords.

    Reference: MVSNeRF utils.py `get_ndc_coordinate`.
    Differs from the reference: none; like it, a look-up lies up to 0.75 cells beside the feature it was made from.
    """
    height, width = sources.images.shape[1:3]
    frustum = Frustum(reference(sources), sources.near, sources.far, height, width)
    coords = frustum_from_world(frustum, points)
    x, y = ((coords[..., i] * (n // 4) + padding) / (n // 4 + 2 * padding) for i, n in enumerate((width, height)))
    return jnp.stack([x, y, coords[..., 2]], axis=-1)


def look_up(volume: Array, coords: Array) -> jax.Array:
    """(..., C) of a volume at coords; from its outer cells it fades to 0 over one cell."""
    planes, rows, columns = volume.shape[:3]
    cells = cells_from_frustum(coords, planes, rows, columns) + 1
    return trilinear(jnp.pad(volume, [(1, 1), (1, 1), (1, 1), (0, 0)]), cells, border="zero")


def view_colours(sources: Sources, points: Array) -> jax.Array:
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


def field(params: MvsNerfField, coords: jax.Array, features: jax.Array, direction: jax.Array) -> FieldOutput:
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


@part
class MvsNerf:
    """MVSNeRF's field, of a scene that stands still. frames: its sources, all of which must be there. padding: see the
    header. statistics: of the norms, of the images at hand (`batch`), as the published system always runs, or the
    `stored` ones, which it never used. width, depth: of the trunk."""

    frames: KeyFrames = KeyFrames(3, least=3)
    padding: int = 24
    statistics: str = "batch"
    width: int = 128
    depth: int = 6

    def __post_init__(self):
        check_counts("MvsNerf", padding=(self.padding, 0, MOST_PADDING))
        check_counts("MvsNerf", width=(self.width, 1, MOST_WIDTH), depth=(self.depth, 1, MOST_LAYERS))
        check_option("MvsNerf", statistics=(self.statistics, STATISTICS))

    def init(self, key: jax.Array) -> MvsNerfParams:
        """Parameters."""
        params = init_mvsnerf(key, views=self.frames.count, width=self.width, depth=self.depth)
        if self.statistics == "batch":
            return params
        known = lambda x: x._replace(statistics=Statistics(0 * x.offset, x.scale)) if isinstance(x, Norm) else x
        return jax.tree.map(known, params, is_leaf=lambda x: isinstance(x, Norm))

    def encode(
        self, params: MvsNerfParams, inputs: Inputs, maps: FrameMaps | None, frustum: Frustum, depths: Array
    ) -> Seen:
        """See `systems.fields.Field`."""
        key = self.frames.of(inputs)
        sources = Sources(jnp.asarray(key.images), key.cameras, inputs.near, inputs.far)
        return Seen(volume(params, sources, planes=len(depths), padding=self.padding), sources)

    def __call__(self, params, seen, marched, place):
        """See `systems.fields.Field`."""
        sources, points = seen.views, flat(marched.points)
        coords = volume_coords(sources, points, padding=self.padding)
        features = jnp.concatenate([look_up(seen.volume, coords), view_colours(sources, points)], axis=-1)
        direction = jnp.repeat(marched.directions, marched.depths.shape[1], axis=0)
        found = field(params.field, coords, features, direction)
        none = jnp.zeros_like(found.density)
        return gridded(StaticSample(found.density, found.colour, none, none), marched)


@part
class Ends:
    """`samples` even ones, the first at near and the last at far, or anywhere up to half-way to their neighbours; a
    density is per sample, whatever its interval.

    Reference: MVSNeRF renderer.py `raw2alpha`: an interval's length is not part of its opacity.
    """

    samples: int = 128

    guided: ClassVar[bool] = False
    fills: ClassVar[bool] = False

    def __post_init__(self):
        check_counts("Ends", samples=(self.samples, 2, MOST_SAMPLES))

    def guide(self, volumes: Sequence[Any]) -> None:
        """See `systems.sampling.Sampler`."""
        return None

    def fractions(self, guides: Any, pixels: jax.Array, jitter: jax.Array | None) -> jax.Array:
        """See `systems.sampling.Sampler`."""
        even = jnp.linspace(0, 1, self.samples, dtype=pixels.dtype)
        if jitter is None:
            return jnp.broadcast_to(even, (pixels.shape[0], self.samples))
        half = 0.5 / (self.samples - 1)
        low, high = jnp.maximum(even - half, 0), jnp.minimum(even + half, 1)
        return low + jitter * (high - low)

    def lengths(self, fractions: Array, depths: Array, inputs: Inputs, norm: Array, planes: int) -> jax.Array:
        """See `systems.sampling.Sampler`."""
        return jnp.ones_like(depths)


MVSNERF = System(Space(128, "depth", "key_frame", "strided"), MvsNerf(), None, Ends(), frames=None)
