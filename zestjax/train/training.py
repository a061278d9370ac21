"""Training as a sequence of pure steps: which clip step n sees, and the loop that yields every state.

    n        step, counted from 0 over the whole life of a run, resumed or not
    clip     one rendered scene: frames to read and targets to predict

A step's batch is a function of (seed, n) alone, so a run that is killed and resumed computes what an uninterrupted
one does, bit for bit on one machine with one number of threads. Nothing here reads a clock, prints or writes:
`zestjax.apps.train` does.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from zestjax.base.types import Tree


class TrainState(NamedTuple):
    """All that a step changes. params, opt_state: trees of arrays. step: int, steps already taken."""

    params: Any
    opt_state: Any
    step: int


def clip_window(step: int, *, window: int, steps_per_clip: int, count: int | None = None) -> range:
    """Indices of the clips that step `step` may see: the newest few; one joins every `steps_per_clip` steps.

    Args:
      step: int >= 0.
      window: clips alive at a time, >= 1.
      steps_per_clip: steps between one new clip and the next, >= 1.
      count: clips there are in all, reused from the first one when they have been through; None: without limit.

    Returns:
      range of clip indices before reuse (index modulo `count` is the clip to load).
    """
    newest = step // steps_per_clip
    oldest = max(0, newest - window + 1)
    return range(oldest, newest + 1) if count is None else range(max(oldest, newest - count + 1), newest + 1)


def clip_index(
    step: int, *, seed: int, window: int, steps_per_clip: int, count: int | None = None, draw: int = 0
) -> int:
    """A clip that step `step` of run `seed` sees: drawn evenly from `clip_window` by (seed, step, draw) alone."""
    live = clip_window(step, window=window, steps_per_clip=steps_per_clip, count=count)
    number = int(np.random.SeedSequence([seed, step, draw]).generate_state(1, np.uint64)[0])
    index = live[number % len(live)]
    return index if count is None else index % count


def batch_key(step: int, *, seed: int, draw: int = 0) -> jax.Array:
    """The random key of the batch of step `step`, or of its clip `draw`: which target, which rays, which slots are
    dropped."""
    key = jax.random.fold_in(jax.random.key(seed), step)
    return jax.random.fold_in(key, draw) if draw else key


def scalars(info: Tree) -> dict[str, float]:
    """A step's report, any tree of () arrays, as {leaf path: float}; other leaves are left out."""
    leaves = jax.tree_util.tree_leaves_with_path(info)
    named = ((jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in leaves)
    return {name or "total": float(leaf) for name, leaf in named if np.ndim(leaf) == 0}


def training_steps(
    step_fn: Callable, state: TrainState, batch_at: Callable[[int], Any], *, steps: int
) -> Iterator[tuple[TrainState, dict[str, float]]]:
    """Runs steps `state.step` to `steps` - 1 and yields (state, info) after each.

    The next batch is prepared while the device computes the current step. `step_fn` may donate its arguments:
    a yielded state is valid until the next one is asked for. A batch that cannot be made raises its error after the
    step before it was yielded, whose state then stays valid.

    Args:
      step_fn: (params, opt_state, batch) -> (params, opt_state, info).
      state: `TrainState` to start from.
      batch_at: step -> batch.
      steps: int, where to stop.

    Yields:
      (`TrainState`, {name: float}) per step.
    """
    batch = batch_at(state.step) if state.step < steps else None
    while state.step < steps:
        params, opt_state, info = step_fn(state.params, state.opt_state, batch)
        state = TrainState(params, opt_state, state.step + 1)
        failed = None
        try:
            batch = batch_at(state.step) if state.step < steps else None
        except Exception as error:
            failed = error
        yield state, scalars(info)
        if failed is not None:
            raise failed
