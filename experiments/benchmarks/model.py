"""Seconds, memory and share of the machine's matmul peak of a training step and of a rendered view; a JSON line each.

    python experiments/benchmarks/model.py [--preset small] [--system zest] [--repeats 5] [--rows 8]

The clip is noise seen by cameras on a line: arithmetic does not depend on what is seen. `--rows` renders only that many
rows of a view (0: all of it). Compile seconds are apart; peak memory is the process's. XLA counts the operations of a
loop's body once: of a program in blocks of rays they, and the share of the peak, are too low.
"""

import argparse
import json
import os
import time

import jax
import jax.numpy as jnp
import numpy as np

from zestjax import novel_view
from zestjax.apps.memory import peak_megabytes, reset_peak
from zestjax.cameras import Camera
from zestjax.simulate.clips import Clip
from zestjax.systems.targets import target_inputs
from zestjax.train import batches
from zestjax.train.recipes import RECIPES, SYSTEMS, recipe_of
from zestjax.video import Video


def noise_clip(recipe, frames=12, targets=2):
    """A `Clip` of noise from cameras 0.1 apart, depths between 2 and 8."""
    draw, size = np.random.default_rng(0), (recipe.height, recipe.width)
    times = np.arange(targets, dtype=np.int32) + 4
    image = lambda n: draw.integers(0, 256, (n, *size, 3), np.uint8)
    depth = lambda n: draw.uniform(2, 8, (n, *size)).astype(np.float32)
    mask = lambda n: draw.uniform(size=(n, *size)) > 0.9

    def cameras(n):
        intrinsics = np.array([[size[1], 0, size[1] / 2], [0, size[1], size[0] / 2], [0, 0, 1]], np.float32)
        poses = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
        poses[:, 0, 3] = 0.1 * np.arange(n)
        return np.tile(intrinsics, (n, 1, 1)), poses

    (k, e), (tk, te) = cameras(frames), cameras(targets)
    flow = np.zeros((targets, 2, *size, 3), np.float16)
    return Clip(
        image(frames), depth(frames), mask(frames), k, e, np.float32(2), np.float32(8), image(targets), depth(targets),
        mask(targets), flow, image(targets), depth(targets), ~mask(targets), tk, te, times,
    )  # fmt: skip


def matmul_peak():
    """Multiply-add operations per second of a large float32 product, best of five."""
    n = 2048
    product, x = jax.jit(jnp.dot), jnp.ones((n, n))
    times = []
    for _ in range(6):
        start = time.perf_counter()
        product(x, x).block_until_ready()
        times.append(time.perf_counter() - start)
    return 2 * n**3 / min(times[1:])


def timed(run, repeats):
    """Best and median seconds of a call, after two that do not count."""
    times = []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    counted = sorted(times[2:] or times[-1:])
    return {"best": counted[0], "median": counted[len(counted) // 2]}


def flops(compiled):
    """Operations that the compiled program states, or None."""
    return (compiled.cost_analysis() or {}).get("flops")


def measure_step(recipe, clip, repeats):
    """One training step of a recipe."""
    init, step = recipe.trainer(steps=1000)
    prepared = batches.prepare_clip(jax.random.key(0), clip, recipe.system)
    batch = batches.batch_from_clip(jax.random.key(1), prepared, recipe)
    params = recipe.init(jax.random.key(2))
    state = [params, init(params)]
    start = time.perf_counter()
    compiled = jax.jit(step, donate_argnums=(0, 1)).lower(*state, batch).compile()
    seconds = time.perf_counter() - start

    def run():
        *state[:], terms = compiled(*state, batch)
        return terms

    return {"compile": seconds, **timed(run, repeats), "flops": flops(compiled), "temp_mb": temporary(compiled)}


def inputs_and_maps(params, clip, system):
    """(`Inputs`, `FrameMaps` or None) of a view of a clip, from its frame 3's camera at time 5."""
    camera = Camera(clip.intrinsics, clip.camera_from_world)
    video = Video(clip.images.astype(np.float32) / 255, camera, clip.near, clip.far)
    prepared = novel_view.prepare(params, video, system=system)
    inputs, frames = target_inputs(
        video.images, camera, clip.near, clip.far, Camera(*(x[3] for x in camera)), 5, system=system
    )
    return inputs, None if prepared.maps is None else jax.tree.map(lambda x: x[frames], prepared.maps)


def measure_view(system, clip, repeats, rows):
    """One view, or its first rows."""
    params = system.init(jax.random.key(2))
    inputs, maps = inputs_and_maps(params, clip, system)
    start = time.perf_counter()
    compiled = novel_view.render_inputs.lower(params, inputs, maps, system=system, rows=rows or None).compile()
    seconds = time.perf_counter() - start
    run = lambda: compiled(params, inputs, maps)
    return {"compile": seconds, **timed(run, repeats), "flops": flops(compiled), "temp_mb": temporary(compiled)}


def temporary(compiled):
    """MB of temporaries that the compiled program states."""
    return compiled.memory_analysis().temp_size_in_bytes / 1e6


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Times a training step and a rendered view.")
    parser.add_argument("--preset", default="small", choices=tuple(RECIPES))
    parser.add_argument("--system", default="zest", choices=SYSTEMS)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--rows", type=int, default=0)
    options = parser.parse_args()
    recipe, peak = recipe_of(options.preset, system=options.system), matmul_peak()
    recipe = recipe.of(recipe.system)
    clip = noise_clip(recipe)
    stages = {
        "training step": lambda: measure_step(recipe, clip, options.repeats),
        f"view, {options.rows or 'all'} rows": lambda: measure_view(recipe.system, clip, options.repeats, options.rows),
    }
    for name, stage in stages.items():
        reset_peak()
        row = {"preset": options.preset, "system": options.system, "what": name, **stage(), "peak_mb": peak_megabytes()}
        if row["flops"]:
            row["share_of_matmul_peak"] = row["flops"] / row["best"] / peak
        row |= {"matmul_gflops": peak / 1e9, "load": os.getloadavg()[0], "device": jax.devices()[0].device_kind}
        print(json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}), flush=True)


if __name__ == "__main__":
    main()
