"""What a field sweeps: tables of its source frames, and the volume that is made of them.

V        source frames of one field
h w      cells
maps     what each frame says about itself (`analysis.FrameMaps`); None in a system that does not ask
"""

from typing import ClassVar, Protocol

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_counts
from zestjax.base.parts import part
from zestjax.cameras import resized, scaled
from zestjax.encoding import SweepViews, Volume, VolumeParams, encode_volume, init_volume
from zestjax.fields.conditioning import SourceViews
from zestjax.frames.analysis import FrameMaps
from zestjax.frames.cells import SIDE, cell_values, grown, half_images, pooled
from zestjax.frustum import Frustum
from zestjax.nets.feature_pyramid import feature_pyramid
from zestjax.video import Frames, Inputs

MOST_CHANNELS, MOST_LEVELS = 4096, 8  # of a network that fits a machine: a file of weights may not ask for more


class Tables(Protocol):
    """What is swept. colours, trusted: as of `encoding.init_volume`. channels: learned features of a cell."""

    colours: ClassVar[str]
    trusted: ClassVar[bool]

    @property
    def channels(self) -> int: ...

    def sweep(self, params: VolumeParams, frames: Frames, maps: FrameMaps | None, inputs: Inputs) -> SweepViews:
        """Tables at the volume's resolution."""
        ...

    def views(self, frames: Frames, maps: FrameMaps | None, inputs: Inputs) -> SourceViews:
        """Tables at full resolution, for the rays; nothing of them is learned."""
        ...


@part
class OwnDepths:
    """The colours of each frame's cells, and where the frame can be trusted, by its own depth and moving pixels. The
    maps are constants here: they learn from their own losses, which halves the sweep's cost."""

    colours: ClassVar[str] = "mean"
    trusted: ClassVar[bool] = True

    @property
    def channels(self) -> int:
        """Nothing is learned in the tables."""
        return 0

    def sweep(self, params: VolumeParams, frames: Frames, maps: FrameMaps | None, inputs: Inputs) -> SweepViews:
        """See `Tables`."""
        moving, surface, tolerance = _trust_maps(maps, inputs)
        parts = [cell_values(half_images(frames.images)), pooled(moving[..., None], 2)]
        parts += [surface[..., None], tolerance[..., None]]
        cameras, times = resized(frames.cameras, 1 / SIDE, 1 / SIDE), frames.times - inputs.time
        return SweepViews(jnp.concatenate(parts, -1), cameras, frames.valid, times)

    def views(self, frames: Frames, maps: FrameMaps | None, inputs: Inputs) -> SourceViews:
        """See `Tables`."""
        (moving, *rest), size = _trust_maps(maps, inputs), frames.images.shape[1:3]
        wide = [grown(moving, size, factor=2), *(grown(x, size, factor=4) for x in rest)]
        tables = jnp.concatenate([frames.images, jnp.stack(wide, -1)], axis=-1)
        return SourceViews(tables, frames.cameras, frames.valid, frames.times - inputs.time)


def _trust_maps(maps, inputs):
    """(V, 2h, 2w) probability of moving, (V, h, w) inverse depth of the surface, and its tolerance."""
    maps, near, far = jax.lax.stop_gradient(maps), inputs.near, inputs.far
    surface = (1 - maps.coordinate) / near + maps.coordinate / far
    return jax.nn.sigmoid(maps.moving_logits), surface, maps.tolerance * (1 / near - 1 / far)


@part
class Pyramid:
    """The paper's tables: `channels` features of a 2-D net of each frame, and every fourth of its pixels."""

    channels: int = 32

    colours: ClassVar[str] = "all"
    trusted: ClassVar[bool] = False

    def __post_init__(self):
        check_counts("Pyramid", channels=(self.channels, 4, MOST_CHANNELS))

    def sweep(self, params: VolumeParams, frames: Frames, maps: FrameMaps | None, inputs: Inputs) -> SweepViews:
        """See `Tables`."""
        assert params.pyramid is not None  # `Swept.init` made one, as there are channels
        features = feature_pyramid(params.pyramid, frames.images)
        tables = jnp.concatenate([features, frames.images[:, ::SIDE, ::SIDE]], axis=-1)
        cameras, times = scaled(frames.cameras, 1 / SIDE, 1 / SIDE), frames.times - inputs.time
        return SweepViews(tables, cameras, frames.valid, times)

    def views(self, frames: Frames, maps: FrameMaps | None, inputs: Inputs) -> SourceViews:
        """See `Tables`."""
        return SourceViews(frames.images, frames.cameras, frames.valid, frames.times - inputs.time)


@part
class Swept:
    """A volume of `tables`, encoded by a 3-D U-Net of `widths`; `occupied`: its cells get a logit of being a surface,
    by which rays can be guided."""

    tables: Tables = OwnDepths()
    widths: tuple[int, ...] = (8, 16, 32)
    occupied: bool = True

    def __post_init__(self):
        check_counts("Swept", levels=(len(self.widths), 1, MOST_LEVELS))
        check_counts("Swept", **{f"widths[{i}]": (n, 1, MOST_CHANNELS) for i, n in enumerate(self.widths)})

    @property
    def channels(self) -> int:
        """What a look-up gives."""
        return self.widths[0] + self.occupied

    def init(self, key: jax.Array, *, views: int, motion_votes: bool) -> VolumeParams:
        """Parameters, for that many source frames; motion_votes: votes are kept slot by slot."""
        features = self.tables.channels
        return init_volume(
            key, features=features, views=views, widths=self.widths, colours=self.tables.colours,
            trusted=self.tables.trusted, motion_votes=motion_votes, occupied=self.occupied,
            pyramid_widths=(features // 4, features // 2, features) if features else None,
        )  # fmt: skip

    def encode(
        self,
        params: VolumeParams,
        frames: Frames,
        maps: FrameMaps | None,
        inputs: Inputs,
        frustum: Frustum,
        depths: jax.Array,
        *,
        motion_votes: bool,
    ) -> Volume:
        """The volume that fills a frustum, on planes at `depths`."""
        views = self.tables.sweep(params, frames, maps, inputs)
        return encode_volume(
            params, views, frustum.camera, (frustum.height, frustum.width), depths,
            colours=self.tables.colours, trusted=self.tables.trusted, motion_votes=motion_votes,
        )  # fmt: skip
