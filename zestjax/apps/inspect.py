"""`zestjax inspect`: what a scene is, and which effects it calls for, with evidence."""

import dataclasses
import json
import time
from pathlib import Path

import numpy as np

from zestjax.apps.own_frames import known_of
from zestjax.apps.results import write_record
from zestjax.apps.scenes import open_scene
from zestjax.apps.scoring import number
from zestjax.apps.weights import open_weights
from zestjax.effects import as_told, inspect
from zestjax.effects.found import SWITCHES
from zestjax.frames.assembly import positions
from zestjax.io.pictures import write_image


@dataclasses.dataclass(frozen=True)
class InspectOptions:
    """The flags of `zestjax inspect`; see the command's help. out: of the pictures, or None."""

    scene: str
    json: bool = False
    out: Path | None = None
    size: tuple | None = None
    format: str | None = None
    seed: int = 0
    quiet: bool = False


def inspect_scene(options):
    """Run `zestjax inspect`.

    Returns:
      str: the report, and the summary line last.

    Raises:
      ValueError: a scene that cannot be read.
    """
    recipe = open_weights().recipe  # whose height is a folder's pictures' by default
    scene = open_scene(options.scene, recipe, size=options.size, protocol=None, layout=options.format).scene
    start = time.perf_counter()
    found = inspect(scene.video, given=known_of(scene))
    seconds = time.perf_counter() - start
    told = {"scene": described(scene), "effects": as_told(found), "seconds": number(seconds)}
    if options.out is not None:
        pictures = {name: e.picture for name, e in found.items() if e.picture is not None}
        for name, picture in pictures.items():
            write_image(options.out / f"{name}.png", np.clip(picture, 0, 1))
        write_record(options.out / "effects.json", told)
    if options.json:
        return json.dumps(told, indent=1)
    return "\n".join([*lines_of(told), summary(scene, found, seconds)])


def described(scene):
    """What a scene is, as JSON holds it."""
    video = scene.video
    places = positions(video.cameras)
    extent = float(np.ptp(places, axis=0).max())
    return {
        "name": scene.name, "layout": scene.layout, "frames": len(video.images),
        "height": int(video.images.shape[1]), "width": int(video.images.shape[2]),
        "near": number(video.near), "far": number(video.far), "extent_of_cameras": number(extent),
        "masks": scene.motion_masks is not None, "flow": scene.flow_forward is not None,
        "depth": scene.disparity is not None,
    }  # fmt: skip


def lines_of(told):
    """The report for people: a line for the scene, and one for each effect."""
    scene = told["scene"]
    given = ", ".join(name for name in ("masks", "flow", "depth") if scene[name]) or "nothing"
    lines = [
        f"{scene['name']}: {scene['frames']} frames of {scene['height']}x{scene['width']}, depths {scene['near']:.4g} "
        f"to {scene['far']:.4g}, cameras within {scene['extent_of_cameras']:.4g}; given beside the frames: {given}"
    ]
    width = max(map(len, told["effects"]))
    for name, effect in told["effects"].items():
        told_as = effect["evidence"]["told"]
        use = "" if name in SWITCHES else " (told only)"
        lines.append(
            f"  {name:{width}}  {'on ' if effect['on'] else 'off'}  {told_as}: {effect['evidence']['reason']}{use}"
        )
    return lines


def summary(scene, found, seconds):
    """The last line."""
    off = [name.replace("_", " ") for name in SWITCHES if not found[name].on]
    doubt = [name.replace("_", " ") for name in found if found[name].told == "cannot tell"]
    without = f"without {', '.join(off)}" if off else "with every effect"
    unsure = f"; cannot tell of {', '.join(doubt)}" if doubt else ""
    return f"inspect: {scene.name} is rendered {without}{unsure} ({seconds:.1f} s)"
