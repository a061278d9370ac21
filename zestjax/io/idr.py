"""IDR's layout, in which DTU's scans are handed on: photographs around an object, and one matrix for each.

    cameras_sphere.npz (or cameras.npz)   world_mat_i (4, 4): pixels from world; scale_mat_i: the sphere around it
    image/ (or images/, images_WxH/)      N pictures, sorted by name, the i-th of matrix i

The matrices count pixels of the size (height, width) that an array `size` in their file says. Without one it must be
the pictures' own, the folder's W x H or DTU's, and is taken only if the cameras look at its middle.

Depth bounds are the sphere's, over all cameras. Held out are photographs 23, 24, 32 and 44, as MVSNeRF (Chen et al.
2021) holds them out of DTU's 49; of other counts every eighth.
"""

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from zestjax.base.types import FilePath
from zestjax.cameras import Camera
from zestjax.io.files import replaced_folder
from zestjax.io.layouts import MOST_DEPTH, Record, as_float32, check_order, every_eighth, pictures_in
from zestjax.io.pictures import image_size, write_image
from zestjax.io.reading import check_numbers, read_arrays, visible
from zestjax.video import Video

FILES = ("cameras_sphere.npz", "cameras.npz")
DTU_COUNT, DTU_RESERVED = 49, (23, 24, 32, 44)
NATIVE = (1200, 1600)  # of DTU, whose pictures are handed on resized, but not its matrices
OFF_CENTRE = (
    0.05  # of a side, most by which a camera looks past the middle: DTU's does by 0.016; a tenth cropped is 0.05
)
SIZED = re.compile(r"images_(\d+)x(\d+)")


def is_idr(path: Path) -> bool:
    """Whether a folder is in this layout."""
    return any((path / name).is_file() for name in FILES) and bool(_pictures(path))


def read_idr(path: Path) -> Record:
    """Read the folder to a `Record`.

    Raises:
      ValueError: the matrices are not there for every picture, not finite, or no cameras; or the size in which they
        count pixels is not known.
    """
    source = next(path / name for name in FILES if (path / name).is_file())
    images = _pictures(path)
    check_order(images, source)
    world, sphere, size = _matrices(source, len(images))
    leaves = map(np.stack, zip(*(_camera(source, matrix) for matrix in world), strict=True))
    cameras = Camera(*(as_float32(source, leaf) for leaf in leaves))
    near, far = _bounds(source, cameras, sphere)
    count = len(images)
    reserved = DTU_RESERVED if count == DTU_COUNT else every_eighth(count)
    native = _native(source, cameras, images, size)
    return Record(path.resolve().name, "idr", images, cameras, native, near, far, reserved=reserved)


def _pictures(path):
    folders = [path / "image", path / "images", *(p for p in visible(path) if SIZED.fullmatch(p.name))]
    return next((files for folder in folders if (files := pictures_in(folder))), ())


def _matrices(source, count):
    """world_mat_i and scale_mat_i (count, 4, 4) of a file, and its `size` or None."""
    stored = read_arrays(
        source, names={f"{n}_{i}" for n in ("world_mat", "scale_mat") for i in range(count)} | {"size"}
    )
    said = f"{source}: should hold world_mat_i and scale_mat_i of {count} pictures"
    if missing := [f"{n}_{i}" for n in ("world_mat", "scale_mat") for i in range(count) if f"{n}_{i}" not in stored]:
        raise ValueError(f"{said} ({missing[0]} is missing); copy it again.")
    size = stored.pop("size", None)
    for name, matrix in stored.items():
        check_numbers(source, matrix, shape=(4, 4), name=name, finite=True)
    world, sphere = (
        np.stack([stored[f"{n}_{i}"] for i in range(count)]).astype(np.float64) for n in ("world_mat", "scale_mat")
    )
    if size is not None:
        size = check_numbers(source, size, shape=(2,), name="size", finite=True)
        if not (size >= 1).all() or not (size == np.round(size)).all():
            raise ValueError(f"{source}: `size` is {size.tolist()}, expected the height and width in pixels.")
        size = (int(size[0]), int(size[1]))
    return world, sphere, size


