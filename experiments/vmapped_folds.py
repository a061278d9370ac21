"""Seeds of `tiny` as one vmapped program, against one after the other: the same parameters, and the seconds of both.

    python experiments/vmapped_folds.py [--system zest] [--seeds 4] [--steps 100]

Each seed has its own parameters and batches, as a fold of a cross-validation has. Rounding is not a fixed number: Adam
divides a gradient by its own size. So the yardstick is a run whose colours are brighter by one float32 rounding: the
vmapped parameters may be off by FACTOR times what that run's are, root mean square.
"""

import argparse
import json
import os
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.simulate.clips import training_clip
from zestjax.train.batches import batch_from_clip, prepare_clip
from zestjax.train.recipes import SYSTEMS, recipe_of
from zestjax.train.training import batch_key

ROUNDING = 2.0**-23  # of 1 in float32
FACTOR = 10.0  # one rounding moves each sum's other roundings too; a fault is larger by orders


def stacked(trees):
    """Trees with a new leading axis."""
    return jax.tree.map(lambda *rows: jnp.stack([jnp.asarray(row) for row in rows]), *trees)


def run(step, state, batches):
    """(params, seconds of the first step, seconds of the others)."""
    seconds = []
    for batch in batches:
        start = time.perf_counter()
        *state, _ = step(*state, batch)
        jax.block_until_ready(state)
        seconds.append(time.perf_counter() - start)
    return jax.device_get(state[0]), seconds[0], sum(seconds[1:])


def off(params, other):
    """Root mean square of a difference of trees."""
    squares = [np.square(a - b).ravel() for a, b in zip(jax.tree.leaves(params), jax.tree.leaves(other), strict=True)]
    return float(np.sqrt(np.mean(np.concatenate(squares), dtype=np.float64)))


def brighter(batch):
    """A batch whose colours are one rounding brighter."""
    return batch._replace(truth=batch.truth._replace(colour=batch.truth.colour * np.float32(1 + ROUNDING)))


def main():
    """Train both ways and compare; 1 where they differ by more than rounding does."""
    parser = argparse.ArgumentParser(description="Seeds of tiny as one program.")
    parser.add_argument("--system", default="zest", choices=SYSTEMS)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--steps", type=int, default=100)
    options = parser.parse_args()
    recipe = recipe_of("tiny", system=options.system)
    recipe = recipe.of(recipe.system)
    init, step = recipe.trainer(steps=options.steps)
    clip = prepare_clip(
        jax.random.key(0), training_clip(jax.random.key(0), height=recipe.height, width=recipe.width), recipe.system
    )
    seeds = range(options.seeds)
    batches = [[batch_from_clip(batch_key(n, seed=seed), clip, recipe, step=n) for n in range(options.steps)]
               for seed in seeds]  # fmt: skip

    def start(seed):
        params = recipe.init(jax.random.key(seed))
        return params, init(params)

    one, together = jax.jit(step, donate_argnums=(0, 1)), jax.jit(jax.vmap(step), donate_argnums=(0, 1))
    alone = [run(one, start(seed), batches[seed]) for seed in seeds]
    rounding = off(run(one, start(0), map(brighter, batches[0]))[0], alone[0][0])
    first, *_ = alone
    of_all = map(stacked, zip(*batches, strict=True))
    whole, compiled, seconds = run(together, stacked([start(seed) for seed in seeds]), of_all)
    apart = max(off(jax.tree.map(lambda x, s=seed: x[s], whole), alone[seed][0]) for seed in seeds)
    row = {
        "system": options.system, "seeds": options.seeds, "steps": options.steps,
        "one_by_one_seconds": sum(rest for *_, rest in alone), "vmapped_seconds": seconds,
        "one_by_one_compile": first[1], "vmapped_compile": compiled, "off": apart, "off_by_a_rounding": rounding,
        "moved": off(first[0], jax.device_get(start(0)[0])), "load": os.getloadavg()[0],
        "device": jax.devices()[0].device_kind,
    }  # fmt: skip
    print(json.dumps({k: float(f"{v:.3g}") if isinstance(v, float) else v for k, v in row.items()}))
    return 0 if apart <= FACTOR * rounding else 1


if __name__ == "__main__":
    sys.exit(main())
