"""Nerfies' layout, in which HyperNeRF's and DyCheck's scenes come too.

    dataset.json        `train_ids` and `val_ids`: names of pictures (`ids`, all of them, where there is no split)
    metadata.json       by name: its instant (`time_id`, `warp_id` or `appearance_id`) and its `camera_id`
    scene.json          `scale` and `center` of the world, `near` and `far` in the scaled one
    camera/ID.json      `orientation` (3, 3) world to camera, `position`, `focal_length`, `pixel_aspect_ratio`, `skew`,
                        `principal_point` in pixels that count from the corner, `image_size` (width, height),
                        `radial_distortion` (3,), `tangential_distortion` (2,) (or `tangential`)
    rgb/1x/ID.png       the pictures (or the largest of rgb/2x, rgb/4x, ...)

Axes are OpenCV's. The world is (x - center) scale, as the authors' loaders make it. The frames are the training
pictures, which must have an instant each; pictures of other cameras are held out where they were taken at a frame's
instant. Where the held-out ones are of instants between the frames, all are frames, and those held out as LLFF's are.
Colours are taken as stored under DyCheck's transparent pixels too, whose depth was not measured. `near` and `far` are
along rays: a depth can be a little less.
"""

import json
import os
import re
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from zestjax.base.types import FilePath
from zestjax.cameras import Camera
from zestjax.io.files import replaced_folder
from zestjax.io.layouts import Record, select
from zestjax.io.pictures import SUFFIXES, write_image
from zestjax.io.posed import ABOUT, Posed, about_of, file_inside, intrinsics_of, record_of, rigid
from zestjax.io.reading import FileWarning, json_numbers, read_json, visible
from zestjax.video import Video

MARKER = "dataset.json"
FILES = (MARKER, "metadata.json", ABOUT)
INSTANTS = ("time_id", "warp_id", "appearance_id")


def is_nerfies(path: Path) -> bool:
    """Whether a folder is in this layout."""
    return all((path / name).is_file() for name in FILES) and (path / "camera").is_dir()


def read_nerfies(path: Path) -> Record:
    """Read the folder to a `Record`.

    Raises:
      ValueError: a file is not what it should be, a picture or a camera is missing, or several training pictures are of
        one instant.

    Warns:
      FileWarning: held-out pictures of instants that no frame has are left out.
    """
    source = path / MARKER
    training, held = _splits(source)
    metadata = read_json(path / "metadata.json")
    entry = {name: _entry(path / "metadata.json", metadata, name) for name in (*training, *held)}
    instants = {entry[name][0] for name in training}
    alone = not any(entry[name][0] in instants for name in held)  # instants between the frames, by the same camera
    frames = [*training, *held] if alone else training
    frames = sorted(frames, key=lambda name: entry[name][0])
    for name, other in zip(frames, frames[1:], strict=False):
        if entry[name][0] == entry[other][0]:
            raise ValueError(
                f"{source}: {name} and {other} are both of instant {entry[name][0]:g}; several cameras at one time "
                "are not read: keep one of them in the split."
            )
    times = {entry[name][0]: i for i, name in enumerate(frames)}
    others = [] if alone else [name for name in held if entry[name][0] in times]
    if not alone and len(others) < len(held):
        warnings.warn(
            f"{source}: {len(held) - len(others)} of {len(held)} held-out pictures are of instants that no frame has, "
            "and are left out.", FileWarning, stacklevel=3,
        )  # fmt: skip
    (called, bounds), rgb, world = about_of(path), _rgb(path), _world(path / ABOUT)
    if bounds is None:
        raise ValueError(f"{path / ABOUT}: has no `near` and `far`; copy it again.")
    posed = lambda name: _posed(path, rgb, name, world, (times[entry[name][0]], entry[name][1]))
    return record_of(
        path, "nerfies", source, [posed(name) for name in frames], bounds, name=called,
        held_out=[posed(name) for name in others],
        reserved=[i for i, name in enumerate(frames) if name in set(held)], transparent=True,
    )  # fmt: skip


def _splits(source):
    """(training, held-out) names."""
    found = read_json(source)
    lists = [found.get(key, []) for key in ("train_ids", "val_ids")]
    lists = lists if "train_ids" in found else [found.get("ids"), []]
    for names in lists:
        if not isinstance(names, list) or not all(isinstance(name, str | int) for name in names):
            raise ValueError(f"{source}: should hold `train_ids` and `val_ids`, lists of names; copy it again.")
    training, held = ([str(name)[:300] for name in names] for names in lists)
    if len({*training, *held}) < len(training) + len(held):
        raise ValueError(f"{source}: a picture is listed twice, or in both splits; list it once.")
    return training, held


def _entry(source, metadata, name):
    """(instant, name of the camera) of a picture."""
    found = metadata.get(name)
    key = next((key for key in INSTANTS if isinstance(found, dict) and key in found), None)
    if key is None:
        raise ValueError(f"{source}: has no instant of {name[:80]!r} ({', '.join(INSTANTS)}); copy it again.")
    camera = json_numbers(source, found, "camera_id", shape=()) if "camera_id" in found else 0
    return float(json_numbers(source, found, key, shape=())), f"cam{int(camera):02d}"


