"""NSFF's layout, which is also how the NVIDIA Dynamic Scenes come and what `zestjax simulate` writes.

Under the scene's folder, or `dense/` in it:

    poses_bounds.npy            (N, 17): 3 x 5 [down right back position | height width focal], near, far
    images/                     N pictures, in the order of their names, which must be that of their numbers (or
                                images_<W>x<H>/, or images_<factor>/ as LLFF has); resized at most, never cropped
    mv_images/00000/cam01.png   what every camera of the rig saw at a time; frame i was taken by camera i mod rig, and
                                camera c is cam01 and so on as published: `zestjax.io.rig` reads other numberings too
    mv_masks/00000/cam01.png    their moving pixels
    motion_masks/00000.png      moving pixels of the frames
    disp/00000.npy              (H, W) disparity, up to scale and shift (an inverse depth when simulated)
    flow_i1/00000_fwd.npz       `flow` (H, W, 2) pixels and `mask` (H, W) towards the next frame; `_bwd` the previous;
                                or 00000_fwd.flo

Masks, disparity and flow belong to the frame of their name, else of the number in it, else of their place.

and, where the truth is known, `truth/00000.npz` by frame and `truth/00000_cam02.npz` by held-out picture (`depth`,
`flow`, and its camera), with `scene.json` for the name and the exact depth bounds.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from zestjax.base.types import Array, FilePath
from zestjax.cameras import Camera, camera_from_llff_pose, check_camera
from zestjax.io.files import replaced_folder
from zestjax.io.layouts import (
    HeldOut,
    Later,
    Record,
    as_float32,
    bounds_from_frames,
    check_order,
    check_sizes,
    files_in,
    frames_by_number,
    one_each,
    pictures_in,
    select,
)
from zestjax.io.pictures import SUFFIXES, write_image
from zestjax.io.posed import about_of, write_about
from zestjax.io.reading import check_numbers, numbers_of, read_array, read_arrays, visible
from zestjax.io.rig import find_rig, numbered, targets_of
from zestjax.video import Video

MARKER = "poses_bounds.npy"


def is_nsff(path: Path) -> bool:
    """Whether a folder is in this layout."""
    root = _root(path)
    return (root / MARKER).is_file() and bool(_frames(root))


def read_nsff(path: Path) -> Record:
    """Read the folder to a `Record`.

    Raises:
      ValueError: poses are not (N, 17) or not finite, or there are not as many pictures as poses.
    """
    root = _root(path)
    source, images = root / MARKER, _frames(root)
    rows = read_array(source)
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.isfinite(rows).all():
        raise ValueError(f"{source}: should hold finite (N, 17) poses and bounds, got {rows.shape}; write it again.")
    if not images or len(rows) != len(images):
        raise ValueError(
            f"{source}: has {len(rows)} poses for {len(images)} pictures; complete it, or remove the extra ones."
        )
    check_order(images, source)
    poses = rows[:, :15].astype(np.float64).reshape(-1, 3, 5)
    size, _ = check_sizes(source, poses[..., 4])
    cameras = Camera(*map(np.asarray, camera_from_llff_pose(as_float32(source, poses))))
    scene = path.resolve().parent if path.resolve().name == "dense" else path.resolve()
    name, bounds = about_of(root)
    near, far = bounds or bounds_from_frames(rows[:, 15:], where=str(source))
    listed = lambda folder, suffixes: one_each(root / folder, files_in(root / folder, suffixes), images)
    forward, backward = _flows(root / "flow_i1", images)
    return Record(
        name=name or scene.name,
        layout="nsff",
        images=images,
        cameras=cameras,
        size=size,
        near=near,
        far=far,
        motion_masks=listed("motion_masks", SUFFIXES),
        disparity=listed("disp", (".npy",)),
        flow_forward=forward,
        flow_backward=backward,
        truth=_truths(root / "truth", images),
        held_out=Later(lambda: _held_out(root, images, cameras)),
    )


def write_nsff(
    folder: FilePath,
    name: str,
    video: Video,
    *,
    motion_masks: Array | None = None,
    disparity: Array | None = None,
    flow_forward: tuple[Array, Array] | None = None,
    flow_backward: tuple[Array, Array] | None = None,
    truth: Sequence[Mapping[str, Array]] | None = None,
    held_out: Iterable = (),
) -> None:
    """Write a scene in this layout, all or nothing.

    Args:
      folder: the destination: absent, empty, or an earlier scene, which is replaced.
      name: of the scene.
      video: `Video`; one focal length a frame, principal point in the middle: the layout knows no other cameras.
      motion_masks: (N, H, W) bool, or None.
      disparity: (N, H, W), or None.
      flow_forward: (vectors (N, H, W, 2), valid (N, H, W)) towards the next frame, or None; the last frame's is not
        written.
      flow_backward: the same towards the previous one; the first frame's is not written.
      truth: one dict of arrays by frame, written as they are, or None.
      held_out: iterable of `zestjax.io.scenes.Target`, read once; it may render them as it goes.

    Raises:
      ValueError: a camera the layout cannot hold, or a folder with something else in it, which is left alone.
      OSError: the disk is full or the place not writable; nothing half-written is left, an earlier scene is unchanged.
    """
    rows = poses_bounds(video)
    with replaced_folder(folder, marker=MARKER) as root:
        np.save(root / MARKER, rows)
        write_about(root, name, (float(video.near), float(video.far)))
        for i, image in enumerate(np.asarray(video.images)):
            write_image(root / f"images/{i:05d}.png", image)
            if motion_masks is not None:
                write_image(root / f"motion_masks/{i:05d}.png", np.asarray(motion_masks[i], bool))
            if disparity is not None:
                _save(root / f"disp/{i:05d}.npy", np.asarray(disparity[i], np.float32))
            if flow_forward is not None and i + 1 < len(rows):
                _save_flow(root / f"flow_i1/{i:05d}_fwd.npz", flow_forward, i)
            if flow_backward is not None and i > 0:
                _save_flow(root / f"flow_i1/{i:05d}_bwd.npz", flow_backward, i)
            if truth is not None:
                _save(root / f"truth/{i:05d}.npz", **truth[i])
        for target in held_out:
            _write_target(root, target)


def poses_bounds(video: Video) -> np.ndarray:
    """(N, 17) rows of `poses_bounds.npy`.

    Raises:
      ValueError: a camera has two focal lengths, skew, or its principal point off the middle by over 0.01 pixels.
    """
    k = np.asarray(video.cameras.intrinsics, np.float64)
    pose = np.linalg.inv(np.asarray(video.cameras.camera_from_world, np.float64))
    height, width = video.images.shape[1:3]
    wanted = np.zeros_like(k)
    wanted[:, 0, 0] = wanted[:, 1, 1] = k[:, 0, 0]
    wanted[:] += [[0, 0, (width - 1) / 2], [0, 0, (height - 1) / 2], [0, 0, 1]]
    if np.abs(k - wanted).max() > 0.01:
        raise ValueError(
            "poses_bounds: this layout holds cameras of one focal length without skew, centred in the image; "
            f"camera {int(np.abs(k - wanted).max((1, 2)).argmax())} is another."
        )
    right, down, forward, position = (pose[:, :3, i] for i in range(4))
    size = np.stack([np.full(len(k), height), np.full(len(k), width), k[:, 0, 0]], -1)
    rows = np.stack([down, right, -forward, position, size], -1).reshape(-1, 15)
    bounds = np.broadcast_to([float(video.near), float(video.far)], (len(k), 2))
    return np.concatenate([rows, bounds], -1)


def _root(path):
    return path / "dense" if (path / "dense").is_dir() else path


def _frames(root):
    """The frames' files: of `images/`, or of the largest of the folders of smaller ones."""
    sized = [(-int(m[1]), p) for p in visible(root) if (m := re.fullmatch(r"images_(\d+)x\d+", p.name))]
    shrunk = [(int(m[1]), p) for p in visible(root) if (m := re.fullmatch(r"images_(\d+)", p.name))]
    folders = [root / "images", *(folder for _, folder in sorted(sized) + sorted(shrunk))]
    return next((files for folder in folders if (files := pictures_in(folder))), ())


