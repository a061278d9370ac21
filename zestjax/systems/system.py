"""A system: what a model is, as a value made of parts. What a part lacks is not in the compiled program.

V        source frames: those of the static field, then those of the dynamic one
R S      rays, samples on a ray
maps     what each frame says about itself (`analysis.FrameMaps`); None in a system that does not ask
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_counts, check_option
from zestjax.base.parts import part
from zestjax.base.precision import PRECISIONS
from zestjax.cameras import resized, scaled
from zestjax.depth import expected_depth
from zestjax.fields.dynamic import DynamicSample
from zestjax.frames.analysis import AnalysisParams, FrameMaps, OwnMaps
from zestjax.frames.cells import SIDE, cells_of
from zestjax.frames.exposure import Gains
from zestjax.frustum import Frustum
from zestjax.planesweep import plane_depths
from zestjax.rays import SPACINGS
from zestjax.rendering import FieldSamples, composite, weights_from_density
from zestjax.systems.fields import Dynamic, Field, Marched, Place, Seen, Static
from zestjax.systems.mixes import Mix, Opacity
from zestjax.systems.sampling import Guided, Sampler, march
from zestjax.systems.swept import Swept
from zestjax.video import Inputs

MOST_PLANES = 4096  # of a volume that fits a machine: a file of weights may not ask for more


class Params(NamedTuple):
    """All learned parameters. analysis: of the frames' own maps. A part that the system lacks is None."""

    analysis: AnalysisParams | None
    static: Any
    dynamic: Any


class Scene(NamedTuple):
    """What the rays of one target are rendered from. frustum: of the volumes. static, dynamic: what each field reads.
    guides: of the sampler."""

    frustum: Frustum
    static: Seen
    dynamic: Seen | None
    guides: Any


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


@part
class Space:
    """What a target is described in. planes: of the volumes, even in `depth` or in `inverse` depth (spacing). camera:
    whose frustum they fill, the `target`'s or the first `key_frame`'s. cells: what a cell shows, the mean of its pixels
    (`pooled`) or every fourth pixel of the image (`strided`)."""

    planes: int = 32
    spacing: str = "inverse"
    camera: str = "target"
    cells: str = "pooled"

    def __post_init__(self):
        check_counts("Space", planes=(self.planes, 2, MOST_PLANES))
        check_option(
            "Space",
            spacing=(self.spacing, SPACINGS),
            camera=(self.camera, ("target", "key_frame")),
            cells=(self.cells, ("pooled", "strided")),
        )

    def frustum(self, inputs: Inputs) -> Frustum:
        """Of the volumes, at their resolution, with that camera."""
        camera = inputs.camera if self.camera == "target" else jax.tree.map(lambda x: x[0], inputs.key.cameras)
        at = resized if self.cells == "pooled" else scaled
        height, width = (cells_of(n) for n in inputs.key.images.shape[1:3])
        return Frustum(at(camera, 1 / SIDE, 1 / SIDE), inputs.near, inputs.far, height, width)

    def depths(self, inputs: Inputs) -> jax.Array:
        """(D,) of the planes, world units."""
        return plane_depths(inputs.near, inputs.far, self.planes, spacing=self.spacing)