def _world(source):
    """(centre (3,), scale) of the world that near and far are of."""
    found = read_json(source)
    centre, scale = (
        json_numbers(source, found, "center", shape=(3,)),
        float(json_numbers(source, found, "scale", shape=())),
    )
    if not scale > 0:
        raise ValueError(f"{source}: `scale` is {scale:g}, expected more than 0; copy it again.")
    return centre, scale


def _rgb(path):
    """The folder of the largest pictures."""
    sized = [(int(m[1]), p) for p in visible(path / "rgb") if (m := re.fullmatch(r"(\d{1,9})x", p.name)) and p.is_dir()]
    if not sized:
        raise ValueError(f"{path / 'rgb'}: has no folder of pictures (1x, 2x, ...); copy it again.")
    return min(sized)[1]


def _posed(path, rgb, name, world, place):
    """A picture's `Posed`, with its place: frame and camera."""
    source = file_inside(path / "camera", f"{name}.json", path / MARKER)
    found = read_json(source)
    number = lambda key, *shape: json_numbers(source, found, key, shape=shape)
    optional = lambda key, other: float(number(key)) if key in found else other
    size = number("image_size", 2)
    if (size != np.round(size)).any():
        raise ValueError(f"{source}: `image_size` is {size.tolist()}, expected whole pixels; copy it again.")
    focal, (cx, cy) = float(number("focal_length")), number("principal_point", 2)
    fy = focal * optional("pixel_aspect_ratio", 1.0)
    radial = number("radial_distortion", 3) if "radial_distortion" in found else np.zeros(3)
    key = next((key for key in ("tangential_distortion", "tangential") if key in found), None)
    tangential = np.zeros(2) if key is None else number(key, 2)
    rotation = number("orientation", 3, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        position = (number("position", 3) - world[0]) * world[1]
        pose = rigid(rotation, -rotation @ position)
    files = [file_inside(rgb, f"{name}{suffix}", path / MARKER) for suffix in SUFFIXES]
    return Posed(
        next((file for file in files if os.path.exists(file)), files[0]),
        (int(size[1]), int(size[0])),
        intrinsics_of(focal, fy, cx, cy, skew=optional("skew", 0.0), centre=0.5),
        pose,
        np.array([*radial[:2], *tangential, radial[2], 0, 0, 0]),
        *place,
    )


def write_nerfies(folder: FilePath, name: str, video: Video, *, held_out: Iterable = ()) -> None:
    """Write a scene in this layout, all or nothing.

    Args:
      folder: the destination: absent, empty, or an earlier scene of this layout, which is replaced.
      name: of the scene; it stands in scene.json, where others do not look for one.
      video: `Video`; its images may be uint8.
      held_out: iterable of `zestjax.io.scenes.Target`, read once.

    Raises:
      ValueError: a folder with something else in it, which is left alone.
      OSError: the disk is full or the place not writable; nothing half-written is left.
    """
    cameras = [select(video.cameras, i) for i in range(len(video.images))]
    shots: Sequence = [
        (i, 0, camera, image) for i, (camera, image) in enumerate(zip(cameras, video.images, strict=True))
    ]
    names: dict[str, int] = {}
    with replaced_folder(folder, marker=MARKER) as root:
        (root / "camera").mkdir()
        metadata = {f"0_{i:05d}": _write_shot(root, f"0_{i:05d}", *shot) for i, shot in enumerate(shots)}
        training = list(metadata)
        for target in held_out:
            number = names.setdefault(target.camera_name, len(names) + 1)
            key = f"{number}_{target.time:05d}"
            metadata[key] = _write_shot(root, key, target.time, number, target.camera, target.image)
        held = list(metadata)[len(training) :]
        ids = dict(
            count=len(metadata), num_exemplars=len(training), ids=list(metadata), train_ids=training, val_ids=held
        )
        about = dict(name=name, scale=1.0, center=[0.0, 0.0, 0.0], near=float(video.near), far=float(video.far))
        for file, content in zip(FILES, (ids, metadata, about), strict=True):
            (root / file).write_text(json.dumps(content))


def _write_shot(root, key, time, number, camera: Camera, image):
    """Write one picture with its camera; returns its entry in the metadata."""
    k, pose = (np.asarray(leaf, np.float64) for leaf in camera)
    height, width = np.shape(image)[:2]
    stored = dict(
        orientation=pose[:3, :3].tolist(),
        position=(-pose[:3, :3].T @ pose[:3, 3]).tolist(),
        focal_length=k[0, 0],
        pixel_aspect_ratio=k[1, 1] / k[0, 0],
        principal_point=(k[:2, 2] + 0.5).tolist(),
        skew=k[0, 1],
        radial_distortion=[0.0] * 3,
        tangential_distortion=[0.0] * 2,
        image_size=[width, height],
    )
    (root / f"camera/{key}.json").write_text(json.dumps(stored))
    write_image(root / f"rgb/1x/{key}.png", image)
    return dict(warp_id=time, appearance_id=time, camera_id=number)
