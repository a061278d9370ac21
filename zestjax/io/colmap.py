"""COLMAP's layout: a sparse model and the pictures that it registered.

    images/                 (or images_<factor>/, smaller) the pictures, by the model's names
    sparse/0/, sparse/1/    models, in binary or text, of which the one with most pictures is read (or sparse/ itself,
                            colmap/sparse/ as nerfstudio leaves it, or the folder itself)
    scene.json              `near` and `far` (and `name`), where the model has no points or theirs are not wanted

or all of it under `dense/`, as COLMAP undistorts. A picture's time is its place among the registered ones, by number if
their names differ in digits only, else by name. Pictures that are not registered are left out, with a word. A model of
several folders of pictures is of several cameras, and refused.

Depth bounds are those of the points that lie in each picture: the 5th and 95th percentile of their depths, joined as
`zestjax.io.layouts.bounds_from_frames` does. By convention every eighth picture is held out, as of LLFF's scenes.
"""

import dataclasses
import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from zestjax.base.types import Array, FilePath
from zestjax.io.colmap_model import (
    Model,
    StoredCamera,
    StoredImage,
    count_images,
    model_in,
    read_model,
    write_model,
)
from zestjax.io.files import replaced_folder
from zestjax.io.layouts import Record, bounds_from_frames, every_eighth, files_in
from zestjax.io.lens import COEFFICIENTS
from zestjax.io.pictures import SUFFIXES, write_image
from zestjax.io.posed import (
    NO_BOUNDS,
    Posed,
    about_of,
    file_inside,
    intrinsics_of,
    quaternion_of,
    record_of,
    rigid,
    rotation_of,
    write_about,
)
from zestjax.io.reading import FileWarning, in_order, visible
from zestjax.video import Video

MOST_POINTS = 20_000  # of which depths are taken, evenly chosen
SHOWN = 5  # names in a message
MARKER = "sparse"


def is_colmap(path: Path) -> bool:
    """Whether a folder is in this layout."""
    return bool(_models(path)) and bool(_picture_folders(path))


def read_colmap(path: Path) -> Record:
    """Read the folder to a `Record`.

    Raises:
      ValueError: a damaged model, a camera or a pose that is none, a picture that is missing, or no depth bounds.

    Warns:
      FileWarning: several models, of which one is read, or pictures that are not registered.
    """
    folder = _largest(path)
    model = read_model(folder)
    name, bounds = about_of(path)
    images = {image.name: image for image in model.images}
    if len(images) < len(model.images):
        raise ValueError(f"{model.source}: lists a picture twice; export it again.")
    pictures = _pictures_of(path, images, model.source)
    files = in_order(pictures)
    if len({file.parent for file in files}) > 1:
        folders = ", ".join(sorted({file.parent.name for file in files})[:SHOWN])
        raise ValueError(f"{model.source}: has pictures of several folders, so cameras ({folders}); keep one of them.")
    _tell_missing(path, files)
    posed = [_posed(model, images[pictures[file]], file) for file in files]
    reserved = every_eighth(len(posed))
    scene = path.resolve().parent.name if path.resolve().name == "dense" else path.resolve().name
    record = record_of(path, "colmap", model.source, posed, bounds or (0, 0), name=name or scene, reserved=reserved)
    if bounds is None:
        near, far = _bounds(model, record.cameras, record.size)
        record = dataclasses.replace(record, near=near, far=far)
    return record


def _models(path):
    """The folders that hold models, at the first place that has any."""
    for place in (path / MARKER, path / "colmap" / MARKER, path):
        inside = [place, *(p for p in visible(place) if p.is_dir())] if place != path else [place]
        if found := [folder for folder in inside if model_in(folder)]:
            return found
    return []


def _picture_folders(path):
    """The folders of pictures, the largest pictures first."""
    smaller = [p for p in visible(path) if p.name.removeprefix("images_").isdigit() and p.name.startswith("images_")]
    ordered = [path / "images", *sorted(smaller, key=lambda p: int(p.name.removeprefix("images_")))]
    return [folder for folder in ordered if folder.is_dir() and visible(folder)]


def _largest(path):
    """The model of most pictures."""
    folders = _models(path)
    counts = [count_images(folder) for folder in folders]
    best = max(range(len(folders)), key=lambda i: counts[i])
    if len(folders) > 1:
        said = ", ".join(f"{p.name} with {count}" for p, count in zip(folders, counts, strict=True))
        warnings.warn(
            f"{path}: has {len(folders)} models of pictures ({said}); {folders[best].name} is read.", FileWarning,
            stacklevel=4,
        )  # fmt: skip
    return folders[best]


