"""Damaged files of every format that zestjax reads: each must load, or be refused by one line that names it.

    python experiments/fuzz.py [--count 3000] [--seed 0] [FORMAT ...]

Every format has a whole file, made here, and a function that loads it. A damage cuts the file, flips bits, overwrites
or repeats a part, or says something else in the format's own terms: another type or rank, NaN, a header that claims
much. It prints a row for each format; exit 1 if any file ended otherwise, took more memory than is allowed (an address
space of 3 GB more than at the start), or more than ten seconds of CPU.
"""

import argparse
import io
import json
import multiprocessing
import random
import re
import resource
import shutil
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from zestjax.apps.paths import camera_path
from zestjax.apps.weights import recipe_from_metadata
from zestjax.base.parts import to_stored
from zestjax.cameras import Camera
from zestjax.io.colmap import write_colmap
from zestjax.io.reading import FileWarning
from zestjax.io.scenes import load_scene
from zestjax.io.torch_files import LEGACY_MAGIC, read_torch
from zestjax.io.weights import WeightsError, load_weights, save_weights
from zestjax.train.recipes import TINY
from zestjax.video import Video

N, HEIGHT, WIDTH = 3, 24, 32
MOST_MEMORY = 3 * 2**30  # bytes of address space that loading a file of a few kB may take
MOST_SECONDS = 10  # of CPU: what is read is tiny
ODD = (
    None, True, -1, 0, 1.5, "x", [], {}, [[]], 10**400, 1e308, float("nan"), float("inf"), [1, [2]], 2**63, "9" * 5000,
)  # fmt: skip


class Case(NamedTuple):
    """file: what is damaged. load: function without arguments that reads it. retell: function of (generator, content)
    to content that says something odd in the format's own terms."""

    file: Path
    load: Callable
    retell: Callable


class Row(NamedTuple):
    """format, how many were tried, loaded and refused; the worst seconds and MB; faults: what ended otherwise."""

    format: str
    tried: int
    loaded: int
    refused: int
    seconds: float
    megabytes: float
    faults: tuple[str, ...]


def poses(size=(HEIGHT, WIDTH)):
    columns = lambda i: np.stack([[0, 1, 0], [1, 0, 0], [0, 0, -1], [0.1 * i, 0, 0], [*size, 30.0]], 1)
    return np.array([[*columns(i).ravel(), 1, 9] for i in range(N)])


def scene(folder, *, suffix=".png"):
    """A scene in NSFF's layout; returns its folder."""
    (folder / "images").mkdir()
    np.save(folder / "poses_bounds.npy", poses())
    for i in range(N):
        picture = np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"images/{i:05d}{suffix}"), picture)
    return folder


def part_of_scene(name, write, *, held_out=False, suffix=".png", retell):
    """Function of a folder to the `Case` of one file of a scene."""

    def case(folder):
        root = scene(folder, suffix=suffix)
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        write(root, file)

        def load():
            loaded = load_scene(root, protocol="held-out" if held_out else "strict")
            return [target.image for target in loaded.targets]

        return Case(file, load, retell)

    return case


def masks(root, file):
    for i in range(N):
        cv2.imwrite(str(file.parent / f"{i:05d}.png"), np.eye(HEIGHT, WIDTH).astype(np.uint8) * 255)


def disparities(root, file):
    for i in range(N):
        np.save(file.parent / f"{i:05d}.npy", np.ones((HEIGHT, WIDTH), np.float32))


def flow(root, file):
    vectors, mask = np.ones((HEIGHT, WIDTH, 2), np.float32), np.ones((HEIGHT, WIDTH), np.float32)
    if file.suffix == ".npz":
        np.savez_compressed(file, flow=vectors, mask=mask)
    else:
        file.write_bytes(b"PIEH" + np.array([WIDTH, HEIGHT], "<i4").tobytes() + vectors.astype("<f4").tobytes())


