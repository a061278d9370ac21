"""Batches from a real video: some of its frames are held back and predicted from the others.

holes    frames that a group of steps holds back: they are its targets, and serve no other frame in it
"""

import functools

import numpy as np

from zestjax.cameras import Camera
from zestjax.frames.assembly import footage, video_evidence
from zestjax.frames.exposure import evened
from zestjax.frames.known import KnownFrames, known_frames
from zestjax.io.scenes import Scene
from zestjax.systems.fields import reads_frames
from zestjax.train.batches import PreparedClip, batch_from_clip
from zestjax.train.training import batch_key

HOLES, STEPS_PER_HOLES = 3, 8


def known_of(scene: Scene) -> KnownFrames:
    """What a scene's files say of its frames: masks decide where rays are mined, priors are learned from."""
    flows = (scene.flow_forward, scene.flow_backward)
    there = all(flow is not None for flow in flows)
    pair = lambda name: np.stack([getattr(flow, name) for flow in flows], 1) if there else None
    return known_frames(
        scene.video, mined=scene.motion_masks, disparity=scene.disparity, flow=pair("vectors"), flow_valid=pair("valid")
    )


def own_frame_batches(known: KnownFrames, recipe, *, seed, exclude=(), kept=()):
    """(step, draw=0) -> batch: a hole of the step's group, predicted from the frames that are neither holes nor
    excluded; of a system that reads no frames, any that is not excluded.

    Args:
      known: `KnownFrames`.
      recipe: `Recipe`.
      seed: draws the holes and the rays.
      exclude: frames that serve nothing, not even as targets.
      kept: frames that are no targets.
    """
    usable = np.array([i for i in range(len(known.images)) if i not in set(exclude)])
    targets = np.array([i for i in usable if i not in set(kept)])
    cameras, maps = Camera(known.intrinsics, known.camera_from_world), recipe.system.frames
    gains, reading = recipe.system.exposure, any(map(reads_frames, (recipe.system.static, recipe.system.dynamic)))
    seen = footage(known.images) if reading and (maps or gains) else None
    links = gains(seen, exclude=exclude) if gains and seen else None

    @functools.lru_cache(maxsize=16)
    def prepared(group):
        size = min(HOLES, len(usable) - 2, len(targets))
        rounds, place = divmod(group * size, len(targets))
        order = np.random.default_rng([seed, rounds]).permutation(targets)
        holes = tuple(int(i) for i in np.roll(order, -place)[:size])
        evidence, missing = None, (*holes, *exclude)
        exposure = gains(seen, exclude=missing, known=links) if gains and seen else None
        if maps is not None and seen is not None:
            evidence = video_evidence(
                evened(seen, exposure), cameras, known.near, known.far, planes=maps.planes, exclude=missing
            )
        return PreparedClip(known, evidence, holes, tuple(exclude), exposure=exposure)

    by_heart = PreparedClip(known, None, (), tuple(exclude), tuple(map(int, targets)))

    def batch_at(step, draw=0):
        chosen = prepared(step // STEPS_PER_HOLES) if reading else by_heart
        return batch_from_clip(batch_key(step, seed=seed, draw=draw), chosen, recipe, step=step)

    return batch_at
