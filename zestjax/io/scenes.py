"""A scene ready for use: the input video, and the pictures it is judged by.

    N        frames of the input video
    H W      rows and columns asked for; everything is brought to them, cameras and flow vectors with it
    target   a camera and a time to predict, with the truth where there is one

A protocol says what the targets are:

    held-out   pictures of other cameras than the one that took the frame of their time; all frames are inputs. Where
               there are none: the frames that the layout reserves, which are then never inputs
    strict     frames of the video itself, each never among its own inputs
    paper      frames of the video itself, which are among the inputs: this leaks the answer, and is kept only to set
               figures beside the paper's
    fixed-view the first twelve frames are the inputs; the camera of the first is held, and predicted at the times that
               other cameras took (Gao et al. 2021, DynNeRF, and those who compare with it)
"""

import dataclasses
import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zestjax.base.checks import check_option
from zestjax.base.types import FilePath
from zestjax.cameras import Camera, resized
from zestjax.frames.inputs import check_inputs
from zestjax.io.colmap import is_colmap, read_colmap
from zestjax.io.idr import is_idr, read_idr
from zestjax.io.layouts import select
from zestjax.io.lens import undistorted
from zestjax.io.llff import is_llff, read_llff
from zestjax.io.maps import FlowMaps, disparity_of, flow_of, masks_of, truth_of
from zestjax.io.n3dv import is_n3dv, read_n3dv
from zestjax.io.nerfies import is_nerfies, read_nerfies
from zestjax.io.nrnerf import is_nrnerf, read_nrnerf
from zestjax.io.nsff import is_nsff, read_nsff
from zestjax.io.pictures import SUFFIXES, image_size, read_image, read_mask, resize_area, resize_nearest
from zestjax.io.reading import open_regular, visible
from zestjax.io.table import is_table, read_table
from zestjax.io.transforms import is_transforms, read_transforms
from zestjax.video import Video

PROTOCOLS = ("held-out", "strict", "paper", "fixed-view")
FIXED_VIEW_FRAMES = 12  # as DynNeRF counts them, one of each camera of the rig

LAYOUTS = dict(
    idr=(is_idr, read_idr),
    llff=(is_llff, read_llff),
    nsff=(is_nsff, read_nsff),
    nrnerf=(is_nrnerf, read_nrnerf),
    table=(is_table, read_table),
    nerfies=(is_nerfies, read_nerfies),
    transforms=(is_transforms, read_transforms),
    colmap=(is_colmap, read_colmap),
    n3dv=(is_n3dv, read_n3dv),
)
"""By name: a function of the folder that recognises it, and one that reads it to a `zestjax.io.layouts.Record`. A
folder in several of them is read by the first, unless one is named."""

_PICTURES = "no pictures to it in images/ or image/"
MARKS = {
    "poses_bounds.npy": _PICTURES,
    "cameras_sphere.npz": _PICTURES,
    "cameras.npz": _PICTURES,
    "precomputed.json": "it is no file",
    "cameras.csv": "it is no file",
    "dataset.json": "not metadata.json, scene.json and camera/ besides",
    "transforms.json": "it is no file",
    "sparse": "no cameras and images (.bin or .txt) in it or in sparse/0, or no pictures to them in images/",
}
"""By name: the layouts' files of cameras, and what may miss where one is there and the layout is not recognised."""

FOREIGN = {"transforms_train.json": "Blender's"}


@dataclass(frozen=True)
class Target:
    """A picture to predict.

    time: frame index. camera_name: str. camera: `Camera` of numpy arrays. image: (H, W, 3) float32, or None where the
    truth is not known. dynamic: (H, W) bool, moving pixels. exclude: input frames that may not be used for it.
    depth: (H, W) world units. flow: (H, W, 2) pixels towards the next time, NaN where not known.
    """

    time: int
    camera_name: str
    camera: Camera
    image: np.ndarray | None = None
    dynamic: np.ndarray | None = None
    exclude: tuple[int, ...] = ()
    depth: np.ndarray | None = None
    flow: np.ndarray | None = None


class Targets(Sequence):
    """Targets that are read when they are asked for, and not kept."""

    def __init__(self, readers: Sequence[Callable[[], Target]]):
        self._readers = tuple(readers)

    def __len__(self):
        return len(self._readers)

    def __getitem__(self, index):
        return Targets(self._readers[index]) if isinstance(index, slice) else self._readers[index]()


@dataclass(frozen=True)
class Scene:
    """A scene in memory, as numpy arrays.

    name, layout: str. video: `Video`. targets: sequence of `Target`, which may read them as it goes. motion_masks:
    (N, H, W) bool. flow_forward, flow_backward: `FlowMaps`. disparity: (N, H, W), up to scale and shift. stored:
    (height, width) of the first picture's file. What a scene lacks is None.
    """

    name: str
    video: Video
    targets: Sequence[Target]
    motion_masks: np.ndarray | None = None
    flow_forward: FlowMaps | None = None
    flow_backward: FlowMaps | None = None
    disparity: np.ndarray | None = None
    layout: str = ""
    stored: tuple[int, int] | None = None