@part
class System:
    """What a model is: hashable, compared by value, the static argument of every compiled function.

    space: what a target is described in. static, dynamic: the two fields, dynamic None where nothing moves. sampler:
    where rays are sampled. mix: how the fields share a ray. frames: what every frame is asked about itself, or None.
    precision: of the networks (see `precision`); geometry beside `bfloat16` networks stays float32. exposure: by what
    the frames' exposures are made one where they drift, or None: they are taken as they are.
    """

    space: Space = Space()
    static: Field = Static()
    dynamic: Field | None = Dynamic()
    sampler: Sampler = Guided()
    mix: Mix = Opacity()
    frames: OwnMaps | None = OwnMaps()
    precision: str = "float32"
    exposure: Gains | None = None

    def __post_init__(self):
        check_option("System", precision=(self.precision, PRECISIONS))
        volumes = swept(self)
        if self.sampler.guided and (self.space.camera != "target" or not volumes):
            raise ValueError(
                f"System: a guided sampler with {len(volumes)} volumes in the {self.space.camera}'s frustum; expected "
                "volumes in the target's, or `Even`."
            )
        if self.sampler.guided and not all(volume.occupied for volume in volumes):
            raise ValueError("System: a guided sampler with a volume without logits; use `occupied=True`, or `Even`.")
        read = any(volume.tables.trusted for volume in volumes)
        if read and self.frames is None:
            raise ValueError("System: tables of the frames' own depths without `frames`; use `OwnMaps`, or `Pyramid`.")
        ours = all(isinstance(field, Static | Dynamic | None) for field in (self.static, self.dynamic))
        if self.frames is not None and ours and not read:
            raise ValueError("System: `frames` are asked for what no volume's tables read; use `frames=None`.")

    def init(self, key: jax.Array) -> Params:
        """Parameters."""
        keys = jax.random.split(key, 3)
        return Params(
            None if self.frames is None else self.frames.init(keys[0]),
            self.static.init(keys[1]),
            None if self.dynamic is None else self.dynamic.init(keys[2]),
        )

    def encode(self, params: Params, inputs: Inputs, maps: FrameMaps | None) -> Scene:
        """Volumes and tables of one target.

        Args:
          params: `Params`.
          inputs: `Inputs`.
          maps: `FrameMaps` of the frames of the static field, then of the dynamic one; None without `frames`.

        Returns:
          `Scene`.

        Source: ZeST-NeRF eq. 2, eq. 3.
        """
        frustum, depths = self.space.frustum(inputs), self.space.depths(inputs)
        of_key, of_slots = (None, None) if maps is None else split_maps(maps, len(inputs.key.valid))
        static = self.static.encode(params.static, inputs, of_key, frustum, depths)
        dynamic = None
        if self.dynamic is not None:
            dynamic = self.dynamic.encode(params.dynamic, inputs, of_slots, frustum, depths)
        found = [seen.volume for seen in (static, dynamic) if seen is not None and seen.volume is not None]
        return Scene(frustum, static, dynamic, self.sampler.guide(found))

    def render(
        self, params: Params, scene: Scene, inputs: Inputs, pixels: jax.Array, *, jitter: jax.Array | None = None
    ) -> Prediction:
        """Render pixels of the target.

        Args:
          params: `Params`.
          scene: of `encode` of the same inputs.
          inputs: `Inputs`.
          pixels: (R, 2) column and row in the target image.
          jitter: see `sampling.march`.

        Returns:
          `Prediction`.

        Source: ZeST-NeRF eq. 6, eq. 7, eq. 8, eq. 9.
        """
        marched = march(self.sampler, self.space, scene.frustum, scene.guides, inputs, pixels, jitter=jitter)
        place = self.place(scene, inputs)
        still = self.static(params.static, scene.static, marched, place)
        static = FieldSamples(still.density, still.colour)
        if self.dynamic is None or scene.dynamic is None:
            return static_prediction(static, marched, fills=self.sampler.fills)
        moving = self.dynamic(params.dynamic, scene.dynamic, marched, place)
        blend = jax.nn.sigmoid(still.blend_logit + moving.blend_logit)
        out = self.mix(static, FieldSamples(moving.density, moving.colour), blend, marched.lengths, marched.depths)
        colour, static_colour = out.colour, out.static_colour
        if self.sampler.fills:
            behind = last_resort(static)
            colour = filled(colour, out.opacity, behind)
            static_colour = filled(static_colour, jnp.sum(out.static_weights, -1), behind)
        return Prediction(
            colour, static_colour, out.dynamic_colour, out.depth, out.dynamic_depth, out.opacity, out.dynamicness,
            blend, out.weights.static + out.weights.dynamic, out.weights.dynamic, out.dynamic_weights, moving, marched,
        )  # fmt: skip

    def place(self, scene: Scene, inputs: Inputs, *, offset: int = 0) -> Place:
        """Where and when the fields are asked, `offset` frames after the target's time."""
        return Place(scene.frustum, self.space.spacing, inputs.time + offset, inputs.duration)


def swept(system: System) -> list[Swept]:
    """The `Swept` volumes of a system's fields; a field of your own may have another kind, or none."""
    volumes = (getattr(field, "volume", None) for field in (system.static, system.dynamic))
    return [volume for volume in volumes if isinstance(volume, Swept)]


def split_maps(maps: FrameMaps, count: int) -> tuple[FrameMaps, FrameMaps]:
    """`FrameMaps` of V frames into those of the first `count` and the rest."""
    return jax.tree.map(lambda x: x[:count], maps), jax.tree.map(lambda x: x[count:], maps)


def last_resort(field: FieldSamples) -> jax.Array:
    """(R, 3) colour of a ray whose samples are all transparent: the mean of their colours by density, never black."""
    share = field.density + 1e-6  # where no sample has any density, all count alike
    return jnp.sum(share[..., None] * field.colour, axis=-2) / jnp.sum(share, axis=-1)[..., None]


def filled(colour: jax.Array, opacity: jax.Array, behind: jax.Array) -> jax.Array:
    """A ray's colour (R, 3) with what lies behind it (R, 3) where it lets light through; a mean of colours always, also
    where the opacity (R,) of two fields that share their samples is above 1."""
    opacity = opacity[:, None]
    return colour / jnp.maximum(opacity, 1) + jnp.maximum(1 - opacity, 0) * behind


def static_prediction(static: FieldSamples, marched: Marched, *, fills: bool) -> Prediction:
    """The `Prediction` of a scene in which nothing moves; `fills` where rays that see nothing show a last resort."""
    weights = weights_from_density(static.density, marched.lengths)
    shown = composite(weights, static.colour, background=last_resort(static) if fills else None)
    depth, none = expected_depth(weights, marched.depths), jnp.zeros_like(shown.opacity)
    colour = shown.values
    return Prediction(colour, colour, None, depth, None, shown.opacity, none, None, weights, None, None, None, marched)