def truth(root, file):
    (root / "mv_images/00000").mkdir(parents=True)
    cv2.imwrite(str(root / "mv_images/00000/cam02.png"), np.full((HEIGHT, WIDTH, 3), 9, np.uint8))
    np.savez(
        file, depth=np.ones((HEIGHT, WIDTH)), flow=np.zeros((HEIGHT, WIDTH, 2)), camera_from_world=np.eye(4),
        intrinsics=np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]]),
    )  # fmt: skip


def about(root, file):
    file.write_text(json.dumps({"name": "toy", "near": 1.0, "far": 9.0}))


def idr(root, file):
    k, pose, arrays = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), np.eye(4), {}
    for i in range(N):
        pose[:3, 3] = [-0.1 * i, 0, 6]
        arrays |= {f"world_mat_{i}": np.vstack([k @ pose[:3], [0, 0, 0, 1]]), f"scale_mat_{i}": np.diag([2.0, 2, 2, 1])}
    np.savez(file, **arrays, size=np.array([HEIGHT, WIDTH]))
    (root / "poses_bounds.npy").unlink()


def nrnerf(root, file):
    cameras = np.zeros((N, 3, 5))
    cameras[:, :, :3], cameras[:, 0, 3], cameras[:, :, 4] = np.eye(3), 0.1 * np.arange(N), [HEIGHT, WIDTH, 30.0]
    file.write_text(json.dumps({"poses": cameras.tolist(), "bds": [[1.0, 9.0]] * N}))
    (root / "poses_bounds.npy").unlink()


def colmap(root, file):
    """A model of COLMAP whose files are binary or text, as `file`."""
    shutil.rmtree(root / "sparse", ignore_errors=True)
    k, poses = np.tile(np.eye(3), (N, 1, 1)), np.tile(np.eye(4), (N, 1, 1))
    k[:, 0, 0] = k[:, 1, 1] = 30
    k[:, :2, 2], poses[:, 0, 3] = [15.5, 11.5], 0.1 * np.arange(N)
    shown = Video(np.zeros((N, HEIGHT, WIDTH, 3), np.uint8), Camera(k, poses), np.float32(1), np.float32(9))
    points = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 6], (9, 3))
    write_colmap(root / "whole", "toy", shown, binary=file.suffix == ".bin", points=points)
    (root / "whole/sparse").rename(root / "sparse")
    shutil.rmtree(root / "whole")
    (root / "poses_bounds.npy").unlink()