def _flows(folder, images):
    """({frame: file} towards the next, {frame: file} towards the previous one).

    Raises:
      ValueError: the files' numbers are neither those in the frames' names nor places from 0.
    """
    found = [(m, p) for p in visible(folder) if (m := re.fullmatch(r"(\d+)_(fwd|bwd)\.(npz|flo)", p.name))]
    forward, backward = ({int(m[1]): p for m, p in found if m[2] == way} for way in ("fwd", "bwd"))

    def fits(frames):  # the last frame has no next one, the first no previous one
        return len(images) - 1 not in map(frames.get, forward) and 0 not in map(frames.get, backward)

    frames = frames_by_number(images, {*forward, *backward}, fits=fits)
    if frames is None:
        raise ValueError(
            f"{folder}: {found[0][1].name} to {found[-1][1].name} are not flows between {images[0].name} and "
            f"{images[-1].name}; give them the frames' numbers, or remove those of other frames."
        )
    return tuple({frames[number]: path for number, path in files.items()} for files in (forward, backward))


def _truths(folder, images):
    """{frame: file} of the frames' own truth files."""
    files = {int(m[1]): p for p in visible(folder) if (m := re.fullmatch(r"(\d+)\.npz", p.name))}
    frames = frames_by_number(images, files, fits=lambda frames: True) or {}
    return {frames[number]: path for number, path in files.items() if number in frames}


