"""`zestjax prepare`: a video file, or a folder of pictures, to a scene that the other commands open.

Each stage leaves its result in a hidden folder of the scene's, whole or not at all; the same command, killed and run
again, goes on from there. The scene appears at the end, `poses_bounds.npy` last, and the hidden folder goes.

    frames      measured, chosen, brought to size
    poses_1     cameras from all features
    flow        between neighbours, a file a pair
    maps_1      what moves, by these cameras
    poses_2     cameras again, without features on what moves
    maps_2      what moves, and inverse depth
"""

import dataclasses
import io
import json
import shutil
import warnings
from pathlib import Path

import numpy as np

from zestjax.apps.prepare_frames import each_frame, find_source, measured, pick, shrunk
from zestjax.apps.prepare_maps import FlowPair, Maps, avoided, flow_between, frame_maps, scene_video
from zestjax.apps.progress import progress
from zestjax.apps.quality import quality_of, write_quality
from zestjax.apps.run_folder import LOCK, held
from zestjax.apps.tables import counted
from zestjax.io.files import resolved, write_bytes
from zestjax.io.nsff import MARKER, write_nsff
from zestjax.io.pictures import read_image, to_bytes, write_image
from zestjax.io.reading import read_arrays, read_json
from zestjax.sfm.estimate import Estimated, estimate_cameras

WORK, OURS = ".prepare", "quality.json"
KINDS = ("moving", "turning", "still")
LEAST_SHARE = 0.5  # of the frames that must have a camera: less is not this video's scene


@dataclasses.dataclass(frozen=True)
class PrepareOptions:
    """The flags of `zestjax prepare`. source: a video or a folder. frames, height: at most. focal: pixels of the
    source, or fov: degrees across, where they are known."""

    source: Path
    out: Path
    frames: int = 24
    height: int = 288
    focal: float | None = None
    fov: float | None = None
    seed: int = 0
    quiet: bool = False


def prepare(options):
    """Run `zestjax prepare`.

    Returns:
      str, the summary line.

    Raises:
      ValueError: a source that is no video, or whose cameras cannot be found; nothing is left in the folder.
      OSError: the disk is full or the place not writable; the same command goes on later.

    Warns:
      UserWarning: each thing in doubt.
    """
    if options.fov is not None and not 1 <= options.fov < 179:
        raise ValueError(f"prepare: --fov {options.fov:g} is no field of view; give degrees from 1 to 178.")
    if options.frames < 2:
        raise ValueError(f"prepare: {options.frames} frame is no video; give --frames 2 or more.")
    source, out = find_source(options.source), Path(options.out)
    _check_place(source, out)
    existed = out.exists()
    with held(out, doing="preparing"):
        work = out / WORK
        _begin(work, _identity(options, source))
        try:
            return _prepared(options, source, out, work)
        except ValueError:
            shutil.rmtree(work, ignore_errors=True)
            raise
        finally:
            if not existed and not any(path.name != LOCK for path in out.glob("*")):
                shutil.rmtree(out, ignore_errors=True)


def _check_place(source, out):
    """Refuse a folder that holds something else, or the pictures themselves."""
    place, given = resolved(out), resolved(source.path)
    if place == given or given.is_relative_to(place) or (given.is_dir() and place.is_relative_to(given)):
        raise ValueError(f"{out}: the source lies there, or it in the source; choose another --out.")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is a file; choose another --out.")
    others = [p.name for p in out.glob("*") if p.name not in (WORK, LOCK)] if out.is_dir() else []
    if others and OURS not in others and not (out / WORK).is_dir():
        raise ValueError(f"{out}: holds files that `prepare` did not write; choose an empty or a new folder.")


def _identity(options, source):
    """What a run that goes on must share with the one before."""
    files = source.files or (source.path,)
    found = [[path.name, path.stat().st_size, path.stat().st_mtime_ns] for path in files]
    told = {key: getattr(options, key) for key in ("frames", "height", "focal", "fov", "seed")}
    return told | {"source": str(resolved(source.path)), "files": found}


def _begin(work, identity):
    """Keep what an equal command left; remove what another one did."""
    plan = work / "plan.json"
    try:
        same = read_json(plan) == identity
    except ValueError:
        same = False
    if work.exists() and not same:
        shutil.rmtree(work)
    work.mkdir(exist_ok=True)
    write_bytes(plan, json.dumps(identity).encode())


def _prepared(options, source, out, work):
    """Run the stages that are missing; the summary line."""
    told = _frames(options, source, work)
    images = np.stack([to_bytes(read_image(work / f"images/{i:05d}.png")) for i in range(len(told["chosen"]))])
    cameras, flows, maps = _two_passes(options, told, work, images)
    quality = quality_of(str(options.source), told, cameras, flows, maps, given=_focal(options, told) is not None)
    if not (work / "scene/done").exists():
        video = scene_video(images, cameras)
        _write_scene(work / "scene", out.resolve().name, video, flows, maps)
        write_quality(work / "scene", quality, images[cameras.registered], maps.moving, cameras)
        write_bytes(work / "scene/done", b"")
    _publish(out, work)
    for doubt in quality["doubts"]:
        warnings.warn(f"{out}: {doubt['says']}; {doubt['advice']}.", stacklevel=2)
    height, width = images.shape[1:3]
    count, kind = int(cameras.registered.sum()), quality["camera"]
    doubts = f", {counted(len(quality['doubts']), 'doubt')}: see quality.html" if quality["doubts"] else ""
    return f"prepare: {counted(count, 'frame')} of {height}x{width}, camera {kind}{doubts}: {out}"