def load_scene(
    path: FilePath,
    *,
    height: int | None = None,
    width: int | None = None,
    layout: str | None = None,
    protocol: str = "held-out",
    targets: Sequence[int] | Sequence[tuple[int, str]] | None = None,
    exclude: Collection[int] = (),
) -> Scene:
    """Read a scene from a folder; the protocol `paper` is the released ZeST-NeRF's.

    Differs from the reference: frames that are predicted are never among the inputs, but with `paper`.

    Args:
      path: a folder in one of the layouts of `LAYOUTS`, or one that holds a single such folder, up to two levels below.
      height: rows wanted; None follows from the width by the pictures' shape, or is theirs.
      width: columns wanted; the same.
      layout: its name; recognised unless told.
      protocol: one of `PROTOCOLS`; see above.
      targets: which times to predict, as frame indices; `(time, camera name)` pairs choose single pictures; None for
        all.
      exclude: frames whose pictures are not read; they are black. (With `held-out`, where poses must be told from
        photographs, `zestjax.io.rig` looks at all.)

    Returns:
      `Scene`.

    Raises:
      ValueError: no such folder, unknown layout, a frame to exclude that the video does not have, a file that is not
        what it should be, a protocol that the scene has no targets for, targets that do not exist, or a video that
        `check_inputs` refuses.
    """
    path = Path(path)
    check_option("load_scene", protocol=(protocol, PROTOCOLS))
    path, layout = _found(path, layout)
    record = _asked_of(path, LAYOUTS[layout][1](path), protocol)
    if outside := [i for i in exclude if not 0 <= i < len(record.images)]:
        raise ValueError(f"{path}: no frame {outside[0]} to exclude; the video has 0 to {len(record.images) - 1}.")
    shown = [i for i in range(len(record.images)) if i not in set(exclude)]
    stored = image_size(record.images[shown[0] if shown else 0])
    size = _size(stored, height, width)
    images = np.zeros((len(record.images), *size, 3), np.float32)
    for i in shown:
        images[i] = _picture(record, record.images[i], record.lenses.get(i), size)
    cameras = _resized(record.cameras, record.size, size)
    video = Video(images, cameras, np.float32(record.near), np.float32(record.far))
    check_inputs(str(path), video)
    masks = masks_of(record, size)
    listed = _listed(record, video, masks, protocol)
    return Scene(
        name=record.name,
        video=video,
        targets=Targets(_chosen(path, listed, targets)),
        motion_masks=masks,
        flow_forward=flow_of(record, record.flow_forward, size),
        flow_backward=flow_of(record, record.flow_backward, size),
        disparity=disparity_of(record, size),
        layout=record.layout,
        stored=stored,
    )


def _asked_of(path, record, protocol):
    """What of a record a protocol looks at, if it has targets for it."""
    record = record.first(FIXED_VIEW_FRAMES) if protocol == "fixed-view" else record
    others = protocol in ("held-out", "fixed-view")
    if others and not record.held_out and not (protocol == "held-out" and record.reserved):
        raise ValueError(f"{path}: has no pictures of other cameras (mv_images) for `{protocol}`; use `strict`.")
    return record


def _found(path, layout):
    """The folder of the scene, which may lie inside the one given, and its layout."""
    if not path.is_dir():
        what = "is a file; give the folder of a scene" if path.is_file() else "is not a folder; give one"
        raise ValueError(f"{path}: {what} in a supported layout ({', '.join(LAYOUTS)}).")
    if layout is not None:
        check_option("load_scene", layout=(layout, tuple(LAYOUTS)))
    known = {layout: LAYOUTS[layout]} if layout is not None else LAYOUTS
    found = scenes_in(path, known=known)
    if len(folders := {folder for folder, _ in found}) > 1:
        names = ", ".join(sorted({str(p.relative_to(path)) for p in folders})[:5])
        raise ValueError(f"{path}: holds several scenes ({names}); name one of them.")
    if found:
        return found[0]
    raise ValueError(f"{path}: {_unsupported(path, tuple(known))}")


def scenes_in(path: FilePath, *, known: Mapping[str, tuple] = LAYOUTS) -> list[tuple[Path, str]]:
    """The scenes that a folder is or holds, at the first of three levels that has any.

    Args:
      path: a folder.
      known: layouts by name, as `LAYOUTS`.

    Returns:
      list of (folder, name of a layout that it is in).
    """
    folders = [Path(path)]
    for _ in range(3):
        if found := [(p, name) for p in folders for name, (recognises, _) in known.items() if recognises(p)]:
            return found
        folders = [inside for p in folders for inside in visible(p) if inside.is_dir() and os.access(inside, os.X_OK)]
    return []