def _held_out(root, images, cameras):
    """Pictures of other cameras at each time, by time and name.

    A picture's camera is that of its truth file; without one, that of a frame which the same camera took.
    """
    folders = {int(p.name): p for p in visible(root / "mv_images") if re.fullmatch(r"[0-9]{1,9}", p.name)}
    named = {number: i for i, number in enumerate(numbers_of(images) or ())}
    times = named if folders.keys() <= named.keys() else {i: i for i in range(len(images))}
    by_time = {times[number]: pictures_in(p) for number, p in folders.items() if number in times}
    files = [(time, file) for time, files in sorted(by_time.items()) for file in files]
    truths = {entry: truth for entry in files if (truth := _truth_of(root, entry[1])).is_file()}
    known = {entry: camera for entry, truth in truths.items() if (camera := _camera_of(truth)) is not None}
    if len(known) < len(files):
        pictures = numbered(by_time)
        rig = find_rig(root / "mv_images", images, pictures)
        told = {(time, pictures[time][number]): place for time, number, place in targets_of(rig, pictures, len(images))}
        known = {entry: select(cameras, place) for entry, place in told.items()} | known
    for time, file in files:
        if (time, file) in known:
            masks = {mask.stem: mask for mask in pictures_in(root / "mv_masks" / file.parent.name)}
            yield HeldOut(time, file.stem, known[time, file], file, masks.get(file.stem), truths.get((time, file)))


def _truth_of(root, file):
    return root / f"truth/{file.parent.name}_{file.stem}.npz"


def _camera_of(truth):
    arrays = read_arrays(truth, names=Camera._fields)
    if not arrays:
        return None
    if missing := set(Camera._fields) - arrays.keys():
        raise ValueError(f"{truth}: holds half a camera, `{missing.pop()}` is missing; write it again.")
    shapes = dict(intrinsics=(3, 3), camera_from_world=(4, 4))
    check = lambda name: check_numbers(truth, arrays[name], shape=shapes[name], name=name, finite=True)
    camera = Camera(*(as_float32(truth, check(name)) for name in Camera._fields))
    check_camera(str(truth), camera)
    return camera


def _write_target(root, target):
    place = f"{target.time:05d}/{target.camera_name}.png"
    write_image(root / "mv_images" / place, target.image)
    if target.dynamic is not None:
        write_image(root / "mv_masks" / place, np.asarray(target.dynamic, bool))
    known = {"depth": target.depth, "flow": target.flow, **target.camera._asdict()}
    known = {key: np.asarray(value, np.float32) for key, value in known.items() if value is not None}
    _save(root / f"truth/{target.time:05d}_{target.camera_name}.npz", **known)


def _save_flow(path, flow, i):
    vectors, valid = flow
    _save(path, flow=np.asarray(vectors[i], np.float32), mask=np.asarray(valid[i], np.float32))


def _save(path, array=None, **arrays):
    path.parent.mkdir(parents=True, exist_ok=True)
    if array is not None:
        np.save(path, array)
    else:
        np.savez_compressed(path, **arrays)
