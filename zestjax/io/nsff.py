"""NSFF's layout, which is also how the NVIDIA Dynamic Scenes come and what `zestjax simulate` writes.

Under the scene's folder, or `dense/` in it:

    poses_bounds.npy            (N, 17): 3 x 5 [down right back position | height width focal], near, far
    images/                     N pictures, sorted by name (or images_<W>x<H>/, or images_<factor>/ as LLFF has)
    mv_images/00000/cam01.png   what every camera of the rig saw at a time; frame i was taken by camera i mod rig, and
                                camera c is cam01 and so on as published: `zestjax.io.rig` reads other numberings too
    mv_masks/00000/cam01.png    their moving pixels
    motion_masks/00000.png      moving pixels of the frames
    disp/00000.npy              (H, W) disparity, up to scale and shift (an inverse depth when simulated)
    flow_i1/00000_fwd.npz       `flow` (H, W, 2) pixels and `mask` (H, W) towards the next frame; `_bwd` the previous;
                                or 00000_fwd.flo

and, where the truth is known, `truth/00000.npz` by frame and `truth/00000_cam02.npz` by held-out picture (`depth`,
`flow`, and its camera), with `scene.json` for the name and the exact depth bounds.
"""

import json
import re

import numpy as np

from zestjax.cameras import Camera, camera_from_llff_pose
from zestjax.io.files import replaced_folder
from zestjax.io.layouts import HeldOut, Later, Record, bounds_from_frames, pictures_in, select
from zestjax.io.pictures import write_image
from zestjax.io.rig import find_rig, numbered, targets_of

MARKER = "poses_bounds.npy"


def is_nsff(path):
    """Whether a folder is in this layout."""
    root = _root(path)
    return (root / MARKER).is_file() and bool(_frames(root))


def read_nsff(path):
    """Read the folder to a `Record`.

    Raises:
      ValueError: poses are not (N, 17) or not finite, or there are not as many pictures as poses.
    """
    root = _root(path)
    source, images = root / MARKER, _frames(root)
    try:
        rows = np.load(source, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"{source}: is not a numpy file ({error}); copy or write it again.") from error
    if rows.ndim != 2 or rows.shape[1] != 17 or not np.isfinite(rows).all():
        raise ValueError(f"{source}: should hold finite (N, 17) poses and bounds, got {rows.shape}; write it again.")
    if not images or len(rows) != len(images):
        raise ValueError(
            f"{source}: has {len(rows)} poses for {len(images)} pictures; complete it, or remove the extra ones."
        )
    poses = rows[:, :15].reshape(-1, 3, 5)
    if not np.allclose(poses[:, :2, 4], poses[0, :2, 4]):
        raise ValueError(f"{source}: frames of several sizes are not one video; resize them to one.")
    cameras = Camera._make(map(np.asarray, camera_from_llff_pose(poses.astype(np.float32))))
    about = json.loads((root / "scene.json").read_text()) if (root / "scene.json").is_file() else {}
    near, far = (about["near"], about["far"]) if "near" in about else bounds_from_frames(rows[:, 15:])
    scene = path.resolve().parent if path.resolve().name == "dense" else path.resolve()
    return Record(
        name=about.get("name", scene.name),
        layout="nsff",
        images=images,
        cameras=cameras,
        size=(round(poses[0, 0, 4]), round(poses[0, 1, 4])),
        near=near,
        far=far,
        motion_masks=dict(enumerate(_one_each(root / "motion_masks", pictures_in, images))),
        disparity=dict(enumerate(_one_each(root / "disp", lambda folder: tuple(sorted(folder.glob("*.npy"))), images))),
        flow_forward=_flows(root, "fwd"),
        flow_backward=_flows(root, "bwd"),
        truth={i: p for i in range(len(rows)) if (p := root / f"truth/{i:05d}.npz").is_file()},
        held_out=Later(lambda: _held_out(root, images, cameras)),
    )


def write_nsff(
    folder,
    name,
    video,
    *,
    motion_masks=None,
    disparity=None,
    flow_forward=None,
    flow_backward=None,
    truth=None,
    held_out=(),
):
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
        about = {"name": name, "near": float(video.near), "far": float(video.far)}
        (root / "scene.json").write_text(json.dumps(about, indent=1))
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


def poses_bounds(video):
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
    sized = [(-int(m[1]), p) for p in root.glob("images_*x*") if (m := re.fullmatch(r"images_(\d+)x\d+", p.name))]
    shrunk = [(int(m[1]), p) for p in root.glob("images_*") if (m := re.fullmatch(r"images_(\d+)", p.name))]
    folders = [root / "images", *(folder for _, folder in sorted(sized) + sorted(shrunk))]
    return next((files for folder in folders if (files := pictures_in(folder))), ())


def _one_each(folder, listing, images):
    """One file for every frame, in order; none at all when the folder is absent.

    Raises:
      ValueError: there are some, but not as many as frames.
    """
    files = listing(folder) if folder.is_dir() else ()
    if files and len(files) != len(images):
        raise ValueError(
            f"{folder}: has {len(files)} files for {len(images)} frames; complete it, or remove the folder."
        )
    return files


def _flows(root, direction):
    matches = ((re.fullmatch(rf"(\d+)_{direction}\.(npz|flo)", p.name), p) for p in (root / "flow_i1").glob("*"))
    return {int(match[1]): path for match, path in matches if match}


def _held_out(root, images, cameras):
    """Pictures of other cameras at each time, by time and name.

    A picture's camera is that of its truth file; without one, that of a frame which the same camera took.
    """
    by_time = {int(p.name): pictures_in(p) for p in sorted((root / "mv_images").glob("*")) if p.name.isdigit()}
    files = [(time, file) for time, files in sorted(by_time.items()) if time < len(images) for file in files]
    truths = {entry: truth for entry in files if (truth := _truth_of(root, *entry)).is_file()}
    known = {entry: camera for entry, truth in truths.items() if (camera := _camera_of(truth)) is not None}
    if len(known) < len(files):
        pictures = numbered(by_time)
        rig = find_rig(root / "mv_images", images, pictures)
        told = {(time, pictures[time][number]): place for time, number, place in targets_of(rig, pictures, len(images))}
        known = {entry: select(cameras, place) for entry, place in told.items()} | known
    for time, file in files:
        if (time, file) in known:
            mask = root / f"mv_masks/{time:05d}/{file.stem}.png"
            mask, truth = mask if mask.is_file() else None, truths.get((time, file))
            yield HeldOut(time, file.stem, known[time, file], file, mask, truth)


def _truth_of(root, time, file):
    return root / f"truth/{time:05d}_{file.stem}.npz"


def _camera_of(truth):
    with np.load(truth, allow_pickle=False) as arrays:
        return Camera(arrays["intrinsics"], arrays["camera_from_world"]) if "intrinsics" in arrays else None


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
