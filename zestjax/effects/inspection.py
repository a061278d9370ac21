"""Which effects a scene calls for, from its frames and cameras alone: `inspect`.

N        frames
H W      rows and columns
exclude  frames that are not read
"""

from collections.abc import Collection

import jax
import numpy as np

from zestjax.effects.found import EFFECTS, Evidence, Found, unknown
from zestjax.effects.motion import LEAST_SIDE, motion_evidence, motion_of
from zestjax.effects.pairs import beside_another, look
from zestjax.effects.recording import (
    depth_prior_evidence,
    exposure_evidence,
    flow_prior_evidence,
    forward_evidence,
    noise_evidence,
    revisits_evidence,
)
from zestjax.effects.surfaces import disocclusion_evidence, thin_evidence, view_evidence
from zestjax.frames.assembly import Footage, footage
from zestjax.frames.exposure import Gains, evened
from zestjax.frames.inputs import check_exclude, check_inputs
from zestjax.frames.known import KnownFrames
from zestjax.video import Video


def inspect(
    video: Video,
    *,
    seen: Footage | None = None,
    given: KnownFrames | None = None,
    exclude: Collection[int] = (),
    smallest: int = LEAST_SIDE,
) -> Found:
    """What a scene calls for.

    Args:
      video: `Video`, whose images may be uint8.
      seen: `Footage` of it, where it is there already.
      given: priors of the scene's files, or None.
      exclude: see the header.
      smallest: pixels of a frame's shorter side below which nothing is said to stand still.

    Returns:
      `Evidence` of every effect of `found.EFFECTS`. It has an answer for every video that can be rendered: where the
      frames do not tell, "cannot tell" and the reason.

    Raises:
      ValueError: no view can be predicted from the video (see `frames.inputs.check_inputs`).
    """
    video = check_inputs("effects.inspect", video, quantised=True)
    exclude = frozenset(check_exclude("effects.inspect", len(video.images), exclude))
    left = [i for i in range(len(video.images)) if i not in exclude]
    if not beside_another(left):
        return {name: unknown("no two frames that follow each other are left to be compared") for name in EFFECTS}
    seen, gains = footage(video.images) if seen is None else seen, Gains()
    exposure = gains(seen, exclude=exclude)
    cameras = jax.tree.map(np.asarray, video.cameras)
    size = (int(video.images.shape[1]), int(video.images.shape[2]))
    looked = look(evened(seen, exposure), cameras, size, excluded=exclude)
    near, far = float(video.near), float(video.far)
    noise = noise_evidence(np.asarray(video.images)[left])
    motion = motion_of(looked, near, far, noise=noise.numbers["noise"])
    kept = jax.tree.map(lambda leaf: leaf[left], cameras)
    found: dict[str, Evidence] = {
        "motion": motion_evidence(motion, looked, smallest=smallest),
        "disocclusion": disocclusion_evidence(looked),
        "exposure": exposure_evidence(exposure, gains),
        "flow_prior": flow_prior_evidence(looked, given),
        "depth_prior": depth_prior_evidence(looked, given),
        "view_dependence": view_evidence(looked, motion, near, far),
        "noise": noise,
        "thin_structures": thin_evidence(looked, near, far),
        "revisits": revisits_evidence(kept),
        "forward_facing": forward_evidence(kept),
    }
    return found
