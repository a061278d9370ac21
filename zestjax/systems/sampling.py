"""Where rays are sampled, and what a sample stands for.

R S      rays, samples on a ray
fraction of a ray, in [0, 1]: 0 at near, 1 at far, even in depth or in inverse depth (`Space.spacing`)
guides   (G, h, w) coordinates of likely surfaces of each cell, one map a volume; None where nothing guides
"""

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_counts, check_option
from zestjax.base.numerics import matvec
from zestjax.base.parts import part
from zestjax.base.types import Array
from zestjax.encoding import Volume
from zestjax.frames.analysis import plane_moments, without_mode
from zestjax.frames.cells import nearest_cells
from zestjax.frustum import Frustum, frustum_from_world
from zestjax.rays import depths_from_fractions, interval_lengths, rays_from_pixels
from zestjax.systems.fields import Marched
from zestjax.video import Inputs

FARTHEST = 1e6  # of far, as good as infinity
BEYOND = 1.5  # of far: a point one plane past the last one lies this side of it
UNITS = ("world", "plane", "sample")
MOST_MODES = 8  # of a cell: a file of weights may not ask for more
MOST_SAMPLES = 4096  # of a ray: a file of weights may not ask for more


class Sampler(Protocol):
    """guided: it needs volumes whose cells have logits. fills: a ray that sees nothing shows a last resort."""

    guided: ClassVar[bool]
    fills: ClassVar[bool]

    def guide(self, volumes: list[Volume]) -> Any:
        """What the volumes say of where to look, once a target; None if nothing."""
        ...

    def fractions(self, guides: Any, pixels: jax.Array, jitter: jax.Array | None) -> jax.Array:
        """(R, S) places of the samples; jitter: (R, S) in [0, 1), the places in their strata, or None."""
        ...

    def lengths(self, fractions: Array, depths: Array, inputs: Inputs, norm: Array, planes: int) -> jax.Array:
        """(R, S) what a sample stands for. norm: (R, 1) of the rays' directions. planes: of the volumes."""
        ...


@part
class Guided:
    """At the surfaces that the volumes believe in: those of a pixel's four cells and their blend. Densities are per
    plane, and a sample stands for one. modes: surfaces that a cell is asked for, the likeliest first; two where one
    thing hides another, and a cell may show both."""

    modes: int = 1

    guided: ClassVar[bool] = True
    fills: ClassVar[bool] = True

    def __post_init__(self):
        check_counts("Guided", modes=(self.modes, 1, MOST_MODES))

    def guide(self, volumes: Sequence[Any]) -> jax.Array:
        """See `Sampler`."""
        logits, moments = [jnp.moveaxis(volume.logits, 0, -1) for volume in volumes], []
        for mode in range(self.modes):
            logits = [without_mode(x) for x in logits] if mode else logits
            moments += [plane_moments(x)[0] for x in logits]
        return jax.lax.stop_gradient(jnp.stack(moments))

    def fractions(self, guides: Array, pixels: jax.Array, jitter: jax.Array | None) -> jax.Array:
        """See `Sampler`."""
        return jnp.sort(nearest_cells(guides, pixels), axis=-1)

    def lengths(self, fractions: Array, depths: Array, inputs: Inputs, norm: Array, planes: int) -> jax.Array:
        """See `Sampler`."""
        return jnp.ones_like(depths)


@part
class Even:
    """In the middles of `samples` even intervals, or anywhere in them. unit: a sample stands for its interval, in
    `world` units (as published) or in `plane`s of the volumes, or for one `sample`."""

    samples: int = 128
    unit: str = "world"

    guided: ClassVar[bool] = False
    fills: ClassVar[bool] = False

    def __post_init__(self):
        check_counts("Even", samples=(self.samples, 1, MOST_SAMPLES))
        check_option("Even", unit=(self.unit, UNITS))

    def guide(self, volumes: Sequence[Any]) -> None:
        """See `Sampler`."""
        return None

    def fractions(self, guides: Any, pixels: jax.Array, jitter: jax.Array | None) -> jax.Array:
        """See `Sampler`."""
        place = jnp.full((pixels.shape[0], self.samples), 0.5, pixels.dtype) if jitter is None else jitter
        return (jnp.arange(self.samples, dtype=pixels.dtype)[None] + place) / self.samples

    def lengths(self, fractions: Array, depths: Array, inputs: Inputs, norm: Array, planes: int) -> jax.Array:
        """See `Sampler`."""
        if self.unit == "sample":
            return jnp.ones_like(depths)
        if self.unit == "plane":
            return interval_lengths(fractions, 0.0, 1.0) * (planes - 1)
        return interval_lengths(depths, inputs.near, inputs.far) * norm


def march(
    sampler: Sampler,
    space: Any,
    frustum: Frustum,
    guides: Any,
    inputs: Inputs,
    pixels: jax.Array,
    *,
    jitter: jax.Array | None = None,
) -> Marched:
    """Samples of each ray of the target.

    Args:
      sampler: a part.
      space: `system.Space`.
      frustum: of the volumes.
      guides: of the sampler's `guide`.
      inputs: `Inputs`.
      pixels: (R, 2) column and row.
      jitter: (R, S) in [0, 1) places of even samples in their strata, or None for the middles.

    Returns:
      `Marched`.
    """
    near, far, spacing = inputs.near, inputs.far, space.spacing
    rays = rays_from_pixels(inputs.camera, pixels)
    fractions = sampler.fractions(guides, pixels, jitter)
    depths = depths_from_fractions(fractions, near, far, spacing=spacing)
    farther = depths_from_fractions(fractions + 1 / (space.planes - 1), near, far * BEYOND, spacing=spacing)
    # One plane past the last may lie at infinity or beyond it, which a rounding decides: it is taken for very far.
    farther = jnp.where(farther > 0, jnp.minimum(farther, FARTHEST * far), FARTHEST * far)
    along = lambda z: rays.origins[:, None] + z[..., None] * rays.directions[:, None]
    points = along(depths)
    coords = frustum_from_world(frustum, points, spacing=spacing)
    norm = jnp.sqrt(jnp.sum(rays.directions**2, axis=-1, keepdims=True))
    lengths = sampler.lengths(fractions, depths, inputs, norm, space.planes)
    rotation = frustum.camera.camera_from_world[:3, :3]
    return Marched(depths, coords, points, along(farther), lengths, matvec(rotation, rays.directions / norm))
