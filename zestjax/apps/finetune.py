"""`zestjax finetune`: weights adapted to one scene by predicting what stands still in its frames from other frames.

A frame that is held back has no picture of its own time to be predicted from, as the views asked for later have: what
moves would learn to fade. It is therefore left out, as far as the frames' own analysis finds it.
"""

import dataclasses
import functools
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from zestjax import novel_view
from zestjax.apps.loop import LoopOptions, run_loop
from zestjax.apps.own_frames import known_of, own_frame_batches
from zestjax.apps.scenes import digest, open_scene, place_of
from zestjax.apps.train import run_name, summarise
from zestjax.apps.weights import arithmetic, open_weights
from zestjax.base.parts import to_stored
from zestjax.frames.known import answers_of
from zestjax.train.batches import step_batches
from zestjax.train.learn import find_fault
from zestjax.train.recipes import Cosine
from zestjax.train.training import TrainState

RATE = Cosine(1e-3, 1e-3, 5)
STILL_WEIGHTS = dict(static_rec=20.0)
MOVING = 0.3  # probability of moving from which a pixel is left out, and its surroundings with it
LEAST_STILL = 0.01  # share of the pixels that must stand still: with less a run would learn from nothing, at loss 0
FOREVER = 1_000_000
CHECKPOINT_SECONDS = 60.0  # the default budget: a run that asks for more loses at most this much to a kill


@dataclasses.dataclass(frozen=True)
class FinetuneOptions:
    """The flags of `zestjax finetune`; see the command's help. steps: in all; the budget usually ends it first."""

    scene: str
    out: Path
    weights: Path | None = None
    system: str | None = None
    budget: float = 60.0
    exclude: tuple = ()
    size: tuple | None = None
    format: str | None = None
    resume: bool = False
    steps: int = FOREVER
    seed: int = 0
    quiet: bool = False


@arithmetic()
def finetune(options):
    """Run `zestjax finetune`.

    Returns:
      `train.Summary`.

    Raises:
      ValueError, WeightsError: a scene or weights that cannot be used, or no frame left to learn from.
    """
    model = open_weights(options.weights, system=options.system)
    if getattr(model.system.static, "statistics", "batch") != "batch":
        raise ValueError("finetune: norms with stored statistics do not learn; import them with --statistics batch.")
    opened = open_scene(
        options.scene, model.recipe, size=options.size, protocol=None, layout=options.format, exclude=options.exclude
    )
    video = opened.scene.video
    if len(video.images) - len(set(options.exclude)) < 3:
        raise ValueError(f"finetune: --exclude leaves too few of {len(video.images)} frames; leave at least 3.")
    moving = moving_pixels(model, video, options.exclude)
    known = known_of(opened.scene)._replace(moving=moving)
    recipe = dataclasses.replace(model.recipe, rate=RATE)
    recipe = recipe.of(model.system, known=answers_of(known)) if moving is None else recipe.weighted(STILL_WEIGHTS)
    (init, step_fn), objective = recipe.trainer(steps=FOREVER), recipe.objective()
    explain = functools.partial(find_fault, objective)
    params = jax.tree.map(jnp.array, model.trained)  # copies: the step donates
    loop = LoopOptions(
        options.out,
        options.steps,
        options.budget,
        options.resume,
        CHECKPOINT_SECONDS,
        quiet=options.quiet,
        label="finetune",
    )
    metadata = model.metadata | {
        "recipe": to_stored(recipe), "seed": options.seed, "start": run_name(model.path),
        "scene": place_of(options.scene),
        "data": {"frames": digest(video), "exclude": list(options.exclude)},
    }  # fmt: skip
    one_at = own_frame_batches(known, recipe, seed=options.seed, exclude=options.exclude)
    batch_at = step_batches(one_at, recipe.clips)
    step_fn = jax.jit(step_fn, donate_argnums=(0, 1))
    result = run_loop(step_fn, TrainState(params, init(params), 0), batch_at, loop, metadata=metadata, explain=explain)
    return summarise(result, options.out, "finetune")


def moving_pixels(model, video, exclude):
    """(N, H, W) bool of what may move, by the frames' own analysis; None where the model has none.

    Raises:
      ValueError: hardly anything stands still.
    """
    maps = novel_view.prepare(model.params, video, system=model.system, exclude=exclude).maps
    if maps is None:
        return None
    size = video.images.shape[2:0:-1]
    likely = np.asarray(jax.nn.sigmoid(maps.moving_logits), np.float32)
    moving = np.stack([cv2.resize(cv2.dilate(frame, np.ones((3, 3))), size) for frame in likely]) > MOVING
    if (still := 1 - moving.mean()) < LEAST_STILL:
        raise ValueError(
            f"finetune: the weights take all but {still:.1%} of the pixels for moving, which leaves nothing to learn "
            "from; give weights that were trained for longer, or another scene."
        )
    return moving
