"""What a precision costs and what it gives up: the shipped weights at float32, bfloat16 networks, and float64.

    python experiments/precision.py --out runs/precision [--scenes walker,dusk,still_life] [--times 6,14]

Every precision renders the same held-out views of zest-bench and takes the gradient of the same training step. Beside
the scores against the truth stand the differences from float64: of colours and depths, and of the gradient as a whole.
Writes `precision.md` and `precision.json`.
"""

import argparse
import time
from pathlib import Path

import jax
import numpy as np

from zestjax.apps.evaluate import Renderer, device_name
from zestjax.apps.results import write_record
from zestjax.apps.scenes import open_scene
from zestjax.apps.scoring import mean_scores, score_image
from zestjax.apps.weights import arithmetic, at_precision, open_weights
from zestjax.base.precision import PRECISIONS
from zestjax.io.files import write_bytes
from zestjax.simulate.clips import training_clip
from zestjax.train import batches

COLUMNS = (
    "precision", "full PSNR", "dynamic", "static", "colour from float64's", "depth from float64's",
    "gradient from float64's", "s / frame", "s / step", "s compile",
)  # fmt: skip


def views(model, options):
    """Scores, colours and depths of all targets, and the seconds of each."""
    scores, colours, depths, seconds, compiling = [], [], [], [], []
    for name in options.scenes:
        scene = open_scene(f"bench:{name}", model.recipe, targets=options.times).scene
        view_of = Renderer(model, scene.video, steady=True)
        for target in scene.targets:
            view, took = view_of(target.camera, target.time)
            scores.append(score_image(view.colour, target.image, target.dynamic))
            colours.append(np.asarray(view.colour, np.float64))
            depths.append(np.asarray(view.depth, np.float64))
            seconds.append(took)
        compiling.append(view_of.compile_seconds)
    return mean_scores(scores), np.stack(colours), np.stack(depths), float(np.median(seconds)), compiling[0]


def gradient(model, batch):
    """The gradient of a training step as one float64 vector, and the seconds it takes."""
    step = jax.jit(jax.grad(model.recipe.objective(), has_aux=True))
    run = lambda: jax.block_until_ready(step(model.params, batch)[0])
    for _ in range(2):
        run()
    start = time.perf_counter()
    grads = run()
    seconds = time.perf_counter() - start
    return np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(grads)]), seconds


def measured(options):
    """One row a precision; float64, the exact one, is last."""
    model, rows, kept = open_weights(), [], []
    recipe = model.recipe
    clip = training_clip(jax.random.key(options.seed), height=recipe.height, width=recipe.width)
    prepared = batches.prepare_clip(jax.random.key(1), clip, recipe.system)
    batch = batches.batch_from_clip(jax.random.key(0), prepared, recipe)
    for precision in PRECISIONS:
        chosen = at_precision(model, precision)
        with arithmetic(precision):
            mean, colours, depths, frame, compiling = views(chosen, options)
            grads, step = gradient(chosen, batch)
        kept.append((colours, depths, grads))
        rows.append({"precision": precision, "mean": mean, "seconds_per_frame": frame, "seconds_per_step": step,
                     "compile_seconds": compiling})  # fmt: skip
        print(f"{precision}: {frame:.2f} s a frame, {step:.2f} s a step", flush=True)
    exact = kept[-1]
    for row, (colours, depths, grads) in zip(rows, kept, strict=True):
        row["colour_rms"] = float(np.sqrt(np.mean((colours - exact[0]) ** 2)))
        row["depth_median_relative"] = float(np.median(np.abs(depths - exact[1]) / exact[1]))
        row["gradient_relative"] = float(np.linalg.norm(grads - exact[2]) / np.linalg.norm(exact[2]))
    return rows


def line(row):
    """A row in Markdown."""
    psnr = lambda region: f"{row['mean'][region]['psnr']:.2f}"
    cells = [
        row["precision"], psnr("full"), psnr("dynamic"), psnr("static"), f"{row['colour_rms']:.1e}",
        f"{row['depth_median_relative']:.1e}", f"{row['gradient_relative']:.1e}", f"{row['seconds_per_frame']:.2f}",
        f"{row['seconds_per_step']:.2f}", f"{row['compile_seconds']:.0f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main():
    """Run the comparison."""
    names = lambda text: tuple(text.split(","))
    parser = argparse.ArgumentParser(description="Accuracy and time of each precision, on the same weights.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", type=names, default=("walker", "dusk", "still_life"))
    parser.add_argument("--times", type=lambda text: tuple(map(int, text.split(","))), default=(6, 14))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = measured(options)
    report = {"device": device_name(), "scenes": options.scenes, "times": options.times, "rows": rows}
    write_record(options.out / "precision.json", report)
    table = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|", *map(line, rows)]
    write_bytes(options.out / "precision.md", ("\n".join(table) + "\n").encode())
    print(*table, sep="\n")


if __name__ == "__main__":
    main()
