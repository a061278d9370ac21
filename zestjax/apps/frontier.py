"""`zestjax frontier`: what each setting costs and gives on one scene, with one set of weights.

The settings vary samples per ray, depth planes, source views and resolution: one at a time, then together. A setting is
on the frontier when no other is both faster and better.
"""

import csv
import dataclasses
import io
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.apps.evaluate import Renderer
from zestjax.apps.memory import peak_megabytes, reset_peak
from zestjax.apps.progress import progress
from zestjax.apps.render import scaled_video
from zestjax.apps.scenes import open_scene
from zestjax.apps.scoring import mean_scores, score_image
from zestjax.apps.weights import arithmetic, open_weights
from zestjax.cameras import resized
from zestjax.io.figures import png_of
from zestjax.io.files import write_bytes
from zestjax.io.pictures import resize_area
from zestjax.systems.sampling import Even
from zestjax.systems.system import System

COLUMNS = ("setting", "psnr_full", "psnr_dynamic", "ssim_full", "seconds_per_frame", "peak_mb", "pareto")


class Setting(NamedTuple):
    """name: str. system: `System` to render with. scale: of the resolution."""

    name: str
    system: System
    scale: float = 1.0


@dataclasses.dataclass(frozen=True)
class FrontierOptions:
    """The flags of `zestjax frontier`; see the command's help. targets: times, four of zest-bench unless told."""

    scene: str
    out: Path
    weights: Path | None = None
    system: str | None = None
    size: tuple | None = None
    targets: tuple | None = None
    format: str | None = None
    seed: int = 0
    quiet: bool = False


def settings_of(system):
    """The settings tried with weights of a system; the first is its own."""
    frames, planes, sampler = system.static.frames, system.space.planes, system.sampler
    swept = lambda n: replace(system, space=replace(system.space, planes=n))
    looking = lambda n: replace(system, static=replace(system.static, frames=replace(frames, count=n)))
    evenly = lambda n: replace(system, sampler=Even(n, "plane"))
    tried = [Setting("as trained", system)]
    head = getattr(system.static, "head", None)
    if head is not None and head.looks:  # a head that looks at each view takes any number of them
        views = frames.count
        tried += [Setting(f"{n} views", looking(n)) for n in (views * 3 // 2, views // 2, views // 4)]
    tried += [Setting(f"{n} planes", swept(n)) for n in (planes * 3 // 2, planes // 2)]
    if sampler.guided:
        tried += [Setting(f"{n} regular samples", evenly(n)) for n in (planes // 2, planes, 2 * planes)]
    else:
        fewer = (max(1, sampler.samples // 2), max(1, sampler.samples // 4))
        tried += [Setting(f"{n} samples", replace(system, sampler=replace(sampler, samples=n))) for n in fewer]
    tried += [Setting(f"{scale} of the size", system, scale) for scale in (0.75, 0.5)]
    return [*tried, Setting(f"{planes // 2} planes, 0.75 of the size", swept(planes // 2), 0.75)]


@arithmetic()
def frontier(options):
    """Run `zestjax frontier`.

    Returns:
      str, the summary line.

    Raises:
      ValueError, WeightsError: a scene or weights that cannot be used.
    """
    model, out = open_weights(options.weights, system=options.system), Path(options.out)
    opened = open_scene(options.scene, model.recipe, size=options.size, protocol="held-out", layout=options.format,
                        targets=options.targets or default_times(options))  # fmt: skip
    scene, rows = opened.scene, []
    for setting in progress(settings_of(model.system), "frontier", quiet=options.quiet):
        rows.append({"setting": setting.name, **measure(model, scene, setting)})
        write_rows(out, mark_pareto(rows))
    draw(out / "frontier.png", rows, scene.name)
    best, own = max(rows, key=lambda row: row["psnr_full"]), rows[0]
    good = [row for row in rows if row["psnr_full"] >= best["psnr_full"] - 0.1]
    fast = min(good, key=lambda row: row["seconds_per_frame"])
    return (
        f"frontier: on {scene.name} `{fast['setting']}` reaches {fast['psnr_full']:.2f} dB in "
        f"{fast['seconds_per_frame']:.2f} s a frame, within 0.1 dB of the best; as trained "
        f"{own['psnr_full']:.2f} dB in {own['seconds_per_frame']:.2f} s: {out / 'frontier.csv'}"
    )


def default_times(options):
    """Four times spread over a scene of zest-bench; all there are of a folder."""
    return (3, 9, 14, 20) if str(options.scene).startswith("bench:") else None


def measure(model, scene, setting):
    """A setting's row but for its name: mean scores, median seconds and the peak memory of the process meanwhile."""
    reset_peak()
    size = scene.video.images.shape[1:3]
    video = scaled_video(scene.video, setting.scale)
    factors = [new / old for new, old in zip(video.images.shape[1:3], size, strict=True)]
    view_of = Renderer(model, video, steady=True, system=setting.system)
    scores, seconds = [], []
    for target in scene.targets:
        view, spent = view_of(resized(target.camera, factors[1], factors[0]), target.time, target.exclude)
        image = resize_area(np.clip(np.asarray(view.colour, np.float32), 0, 1), *size)
        scores.append(score_image(image, target.image, target.dynamic))
        seconds.append(spent)
    mean = mean_scores(scores)
    dynamic = mean["dynamic"]["psnr"] if mean["dynamic"] else None
    return {
        "psnr_full": mean["full"]["psnr"], "psnr_dynamic": dynamic, "ssim_full": mean["full"]["ssim"],
        "seconds_per_frame": float(np.median(seconds)), "peak_mb": peak_megabytes(),
    }  # fmt: skip


def mark_pareto(rows):
    """The rows with `pareto` 1 where no other row is at least as fast and as good, and better in one; else 0."""
    cost = lambda row: (row["seconds_per_frame"], -row["psnr_full"])
    beats = lambda a, b: all(x <= y for x, y in zip(cost(a), cost(b), strict=True)) and cost(a) != cost(b)
    for row in rows:
        row["pareto"] = int(not any(beats(other, row) for other in rows))
    return rows


def write_rows(out, rows):
    """Write `frontier.csv`."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    shown = lambda value: "" if value is None else round(value, 4) if isinstance(value, float) else value
    writer.writerows({name: shown(row[name]) for name in COLUMNS} for row in rows)
    write_bytes(out / "frontier.csv", text.getvalue().encode())


def draw(path, rows, title):
    """Write the plot: seconds against PSNR, the frontier joined and its settings named."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    best = sorted((row for row in rows if row["pareto"]), key=lambda row: row["seconds_per_frame"])
    axes.plot(*np.array([(r["seconds_per_frame"], r["psnr_full"]) for r in best]).T, "o-", color="C0", label="frontier")
    for row in rows:
        place = (row["seconds_per_frame"], row["psnr_full"])
        axes.plot(*place, "o", color="C0" if row["pareto"] else "0.7", zorder=0)
        axes.annotate(row["setting"], place, xytext=(4, -9), textcoords="offset points", fontsize=7)
    axes.set(xlabel="seconds per frame", ylabel="PSNR, full image (dB)", title=title, xscale="log")
    axes.legend()
    write_bytes(path, png_of(figure))