def transforms(root, file):
    frame = lambda i: dict(
        file_path=f"images/{i:05d}.png",
        time=i,
        transform_matrix=[[1, 0, 0, 0.1 * i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    )
    said = dict(w=WIDTH, h=HEIGHT, fl_x=30.0, fl_y=30.0, cx=16.0, cy=12.0, k1=0.02, k2=0.0, near=1, far=9)
    file.write_text(json.dumps(said | {"frames": [frame(i) for i in range(N)]}))
    (root / "poses_bounds.npy").unlink()


def nerfies(root, file):
    names = [f"{i:05d}" for i in range(N)]
    (root / "rgb").mkdir()
    (root / "images").rename(root / "rgb/1x")
    (root / "poses_bounds.npy").unlink()
    (root / "camera").mkdir(exist_ok=True)
    write = lambda place, content: (root / place).write_text(json.dumps(content))
    for i, name in enumerate(names):
        camera = dict(orientation=np.eye(3).tolist(), position=[0.1 * i, 0, 0], focal_length=30.0, skew=0.0,
                      principal_point=[16.0, 12.0], image_size=[WIDTH, HEIGHT], pixel_aspect_ratio=1.0,
                      radial_distortion=[0.01, 0, 0], tangential_distortion=[0, 0])  # fmt: skip
        write(f"camera/{name}.json", camera)
    write("dataset.json", dict(count=N, num_exemplars=N, ids=names, train_ids=names, val_ids=[]))
    write("metadata.json", {name: dict(warp_id=i, appearance_id=i, camera_id=0) for i, name in enumerate(names)})
    write("scene.json", dict(scale=1.0, center=[0, 0, 0], near=1, far=9))


def table(root, file):
    head = "file,time,width,height,fx,fy,cx,cy,qw,qx,qy,qz,tx,ty,tz,near,far\n"
    lines = [f"images/{i:05d}.png,{i},{WIDTH},{HEIGHT},30,30,15.5,11.5,1,0,0,0,{0.1 * i},0,0,1,9\n" for i in range(N)]
    file.write_text(head + "".join(lines))
    (root / "poses_bounds.npy").unlink()


def camera_file(suffix, retell):
    """Function of a folder to the `Case` of a camera path."""

    def case(folder):
        k = np.tile([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]], (N, 1, 1))
        stored = {"intrinsics": k, "camera_from_world": np.tile(np.eye(4), (N, 1, 1)), "times": np.arange(N)}
        images = np.zeros((N, HEIGHT, WIDTH, 3), np.float32)
        shown = Video(images, Camera(*list(stored.values())[:2]), np.float32(1), np.float32(9))
        file = folder / f"path{suffix}"
        if suffix == ".npz":
            np.savez(file, **stored)
        else:
            file.write_text(json.dumps({name: value.tolist() for name, value in stored.items()}))
        return Case(file, lambda: camera_path(str(file), shown), retell)

    return case


def weights(folder):
    tree = {"kernel": np.ones((4, 5), np.float32), "bias": np.zeros(5, np.float32)}
    file = folder / "w.safetensors"
    save_weights(file, tree, metadata={"recipe": to_stored(TINY)})

    def retell(rng, content):
        if rng.random() < 0.5:
            return retold_header(rng, content)
        save_weights(file, tree, metadata={"recipe": with_odd_value(rng, to_stored(TINY))})  # counted right
        return file.read_bytes()

    def load():
        _, metadata = load_weights(file, like=tree)
        try:
            return recipe_from_metadata(metadata)
        except WeightsError as error:
            raise WeightsError(f"{file}: {error}") from error  # as `open_weights` does

    return Case(file, load, retell)


def torch(*, legacy):
    """Function of a folder to the `Case` of a PyTorch file, written instruction by instruction."""

    def case(folder):
        view = b"N" if legacy else b""
        storage = b"(X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\x000X\x03\0\0\0cpuK\x06" + view + b"tQ"
        tensor = b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\0K\2K\3\x86K\3K\1\x86\x89"
        saved = b"\x80\x02}q\0X\6\0\0\0weight" + tensor + b"ccollections\nOrderedDict\n)RtRs."
        file, values = folder / "w.pth", np.arange(6, dtype=np.float32).tobytes()
        if legacy:
            magic = LEGACY_MAGIC.to_bytes(10, "little")
            plain = [b"\x80\x02\x8a\x0a" + magic + b".", b"\x80\x02M\xe9\x03.", b"\x80\x02}."]
            keys = b"\x80\x02]X\x01\0\0\x000a."
            file.write_bytes(b"".join([*plain, saved, keys, (6).to_bytes(8, "little"), values]))
        else:
            with zipfile.ZipFile(file, "w") as archive:
                archive.writestr("model/data.pkl", saved)
                archive.writestr("model/data/0", values)
        return Case(file, lambda: read_torch(file), retold_zip)

    return case


def npy(array, *, claim=None):
    """Bytes of an .npy file, whose header may claim another shape."""
    stream = io.BytesIO()
    if claim is None:
        np.lib.format.write_array(stream, array, allow_pickle=True)
    else:
        said = {"descr": array.dtype.str, "fortran_order": False, "shape": claim}
        np.lib.format.write_array_header_2_0(stream, said)
        stream.write(array.tobytes())
    return stream.getvalue()


def retold_array(rng, content):
    """An array of another type, rank or length, with numbers that are none, or with a header that claims much."""
    array = np.load(io.BytesIO(content))
    flat = array.astype(np.float64)
    flat.flat[rng.randrange(flat.size)] = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1.0, 0.0, 1e-300])
    kind = rng.choice(["?", "i1", "u8", "f2", "c8", "S3", "U3", "M8[s]", "O"])
    with np.errstate(all="ignore"):
        other = array.astype(kind) if kind != "M8[s]" else array.astype("i8").astype(kind)
    return rng.choice(
        [
            lambda: npy(flat), lambda: npy(other), lambda: npy(array[None]), lambda: npy(array.reshape(-1)),
            lambda: npy(array[:-1] if array.ndim else array), lambda: npy(array[:0] if array.ndim else array),
            lambda: npy(array.T), lambda: npy(np.array(5.0)),
            lambda: npy(array, claim=(10 ** rng.randrange(2, 25), 17)), lambda: npy(array, claim=(-3, 17)),
        ]
    )()  # fmt: skip


