"""`zestjax finetune`: weights adapted to one scene by predicting its own frames, each from the others."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp

from zestjax.apps.loop import LoopOptions, run_loop
from zestjax.apps.own_frames import FRAMES_WEIGHTS, frame_batches
from zestjax.apps.scenes import open_scene
from zestjax.apps.train import summarise
from zestjax.apps.weights import open_weights
from zestjax.learn import make_train_step
from zestjax.training import TrainState

RATE = 1e-4
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
    opened = open_scene(
        options.scene, model.config, size=options.size, protocol=None, layout=options.format, exclude=options.exclude
    )
    video = opened.scene.video
    if len(video.images) - len(set(options.exclude)) < 3:
        raise ValueError(f"finetune: --exclude leaves too few of {len(video.images)} frames; leave at least 3.")
    init, step_fn = make_train_step(
        model.config, steps=FOREVER, weights=FRAMES_WEIGHTS, peak=RATE, floor=RATE, warmup=5
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
