"""`zestjax render`: a camera path through a video, as pictures and as a film."""

import dataclasses
from pathlib import Path

import jax
import numpy as np

from zestjax.apps import results
from zestjax.apps.budget import Budget
from zestjax.apps.effects import check_choice, choose, with_effects
from zestjax.apps.evaluate import Renderer, device_name
from zestjax.apps.paths import camera_path
from zestjax.apps.pilot import Pilot
from zestjax.apps.progress import progress
from zestjax.apps.scenes import open_scene
from zestjax.apps.scoring import number
from zestjax.apps.tables import counted
from zestjax.apps.weights import arithmetic, at_precision, open_weights
from zestjax.frames.inputs import check_target
from zestjax.io.pictures import to_bytes, write_image
from zestjax.io.video import write_video

MOST_FRAMES = 10**6  # of a film that a `timing.json` is believed to tell of: 12 hours at 24 frames a second


@dataclasses.dataclass(frozen=True)
class RenderOptions:
    """The flags of `zestjax render`; see the command's help. frames: of the path; budget_seconds: for all of them,
    frame_ms: for each. memory: MB."""

    scene: str
    out: Path
    weights: Path | None = None
    system: str | None = None
    path: str = "orbit"
    frames: int | None = None
    size: tuple | None = None
    budget_seconds: float | None = None
    frame_ms: float | None = None
    at_least_db: float | None = None
    memory: float | None = None
    format: str | None = None
    fps: float = 12.0
    still: bool = False
    precision: str | None = None
    effects: str = "auto"
    seed: int = 0
    quiet: bool = False


def render(options):
    """Run `zestjax render`.

    Returns:
      str, the summary line.

    Raises:
      ValueError, WeightsError: a scene, a path or weights that cannot be used.
    """
    with arithmetic(options.precision):
        return _render(options)


def _render(options):
    check_choice(options.effects)
    model = at_precision(open_weights(options.weights, system=options.system), options.precision)
    out = Path(options.out)
    scene = open_scene(options.scene, model.recipe, size=options.size, protocol=None, layout=options.format).scene
    path = camera_path(options.path, scene.video, count=options.frames)
    for index in range(len(path.times)):  # before the frames are looked at
        check_target(scene.name, scene.video, camera_at(path, index))
    chosen = choose(options.effects, scene, still=options.still, quiet=options.quiet)
    model = with_effects(model, chosen.on)
    size, count = scene.video.images.shape[1:3], len(path.times)
    told = {
        "scene": scene.name, "path": options.path, "height": size[0], "width": size[1], "frames": count,
        "effects": chosen.told,
    }  # fmt: skip
    each, timing = render_path(model, scene, path, budget=Budget.of(options), quiet=options.quiet)
    pictures, seconds = [], []
    for i, (view, spent) in enumerate(each):
        if i == 0:
            results.begin(out / "timing.json", frame_names, told)
        pictures.append(to_bytes(np.clip(np.asarray(view.colour, np.float32), 0, 1)))
        write_image(out / f"frames/{i:05d}.png", pictures[-1])
        seconds.append(spent)
    film = write_video(out / "video", np.stack(pictures), fps=options.fps)
    told |= timing(seconds) | {"video": film.name}
    results.write_record(out / "timing.json", told)
    chosen = f"; {told['budget']['said']}" if told["budget"] else ""
    return (
        f"render: {counted(count, 'frame')} of {size[0]}x{size[1]}, {told['seconds_per_frame']:.2f} s each "
        f"({told['seconds']:.0f} s in all){chosen}: {film}"
    )


def frame_names(told):
    """The files that a `timing.json` tells of."""
    count = told.get("frames")
    numbers = range(count) if isinstance(count, int) and count < MOST_FRAMES else ()
    return [f"frames/{i:05d}.png" for i in numbers] + ["video.webm", "video.webp"] * bool(numbers)


def render_path(model, scene, path, *, budget=None, quiet=False):
    """The views along a `CameraPath`, rendered as they are taken; within a `Budget`, if given.

    Returns:
      (iterator of (`View`, seconds), function of all the seconds to a dict of timing).
    """
    first, count = (camera_at(path, 0), int(path.times[0]), ()), len(path.times)
    view_of = Pilot(model, scene.video, budget, count, first, quiet=quiet) if budget else Renderer(model, scene.video)
    view_at = lambda index: view_of(camera_at(path, index), int(path.times[index]), ())
    views = (view_at(index) for index in progress(range(len(path.times)), "render", quiet=quiet, unit="frame"))

    def timing(seconds):
        each = float(np.median(seconds))  # the first one's compiling is not in it, if there are three
        chosen = view_of.record if isinstance(view_of, Pilot) else None
        before = view_of.first_seconds or 0.0
        scale = 1.0 if chosen is None else chosen["scale"]
        return {
            "device": device_name(), "preset": model.preset, "frames": len(seconds), "scale": scale,
            "seconds_per_frame": number(each), "first_frame_seconds": number(seconds[0]),
            "prepare_seconds": number(before), "seconds": number(before + sum(seconds)),
            "budget_seconds": budget.seconds if budget else None, "budget": chosen,
        }  # fmt: skip

    return views, timing


def camera_at(path, index):
    """One camera of a path."""
    return jax.tree.map(lambda leaf: leaf[index], path.cameras)
