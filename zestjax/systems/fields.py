"""The two fields as parts: whose frames they read, what they sweep, and what they say of the samples of rays.

R S      rays, samples on a ray; P = R S points, ray by ray
coords   (R, S, 3) in the frustum of the target's volumes, z in [0, 1]
"""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_counts, check_option
from zestjax.base.numerics import computed_once
from zestjax.base.parts import part
from zestjax.base.types import Array, Scalar, T
from zestjax.encoding import Volume, VolumeParams
from zestjax.fields import dynamic, static
from zestjax.fields.conditioning import SourceViews, parallax, sample_views
from zestjax.fields.dynamic import DynamicParams, dynamic_field, dynamic_views, early_flow, shown_moving
from zestjax.fields.heads import Blend, Head
from zestjax.fields.static import StaticParams, static_field, static_views
from zestjax.fields.trunk import MODULATIONS
from zestjax.frames.analysis import FrameMaps
from zestjax.frames.selection import KeyFrames, Slots
from zestjax.frustum import Frustum, cells_from_frustum, world_from_frustum
from zestjax.nets.positional import positional_encoding
from zestjax.resample import trilinear
from zestjax.systems.swept import Swept
from zestjax.video import Inputs

MOST_LAYERS, MOST_WIDTH, MOST_LEVELS = 64, 4096, 32  # of a field that fits a machine, whoever wrote its file


class Marched(NamedTuple):
    """Samples along rays. depths: (R, S) world units. coords: (R, S, 3). points: (R, S, 3) world. beyond: (R, S, 3)
    world, one plane farther. lengths: (R, S) what a sample stands for, which its density is multiplied by.
    directions: (R, 3) unit, in the frustum's camera."""

    depths: jax.Array
    coords: jax.Array
    points: jax.Array
    beyond: jax.Array
    lengths: jax.Array
    directions: jax.Array


class Seen(NamedTuple):
    """What one field reads of a target. volume: learned, or None. views: tables for the rays, not learned, or None."""

    volume: Volume | Any | None
    views: SourceViews | Any | None


class Place(NamedTuple):
    """Where and when a field is asked. frustum, spacing: of the coords. time: (). duration: () frames of the video."""

    frustum: Frustum
    spacing: str
    time: Scalar
    duration: Scalar

    def world(self, coords: Array) -> jax.Array:
        """World points (..., 3) of coords."""
        return world_from_frustum(self.frustum, coords, spacing=self.spacing)


class FieldParams(NamedTuple):
    """volume: `VolumeParams`, None without one. net: of the field itself."""

    volume: VolumeParams | None
    net: Any


class Field(Protocol):
    """What a system asks of a field. frames: `KeyFrames` or `Slots`, or a part of your own with their methods."""

    @property
    def frames(self) -> Any: ...

    def init(self, key: jax.Array) -> Any:
        """Parameters, a pytree."""
        ...

    def encode(self, params: Any, inputs: Inputs, maps: FrameMaps | None, frustum: Frustum, depths: jax.Array) -> Seen:
        """What it reads of a target; maps: of its own frames."""
        ...

    def __call__(self, params: Any, seen: Seen, marched: Marched, place: Place) -> Any:
        """`StaticSample` or `DynamicSample` of (R, S, ...)."""
        ...


@part
class Choices:
    """What both fields choose.

    frames: that serve it. volume: what it sweeps of them; None: it reads nothing and stands alone. head: of colour.
    width, depth: of the trunk. point_levels, view_levels: octaves of the encodings. modulation: see `trunk`.
    """

    frames: Any = None
    volume: Swept | None = Swept()
    head: Head = Blend()
    width: int = 48
    depth: int = 3
    point_levels: int = 2
    view_levels: int = 1
    modulation: str = "multiply"

    def __post_init__(self):
        check_field(self)


@part
class Static(Choices):
    """The field of what stands still; see `Choices`."""

    frames: KeyFrames = KeyFrames()

    def init(self, key: jax.Array) -> FieldParams:
        """Parameters."""
        volume, net = jax.random.split(key)
        sizes = sizes_of(self, axes=3, features=static.VIEW_FEATURES, summaries=static.SUMMARIES)
        swept = None if self.volume is None else self.volume.init(volume, views=self.frames.count, motion_votes=False)
        return FieldParams(swept, static.init_static(net, **sizes))

    def encode(
        self, params: FieldParams, inputs: Inputs, maps: FrameMaps | None, frustum: Frustum, depths: jax.Array
    ) -> Seen:
        """See `Field`. Source: ZeST-NeRF eq. 2."""
        return encoded(self, params, inputs, maps, frustum, depths, motion_votes=False)

    def __call__(self, params, seen, marched, place):
        """See `Field`."""
        net: StaticParams = params.net
        samples = views = None
        if seen.views is not None:
            points = flat(marched.points)[None]
            samples = computed_once(sample_views, seen.views, points)
            if self.head.looks:
                shift = computed_once(parallax, seen.views.cameras, points, flat(marched.beyond)[None])
                there = seen.views.valid > 0  # an empty slot repeats a real frame, whose camera and time say nothing
                shift, times = jnp.where(there[:, None], shift, 0), jnp.where(there, seen.views.times, 0)
                views = computed_once(static_views, samples, shift, times)
        point = positional_encoding(flat(marched.coords), levels=self.point_levels)
        reading = self.head(net.head, look_up(seen.volume, flat(marched.coords)), samples, views)
        found = static_field(net, point, directions_of(self, marched), reading, modulation=self.modulation)
        return gridded(found, marched)


