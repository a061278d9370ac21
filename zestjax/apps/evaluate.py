"""`zestjax evaluate`: a model's views of cameras and times the inputs never contained, scored beside floors.

Every score carries its seconds: of one frame, the volumes of its target included, after a first call that compiles;
what is done once for a video (`prepare`) and the compile stand beside them.
"""

import copy
import dataclasses
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from zestjax import novel_view
from zestjax.apps import results
from zestjax.apps.effects import check_choice, choose, hidden_frames, with_effects
from zestjax.apps.progress import progress
from zestjax.apps.scenes import open_scene
from zestjax.apps.scoring import mean_scores, number, score_depth, score_flow, score_image
from zestjax.apps.tables import FLOORS, counted, headline, lacking, write_table
from zestjax.apps.weights import arithmetic, at_precision, open_weights
from zestjax.frames.between import flow_interpolation
from zestjax.io.figures import depth_picture, error_picture, share_picture, side_by_side
from zestjax.io.lpips import load_lpips
from zestjax.io.pictures import write_image
from zestjax.judge import floors

LABELS = ("nearest input", "novel view", "truth", "error", "depth", "dynamicness")


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """The flags of `zestjax evaluate`; see the command's help. targets: times, or None for the protocol's own."""

    scene: str
    out: Path
    weights: Path | None = None
    system: str | None = None
    protocol: str = "held-out"
    size: tuple | None = None
    targets: tuple | None = None
    format: str | None = None
    pictures: bool = True
    lpips: Path | None = None
    still: bool = False
    precision: str | None = None
    budget_seconds: float | None = None
    frame_ms: float | None = None
    at_least_db: float | None = None
    memory: float | None = None
    effects: str = "auto"
    seed: int = 0
    quiet: bool = False


def evaluate(options):
    """Run `zestjax evaluate`; `bench:all` is all nine scenes of zest-bench and a table.

    Returns:
      str, the summary line.

    Raises:
      ValueError, WeightsError: a scene, a target or weights that cannot be used.
    """
    check_choice(options.effects)
    model = open_weights(options.weights, system=options.system)
    model = at_precision(model, options.precision)
    with arithmetic(options.precision):
        return _evaluate(model, options)


def _evaluate(model, options):
    if options.scene != "bench:all":
        report = evaluate_scene(model, options, Path(options.out))
        chosen = f"; {report['budget']['said']}" if report["budget"] else ""
        return f"evaluate: {headline(report)}{chosen}: {Path(options.out) / 'metrics.json'}"
    from zestjax.simulate.bench import BENCH

    out, reports = Path(options.out), []
    if options.budget_seconds is not None:  # for all frames of all scenes
        options = dataclasses.replace(options, budget_seconds=options.budget_seconds / len(BENCH))
    for name in BENCH:
        reports.append(evaluate_scene(model, dataclasses.replace(options, scene=f"bench:{name}"), out / name))
        write_table(out, reports)
    return (
        f"evaluate: mean of {counted(len(reports), 'scene')}: {headline(write_table(out, reports))}: {out / 'table.md'}"
    )


def evaluate_scene(model, options, out):
    """Score one scene and write `metrics.json` and `pictures/`.

    Returns:
      dict, the content of metrics.json.
    """
    opened = open_scene(options.scene, model.recipe, size=options.size, protocol=options.protocol,
                        targets=options.targets, layout=options.format)  # fmt: skip
    hidden = hidden_frames(opened.scene)
    chosen = choose(options.effects, opened.scene, exclude=hidden, still=options.still, quiet=options.quiet)
    view_of = renderer_of(with_effects(model, chosen.on), opened.scene, options)
    return score_scene(view_of, opened, options, out, told={"effects": chosen.told})


def renderer_of(model, scene, options):
    """A `Renderer` of a scene or, where the flags have a budget, a `pilot.Pilot`."""
    from zestjax.apps.pilot import Budget, Pilot

    budget = Budget.of(options)
    if not budget:
        return Renderer(model, scene.video, steady=True)
    first = scene.targets[0]
    return Pilot(
        model, scene.video, budget, len(scene.targets), (first.camera, first.time, first.exclude), quiet=options.quiet
    )


def score_scene(view_of, opened, options, out, told=None):
    """Score an opened scene's targets with its `Renderer`; see `evaluate_scene`. told: more of metrics.json."""
    scene, model, rows = opened.scene, view_of.model, []
    lpips = None if options.lpips is None else load_lpips(options.lpips)
    given = set() if opened.ceiling is None else {"ceiling"}
    planned = [{"file": picture_name(target)} for target in scene.targets if options.pictures]
    results.begin(out / "metrics.json", picture_names, {"scene": scene.name, "unfinished": True, "targets": planned})
    for target in progress(scene.targets, scene.name, quiet=options.quiet, unit="frame"):
        shown = out if options.pictures else None
        rows.append(evaluate_target(view_of, scene, target, opened.ceiling, shown, lpips))
        given |= {truth for truth in ("dynamic", "depth", "flow") if getattr(target, truth) is not None}
    if (lacks := lacking(scene.name, given)) and not options.quiet:
        print(f"evaluate: {lacks}", file=sys.stderr)
    height, width = scene.video.images.shape[1:3]
    report = {
        "scene": scene.name, "system": model.name, "protocol": options.protocol, "height": height, "width": width,
        "preset": model.preset, "precision": model.system.precision,
        "device": device_name(), "weights": str(model.path), **(told or {}),
        **summary(rows), "prepare_seconds": number(view_of.prepare_seconds),
        "compile_seconds": number(view_of.compile_seconds), "budget": getattr(view_of, "record", None),
        "targets": [row["row"] for row in rows],
    }  # fmt: skip
    results.write_record(out / "metrics.json", report)
    return report


