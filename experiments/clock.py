"""PSNR against seconds on the clock, on one scene: what is known before it is seen, adapted to it, or learned from it.

    python experiments/clock.py --out runs/clock [--scene walker] [--size 72x128] [--seconds 15,30,60,120]

zero-shot     the shipped weights as they are
fine-tuned    the same, adapted to the scene's own frames for so many seconds
from scratch  the same system, from nothing, by the scene's own frames
nsff          both fields without volumes: the scene learned by heart

Seconds are of stepping; compiling stands beside them. Each goes on where it was when more seconds are asked for. Writes
`clock.json` and `clock.png`.
"""

import argparse
import json
from pathlib import Path

from zestjax.apps.commands import numbers, size
from zestjax.apps.evaluate import EvaluateOptions, evaluate
from zestjax.apps.finetune import FinetuneOptions, finetune
from zestjax.apps.results import write_record
from zestjax.apps.simulate import SimulateOptions, simulate
from zestjax.apps.train import TrainOptions, train
from zestjax.io.figures import png_of
from zestjax.io.files import write_bytes
from zestjax.simulate.bench import BENCH

FOREVER = 100_000  # steps of a schedule: the seconds end every run


def scored(weights, out, options):
    """Scores of weights on the scene's held-out targets, `mean` of metrics.json."""
    evaluate(EvaluateOptions(
        scene=str(options.out / "scene"), out=out, weights=weights, size=options.size, targets=options.targets,
        pictures=False, quiet=options.quiet,
    ))  # fmt: skip
    return json.loads((out / "metrics.json").read_text())["mean"]


def adapted(out, seconds, options):
    """The summary of fine-tuning for so many seconds in all."""
    begun = (out / "checkpoints").exists()
    return finetune(FinetuneOptions(
        scene=str(options.out / "scene"), out=out, budget=seconds, size=options.size, resume=begun,
        seed=options.seed, quiet=options.quiet,
    ))  # fmt: skip


def learned(system, out, seconds, options):
    """The summary of training a system on the scene's own frames for so many seconds in all."""
    height, width = options.size
    return train(TrainOptions(
        out, system=system, steps=FOREVER, minutes=seconds / 60, resume=True, seed=options.seed,
        scenes=(str(options.out / "scene"),), settings=(("height", str(height)), ("width", str(width))),
        quiet=options.quiet,
    ))  # fmt: skip


def curves(options):
    """{name: [{"seconds", "compile_seconds", and scores by region}]}."""
    runs = {
        "fine-tuned": lambda seconds: adapted(options.out / "tuned", seconds, options),
        "from scratch": lambda seconds: learned("zest", options.out / "scratch", seconds, options),
        "nsff": lambda seconds: learned("nsff", options.out / "nsff", seconds, options),
    }
    if not (options.out / "scene").exists():
        simulate(
            SimulateOptions(scene=options.scene, out=options.out / "scene", size=options.size, quiet=options.quiet)
        )
    start = {"seconds": 0.0, "compile_seconds": 0.0, **scored(None, options.out / "zero-shot", options)}
    found = {"zero-shot": [start]}
    for name, run in runs.items():
        found[name] = []
        for seconds in options.seconds:
            summary = run(seconds)
            told = {"seconds": summary.result.seconds, "compile_seconds": summary.result.compile_seconds}
            scores = scored(summary.weights, options.out / "scores" / name / str(seconds), options)
            found[name].append(told | scores)
            write_record(options.out / "clock.json", {"scene": options.scene, "size": options.size, "curves": found})
    return found


def draw(path, found, title):
    """The figure: one line a way to get there, zero-shot level all along."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    for axes, region in zip(figure.subplots(1, 2), ("full", "dynamic"), strict=True):
        for name, rows in found.items():
            known = [row for row in rows if row[region]]
            places = [row["seconds"] for row in known], [row[region]["psnr"] for row in known]
            if name == "zero-shot" and known:
                axes.axhline(places[1][0], color="C0", label=name)
            else:
                axes.plot(*places, "o-", label=name)
        axes.set(xlabel="seconds of stepping on the scene", ylabel=f"PSNR, {region} (dB)", xscale="log", title=title)
    figure.axes[0].legend()
    write_bytes(path, png_of(figure))


def parsed(arguments=None):
    """The command's options."""
    parser = argparse.ArgumentParser(description="PSNR against seconds on one scene.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", default="walker", choices=BENCH)
    parser.add_argument("--size", type=size, default=(72, 128), help="HxW")
    parser.add_argument("--seconds", type=numbers, default=(15, 30, 60, 120), help="of stepping, rising")
    parser.add_argument("--targets", type=numbers, default=(4, 12, 20))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quiet", action="store_true")
    return parser.parse_args(arguments)


def main(options):
    """Run it, or go on; the curves."""
    found = curves(options)
    draw(options.out / "clock.png", found, options.scene)
    for name, rows in found.items():
        for row in rows:
            dynamic = "–" if row["dynamic"] is None else f"{row['dynamic']['psnr']:.2f}"
            print(
                f"{name}: {row['seconds']:.0f} s: {row['full']['psnr']:.2f} / {dynamic} dB full / dynamic", flush=True
            )
    return found


if __name__ == "__main__":
    main(parsed())