def retold_arrays(rng, content):
    """An archive of which one array is retold, misses, or is something else."""
    members = {name: zipfile.ZipFile(io.BytesIO(content)).read(name) for name in _names(content)}
    name = rng.choice(sorted(members))
    match rng.randrange(5):
        case 0:
            del members[name]
        case 1:
            members[name] = damaged(rng, members[name])
        case _:
            members[name] = retold_array(rng, members[name])
    return packed(members, zipfile.ZIP_DEFLATED)


def retold_zip(rng, content):
    """An archive of which one member is damaged but counted right; of a file that is none, any damage."""
    if content[:2] != b"PK":
        return damaged(rng, content)
    members = {name: zipfile.ZipFile(io.BytesIO(content)).read(name) for name in _names(content)}
    name = rng.choice(sorted(members))
    members[name] = damaged(rng, members[name])
    return packed(members, rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))


def retold_json(rng, content):
    """JSON of which one value, at any depth, is odd; or in another encoding, or nested without end."""
    text = json.dumps(with_odd_value(rng, json.loads(content)))
    deep = rng.choice([10, 1000, 10**5])
    odd = [text.encode("utf-16"), text.encode("utf-8-sig"), b"[" * deep, b'{"poses":' * deep, text.encode() + b"}"]
    return rng.choice(odd) if rng.random() < 0.2 else text.encode()