@part
class Dynamic(Choices):
    """The field of what moves; see `Choices`. reach: bound of the flow, frustum units."""

    frames: Slots = Slots()
    reach: float = 0.15

    def init(self, key: jax.Array) -> FieldParams:
        """Parameters."""
        volume, net = jax.random.split(key)
        summaries = dynamic.SUMMARIES + 2 * self.frames.count
        sizes = sizes_of(self, axes=4, features=dynamic.VIEW_FEATURES, summaries=summaries)
        swept = None if self.volume is None else self.volume.init(volume, views=self.frames.count, motion_votes=True)
        channels = 0 if self.volume is None else self.volume.channels
        return FieldParams(swept, dynamic.init_dynamic(net, n_volume=channels, looks=self.head.looks, **sizes))

    def encode(
        self, params: FieldParams, inputs: Inputs, maps: FrameMaps | None, frustum: Frustum, depths: jax.Array
    ) -> Seen:
        """See `Field`. Source: ZeST-NeRF eq. 3."""
        return encoded(self, params, inputs, maps, frustum, depths, motion_votes=True)

    def __call__(self, params, seen, marched, place):
        """See `Field`. Time is normalised to [-1, 1) over the video (reference: ZeST-NeRF networks.py)."""
        net: DynamicParams = params.net
        coords = flat(marched.coords)
        when = jnp.broadcast_to(2 * place.time / place.duration - 1, (coords.shape[0], 1)).astype(coords.dtype)
        point = positional_encoding(jnp.concatenate([coords, when], axis=-1), levels=self.point_levels)
        volume = look_up(seen.volume, coords)
        samples = views = early = shown = None
        if self.head.looks:
            early = early_flow(net, point, volume, reach=self.reach)
            times = seen.views.times[:, None, None]
            step = jnp.where(times > 0, early[None, :, :3], early[None, :, 3:]) * jnp.abs(times)
            # Where to look is learned from the flow's own losses: no gradient through the gathers.
            samples = computed_once(sample_views, seen.views, jax.lax.stop_gradient(place.world(coords[None] + step)))
            points, beyond = flat(marched.points)[None], flat(marched.beyond)[None]
            shift = computed_once(parallax, seen.views.cameras, points, beyond)
            views = computed_once(dynamic_views, samples, shift, seen.views.times)
            shown = shown_moving(samples, shift, seen.views.times)
        elif seen.views is not None:
            samples = computed_once(sample_views, seen.views, place.world(coords)[None])
        reading, direction = self.head(net.head, volume, samples, views), directions_of(self, marched)
        options: Any = dict(reach=self.reach, early=early, shown=shown, modulation=self.modulation)
        return gridded(dynamic_field(net, point, direction, reading, **options), marched)


def check_field(field: Choices) -> None:
    """Refuse sizes that no field has, and a head that looks at views where there are none."""
    name = type(field).__name__
    check_counts(
        name,
        width=(field.width, 1, MOST_WIDTH),
        depth=(field.depth, 1, MOST_LAYERS),
        point_levels=(field.point_levels, 0, MOST_LEVELS),
        view_levels=(field.view_levels, 0, MOST_LEVELS),
    )
    check_option(name, modulation=(field.modulation, MODULATIONS))
    if field.volume is None and field.head.looks:
        raise ValueError(f"{name}: the head looks at views, of which there are none without a volume; use `Direct`.")


def reads_frames(field: Field | None) -> bool:
    """Whether a field reads what frames show, as any does that is not ours and alone."""
    return field is not None and not (isinstance(field, Choices) and field.volume is None)


def sizes_of(field: Choices, *, axes: int, features: int, summaries: int) -> dict[str, Any]:
    """Arguments that the inits of both fields share. axes: of a point. features, summaries: of its views."""
    directions = 3 * (1 + 2 * field.view_levels)
    channels = 0 if field.volume is None else field.volume.channels
    views = 0 if field.volume is None else field.frames.count
    return dict(
        n_point=axes * (1 + 2 * field.point_levels),
        n_condition=field.head.channels(volume=channels, views=views, summaries=summaries),
        width=field.width,
        depth=field.depth,
        head=lambda key: field.head.init(key, features=features, width=field.width, directions=directions),
    )


def encoded(
    field: Choices,
    params: FieldParams,
    inputs: Inputs,
    maps: FrameMaps | None,
    frustum: Frustum,
    depths: jax.Array,
    *,
    motion_votes: bool,
) -> Seen:
    """What a field with a `Swept` volume reads of a target."""
    if field.volume is None or params.volume is None:
        return Seen(None, None)
    frames = field.frames.of(inputs)
    volume = field.volume.encode(params.volume, frames, maps, inputs, frustum, depths, motion_votes=motion_votes)
    return Seen(volume, field.volume.tables.views(frames, maps, inputs))


def look_up(volume: Volume | None, coords: jax.Array) -> jax.Array:
    """(P, channels) of a `Volume`'s cells at frustum coordinates (P, 3); no channels without a volume."""
    if volume is None:
        return jnp.zeros((coords.shape[0], 0), coords.dtype)
    return computed_once(trilinear, volume.cells, cells_from_frustum(coords, *volume.cells.shape[:3]))


def directions_of(field: Choices, marched: Marched) -> jax.Array:
    """(P, Q) encoded viewing direction of each sample."""
    encoded = positional_encoding(marched.directions, levels=field.view_levels)
    rays, samples = marched.depths.shape
    wide = jnp.broadcast_to(encoded[:, None], (rays, samples, encoded.shape[1]))
    return wide.reshape(-1, encoded.shape[1])


def flat(x: jax.Array) -> jax.Array:
    """(R, S, ...) as (P, ...)."""
    return x.reshape(-1, *x.shape[2:])


def gridded(samples: T, marched: Marched) -> T:
    """A tree of (P, ...) as (R, S, ...)."""
    return jax.tree.map(lambda x: x.reshape(*marched.depths.shape, *x.shape[1:]), samples)