def _unsupported(path, known):
    """Why a folder is in none of some layouts: which of their files are there, and what is not read of the rest."""
    inside = {p.name: p for root in (path / "dense", path) for p in visible(root)}
    marks = [name for name in MARKS if name in inside]
    for name in marks:
        if name != "sparse":
            with open_regular(inside[name]):  # or it is refused by what it is
                pass
    folders = [p for root in (path, path / "dense") for p in visible(root) if re.fullmatch(r"images?(_.*)?", p.name)]
    others = sorted({p.suffix.lower() for folder in folders for p in visible(folder)} - {*SUFFIXES, ""})
    said = [f"is in none of the supported layouts ({', '.join(known)})"]
    said += [f"it has {name}, but {MARKS[name]}" for name in marks]
    said.append(f"it has none of {', '.join(name for name in MARKS if name not in marks)}")
    if others:
        said.append(f"files of {', '.join(others[:5])} are not read, pictures of {', '.join(SUFFIXES)} are")
    said += [f"{name} is {whose}, which is not read" for name, whose in FOREIGN.items() if name in inside]
    return "; ".join(said) + "; see `zestjax.io` on each."


def _size(have, height, width):
    """(height, width), each from the other and the stored size (height, width) where not given."""
    if height is None:
        height = have[0] if width is None else round(width * have[0] / have[1])
    width = round(height * have[1] / have[0]) if width is None else width
    if min(height, width) < 1:
        raise ValueError(f"load_scene: the size is {height}x{width}, expected at least 1x1.")
    return int(height), int(width)


def _picture(record, file, lens, size):
    """A picture's file as the record's cameras see it: without distortion, at a size."""
    stored = read_image(file, native=record.size, transparent=record.transparent)
    return resize_area(undistorted(stored, lens, record.size), *size)


def _resized(cameras, have, size):
    """The cameras of pictures of `size`, from those of pictures of size `have`, both (height, width)."""
    cameras = Camera(*(np.asarray(leaf, np.float32) for leaf in cameras))
    return Camera(*map(np.asarray, resized(cameras, size[1] / have[1], size[0] / have[0])))


def _listed(record, video, masks, protocol):
    """[((time, camera name), reader)] of a protocol's targets."""
    if protocol == "fixed-view":
        held = [entry for entry in record.held_out if same_place(entry.camera, select(record.cameras, 0))]
        return _other_views(dataclasses.replace(record, held_out=held), video.images.shape[1:3])
    if protocol != "held-out":
        excluded = lambda time: (time,) if protocol == "strict" else ()
        return _own_views(record, video, masks, range(len(video.images)), excluded)
    if record.held_out:
        return _other_views(record, video.images.shape[1:3])
    return _own_views(record, video, masks, record.reserved, lambda time: record.reserved)


def same_place(a: Camera, b: Camera) -> bool:
    """Whether two cameras are one, but for rounding."""
    pose, other = np.asarray(a.camera_from_world), np.asarray(b.camera_from_world)
    return np.allclose(pose, other, atol=1e-4 * max(1.0, float(np.abs(other).max())))  # float32 files, read and turned


def _own_views(record, video, masks, times, excluded):
    """[((time, camera name), reader)] of the video's own frames."""

    def read(time):
        return Target(
            time=time,
            camera_name="input",
            camera=select(video.cameras, time),
            image=video.images[time],
            dynamic=None if masks is None else masks[time],
            exclude=excluded(time),
            **truth_of(record, record.truth.get(time), video.images.shape[1:3]),
        )

    return [((time, "input"), lambda time=time: read(time)) for time in times]


def _other_views(record, size):
    """[((time, camera name), reader)] of the pictures of other cameras."""

    def read(entry):
        return Target(
            time=entry.time,
            camera_name=entry.camera_name,
            camera=_resized(entry.camera, record.size, size),
            image=_picture(record, entry.image, entry.lens, size),
            dynamic=None if entry.mask is None else resize_nearest(read_mask(entry.mask, native=record.size), *size),
            **truth_of(record, entry.truth, size),
        )

    return [((entry.time, entry.camera_name), lambda entry=entry: read(entry)) for entry in record.held_out]


def _chosen(path, listed, targets):
    """The readers of the targets asked for, in the order asked."""
    if targets is None:
        return [reader for _, reader in listed]
    chosen = []
    for wanted in targets:
        match = lambda name, wanted=wanted: name == tuple(wanted) if isinstance(wanted, tuple) else name[0] == wanted
        readers = [reader for name, reader in listed if match(name)]
        if not readers:
            times = sorted({time for (time, _), _ in listed})
            raise ValueError(f"{path}: no target {wanted}; this protocol has times {times[0]} to {times[-1]}.")
        chosen += readers
    return chosen
