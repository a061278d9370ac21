"""The paper's ablation: the same model with both volumes, with either, with neither, under equal training budgets.

    python experiments/ablation.py --out runs/ablation [--preset tiny] [--steps 2000] [--targets 6,14]

Every system sees the same clips in the same order for as many steps, then predicts the same held-out views of
zest-bench.
Writes `ablation.md` and `ablation.json`; a finished system is not trained again.
"""

import argparse
import json
from pathlib import Path

from zestjax.apps.evaluate import EvaluateOptions, evaluate
from zestjax.apps.train import TrainOptions, train
from zestjax.io.files import write_bytes
from zestjax.io.weights import read_metadata
from zestjax.systems.presets import ABLATED
from zestjax.train.recipes import RECIPES

PAPER = {"zest": 21.59, "zest-motion": 20.19, "zest-geometry": 17.87, "zest-none": 12.67}
COLUMNS = ("system", "full PSNR / SSIM", "dynamic", "static", "s / frame", "steps", "s training", "the paper's PSNR")


def measured(system, options):
    """Train and evaluate one system; its row of the table."""
    out = options.out / system
    weights = out / "weights.safetensors"
    if not weights.exists() or read_metadata(weights)["step"] < options.steps:
        train(TrainOptions(
            out=out, preset=options.preset, steps=options.steps, resume=True, seed=options.seed, system=system,
            clips=options.out / "clips", clip_count=options.clips, window=min(64, options.clips),
            steps_per_clip=max(1, options.steps // options.clips),
        ))  # fmt: skip
    height = RECIPES[options.preset].height
    evaluate(EvaluateOptions(
        "bench:all", out / "bench", weights, size=(height, 16 * height // 9), targets=options.targets,
    ))  # fmt: skip
    mean = json.loads((out / "bench" / "metrics.json").read_text())["mean"]
    run = read_metadata(weights)
    return {"system": system, "steps": run["step"], "seconds": run["seconds"], "mean": mean, "paper": PAPER[system]}


def head():
    """The first two lines of the table."""
    return "| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"


def line(row):
    """A row in Markdown."""
    mean = row["mean"]
    psnr = lambda region: f"{mean[region]['psnr']:.2f}"
    cells = [
        row["system"], f"{psnr('full')} / {mean['full']['ssim']:.3f}", psnr("dynamic"), psnr("static"),
        f"{mean['seconds_per_frame']:.2f}", row["steps"], f"{row['seconds']:.0f}", row["paper"],
    ]  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


def main():
    """Run the ablation."""
    parser = argparse.ArgumentParser(description="Geometry and motion volumes, each or both or neither.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", default="tiny", choices=tuple(RECIPES))
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--clips", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--targets", type=lambda text: tuple(map(int, text.split(","))), default=(6, 14))
    options = parser.parse_args()
    rows = []
    for system in sorted(ABLATED, key=lambda name: -PAPER[name]):
        rows.append(measured(system, options))
        write_bytes(options.out / "ablation.json", (json.dumps(rows, indent=1) + "\n").encode())
        write_bytes(options.out / "ablation.md", "\n".join([*head(), *map(line, rows), ""]).encode())
        print(line(rows[-1]), flush=True)


if __name__ == "__main__":
    main()