def _camera(source, matrix):
    """(K, camera_from_world) of a projection matrix, by OpenCV. A matrix has no sign: K's focal lengths are above 0."""
    with np.errstate(all="ignore"):
        volume = np.linalg.det(matrix[:3, :3])
        if not np.isfinite(volume) or volume == 0:
            raise ValueError(f"{source}: a matrix is of no camera (its determinant is {volume:g}); copy it again.")
        k, rotation, centre = cv2.decomposeProjectionMatrix(np.sign(volume) * matrix[:3])[:3]
        signs = np.sign(np.diag(k))
        k, rotation = k * signs, rotation * signs[:, None]
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ (centre[:3, 0] / centre[3, 0])
        return k / k[2, 2], pose


def _bounds(source, cameras, sphere):
    """(near, far): the nearest and the farthest depth that the sphere has in any camera."""
    middle = np.concatenate([sphere[:, :3, 3], np.ones((len(sphere), 1))], -1)
    depth, radius = np.einsum("nij,nj->ni", cameras.camera_from_world, middle)[:, 2], sphere[:, 0, 0]
    near, far = float((depth - radius).min()), float((depth + radius).max())
    if not 0 < near < far < MOST_DEPTH:
        raise ValueError(
            f"{source}: a camera stands inside the sphere of scale_mat_i (or looks away); its bounds fail."
        )
    return near, far


def _native(source, cameras, images, size):
    """(height, width) in which the matrices count pixels: as the file says, or the size whose middle they look at."""
    have = image_size(images[0])
    middle = cameras.intrinsics[:, 1::-1, 2]
    looks_at = lambda size: (np.abs(middle / size - 0.5) < OFF_CENTRE).all()
    if size is not None:
        return size
    if looks_at(have):
        return have
    named = SIZED.fullmatch(images[0].parent.name)
    for native in ((int(named[2]), int(named[1])) if named else have, NATIVE):
        if native != have and looks_at(native) and abs(have[1] * native[0] - have[0] * native[1]) <= max(native):
            return native
    down, right = middle.mean(0)
    raise ValueError(
        f"{source}: its cameras look at pixel ({right:.1f}, {down:.1f}), column and row, which is not the middle of "
        f"{images[0].name} ({have[0]}x{have[1]}, HxW): were the pictures resized or cropped? Give those that the "
        f"matrices are of, or add `size` (height, width), in which they count pixels, to {source.name}."
    )


def write_idr(folder: FilePath, video: Video) -> None:
    """Write photographs in this layout, all or nothing; a scene is called as its folder.

    The layout has a sphere for depth bounds: that about the point in the middle of all views which holds near to far of
    every camera, so that they may be wider when they are read.

    Args:
      folder: the destination: absent, empty, or an earlier scene of this layout, which is replaced.
      video: `Video`; its images may be uint8.

    Raises:
      ValueError: cameras among which no such sphere has room, as it must be in front of all of them; or a folder with
        something else in it, which is left alone.
      OSError: the disk is full or the place not writable; nothing half-written is left.
    """
    k, poses = (np.asarray(leaf, np.float64) for leaf in video.cameras)
    near, far = float(video.near), float(video.far)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    middle = np.append((centres + (near + far) / 2 * poses[:, 2, :3]).mean(0), 1)
    depth = np.einsum("nij,j->ni", poses, middle)[:, 2]
    sphere = np.diag([*[max((depth - near).max(), (far - depth).max())] * 3, 1])
    if depth.min() <= sphere[0, 0]:
        raise ValueError("write_idr: no sphere in front of all cameras holds near to far; this layout needs one.")
    sphere[:3, 3] = middle[:3]
    arrays: dict[str, Any] = {f"world_mat_{i}": np.vstack([k[i] @ poses[i, :3], [0, 0, 0, 1]]) for i in range(len(k))}
    arrays |= {f"scale_mat_{i}": sphere for i in range(len(k))}
    with replaced_folder(folder, marker=FILES[0]) as root:
        np.savez(root / FILES[0], **arrays, size=np.array(np.shape(video.images)[1:3]))
        for i, image in enumerate(video.images):
            write_image(root / f"image/{i:05d}.png", image)