def with_odd_value(rng, found):
    """What JSON held, one value of it at any depth made odd."""
    whole = holder = {"all": found}
    key = "all"
    while isinstance(holder[key], dict | list) and holder[key] and rng.random() < 0.8:
        holder = holder[key]
        key = rng.choice(sorted(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
    holder[key] = rng.choice(ODD)
    return whole["all"]


def retold_header(rng, content):
    """A safetensors file whose header is retold, or whose length is."""
    length = int.from_bytes(content[:8], "little")
    if rng.random() < 0.3:
        return rng.choice([2**31, 2**63, 2**64 - 1, 0, 1, length + 1]).to_bytes(8, "little") + content[8:]
    header = retold_json(rng, content[8 : 8 + length])
    return len(header).to_bytes(8, "little") + header + content[8 + length :]


def retold_counts(rng, content):
    """A binary file of which one number, of some bytes, is another: counts, kinds, sizes, coordinates."""
    place, size = rng.randrange(max(1, len(content) - 8)), rng.choice([4, 8])
    odd = [0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**64 - 1]
    numbers = [struct.pack("<d", value) for value in (0.0, -1.0, 1e300, float("nan"), float("inf"), 1e-300)]
    new = rng.choice([rng.choice(odd).to_bytes(8, "little")[:size], rng.choice(numbers)])
    if rng.random() < 0.3:
        place = 0
    return content[:place] + new + content[place + len(new) :]


def retold_words(rng, content):
    """A text of which one word is another: an odd or a plain number, a place outside, nothing."""
    words = re.split(rb"([ ,\n]+)", content)
    odd = [
        b"nan",
        b"inf",
        b"-1",
        b"0",
        b"1e308",
        b"9" * 5000,
        b"../../x.png",
        b"/x",
        b"C:\\x",
        b"",
        b"x",
        b"\xff",
        b'"',
        b"#",
        b"\n",
    ]
    words[rng.randrange(len(words))] = rng.choice(odd if rng.random() < 0.6 else [b"1", b"2", b"5"])
    return b"".join(words)


def retold_picture(rng, content):
    """A picture of another size, depth or number of channels, or whose header claims much."""
    suffix = ".png" if content[1:4] == b"PNG" else ".jpg"
    height, width = rng.choice([(HEIGHT, WIDTH), (WIDTH, HEIGHT), (1, 1), (12, 16), (HEIGHT, WIDTH - 3), (1, 2000)])
    channels = rng.choice([1, 3] if suffix == ".jpg" else [1, 3, 4])
    kind = np.uint16 if suffix == ".png" and rng.random() < 0.3 else np.uint8
    values = np.random.default_rng(rng.randrange(2**32)).integers(0, 256, (height, width, channels)).astype(kind)
    if suffix == ".png" and rng.random() < 0.3:
        side = rng.choice([0, 30_000, 2**31 - 1, 2**32 - 1])
        return content[:16] + side.to_bytes(4) + side.to_bytes(4) + content[24:]
    return cv2.imencode(suffix, values)[1].tobytes()


def retold_flo(rng, content):
    """A flow of another size than its length, or of numbers that are none."""
    size = np.array([rng.choice([0, -1, 31, 2**31 - 1]), rng.choice([24, 0, 2**31 - 1])], "<i4").tobytes()
    return content[:4] + size + content[12:] if rng.random() < 0.5 else content[:12] + b"\xff" * (len(content) - 12)


def damaged(rng, content):
    """Bytes cut, flipped, overwritten, repeated or put at the end of others."""
    place, length = rng.randrange(len(content) + 1), rng.randrange(1, 64)
    noise = bytes(rng.randrange(256) for _ in range(length))
    match rng.randrange(6):
        case 0:
            return content[:place]
        case 1:
            flipped = bytearray(content)
            for _ in range(rng.choice([1, 1, 2, 8])):
                if flipped:
                    flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
            return bytes(flipped)
        case 2:
            return content[:place] + noise + content[place + length :]
        case 3:
            return content[:place] + rng.choice([b"\0", b"\xff"]) * length + content[place + length :]
        case 4:
            return content[:place] + content[place : place + length] * 2 + content[place + length :]
        case _:
            return noise + content if rng.random() < 0.5 else content + noise


def _names(content):
    return zipfile.ZipFile(io.BytesIO(content)).namelist()


def packed(members, compression):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


nothing = lambda root, file: None
FORMATS = {
    "poses .npy": part_of_scene("poses_bounds.npy", nothing, retell=retold_array),
    "matrices .npz": part_of_scene("cameras_sphere.npz", idr, retell=retold_arrays),
    "poses .json": part_of_scene("precomputed.json", nrnerf, retell=retold_json),
    "scene .json": part_of_scene("scene.json", about, retell=retold_json),
    "frames .png": part_of_scene("images/00001.png", nothing, retell=retold_picture),
    "frames .jpg": part_of_scene("images/00001.jpg", nothing, suffix=".jpg", retell=retold_picture),
    "masks .png": part_of_scene("motion_masks/00001.png", masks, retell=retold_picture),
    "disparity .npy": part_of_scene("disp/00001.npy", disparities, retell=retold_array),
    "flow .npz": part_of_scene("flow_i1/00001_fwd.npz", flow, retell=retold_arrays),
    "flow .flo": part_of_scene("flow_i1/00001_fwd.flo", flow, retell=retold_flo),
    "truth .npz": part_of_scene("truth/00000_cam02.npz", truth, held_out=True, retell=retold_arrays),
    **{
        f"COLMAP {name}": part_of_scene(
            f"sparse/0/{name}", colmap, retell=retold_counts if name.endswith("bin") else retold_words
        )
        for name in ("cameras.bin", "images.bin", "points3D.bin", "cameras.txt", "images.txt", "points3D.txt")
    },
    "transforms.json": part_of_scene("transforms.json", transforms, retell=retold_json),
    **{
        f"Nerfies {name}": part_of_scene(name, nerfies, retell=retold_json)
        for name in ("dataset.json", "metadata.json", "scene.json", "camera/00001.json")
    },
    "cameras.csv": part_of_scene("cameras.csv", table, retell=retold_words),
    "cameras .json": camera_file(".json", retold_json),
    "cameras .npz": camera_file(".npz", retold_arrays),
    "weights .safetensors": weights,
    "PyTorch .pth": torch(legacy=False),
    "PyTorch before 1.6": torch(legacy=True),
}


def fuzz(name, *, count, seed, most_memory=None):
    """Damage the file of a format `count` times.

    Args:
      name: of `FORMATS`.
      count: files to try.
      seed: of all damages; the same seed gives the same files.
      most_memory: bytes of address space beyond what the process has, set for the rest of its life; None for no limit.

    Returns:
      `Row`.
    """
    rng, loaded, refused, worst, faults = random.Random(f"{seed} {name}"), 0, 0, 0.0, []
    with tempfile.TemporaryDirectory() as folder:
        case = FORMATS[name](Path(folder))
        case.load()
        whole, start = case.file.read_bytes(), _memory("VmRSS")
        if most_memory is not None:
            most = _memory("VmSize") + most_memory
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        for number in range(count):
            case.file.write_bytes(case.retell(rng, whole) if rng.random() < 0.5 else damaged(rng, whole))
            began = time.process_time()  # other work on the machine does not count
            fault = _tried(case, folder)
            seconds = time.process_time() - began
            loaded, refused, worst = loaded + (fault == ""), refused + (fault is None), max(worst, seconds)
            if fault or seconds > MOST_SECONDS:
                faults.append(f"{name}, file {number}: {fault or f'{seconds:.1f} s'}")
        return Row(name, count, loaded, refused, worst, (_memory("VmHWM") - start) / 2**20, tuple(faults))


def _tried(case, folder):
    """ "" if the file was loaded, None if it was refused as it should be, else what went wrong."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", FileWarning)
            case.load()
    except ValueError as error:
        text = str(error)
        return None if folder in text and "\n" not in text else f"{type(error).__name__}: {text[:300]}"
    except BaseException as error:
        return f"{type(error).__name__}: {error} {traceback.format_exc(limit=-2)[-400:]}"
    return ""


def _memory(what):
    """Bytes of this process, by Linux's own count; 0 elsewhere."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{what}:")), 0)


def main():
    """Every format in a process of its own; prints the table."""
    parser = argparse.ArgumentParser(description="Damaged files must load or be refused by name.")
    parser.add_argument("formats", nargs="*", default=[], metavar="FORMAT", help=f"of {', '.join(FORMATS)}")
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"{'format':22s} {'tried':>6s} {'loaded':>6s} {'refused':>7s} {'worst s':>8s} {'worst MB':>8s} faults")
    failed = False
    for name in options.formats or FORMATS:
        arguments = {"count": options.count, "seed": options.seed, "most_memory": MOST_MEMORY}
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            row = pool.apply(fuzz, (name,), arguments)
        *numbers, faults = row[1:]
        print(f"{name:22s} {{:6d}} {{:6d}} {{:7d}} {{:8.3f}} {{:8.0f}} {len(faults)}".format(*numbers), flush=True)
        print("\n".join(faults[:5]), file=sys.stderr, end="\n" * bool(faults))
        failed |= bool(faults)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
