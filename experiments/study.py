"""The paper's two tables on zest-bench: every system trained on the same clips for the same minutes, scored on the same
views of scenes that none has seen, and again after some seconds of fine-tuning on each.

    python experiments/study.py --out runs/study [--minutes 10] [--finetune 30] [--size 72x128] [--targets 4,12,20]

Each system's schedule is as long as its minutes on this machine, by a few steps that are timed first (`pace.json`).
Everything goes on where it was when the command is given again. Writes `study.md`, `study.json` and `margins.png`: how
far the first system is ahead of each other one, over scenes, with 95 % intervals. `--learn others` learns from the
bench's other scenes instead, one held out in turn: motion of a kind that was never seen (a training for each scene).
"""

import argparse
import json
from pathlib import Path

import numpy as np

from zestjax.apps.clips import ClipSpec, clip_folder, make_clip
from zestjax.apps.commands import numbers, size
from zestjax.apps.crossval import crossval
from zestjax.apps.crossval_table import interval
from zestjax.apps.log import read_log
from zestjax.apps.progress import progress
from zestjax.apps.results import write_record
from zestjax.apps.train import TrainOptions, train
from zestjax.io.files import write_bytes
from zestjax.simulate.bench import BENCH
from zestjax.train.recipes import SYSTEMS, recipe_of

PAPER = {
    "zest": ((21.59, 0.6239, 0.2048), (26.94, 0.8575, 0.0995)),
    "mvsnerf": ((19.37, 0.6198, 0.2885), (26.94, 0.8678, 0.1208)),
    "svs": ((17.91, 0.4958, 0.3698), (21.28, 0.7103, 0.2001)),
    "nsff": ((13.15, 0.3178, 0.7334), (28.19, 0.9280, 0.0450)),
    "zest-motion": ((20.19, 0.5814, 0.2447), None),
    "zest-geometry": ((17.87, 0.4533, 0.4781), None),
    "zest-none": ((12.67, 0.4142, 0.8277), None),
}
"""PSNR, SSIM, LPIPS as printed: scene-agnostic, then scene-specific. Of other scenes, at another size."""
PACE_STEPS = 12  # timed: enough for the median to leave what warms up behind
STILL = ("still_life",)  # scenes of zest-bench in which nothing moves


def pace(system, options):
    """Seconds of a step of a system on this machine, found once."""
    path = options.out / "pace.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    if system not in known:
        run = learned(system, options.out / "pace" / system, PACE_STEPS, options)
        rows = read_log(run.parent / "log.jsonl")[0]
        known[system] = float(np.median([row["seconds_per_step"] for row in rows]))
        write_record(path, known)
    return known[system]


def render_clips(options):
    """Render the shared clips before anything is timed: two cores serve one thing at a time."""
    planes = {
        getattr(recipe_of(options.preset, system=system).system.frames, "planes", 0) for system in options.systems
    }
    for count in planes:
        spec = ClipSpec(options.seed, *options.size, planes=count)
        folder = clip_folder(spec, root=options.out / "clips")
        for index in progress(range(options.clips), "clips", quiet=options.quiet):
            make_clip(spec, folder, index)


def learned(system, out, steps, options):
    """The weights of a training of so many steps, from the shared clips."""
    height, width = options.size
    return train(TrainOptions(
        out, preset=options.preset, system=system, steps=steps, resume=True, seed=options.seed,
        clips=options.out / "clips", clip_count=options.clips, window=options.clips, steps_per_clip=1,
        settings=(("height", str(height)), ("width", str(width))), quiet=options.quiet,
    )).weights  # fmt: skip


def scored(system, name, options, **choices):
    """The table of a system over the scenes."""
    return crossval(
        options.out / name / system, scenes=[f"bench:{scene}" for scene in options.scenes], systems=(system,),
        preset=options.preset, size=options.size, targets=options.targets, seed=options.seed,
        lpips=options.lpips, quiet=options.quiet, **choices,
    )  # fmt: skip


def measured(system, options):
    """{"steps", "pace", and a table by kind of learning}."""
    steps = options.steps or max(PACE_STEPS, round(60 * options.minutes / pace(system, options)))
    found = {"steps": steps, "pace": pace(system, options)}
    if options.learn == "others":
        return found | {"agnostic": scored(system, "others", options, steps=steps)}
    weights = str(learned(system, options.out / "train" / system, steps, options))
    found["agnostic"] = scored(system, "agnostic", options, weights=weights, steps=0)
    if options.finetune and system in options.tuned:
        tuning = dict(weights=weights, steps=0, finetune=(options.finetune, "s"))
        found["tuned"] = scored(system, "tuned", options, **tuning)
    return found


def line(system, found, kind):
    """A row in Markdown."""
    (row,) = found[kind]["rows"]
    number = lambda one, digits: "–" if one is None or one["mean"] is None else f"{one['mean']:.{digits}f}"
    score = lambda region, metric, digits: number(row[region][metric], digits)
    printed = PAPER[system][0 if kind == "agnostic" else 1]
    there = "–" if printed is None else " / ".join("–" if x is None else f"{x:g}" for x in printed)
    cells = [
        system, *(score("full", m, d) for m, d in (("psnr", 2), ("ssim", 3), ("lpips", 3))),
        score("dynamic", "psnr", 2), score("static", "psnr", 2), number(row["seconds"], 2), f"{found['steps']}",
        f"{found['pace']:.2f}", f"{row['folds']} of {row['of']}", there,
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "system",
    "PSNR",
    "SSIM",
    "LPIPS",
    "dynamic",
    "static",
    "s / frame",
    "steps",
    "s / step",
    "scenes",
    "the paper's",
)


