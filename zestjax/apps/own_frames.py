"""Batches from a video of which nothing is known but its frames: some are held back and predicted from the others.

holes    frames that a group of steps holds back: they are its targets, and serve no other frame in it
"""

import functools

import numpy as np

from zestjax.assembly import footage, video_evidence
from zestjax.batches import PreparedClip, batch_from_clip
from zestjax.losses.objective import Terms
from zestjax.simulate.clips import Clip
from zestjax.training import batch_key

FRAMES_WEIGHTS = Terms(rec=20.0, b=1e-3)  # nothing is known of a real scene but its frames
HOLES, STEPS_PER_HOLES = 3, 8


def frame_batches(video, config, *, seed, exclude=(), moving=None):
    """step -> batch: a hole of the step's group, predicted from the frames that are neither holes nor excluded.

    Args:
      video: `Video` on the host.
      config: `presets.Config`.
      seed: draws the holes and the crops.
      exclude: frames that serve nothing, not even as targets.
      moving: (N, H, W) bool of moving pixels, or None: nothing is known to move.
    """
    usable = np.array([i for i in range(len(video.images)) if i not in set(exclude)])
    clip, seen = _clip(video, moving), footage(video.images)

    @functools.lru_cache(maxsize=16)
    def prepared(group):
        size = min(HOLES, len(usable) - 2)
        rounds, place = divmod(group * size, len(usable))
        order = np.random.default_rng([seed, rounds]).permutation(usable)
        holes = tuple(int(i) for i in np.roll(order, -place)[:size])
        evidence = None
        if config.encoder == "frames":
            hidden = {*holes, *exclude}
            evidence = video_evidence(
                seen, video.cameras, video.near, video.far, planes=config.evidence_planes, exclude=tuple(hidden)
            )  # fmt: skip
        return PreparedClip(clip, evidence, holes, tuple(exclude))

    def batch_at(step):
        chosen = prepared(step // STEPS_PER_HOLES)
        return batch_from_clip(batch_key(step, seed=seed), chosen, config)

    return batch_at


def _clip(video, moving):
    """A `Clip` that knows nothing but the frames; what it does not know is weighted with nothing."""
    count, height, width = video.images.shape[:3]
    maps, none = np.zeros((count, height, width), np.float32), np.zeros((0, height, width), np.float32)
    moving = maps > 0 if moving is None else moving
    images = np.round(np.asarray(video.images) * 255).astype(np.uint8)
    return Clip(
        images=images, depth=maps + float(video.far), moving=moving, intrinsics=np.asarray(video.cameras.intrinsics),
        camera_from_world=np.asarray(video.cameras.camera_from_world), near=video.near, far=video.far,
        target_images=images[:0], target_depth=none, target_moving=none > 0,
        target_scene_flow=np.zeros((0, 2, height, width, 3), np.float16), target_static_images=images[:0],
        target_static_depth=none, target_static_valid=none > 0, target_intrinsics=np.zeros((0, 3, 3), np.float32),
        target_camera_from_world=np.zeros((0, 4, 4), np.float32), target_time=np.zeros(0, np.int32),
    )  # fmt: skip
