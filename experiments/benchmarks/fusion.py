"""What the CPU compiler's fused sums cost: seconds and errors with the fusion that zestjax switches off, and without.

    python experiments/benchmarks/fusion.py [--preset small] [--turns 3] [--repeats 3]

The two sides take turns, each turn a process of its own: `XLA_FLAGS` is read once in a process. Seconds are the best of
all turns. Errors are against float64: of what the shipped weights find in the frames, and of the sum that goes wrong.
"""

import argparse
import json
import os
import subprocess
import sys
import warnings
from typing import Any

SIDES = {"off, as zestjax has it": False, "on, JAX's default": True}


def measure(name, repeats, fused):
    """{what: number} of one side, in this process."""
    if fused:
        import jax

        jax.devices()  # JAX runs: zestjax comes too late to switch anything off, and says so
        warnings.simplefilter("ignore")
    import jax
    import model as stages
    import numpy as np

    from zestjax import novel_view
    from zestjax.apps.weights import open_weights
    from zestjax.base.backend import sum_error
    from zestjax.cameras import Camera
    from zestjax.systems.targets import target_inputs
    from zestjax.train import batches
    from zestjax.train.recipes import RECIPES
    from zestjax.video import Video

    recipe, key = RECIPES[name], jax.random.key
    system: Any = recipe.system
    clip: Any = stages.noise_clip(recipe)
    params = open_weights().params if name == "small" else system.init(key(2))
    cameras = Camera(clip.intrinsics, clip.camera_from_world)
    images: Any = clip.images.astype(np.float32) / 255
    video = Video(images, cameras, clip.near, clip.far)
    target = Camera(*(x[3] for x in cameras))
    prepare = lambda: novel_view.prepare(params, video, system=system)
    inputs, frames = target_inputs(video.images, cameras, clip.near, clip.far, target, 5, system=system)
    maps = jax.tree.map(lambda x: x[frames], prepare().maps)
    encode = jax.jit(system.encode)
    step = jax.jit(jax.value_and_grad(recipe.objective(), has_aux=True))
    batch = batches.batch_from_clip(key(1), batches.prepare_clip(key(0), clip, system), recipe)
    calls = {
        "prepare, s": prepare,
        "volumes, s": lambda: encode(params, inputs, maps),
        "frame, s": lambda: novel_view.render_inputs(params, inputs, maps, system=system),
        "training step, s": lambda: step(params, batch),
    }
    found = {what: stages.timed(call, repeats)["best"] for what, call in calls.items()}
    wide = lambda x: np.asarray(x, np.float64)
    ours, theirs = (wide(found_at(params, batch, system, precision)) for precision in ("float32", "float64"))
    found["frames' logits, median error"] = float(np.median(np.abs(ours - theirs)) / np.sqrt(np.mean(theirs**2)))
    found["mapped sum of 40,000 rows, error"] = sum_error()
    return found


def found_at(params, batch, system, precision):
    """The planes' logits of the frames' own analysis at a precision."""
    import jax

    from zestjax.base.precision import geometry_at, network_at
    from zestjax.frames.assembly import dequantised

    def logits(params, evidence):
        return system.frames(network_at(precision, params), geometry_at(precision, dequantised(evidence))).logits

    with jax.enable_x64(precision == "float64"):
        return jax.device_get(jax.jit(logits)(params.analysis, batch.evidence))


def main():
    """Both sides in turns; a JSON line a turn, then the table."""
    parser = argparse.ArgumentParser(description="Times a scene and a step with and without the fused sums.")
    parser.add_argument("--preset", default="small")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--side", choices=SIDES, help="measure one side, in this process")
    options = parser.parse_args()
    if options.side:
        print(json.dumps(measure(options.preset, options.repeats, SIDES[options.side])))
        return
    rows: dict[str, dict] = {}
    for _ in range(options.turns):
        for side in SIDES:
            found = turn(options, side)
            print(json.dumps({"side": side, "load": os.getloadavg()[0], **found}), flush=True)
            rows[side] = {what: min(value, rows.setdefault(side, found)[what]) for what, value in found.items()}
    off, on = rows.values()
    print(f"| what | {' | '.join(rows)} | off / on |\n|---|---|---|---|")
    for what in off:
        print(f"| {what} | {off[what]:.3g} | {on[what]:.3g} | {off[what] / on[what]:.2g} |")


def turn(options, side):
    """What one side measures in a process of its own."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    flags = ["--preset", options.preset, "--repeats", str(options.repeats), "--side", side]
    ran = subprocess.run([sys.executable, __file__, *flags], env=environment, capture_output=True, text=True)
    if ran.returncode:
        raise SystemExit(f"error: the side `{side}` failed:\n{ran.stderr}")
    return json.loads(ran.stdout.splitlines()[-1])


if __name__ == "__main__":
    main()