def _frames(options, source, work):
    """Choose the frames and write them; what is known of them, a dict."""
    record = work / "frames.json"
    if record.exists():
        return read_json(record)
    found = measured(source, options.height, quiet=options.quiet)
    chosen = pick(found, options.frames)
    places = {frame: place for place, frame in enumerate(chosen)}
    for i, frame in enumerate(progress(each_frame(source), "pictures", quiet=options.quiet)):
        if i in places:
            write_image(work / f"images/{places[i]:05d}.png", shrunk(frame, found.size))
        if i == chosen[-1]:
            break
    told = {
        "found": len(found.sharp), "repeated": sum(found.same), "chosen": chosen, "stored": list(found.stored),
        "size": list(found.size), "sharpness": [found.sharp[i] for i in chosen],
        "names": [source.files[i].name for i in chosen] if source.files else None,
    }  # fmt: skip
    write_bytes(record, json.dumps(told).encode())
    return told


def _focal(options, told):
    """Pixels of the working size, or None where neither is known."""
    width = told["size"][1]
    if options.fov is not None:
        return width / 2 / np.tan(np.radians(options.fov) / 2)
    return None if options.focal is None else options.focal * width / told["stored"][1]


def _two_passes(options, told, work, images):
    """(`Estimated`, list of `FlowPair`, `Maps`): cameras, what moves by them, and both again without what moves."""
    cameras, flows, maps, avoid = None, [], None, None
    for turn in (1, 2):
        start = cameras.focal if cameras is not None and cameras.kind == "moving" else None
        cameras = _cameras(options, told, work / f"poses_{turn}.npz", images, avoid, start, cameras)
        index = np.flatnonzero(cameras.registered)
        steps = progress(list(zip(index[:-1], index[1:], strict=True)), "flow", quiet=options.quiet)
        flows = [_flow(work / f"flow/{a:05d}_{b:05d}.npz", images[a], images[b]) for a, b in steps]
        make = lambda c=cameras, f=flows: frame_maps(scene_video(images, c), c, f)
        maps = Maps(**{"disparity": None, **_stored(work / f"maps_{turn}.npz", make)})
        avoid = [None] * len(images)
        for i, mask in zip(index, avoided(maps.moving), strict=True):
            avoid[i] = mask
    assert cameras is not None and maps is not None
    return cameras, flows, maps


def _cameras(options, told, path, images, avoid, start, before):
    """The cameras, the focal length held in the first pass; where what moves leaves too little for a second one, those
    of the first stay."""

    def make():
        found = before
        try:
            watch = lambda items, label: progress(items, label, quiet=options.quiet)
            found = estimate_cameras(
                images, avoid=avoid, start=start, focal=_focal(options, told), free_focal=before is not None,
                seed=options.seed, watch=watch,
            )  # fmt: skip
        except ValueError as error:
            if before is None:
                raise ValueError(f"{options.source}: {str(error).partition(': ')[2]}") from error
        if before is not None and (found.kind != before.kind or found.registered.sum() < before.registered.sum()):
            found = before  # without what moves too little is left to tell, or to register
        return found._replace(kind=KINDS.index(found.kind), focal_error=found.focal_error or np.nan)

    cameras = _estimated(_stored(path, make))
    if cameras.registered.mean() < LEAST_SHARE:
        raise ValueError(
            f"{options.source}: only {cameras.registered.sum()} of {len(images)} frames have a camera; give a part of "
            "it that shows one scene, sharply, from a camera that moves past it."
        )
    return cameras


def _estimated(stored):
    """The `Estimated` of its arrays in a file, whose kind is a number there, and NaN what is not known."""
    values = {name: value.item() if value.ndim == 0 else value for name, value in stored.items()}
    error = values["focal_error"]
    return Estimated(**values)._replace(kind=KINDS[values["kind"]], focal_error=error if np.isfinite(error) else None)


def _flow(path, image, other):
    return FlowPair(**_stored(path, lambda: flow_between(image, other)))


def _stored(path, make):
    """The arrays that a stage left in a file; else those of the NamedTuple that it makes now, and leaves there."""
    if not path.exists():
        content = io.BytesIO()
        arrays = {name: np.asarray(value) for name, value in make()._asdict().items() if value is not None}
        np.savez(content, allow_pickle=False, **arrays)
        write_bytes(path, content.getvalue())
    return read_arrays(path)


def _write_scene(folder, name, video, flows, maps):
    """The scene in the NSFF layout; an end of the video has no flow beyond it."""
    empty = np.zeros_like(flows[0].there), np.zeros_like(flows[0].sure_there)
    forward = [(pair.there, pair.sure_there) for pair in flows] + [empty]
    backward = [empty] + [(pair.back, pair.sure_back) for pair in flows]
    stacked = lambda ways: (np.stack([vectors for vectors, _ in ways]), np.stack([sure for _, sure in ways]))
    shutil.rmtree(folder, ignore_errors=True)
    write_nsff(
        folder, name, video, motion_masks=maps.moving, disparity=maps.disparity, flow_forward=stacked(forward),
        flow_backward=stacked(backward),
    )  # fmt: skip


def _publish(out, work):
    """Move the scene into its place, once what lay there is out of the way; killed in between, it goes on."""
    fresh, old, ready = work / "scene", work / "old", work / "ready"
    if not ready.exists():
        old.mkdir(exist_ok=True)
        for path in sorted(out.glob("*"), key=lambda path: path.name != MARKER):
            if path.name not in (WORK, LOCK):
                path.rename(old / path.name)
        write_bytes(ready, b"")
    for path in sorted(fresh.glob("*"), key=lambda path: (path.name == MARKER, path.name)):
        if path.name != "done":
            path.rename(out / path.name)
    shutil.rmtree(work)
