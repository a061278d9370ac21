"""Seconds of a training step of one process on all cores, and of two that share it, each on half of them; a JSON line
each.

    python experiments/benchmarks/mesh.py [--preset tiny] [--system zest] [--repeats 20] [--clips 1 2]

With one clip a step its rays are shared, with two each process has one. The processes talk over the loopback address.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import time

import jax
from model import noise_clip, timed

from zestjax.train.batches import batch_from_clip, prepare_clip, step_batches
from zestjax.train.mesh import mesh_of, mesh_trainer
from zestjax.train.recipes import RECIPES, SYSTEMS, recipe_of
from zestjax.train.settings import with_setting

PATIENCE = 1800  # seconds: `paper` compiles for minutes


def measure(options, clips):
    """One process's row, of all processes' step."""
    recipe = recipe_of(options.preset, system=options.system)
    recipe = with_setting(recipe.of(recipe.system), "clips", str(clips))
    prepared = prepare_clip(jax.random.key(0), noise_clip(recipe), recipe.system)
    one = lambda step, clip: batch_from_clip(jax.random.key(clip + 1), prepared, recipe)
    batch = step_batches(one, clips)(0)
    if jax.process_count() > 1:
        init, step = mesh_trainer(recipe, mesh_of(recipe, jax.devices()), steps=1000)
    else:
        init, step = recipe.trainer(steps=1000)
        step = jax.jit(step, donate_argnums=(0, 1))
    params = recipe.init(jax.random.key(2))
    state = [params, init(params)]

    def run():
        *state[:], terms = step(*state, batch)
        return terms

    start = time.perf_counter()
    jax.block_until_ready(run())
    compiled = time.perf_counter() - start
    return {
        "preset": options.preset, "system": options.system, "clips": clips, "processes": jax.process_count(),
        "cores_each": int(os.environ["PJRT_NPROC"]), "first": compiled, **timed(run, options.repeats),
        "load": os.getloadavg()[0], "device": jax.devices()[0].device_kind,
    }  # fmt: skip


def spawned(count):
    """This command in so many processes that share the cores; they print."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    cores = str(max(1, len(os.sched_getaffinity(0)) // count))
    environment = os.environ | {"PJRT_NPROC": cores, "OMP_NUM_THREADS": cores}
    command = [sys.executable, *sys.argv, "--at"]
    running = [subprocess.Popen([*command, f"{port},{count},{index}"], env=environment) for index in range(count)]
    try:
        for process in running:
            process.wait(PATIENCE)
    finally:
        for process in running:
            process.kill()
    if failed := [process.returncode for process in running if process.returncode]:
        raise SystemExit(f"mesh: {len(failed)} of {count} processes failed; their last lines say why.")


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Times a training step that processes share.")
    parser.add_argument("--preset", default="tiny", choices=tuple(RECIPES))
    parser.add_argument("--system", default="zest", choices=SYSTEMS)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--clips", type=int, nargs="+", default=(1, 2))
    parser.add_argument("--at", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.at is None:
        for count in (1, 2):
            spawned(count)
        return
    port, count, index = map(int, options.at.split(","))
    if count > 1:
        jax.distributed.initialize(f"127.0.0.1:{port}", count, index)
    for clips in options.clips:
        row = measure(options, clips)
        if index == 0:
            print(json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}), flush=True)


if __name__ == "__main__":
    main()
