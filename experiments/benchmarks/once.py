"""What it is worth to keep gathers and sums instead of computing them again: a frame and a training step, both ways.

    python experiments/benchmarks/once.py [--preset small] [--repeats 5]

`computed_once` (`zestjax.base.numerics`) against a plain call of the same functions. Both programs are compiled first,
and then run in turns in one process. A JSON line each: compile seconds, best seconds, their ratio, and the largest
difference of the colours, and of the parameters after the step.
"""

import argparse
import contextlib
import json
import time
from unittest import mock

import jax
import jax.numpy as jnp
from model import inputs_and_maps, noise_clip

from zestjax import adam, novel_view
from zestjax.apps.weights import open_weights
from zestjax.fields import heads
from zestjax.systems import fields
from zestjax.train import batches
from zestjax.train.recipes import RECIPES

PLACES = (adam, heads, fields)  # that import it


def calls_of(recipe, clip):
    """{what: (a function to compile, its arguments)}."""
    system, key = recipe.system, jax.random.key
    params = open_weights().params if recipe == RECIPES["small"] else system.init(key(2))
    inputs, maps = inputs_and_maps(params, clip, system)
    init, step = recipe.stage("views").trainer(steps=1000)
    batch = batches.batch_from_clip(key(1), batches.prepare_clip(key(0), clip, system), recipe)
    frame = lambda p, i, m: novel_view.render_inputs(p, i, m, system=system).colour
    return {"frame": (frame, (params, inputs, maps)), "step": (step, (params, init(params), batch))}


def compiled(fn, args, once):
    """(program, seconds that it took to compile)."""
    plain = lambda fn, *args: fn(*args)
    jax.clear_caches()
    start = time.perf_counter()
    with contextlib.ExitStack() as stack:
        for place in () if once else PLACES:
            stack.enter_context(mock.patch.object(place, "computed_once", plain))
        program = jax.jit(fn).lower(*args).compile()
    return program, time.perf_counter() - start


def difference(a, b):
    """Largest, of trees of numbers."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float(jnp.max(jnp.abs(x - y))) for x, y in pairs)


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Times a frame and a step with and without computed_once.")
    parser.add_argument("--preset", default="small", choices=tuple(RECIPES))
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    recipe = RECIPES[options.preset]
    for what, (fn, args) in calls_of(recipe, noise_clip(recipe)).items():
        sides = {name: compiled(fn, args, name == "once") for name in ("plain", "once")}
        seconds = {name: [] for name in sides}
        for _ in range(options.repeats + 1):
            for name, (program, _) in sides.items():
                start = time.perf_counter()
                jax.block_until_ready(program(*args))
                seconds[name].append(time.perf_counter() - start)
        best = {name: min(times[1:]) for name, times in seconds.items()}
        shown = {name: program(*args) for name, (program, _) in sides.items()}
        shown = shown if what == "frame" else {name: out[0] for name, out in shown.items()}
        row = {"what": what, **{f"{name}_s": best[name] for name in best}, "ratio": best["once"] / best["plain"]}
        row |= {f"{name}_compile_s": took for name, (_, took) in sides.items()}
        row["difference"] = difference(shown["plain"], shown["once"])
        print(json.dumps({k: float(f"{v:.3g}") if isinstance(v, float) else v for k, v in row.items()}), flush=True)


if __name__ == "__main__":
    main()