def picture_name(target):
    """A target's picture beside metrics.json."""
    return f"pictures/{target.time:05d}_{target.camera_name}.png"


def picture_names(told):
    """The pictures that a `metrics.json` tells of."""
    targets = told.get("targets")
    return [row.get("file") for row in targets if isinstance(row, dict)] if isinstance(targets, list) else []


class Renderer:
    """Views of one prepared video, each with its seconds.

    model: `weights.Model`. video: `Video`. steady: what compiles first is run twice, so that seconds are those of
    compiled programs; for those who report them. system: to render with in place of the model's own.
    prepare_seconds, compile_seconds: None where nothing was run twice to tell them apart.
    """

    def __init__(self, model, video, *, steady=False, system=None):
        self.model = model
        self.prepare_seconds = self.compile_seconds = None
        self.system = model.system if system is None else system
        self.video = jax.tree.map(jnp.asarray, video)
        prepare = lambda: jax.block_until_ready(novel_view.prepare(model.params, self.video, system=model.system))
        self.prepared, self.first_seconds = timed(prepare)
        if steady:
            self.prepared, self.prepare_seconds = timed(prepare)

    def running(self, system):
        """Views of the same prepared video with another system of the same parameters."""
        other = copy.copy(self)
        other.system = system
        return other

    def __call__(self, camera, frame_time, exclude=()):
        """(`View`, seconds)."""
        camera = jax.tree.map(jnp.asarray, camera)
        render = lambda: jax.block_until_ready(
            novel_view.render_view(
                self.model.params, self.prepared, camera, frame_time, system=self.system, exclude=exclude
            )
        )
        view, seconds = timed(render)
        if self.prepare_seconds is not None and self.compile_seconds is None:
            first = self.first_seconds + seconds
            view, seconds = timed(render)
            self.compile_seconds = max(0.0, first - self.prepare_seconds - seconds)
        return view, seconds


def evaluate_target(view_of, scene, target, ceiling, out, lpips=None):
    """One target's row of metrics.json under `row`, and its floors' and ceiling's scores; writes its picture."""
    view, seconds = view_of(target.camera, target.time, target.exclude)
    nearest, warped = floor_images(view_of.video, target)
    score = lambda image: score_image(image, target.image, target.dynamic, lpips=lpips)
    limit = None if ceiling is None else ceiling(target)
    name = picture_name(target)
    if out is not None:
        write_image(out / name, picture_of(nearest, view, target, scene.video))
    row = {
        "time": int(target.time), "camera": target.camera_name, **score(view.colour),
        "depth_abs_rel": score_depth(view.depth, target.depth),
        "flow_epe_px": score_flow(getattr(view, "flow", None), target.flow),
        "seconds": number(seconds), "file": name if out is not None else None,
    }  # fmt: skip
    extra = None if limit is None else score(limit.image) | {"unseen": number(limit.unseen)}
    between = interpolated(view_of.video, target, nearest)
    return {
        "row": row, "nearest_frame": score(nearest), "plane_warp": score(warped),
        "flow_interpolation": None if between is None else score(between), "ceiling": extra,
    }  # fmt: skip


def summary(rows):
    """The means over the targets: `mean`, `floors` and `ceiling` of metrics.json."""
    mean = mean_scores([{k: v for k, v in r["row"].items() if k not in ("time", "camera", "file")} for r in rows])
    assert isinstance(mean, dict)
    mean["seconds_per_frame"] = mean.pop("seconds")
    return {
        "mean": mean,
        "floors": {name: mean_scores([r[name] for r in rows]) for name in FLOORS},
        "ceiling": mean_scores([r["ceiling"] for r in rows]),
    }


@jax.jit
def _floors(video, camera, frame_time, exclude):
    nearest = floors.nearest_frame(video, camera, frame_time, exclude=exclude)
    return nearest.image, floors.plane_warp(video, camera, frame_time, exclude=exclude).image


def floor_images(video, target):
    """The nearest frame and the plane warp of a target, numpy (H, W, 3)."""
    exclude = jnp.asarray(target.exclude, jnp.int32).reshape(-1)
    camera = jax.tree.map(jnp.asarray, target.camera)
    return tuple(np.asarray(image) for image in _floors(video, camera, jnp.int32(target.time), exclude))


def interpolated(video, target, nearest):
    """The third floor, (H, W, 3), of a target whose own frame is taken away; at the ends of the video, where there is
    no frame on one side, the nearest frame. None of other targets: the video was not there."""
    if target.time not in target.exclude:
        return None
    found = flow_interpolation(video.images, target.time, exclude=target.exclude)
    return nearest if found is None else found.image


def picture_of(nearest, view, target, video):
    """Nearest input, novel view, truth, error, depth and dynamicness of one target, side by side."""
    image = np.clip(np.asarray(view.colour, np.float32), 0, 1)
    truth = np.asarray(target.image, np.float32)
    depth = depth_picture(np.asarray(view.depth), near=float(video.near), far=float(video.far))
    pictures = [nearest, image, truth, error_picture(image, truth), depth, share_picture(np.asarray(view.dynamicness))]
    return side_by_side(pictures, labels=LABELS, columns=3)


def timed(function):
    """(result, seconds)."""
    start = time.perf_counter()
    result = function()
    return result, time.perf_counter() - start


def device_name():
    """What computed: the platform and the device's own name."""
    device = jax.devices()[0]
    return f"{device.platform} ({device.device_kind})"
