"""Presets: every choice that shapes the model, as one frozen value. Parameters carry sizes, a `Config` carries choices.

`paper` is the published system at full size, with its form of every part. `small` is ours, for two cores, and
`tiny` is `small` shrunk for tests. A preset only selects among the same functions.
"""

import dataclasses

from zestjax.checks import check_option
from zestjax.precision import PRECISIONS


@dataclasses.dataclass(frozen=True)
class Config:
    """What the model computes; hashable, so that it can be a static argument of a compiled function.

    height, width: size the preset was made for, pixels. planes: depth planes of a volume.
    evidence_planes: planes on which a frame's own depth is found; the frames' encoder is made for them.
    encoder: `frames` (an encoder of each frame that also finds its depth and moving pixels, see `analysis`) or
      `pyramid` (the paper's 2-D feature net). features, volume_widths, frame_widths: channels.
    key_frames, key_frame_choice: how many, and `nearest` to the target camera or `spread` over the video.
    slots: neighbours of the target time. reference: camera of the volumes, `target` or `key_frame`.
    geometry, motion: the two volumes; dynamic: the dynamic field (without it a scene is static and nothing of the
      dynamic branch is compiled). trust: source views are tested before they count;
      hold_trust: the frames' own maps learn from their own losses alone, which halves the sweep's cost.
    sampling: `guided` by the volumes' depth modes, or `regular`; samples: per ray, of `regular`.
    rays: of a training step, whole `rows` (crop_rows of them) or as many pixels drawn `uniform`ly, and mined_rays more
      from what moves. ray_blocks: parts in which they are computed.
    head: `blend` of the views' colours or `direct`. blend: `opacity` or `density` form of the two fields' sum.
    precision: see `precision`: of the networks; geometry beside `bfloat16` networks stays float32.
    """

    name: str
    height: int = 144
    width: int = 256
    planes: int = 32
    evidence_planes: int = 32
    spacing: str = "inverse"
    encoder: str = "frames"
    features: int = 0
    frame_widths: tuple = (48, 64, 96, 128)
    volume_widths: tuple = (8, 16, 32)
    key_frames: int = 8
    key_frame_choice: str = "nearest"
    slots: tuple = (-2, -1, 0, 1, 2)
    reference: str = "target"
    geometry: bool = True
    motion: bool = True
    dynamic: bool = True
    trust: bool = True
    hold_trust: bool = True
    field_width: int = 48
    field_depth: int = 3
    point_levels: int = 2
    view_levels: int = 1
    sampling: str = "guided"
    samples: int = 8
    head: str = "blend"
    conditioning: str = "pooled"
    blend: str = "opacity"
    rays: str = "rows"
    mined_rays: int = 0
    crop_rows: int = 16
    ray_blocks: int = 4
    precision: str = "float32"

    def __post_init__(self):
        check_option(
            "Config",
            spacing=(self.spacing, ("depth", "inverse")),
            encoder=(self.encoder, ("frames", "pyramid")),
            key_frame_choice=(self.key_frame_choice, ("nearest", "spread")),
            reference=(self.reference, ("target", "key_frame")),
            sampling=(self.sampling, ("guided", "regular")),
            rays=(self.rays, ("rows", "uniform")),
            head=(self.head, ("blend", "direct")),
            conditioning=(self.conditioning, ("pooled", "concatenated")),
            blend=(self.blend, ("opacity", "density")),
            precision=(self.precision, PRECISIONS),
        )
        self._check_together()

    @property
    def motion_volume(self):
        """Whether there is a motion volume: without a dynamic field nothing would read it."""
        return self.motion and self.dynamic

    @property
    def any_volume(self):
        """Whether there is a volume at all."""
        return self.geometry or self.motion_volume

    @property
    def analysed(self):
        """Whether the frames are asked for their own depth and moving pixels."""
        return self.encoder == "frames" and self.any_volume

    def _check_together(self):
        """Choices that only work together; raises `ValueError`."""
        frames = self.encoder == "frames"
        if (self.head == "blend") != (self.conditioning == "pooled") or (self.head == "blend") != frames:
            raise ValueError(
                f"Config: encoder `{self.encoder}`, head `{self.head}`, conditioning `{self.conditioning}` do not fit "
                "together; expected `frames`, `blend`, `pooled` or `pyramid`, `direct`, `concatenated`."
            )
        if self.sampling == "guided" and (self.reference != "target" or not frames):
            raise ValueError(
                f"Config: guided sampling with encoder `{self.encoder}` and reference `{self.reference}`; "
                "expected `frames` and `target`, or sampling `regular`."
            )
        if min(self.planes, self.evidence_planes) < 2:
            raise ValueError(f"Config: {self.planes} planes, {self.evidence_planes} of evidence; expected at least 2.")


PRESETS = {
    "tiny": Config(
        "tiny", height=32, width=48, planes=8, evidence_planes=8, frame_widths=(8, 12), volume_widths=(4, 8),
        key_frames=4, field_width=16, field_depth=2, crop_rows=8, ray_blocks=2,
    ),
    "small": Config("small"),
    "paper": Config(
        "paper", height=288, width=512, planes=128, spacing="depth", encoder="pyramid", features=32,
        volume_widths=(8, 16, 32, 64), key_frame_choice="spread", slots=(-2, -1, 1, 2), reference="key_frame",
        trust=False, field_width=256, field_depth=8, point_levels=10, view_levels=4, sampling="regular",
        samples=128, head="direct", conditioning="concatenated", rays="uniform", mined_rays=512,
        crop_rows=2, ray_blocks=8,
    ),
}  # fmt: skip


def preset(name, **changes):
    """The preset of that name, with fields replaced.

    Raises:
      ValueError: for an unknown name, listing the valid ones.
    """
    check_option("preset", name=(name, tuple(PRESETS)))
    return dataclasses.replace(PRESETS[name], **changes)
