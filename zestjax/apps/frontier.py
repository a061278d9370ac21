"""`zestjax frontier`: what each setting costs and gives, with one set of weights; a search over all axes together.

Settings vary depth planes, source views, samples per ray, precision and resolution. They are drawn jointly, halved on
ever more targets, and what is left is improved by steps (`search`). A setting is on the frontier when it was measured
on all targets and no other such is both faster and better.
"""

import csv
import dataclasses
import io
from pathlib import Path

import numpy as np

from zestjax.apps.evaluate import device_name
from zestjax.apps.frontier_page import Shown, write_page
from zestjax.apps.frontier_plot import draw
from zestjax.apps.progress import progress_of
from zestjax.apps.scenes import digest, open_scene
from zestjax.apps.search import front, search
from zestjax.apps.settings import TRAINED, begun_with, scales
from zestjax.apps.stored import NAME, Frontier, Point, write_frontier
from zestjax.apps.trials import Trials
from zestjax.apps.weights import arithmetic, open_weights
from zestjax.io.files import write_bytes
from zestjax.io.lpips import load_lpips
from zestjax.io.pictures import encoded_png
from zestjax.simulate.bench import BENCH

COLUMNS = ("setting", "psnr_full", "psnr_dynamic", "ssim_full", "seconds_per_frame", "peak_mb", "pareto")
"""The first ones: scripts read them."""
MORE = (
    "psnr_static", "psnr_low", "psnr_high", "ssim_dynamic", "ssim_static", "lpips_full", "lpips_dynamic",
    "lpips_static", "depth_abs_rel", "seconds_low", "seconds_high", "clock_seconds", "cpu_seconds",
    "prepare_seconds", "working_mb", "joules_per_frame", "targets", "planes", "views", "samples", "precision", "scale",
)  # fmt: skip

TURNS = 5  # in which what was found is timed: fewer, and a frame that was disturbed is in the middle
RUN_ALONE = ("frames", "lpips")  # what tells one run's trials from another's, and no reader of its frontier needs


@dataclasses.dataclass(frozen=True)
class FrontierOptions:
    """The flags of `zestjax frontier`; see the command's help. targets: times, four of zest-bench unless told, one of
    each scene of `bench:all`. tries: settings beside those of the size alone."""

    scene: str
    out: Path
    weights: Path | None = None
    system: str | None = None
    size: tuple | None = None
    targets: tuple | None = None
    format: str | None = None
    tries: int = 16
    repeats: int = 1
    lpips: Path | None = None
    resume: bool = False
    seed: int = 0
    quiet: bool = False