def markdown(results, options):
    """Both tables."""
    shape = "x".join(map(str, options.size))
    budget = f"{options.steps} steps" if options.steps else f"{options.minutes:g} minutes of stepping"
    said = f"{budget} each, `{options.preset}`, {shape}, {len(options.scenes)} scenes"
    kinds = {"agnostic": f"Never seen: {said}", "tuned": f"After {options.finetune} s on each scene"}
    parts = []
    for kind, title in kinds.items():
        rows = [line(system, found, kind) for system, found in results.items() if kind in found]
        if rows:
            parts += [f"{title}.", "\n".join(["| " + " | ".join(HEAD) + " |", "|---" * len(HEAD) + "|", *rows])]
    return "\n\n".join([*parts, *(f"- {text}" for text in said_of(margins(results)))]) + "\n"


def means(table):
    """{scene: {region: PSNR}} of a table of one row."""
    (scenes,) = table["scenes"].values()
    return {name: {region: (found[0].get(region) or {}).get("psnr") for region in ("full", "dynamic", "static")}
            for name, found in scenes.items()}  # fmt: skip


def margins(results):
    """{pair: {region: interval over scenes of the first system's PSNR less the other's}}, still scenes apart."""
    first, *others = results
    ours, found = means(results[first]["agnostic"]), {}
    for other in others:
        theirs = means(results[other]["agnostic"])
        shared = [scene for scene in ours if scene in theirs]
        pair = lambda scene, region, theirs=theirs: (ours[scene][region], theirs[scene][region])
        less = lambda scene, region, pair=pair: None if None in (p := pair(scene, region)) else p[0] - p[1]
        over = lambda scenes, region, less=less: interval([less(scene, region) for scene in scenes])
        moving = [scene for scene in shared if scene not in STILL]
        found[f"{first} - {other}"] = {
            "full": over(moving, "full"), "dynamic": over(moving, "dynamic"), "static": over(moving, "static"),
            "still scenes": over([scene for scene in shared if scene in STILL], "full"),
        }  # fmt: skip
    return found


def said_of(found):
    """Margins as sentences."""
    for name, regions in found.items():
        told = [f"{region} {shown(one)}" for region, one in regions.items() if one is not None]
        yield f"{name}, dB: {', '.join(told)}"


def shown(one):
    """`+3.10 (+2.00 to +4.20)`."""
    bounds = "" if one["low"] is None else f" ({one['low']:+.2f} to {one['high']:+.2f})"
    return f"{one['mean']:+.2f}{bounds}"


def draw(path, found):
    """The margins as a figure."""
    from matplotlib.figure import Figure

    from zestjax.io.figures import png_of

    figure = Figure(figsize=(7, 0.5 * len(found) + 1.5), layout="constrained")
    axes = figure.subplots()
    for offset, region in ((0.2, "full"), (0.0, "dynamic"), (-0.2, "static")):
        rows = [(i + offset, one[region]) for i, one in enumerate(found.values()) if one[region]]
        middles = [one["mean"] for _, one in rows]
        half = [0 if one["low"] is None else one["mean"] - one["low"] for _, one in rows]
        axes.errorbar(middles, [y for y, _ in rows], xerr=half, fmt="o", capsize=3, label=region)
    axes.axvline(0, color="0.6", linewidth=1)
    axes.set_yticks(range(len(found)), list(found))
    axes.set_xlabel("dB ahead, mean over the dynamic scenes, 95 % interval")
    axes.legend()
    write_bytes(path, png_of(figure))


def study(options):
    """Run it, or go on; {system: see `measured`}."""
    results = {}
    if options.learn == "simulated":
        render_clips(options)
    for system in options.systems:
        results[system] = measured(system, options)
        text = markdown(results, options)
        write_bytes(options.out / "study.md", text.encode())
        print(text, flush=True)
    found = margins(results)
    told = {
        "minutes": options.minutes,
        "steps": options.steps,
        "size": options.size,
        "margins": found,
        "systems": results,
    }
    write_record(options.out / "study.json", told)
    if found:
        draw(options.out / "margins.png", found)
    return results


def parsed(arguments=None):
    """The command's options."""
    parser = argparse.ArgumentParser(description="The paper's tables on zest-bench, at equal minutes.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--systems", nargs="+", default=list(PAPER), choices=SYSTEMS, help="the first is compared")
    parser.add_argument("--scenes", nargs="+", default=list(BENCH), choices=BENCH)
    parser.add_argument("--preset", default="small")
    parser.add_argument("--minutes", type=float, default=10.0, help="of stepping, each system")
    parser.add_argument("--steps", type=int, help="of each system, in place of equal minutes")
    parser.add_argument("--finetune", type=int, default=30, help="seconds on each scene; 0: no second table")
    parser.add_argument("--tuned", nargs="+", default=["zest", "mvsnerf", "svs", "nsff"], choices=SYSTEMS)
    parser.add_argument("--learn", choices=("simulated", "others"), default="simulated")
    parser.add_argument("--clips", type=int, default=64, help="simulated, shared by all systems")
    parser.add_argument("--size", type=size, default=(72, 128), help="HxW, of clips and pictures")
    parser.add_argument("--targets", type=numbers, default=(4, 12, 20))
    parser.add_argument("--lpips", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quiet", action="store_true")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    study(parsed())
