"""IDR's layout, in which DTU's scans are handed on: photographs around an object, and one matrix for each.

    cameras_sphere.npz (or cameras.npz)   world_mat_i (4, 4): pixels from world; scale_mat_i: the sphere around it
    image/ (or images/, images_WxH/)      N pictures, sorted by name, the i-th of matrix i

Depth bounds are the sphere's, over all cameras. Held out are photographs 23, 24, 32 and 44, as MVSNeRF (Chen et al.
2021) holds them out of DTU's 49; of other counts every eighth.
"""

import cv2
import numpy as np

from zestjax.cameras import Camera
from zestjax.io.layouts import Record, every_eighth, pictures_in
from zestjax.io.pictures import image_size

FILES = ("cameras_sphere.npz", "cameras.npz")
DTU_COUNT, DTU_RESERVED = 49, (23, 24, 32, 44)
NATIVE = (1200, 1600)


def is_idr(path):
    """Whether a folder is in this layout."""
    return any((path / name).is_file() for name in FILES) and bool(_pictures(path))


def read_idr(path):
    """Read the folder to a `Record`.

    Raises:
      ValueError: the matrices are not there for every picture, not finite, or no cameras.
    """
    source = next(path / name for name in FILES if (path / name).is_file())
    images = _pictures(path)
    try:
        with np.load(source, allow_pickle=False) as stored:
            world, sphere = (
                np.stack([stored[f"{n}_{i}"] for i in range(len(images))]) for n in ("world_mat", "scale_mat")
            )
    except (OSError, ValueError, EOFError, KeyError) as error:
        raise ValueError(
            f"{source}: should hold world_mat_i and scale_mat_i of {len(images)} pictures ({error}); copy it again."
        ) from error
    if world.shape[1:] != (4, 4) or not np.isfinite(world).all() or not np.isfinite(sphere).all():
        raise ValueError(f"{source}: matrices should be finite (4, 4), got {world.shape[1:]}; copy it again.")
    cameras = Camera._make(map(np.stack, zip(*map(_camera, world.astype(np.float64)), strict=True)))
    near, far = _bounds(source, cameras, sphere.astype(np.float64))
    count = len(images)
    reserved = DTU_RESERVED if count == DTU_COUNT else every_eighth(count)
    name = path.resolve().name
    return Record(name, "idr", images, cameras, _native(cameras, images), near, far, reserved=reserved)


def _pictures(path):
    folders = [path / "image", path / "images", *sorted(path.glob("images_*x*"))]
    return next((files for folder in folders if (files := pictures_in(folder))), ())


def _camera(matrix):
    """(K, camera_from_world) of a projection matrix, by OpenCV."""
    k, rotation, centre = cv2.decomposeProjectionMatrix(matrix[:3])[:3]
    k = k / k[2, 2]
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ (centre[:3, 0] / centre[3, 0])
    return k, pose


def _bounds(source, cameras, sphere):
    """(near, far): the nearest and the farthest depth that the sphere has in any camera."""
    middle = np.concatenate([sphere[:, :3, 3], np.ones((len(sphere), 1))], -1)
    depth, radius = np.einsum("nij,nj->ni", cameras.camera_from_world, middle)[:, 2], sphere[:, 0, 0]
    near, far = float((depth - radius).min()), float((depth + radius).max())
    if near <= 0:
        raise ValueError(
            f"{source}: a camera stands inside the sphere of scale_mat_i (or looks away); its bounds fail."
        )
    return near, far


def _native(cameras, images):
    """(height, width) in which the matrices count pixels: the pictures' own, or DTU's where they were made smaller."""
    have = image_size(images[0])
    middle = cameras.intrinsics[:, :2, 2].mean(0)
    own = 0.25 < middle[0] / have[1] < 0.75 and 0.25 < middle[1] / have[0] < 0.75
    return have if own else NATIVE