@arithmetic()
def frontier(options):
    """Run `zestjax frontier`.

    Returns:
      str, the summary line.

    Raises:
      ValueError, WeightsError: a scene or weights that cannot be used.
    """
    model, out = open_weights(options.weights, system=options.system), Path(options.out)
    scenes = open_scenes(options, model)
    with progress_of("frontier", len(scales()) + options.tries, quiet=options.quiet) as tick:
        lpips = None if options.lpips is None else load_lpips(options.lpips)
        trials = Trials(model, scenes, out / "trials.jsonl", repeats=options.repeats, lpips=lpips, tick=tick)
        trials.begin(header(model, scenes, options), resume=options.resume)
        tried = [setting for setting, _ in trials.done]  # by a run before this one
        first = [*scales(), *begun_with(options.tries - options.tries // 2, options.seed), *tried]
        trials.measured(TRAINED, len(trials.targets))
        found = search(
            first, scales(), model.system,
            rungs=rungs(len(trials.targets)), measured=trials.measured, tries=options.tries // 2,
        )  # fmt: skip
        trials.time_together(found, TURNS)
    rows = rows_of(trials, model)
    write_rows(out, rows)
    about = header(model, scenes, options) | {"own_psnr": trials.own_psnr()}
    write_frontier(out / NAME, stored(trials, rows, {k: v for k, v in about.items() if k not in RUN_ALONE}))
    name = scenes[0].name if len(scenes) == 1 else f"{len(scenes)} scenes"
    draw(out / "frontier.png", rows, name)
    shown, truth = at_budgets(trials, rows)
    told = summary(rows, name)
    write_page(out, rows, title=name, told=told, shown=shown, truth=truth)
    return f"frontier: {told}: {out / 'frontier.csv'}"


def at_budgets(trials, rows):
    """The first target by the cheapest, the middle and the best setting of the frontier, and its truth, as PNGs."""
    best = sorted((row for row in rows if row["pareto"]), key=lambda row: row["seconds_per_frame"])
    views, truth = [], None
    for row in (best[0], best[len(best) // 2], best[-1]):
        view, truth = trials.shown(row["value"], 0)
        caption = f"{row['setting']}: {row['seconds_per_frame']:.2g} s, {row['psnr_full']:.2f} dB on all targets"
        views.append(Shown(caption, encoded_png(np.clip(np.asarray(view.colour, np.float32), 0, 1))))
    return views, encoded_png(truth)


def open_scenes(options, model):
    """The scene of the flags, or all of zest-bench."""
    whole = options.scene == "bench:all"
    times = options.targets
    if times is None and str(options.scene).startswith("bench:"):
        times = (9,) if whole else (3, 9, 14, 20)
    names = [f"bench:{name}" for name in BENCH] if whole else [options.scene]
    opened = (
        open_scene(name, model.recipe, size=options.size, protocol="held-out", layout=options.format, targets=times)
        for name in names
    )
    return [each.scene for each in opened]


def header(model, scenes, options):
    """What trials are of."""
    height, width = scenes[0].video.images.shape[1:3]
    return {
        "weights": model.path.name, "step": model.metadata.get("step"), "preset": model.preset, "device": device_name(),
        "scenes": [scene.name for scene in scenes], "frames": [digest(scene.video) for scene in scenes],
        "targets": [[t.time for t in scene.targets] for scene in scenes], "height": height, "width": width,
        "video_frames": len(scenes[0].video.images),
        "lpips": options.lpips is not None,
    }  # fmt: skip


def rungs(count):
    """Numbers of targets: a quarter, half and all."""
    return sorted({max(1, count // 4), max(1, count // 2), count})


def rows_of(trials, model):
    """A row for each setting tried, those measured on all targets marked `pareto` where no other beats them."""
    tried = dict.fromkeys(setting for setting, _ in trials.done)
    rows = [
        {"setting": s.named(model.system), **trials.row(s), **dataclasses.asdict(s), "value": s, "pareto": 0}
        for s in tried
    ]
    return mark_pareto(sorted(rows, key=lambda row: row["seconds_per_frame"]), len(trials.targets))


def mark_pareto(rows, targets):
    """The rows with `pareto` 1 where no other of those measured on so many targets is at least as fast and as good, and
    better in one; else 0."""
    whole = [row for row in rows if row["targets"] >= targets]
    points = [(row["seconds_per_frame"], row["psnr_full"]) for row in whole]
    for i in front(points):
        whole[i]["pareto"] = 1
    return rows


def write_rows(out, rows):
    """Write `frontier.csv`."""
    text = io.StringIO()
    names = [*COLUMNS, *MORE]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    shown = lambda value: "" if value is None else round(value, 4) if isinstance(value, float) else value
    writer.writerows({name: shown(row[name]) for name in names} for row in rows)
    write_bytes(out / "frontier.csv", text.getvalue().encode())


def stored(trials, rows, told):
    """The `Frontier` of rows: of settings that were measured on all targets."""
    own = next(row for row in rows if row["value"] == TRAINED)
    cost = lambda row: row["seconds_per_frame"] / own["seconds_per_frame"]
    points = [
        Point(row["value"], cost(row), row["gain"], row["gain_low"], row["gain_high"], row["working_mb"])
        for row in rows if row["targets"] >= len(trials.targets)
    ]  # fmt: skip
    points = tuple(sorted(points, key=lambda point: point.cost))
    return Frontier(points, own["psnr_full"], own["seconds_per_frame"], own["prepare_seconds"], told)


def summary(rows, name):
    """The line of a command: the fastest setting within 0.1 dB of the best, beside the weights as trained."""
    whole = [row for row in rows if row["pareto"]]
    best, own = max(whole, key=lambda row: row["psnr_full"]), next(row for row in rows if row["value"] == TRAINED)
    good = [row for row in whole if row["psnr_full"] >= best["psnr_full"] - 0.1]
    fast = min(good, key=lambda row: row["seconds_per_frame"])
    return (
        f"on {name} `{fast['setting']}` reaches {fast['psnr_full']:.2f} dB in {fast['seconds_per_frame']:.2f} s a frame"
        f", within 0.1 dB of the best of {len(rows)}; as trained {own['psnr_full']:.2f} dB in "
        f"{own['seconds_per_frame']:.2f} s"
    )
