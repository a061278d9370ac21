"""What the CPU compiler's fused sums cost: seconds and errors with the fusion that zestjax switches off, and without.

    python experiments/benchmarks/fusion.py [--preset small] [--turns 3] [--repeats 3]

The two sides take turns, each turn a process of its own: `XLA_FLAGS` is read once in a process. Seconds are the best of
all turns. Errors are of one side against the same program in float64 on the same side's inputs: of what the frames say
of themselves (median of the relative error of the planes' logits) and of a step's largest gradient.
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
    import jax.numpy as jnp
    import model as stages
    import numpy as np

    from zestjax import batches, learn, novel_view
    from zestjax.backend import sum_error
    from zestjax.cameras import Camera
    from zestjax.model import init_params, volumes
    from zestjax.presets import preset
    from zestjax.video import Video

    config, key = preset(name), jax.random.key
    clip: Any = stages.noise_clip(config)
    params = init_params(key(2), config)
    cameras = Camera(clip.intrinsics, clip.camera_from_world)
    images: Any = clip.images.astype(np.float32) / 255
    video = Video(images, cameras, clip.near, clip.far)
    target = Camera(*(x[3] for x in cameras))
    prepare = lambda: novel_view.prepare(params, video, config=config)
    inputs, frames = novel_view.target_inputs(video.images, cameras, clip.near, clip.far, target, 5, config=config)
    maps = jax.tree.map(lambda x: x[frames], prepare().maps)
    swept = jax.jit(lambda p, i, m: volumes(p, i, m, config=config))
    step = jax.jit(learn.step_gradients(config))
    batch = batches.batch_from_clip(key(1), batches.prepare_clip(key(0), clip, config), config)
    calls = {
        "prepare, s": prepare,
        "volumes, s": lambda: swept(params, inputs, maps),
        "frame, s": lambda: novel_view.render_inputs(params, inputs, maps, config=config),
        "training step, s": lambda: step(params, batch),
    }
    found = {what: stages.timed(call, repeats)["best"] for what, call in calls.items()}
    grads = step(params, batch)[0]
    exact_maps: Any
    exact_maps, (exact_grads, *_) = exact(params, batch, config)
    ours: Any = learn._analysed(params.analysis, batch, config)
    relative = lambda a, b: np.abs(np.asarray(a, np.float64) - b) / np.maximum(np.abs(b), 1e-12)
    found["frames' logits, median error"] = float(np.median(relative(ours.logits, np.asarray(exact_maps.logits))))
    pairs = zip(jax.tree.leaves(grads), jax.tree.leaves(exact_grads), strict=True)
    most = max(pairs, key=lambda pair: float(jnp.abs(pair[1]).max()))
    largest = np.unravel_index(int(jnp.abs(most[1]).argmax()), most[1].shape)
    found["largest gradient, error"] = float(relative(most[0][largest], float(most[1][largest])))
    found["mapped sum of 40,000 rows, error"] = sum_error()
    return found


def exact(params, batch, config):
    """Maps and (gradient, terms, total) of the same step in float64."""
    import dataclasses

    import jax

    from zestjax import learn

    with jax.enable_x64(True):
        wide = dataclasses.replace(config, precision="float64")
        maps = jax.jit(lambda p, b: learn._analysed(p, b, wide))(params.analysis, batch)
        return jax.device_get((maps, jax.jit(learn.step_gradients(wide))(params, batch)))


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
            print(json.dumps({"side": side, "load": os.getloadavg()[0], **found}), file=sys.stderr, flush=True)
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
