"""`zestjax finetune`: weights adapted to one scene by predicting its own frames, each from the others.

holes    frames that a group of steps holds back: they are its targets, and serve no other frame in it
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.apps.loop import LoopOptions, run_loop
from zestjax.apps.scenes import open_scene
from zestjax.apps.train import summarise
from zestjax.apps.weights import open_weights
from zestjax.assembly import halved, video_evidence
from zestjax.batches import PreparedClip, batch_from_clip
from zestjax.learn import make_train_step
from zestjax.losses.objective import Terms
from zestjax.simulate.clips import Clip
from zestjax.training import TrainState, batch_key

FINETUNE_WEIGHTS = Terms(rec=20.0, b=1e-3)  # nothing is known of a real scene but its frames
HOLES, STEPS_PER_HOLES, RATE = 3, 8, 5e-4
FOREVER = 1_000_000


@dataclasses.dataclass(frozen=True)
class FinetuneOptions:
    """The flags of `zestjax finetune`; see the command's help. steps: in all; the budget usually ends it first."""

    scene: str
    out: Path
    weights: Path | None = None
    budget: float = 60.0
    exclude: tuple = ()
    size: tuple | None = None
    format: str | None = None
    resume: bool = False
    steps: int = FOREVER
    seed: int = 0
    quiet: bool = False


def finetune(options):
    """Run `zestjax finetune`.

    Returns:
      `train.Summary`.

    Raises:
      ValueError, WeightsError: a scene or weights that cannot be used, or no frame left to learn from.
    """
    model = open_weights(options.weights)
    opened = open_scene(options.scene, model.config, size=options.size, protocol=None, layout=options.format)
    video = withheld(opened.scene.video, options.exclude)
    init, step_fn = make_train_step(
        model.config, steps=FOREVER, weights=FINETUNE_WEIGHTS, peak=RATE, floor=RATE, warmup=5
    )  # fmt: skip
    params = jax.tree.map(jnp.array, model.params)  # copies: the step donates
    loop = LoopOptions(options.out, options.steps, options.budget, options.resume, 60.0, quiet=options.quiet)
    metadata = model.metadata | {
        "seed": options.seed, "start": str(model.path),
        "data": {"scene": str(options.scene), "exclude": list(options.exclude)},
    }  # fmt: skip
    batch_at = frame_batches(video, model.config, seed=options.seed, exclude=options.exclude)
    result = run_loop(step_fn, TrainState(params, init(params), 0), batch_at, loop, metadata=metadata)
    return summarise(result, options.out, "finetune")


def withheld(video, exclude):
    """The video with the excluded frames blackened: nothing of them can be learned.

    Raises:
      ValueError: a frame the video does not have, or fewer than three left.
    """
    count = len(video.images)
    if outside := [i for i in exclude if not 0 <= i < count]:
        raise ValueError(f"finetune: --exclude names frame {outside[0]}; the video has 0 to {count - 1}.")
    if count - len(set(exclude)) < 3:
        raise ValueError(f"finetune: --exclude leaves {count - len(set(exclude))} frames; leave at least 3.")
    images = np.array(video.images)
    images[list(exclude)] = 0
    return video._replace(images=images)


def frame_batches(video, config, *, seed, exclude=()):
    """step -> batch: a hole of the step's group, predicted from the frames that are neither holes nor excluded.

    Args:
      video: `Video` on the host.
      config: `presets.Config`.
      seed: draws the holes and the crops.
      exclude: frames that serve nothing, not even as targets.
    """
    usable = np.array([i for i in range(len(video.images)) if i not in set(exclude)])
    clip, half = _clip(video), halved(jnp.asarray(video.images))

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
                half, video.cameras, video.near, video.far, planes=config.evidence_planes, exclude=tuple(hidden)
            )  # fmt: skip
        return PreparedClip(clip, evidence, holes, tuple(exclude))

    def batch_at(step):
        chosen = prepared(step // STEPS_PER_HOLES)
        return batch_from_clip(batch_key(step, seed=seed), chosen, config)

    return batch_at


def _clip(video):
    """A `Clip` that knows nothing but the frames; what it does not know is weighted with nothing."""
    count, height, width = video.images.shape[:3]
    maps, none = np.zeros((count, height, width), np.float32), np.zeros((0, height, width), np.float32)
    images = np.round(np.asarray(video.images) * 255).astype(np.uint8)
    return Clip(
        images=images, depth=maps + float(video.far), moving=maps > 0, intrinsics=np.asarray(video.cameras.intrinsics),
        camera_from_world=np.asarray(video.cameras.camera_from_world), near=video.near, far=video.far,
        target_images=images[:0], target_depth=none, target_moving=none > 0,
        target_scene_flow=np.zeros((0, 2, height, width, 3), np.float16), target_static_images=images[:0],
        target_static_depth=none, target_static_valid=none > 0, target_intrinsics=np.zeros((0, 3, 3), np.float32),
        target_camera_from_world=np.zeros((0, 4, 4), np.float32), target_time=np.zeros(0, np.int32),
    )  # fmt: skip