def _pictures_of(path, images, source):
    """{file: name} of a model's pictures, in the first folder of pictures that has one of them."""
    for folder in _picture_folders(path):
        files = {file_inside(folder, name, source): name for name in images}
        if any(os.path.exists(file) for file in files):
            return files
    raise ValueError(f"{source}: none of its pictures ({', '.join(sorted(images)[:SHOWN])[:200]}) is in {path}/images.")


def _tell_missing(path, files):
    """Warn of pictures beside those that were registered."""
    left = sorted({file.name for file in files_in(files[0].parent, SUFFIXES)} - {file.name for file in files})
    if left:
        names = ", ".join(left[:SHOWN]) + (", ..." if len(left) > SHOWN else "")
        warnings.warn(
            f"{path}: COLMAP has not registered {len(left)} of {len(left) + len(files)} pictures ({names}); they are "
            "left out, and times are counted without them.", FileWarning, stacklevel=4,
        )  # fmt: skip


def _posed(model, image, file):
    if image.camera not in model.cameras:
        raise ValueError(f"{model.source}: {image.name[:80]!r} is of camera {image.camera}, which is not there.")
    camera = model.cameras[image.camera]
    has = camera.parameters
    fx, fy = (has.get(axis, has.get("f", 0.0)) for axis in ("fx", "fy"))
    return Posed(
        file,
        camera.size,
        intrinsics_of(fx, fy, has["cx"], has["cy"], centre=0.5),
        rigid(rotation_of(model.source, image.quaternion), image.translation),
        np.array([has.get(name, 0.0) for name in COEFFICIENTS]),
    )


def _bounds(model, cameras, size):
    """(near, far) of the points that lie in each picture."""
    points, bounds = model.points[:: max(1, len(model.points) // MOST_POINTS)], []
    for k, pose in zip(*(np.asarray(leaf, np.float64) for leaf in cameras), strict=True):
        with np.errstate(all="ignore"):
            seen = points @ pose[:3, :3].T + pose[:3, 3]
            pixels, depth = seen @ k.T, seen[:, 2]
            u, v = pixels[:, 0] / depth, pixels[:, 1] / depth
            inside = (depth > 0) & (u > -0.5) & (v > -0.5) & (u < size[1] - 0.5) & (v < size[0] - 0.5)
        if inside.sum() > 1:
            bounds.append(np.percentile(depth[inside], [5, 95]))
    if not bounds:
        raise ValueError(f"{model.source}: no picture has two points, so that depth bounds are not known; {NO_BOUNDS}")
    return bounds_from_frames(np.array(bounds), where=model.source)


def write_colmap(
    folder: FilePath, name: str, video: Video, *, binary: bool = True, points: Array | Sequence = ()
) -> None:
    """Write a video in this layout, all or nothing: one model with a pinhole for every camera, and its depth bounds.

    Args:
      folder: the destination: absent, empty, or an earlier scene of this layout, which is replaced.
      name: of the scene.
      video: `Video`; its images may be uint8.
      binary: .bin files, else .txt.
      points: (P, 3) points of the scene, which COLMAP and others show.

    Raises:
      ValueError: a camera with skew, or a folder with something else in it, which is left alone.
      OSError: the disk is full or the place not writable; nothing half-written is left.
    """
    height, width = np.shape(video.images)[1:3]
    cameras, images = {}, []
    for i, (k, pose) in enumerate(zip(*(np.asarray(leaf, np.float64) for leaf in video.cameras), strict=True)):
        if k[0, 1]:
            raise ValueError(f"write_colmap: camera {i} has skew, which this layout does not hold.")
        has = dict(fx=k[0, 0], fy=k[1, 1], cx=k[0, 2] + 0.5, cy=k[1, 2] + 0.5)
        stored = StoredCamera("PINHOLE", (height, width), {key: float(value) for key, value in has.items()})
        number = next((number for number, other in cameras.items() if other == stored), len(cameras) + 1)
        cameras[number] = stored
        images.append(StoredImage(f"{i:05d}.png", number, quaternion_of(pose[:3, :3]), pose[:3, 3]))
    with replaced_folder(folder, marker=MARKER) as root:
        (root / MARKER / "0").mkdir(parents=True)
        points = np.asarray(points, np.float64).reshape(-1, 3)
        write_model(root / MARKER / "0", Model(cameras, tuple(images), points, root), binary=binary)
        write_about(root, name, (float(video.near), float(video.far)))
        for image, picture in zip(images, video.images, strict=True):
            write_image(root / "images" / image.name, picture)
