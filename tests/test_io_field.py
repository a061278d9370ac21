"""Folders as cameras, other programs and other people leave them; each is from a public report of trouble.

They are made by hand, with OpenCV, numpy and bytes, and not by zestjax's writer.
"""

import os
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from zestjax.io import pictures
from zestjax.io.flow_files import write_flo
from zestjax.io.reading import FileWarning
from zestjax.io.scenes import load_scene

N, HEIGHT, WIDTH, FOCAL = 12, 48, 64, 60.0


def shade(i):
    return 20 * i + 10


def photograph(i, *, size=(HEIGHT, WIDTH)):
    """Grey by its frame, brighter to the right, so that a turn shows."""
    picture = np.full((*size, 3), shade(i), np.uint8)
    picture[:, size[1] // 2 :] += 10
    return picture


def row(i, size=(HEIGHT, WIDTH)):
    """A row of poses_bounds.npy whose camera stands at 0.1 i to the right."""
    columns = [[0, 1, 0], [1, 0, 0], [0, 0, -1], [0.1 * i, 0, 0], [*size, FOCAL]]
    return [*np.stack(columns, 1).ravel(), 1, 9]


def nsff(folder, *, names=tuple(f"{i:05d}.png" for i in range(N)), order=None, size=(HEIGHT, WIDTH)):
    """A scene of frames with these names; poses in the order of the names given, or another."""
    (folder / "images").mkdir(parents=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / "images" / name), photograph(i))
    np.save(folder / "poses_bounds.npy", [row(i, size) for i in (order or range(len(names)))])
    return folder


def frames_of(scene):
    """By frame: which photograph it is, and whose pose it has."""
    shown = [round((float(image[0, 0, 0]) * 255 - 10) / 20) for image in scene.video.images]
    at = -scene.video.cameras.camera_from_world[:, 0, 3] / 0.1
    return shown, np.round(at).astype(int).tolist()


def load(folder, **options):
    return load_scene(folder, protocol="strict", **options)


def exif(orientation):
    """The segment that a camera writes into a JPEG: one tag, 0x0112."""
    tiff = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, orientation, 0)
    body = b"Exif\0\0" + tiff
    return b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body


def write_tagged(path, picture, orientation):
    content = cv2.imencode(".jpg", picture)[1].tobytes()
    path.write_bytes(content[:2] + exif(orientation) + content[2:])


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_pixels_are_those_stored_whatever_the_tag(tmp_path, orientation):
    path = tmp_path / "a.jpg"
    write_tagged(path, photograph(3), orientation)
    assert cv2.imread(str(path)).shape == (photograph(3).shape if orientation < 6 else (WIDTH, HEIGHT, 3))
    assert np.abs(pictures.read_image(path) * 255 - photograph(3)).max() < 3
    assert pictures.image_size(path) == (HEIGHT, WIDTH)


def test_a_frame_that_viewers_turn_is_refused_where_only_that_would_fit(tmp_path):
    folder = nsff(tmp_path / "scene", size=(WIDTH, HEIGHT))
    for i in range(N):
        (folder / f"images/{i:05d}.png").unlink()
        write_tagged(folder / f"images/{i:05d}.jpg", photograph(i), 6)
    with pytest.raises(
        ValueError, match=r"00000.jpg: has 48x64 pixels \(HxW\), but its poses are of 64x48 \(turned by EXIF"
    ):
        load(folder)


SHAPES = {
    "portrait": (64, 48), "cropped": (48, 48), "cropped a little": (48, 62), "cropped in height": (40, 64),
    "squeezed": (24, 64), "half and cropped": (24, 30),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("layout", ["nsff", "llff", "nrnerf", "idr"])
def test_a_picture_of_another_shape_than_its_poses_is_refused_in_every_layout(tmp_path, shape, layout):
    folder = nsff(tmp_path / "scene")
    if layout == "llff":
        (folder / "sparse").mkdir()
    elif layout == "nrnerf":
        as_nrnerf(folder)
    elif layout == "idr":
        as_idr(folder)
    assert load(folder).layout == layout
    cv2.imwrite(str(folder / "images/00005.png"), photograph(5, size=SHAPES[shape]))
    with pytest.raises(ValueError, match="00005.png: has .* pixels.*, but its poses are of 48x64"):
        load(folder)


@pytest.mark.parametrize("have", [(24, 32), (12, 16), (96, 128), (16, 21), (16, 22), (5, 7), (6, 9)])
def test_a_resized_picture_fits_with_the_rounding_of_its_size(have):
    pictures.check_fits(Path("a.png"), have, (HEIGHT, WIDTH))
    for size in ((378, 504), (376, 504), (756, 1008)):
        pictures.check_fits(Path("a.png"), size, (3024, 4032))


def as_nrnerf(folder):
    import json

    poses = np.zeros((N, 3, 5))
    poses[:, :, :3] = np.eye(3)
    poses[:, 0, 3], poses[:, :, 4] = 0.1 * np.arange(N), [HEIGHT, WIDTH, FOCAL]
    (folder / "precomputed.json").write_text(json.dumps({"poses": poses.tolist(), "bds": [[1.0, 5.0]] * N}))
    (folder / "poses_bounds.npy").unlink()


def as_idr(folder, *, scale=1.0, middle=(WIDTH / 2, HEIGHT / 2), sign=1.0, **more):
    """Matrices as IDR publishes them: pixels from world, the camera at 0.1 i to the right, the sphere in front."""
    arrays = {}
    for i in range(N):
        k = np.array([[FOCAL * scale, 0, middle[0] * scale], [0, FOCAL * scale, middle[1] * scale], [0, 0, 1]])
        pose = np.eye(4)
        pose[:3, 3] = [-0.1 * i, 0, 6]
        matrix = np.eye(4)
        matrix[:3] = sign * k @ pose[:3]
        arrays |= {f"world_mat_{i}": matrix, f"scale_mat_{i}": np.diag([2.0, 2, 2, 1])}
    np.savez(folder / "cameras_sphere.npz", **arrays, **more)
    (folder / "poses_bounds.npy").unlink()
    return folder


@pytest.mark.parametrize("kind", ["motion_masks", "disp", "flow_npz", "flow_flo"])
def test_maps_of_another_shape_than_the_frames_are_refused(tmp_path, kind):
    folder, size = nsff(tmp_path / "scene"), (WIDTH, HEIGHT)
    place = folder / {"motion_masks": "motion_masks", "disp": "disp"}.get(kind, "flow_i1")
    place.mkdir()
    for i in range(N - 1 if place.name == "flow_i1" else N):
        shape = size if i == 4 else (HEIGHT, WIDTH)
        if kind == "motion_masks":
            cv2.imwrite(str(place / f"{i:05d}.png"), np.eye(*shape).astype(np.uint8) * 255)
        elif kind == "disp":
            np.save(place / f"{i:05d}.npy", np.ones(shape))
        elif kind == "flow_flo":
            write_flo(place / f"{i:05d}_fwd.flo", np.zeros((*shape, 2)))
        else:
            np.savez(place / f"{i:05d}_fwd.npz", flow=np.zeros((*shape, 2)), mask=np.ones(shape))
    with pytest.raises(ValueError, match="00004.*: has 64x48 pixels.*, but its poses are of 48x64"):
        load(folder)


@pytest.mark.parametrize("part", ["mv_images/00000/cam02.png", "mv_masks/00000/cam02.jpg", "truth/00000_cam02.npz"])
def test_held_out_pictures_and_what_belongs_to_them_have_the_shape_of_the_poses(tmp_path, part):
    def write(part, shape):
        (folder / part).parent.mkdir(parents=True, exist_ok=True)
        if part.endswith("npz"):
            camera = dict(intrinsics=[[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], camera_from_world=np.eye(4))
            np.savez(folder / part, depth=np.ones(shape), flow=np.zeros((*shape, 2)), **camera)
        else:
            cv2.imwrite(str(folder / part), np.eye(*shape).astype(np.uint8) * 255)

    folder = nsff(tmp_path / "scene")
    for each in ("mv_images/00000/cam02.png", "mv_masks/00000/cam02.jpg", "truth/00000_cam02.npz"):
        write(each, (HEIGHT, WIDTH))
    (target,) = load_scene(folder).targets
    assert target.dynamic.any() and target.depth.shape == target.flow.shape[:2] == (HEIGHT, WIDTH)
    write(part, (WIDTH, HEIGHT))
    with pytest.raises(ValueError, match="cam02.*: has 64x48 pixels.*, but its poses are of 48x64"):
        list(load_scene(folder).targets)


def test_names_whose_numbers_are_not_padded_are_refused_with_both_orders(tmp_path):
    """The poses may be in either order: LLFF has them by name, a video's own are by time."""
    names = [f"img_{i + 1}.png" for i in range(N)]
    for name, order in (("time", None), ("names", sorted(range(N), key=lambda i: names[i]))):
        folder = nsff(tmp_path / name, names=names, order=order)
        with pytest.raises(ValueError) as caught:
            load(folder)
        for part in ("by number", "img_1.png, img_2.png", "by name", "img_1.png, img_10.png", "zeros"):
            assert part in str(caught.value)
    folder = nsff(tmp_path / "padded", names=[f"img_{i + 1:02d}.png" for i in range(N)])
    assert frames_of(load(folder)) == (list(range(N)), list(range(N)))
    with pytest.raises(ValueError, match="by number"):
        load(as_idr(nsff(tmp_path / "idr", names=names)))


def test_names_without_numbers_are_in_their_order(tmp_path):
    names = [f"{letter}.png" for letter in "abcdefghijkl"]
    assert frames_of(load(nsff(tmp_path, names=names))) == (list(range(N)), list(range(N)))


@pytest.mark.parametrize("first_frame, first_flow", [(0, 0), (1, 0), (1, 1), (100, 100), (100, 0)])
@pytest.mark.parametrize("way", ["fwd", "bwd", "both"])
def test_a_flow_belongs_to_the_frame_of_its_number(tmp_path, first_frame, first_flow, way):
    """ffmpeg numbers from 1, and estimators count from 0 or take the frame's number."""
    folder = nsff(tmp_path / "scene", names=[f"{i + first_frame:05d}.png" for i in range(N)])
    (folder / "flow_i1").mkdir()
    for i in range(N):
        for direction in {"fwd", "bwd"} if way == "both" else {way}:
            if (i, direction) not in ((N - 1, "fwd"), (0, "bwd")):
                file = folder / f"flow_i1/{i + first_flow:05d}_{direction}.npz"
                np.savez(file, flow=np.full((HEIGHT, WIDTH, 2), float(i)), mask=np.ones((HEIGHT, WIDTH)))
    scene = load(folder)
    for flow, missing in ((scene.flow_forward, N - 1), (scene.flow_backward, 0)):
        if flow is not None:
            assert flow.vectors[:, 0, 0, 0].tolist() == [0 if i == missing else i for i in range(N)]
            assert flow.valid[:, 0, 0].tolist() == [i != missing for i in range(N)]


def test_flows_of_other_frames_are_refused(tmp_path):
    folder = nsff(tmp_path / "scene")
    (folder / "flow_i1").mkdir()
    for i in (3, 40):
        np.savez(folder / f"flow_i1/{i:05d}_fwd.npz", flow=np.zeros((HEIGHT, WIDTH, 2)), mask=np.ones((HEIGHT, WIDTH)))
    with pytest.raises(ValueError, match="flow_i1: 00003_fwd.npz to 00040_fwd.npz are not flows between 00000.png and"):
        load(folder)


@pytest.mark.parametrize("name", ["{:05d}.png", "mask_{}.png", "{}_mask.jpg"])
def test_masks_and_disparity_belong_to_the_frame_of_their_number(tmp_path, name):
    folder = nsff(tmp_path / "scene", names=[f"f{i + 1:03d}.png" for i in range(N)])
    (folder / "motion_masks").mkdir()
    (folder / "disp").mkdir()
    for i in range(N):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, 4 * i : 4 * i + 4] = 255
        cv2.imwrite(str(folder / "motion_masks" / name.format(i + 1)), mask, [cv2.IMWRITE_JPEG_QUALITY, 100])
        np.save(folder / f"disp/{i + 1}.npy", np.full((HEIGHT, WIDTH), i))
    scene = load(folder)
    assert [int(mask[0].argmax()) for mask in scene.motion_masks] == [4 * i for i in range(N)]
    assert scene.disparity[:, 0, 0].tolist() == list(range(N))


MASK = np.zeros((HEIGHT, WIDTH), bool)
MASK[10:30, 16:40] = True


def white(mask):
    return np.dstack([np.full((*mask.shape, 3), 255, np.uint8), mask * np.uint8(255)])


GOOD_MASKS = {
    "0 and 255": MASK * np.uint8(255),
    "0 and 1": MASK * np.uint8(1),
    "of 16 bits": MASK * np.uint16(65535),
    "red": np.dstack([0 * MASK, 0 * MASK, 200 * MASK]).astype(np.uint8),
    "white, in alpha": white(MASK),
    "black, in alpha": white(MASK) * np.array([0, 0, 0, 1], np.uint8),
    "opaque": np.dstack([np.dstack([MASK] * 3) * np.uint8(255), np.full(MASK.shape, 255, np.uint8)]),
    "white on nothing": np.dstack([MASK * np.uint8(255)] * 4),
}


@pytest.mark.parametrize("kind", GOOD_MASKS)
def test_a_mask_is_what_its_author_meant(tmp_path, kind):
    cv2.imwrite(str(tmp_path / "m.png"), GOOD_MASKS[kind])
    np.testing.assert_array_equal(pictures.read_mask(tmp_path / "m.png"), MASK)


def test_a_mask_survives_jpeg_and_is_doubted_where_it_is_grey(tmp_path):
    disc = cv2.circle(np.zeros((288, 512), np.uint8), (200, 150), 60, 255, -1)
    cv2.imwrite(str(tmp_path / "m.jpg"), disc, [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert (cv2.imread(str(tmp_path / "m.jpg"), 0) > 0).mean() > 1.02 * (disc > 0).mean()
    mask, doubt = pictures.doubted_mask(tmp_path / "m.jpg")
    assert (mask != (disc > 0)).mean() < 1e-3 and doubt is None
    for picture, said in (
        (np.full((9, 9), 255), "all of it moves"),
        (np.arange(81).reshape(9, 9) * 3, "% of it are grey"),
        (np.arange(81).reshape(9, 9) % 5, "nothing moves"),
    ):
        cv2.imwrite(str(tmp_path / "m.png"), picture.astype(np.uint8))
        with pytest.warns(FileWarning, match=f"m.png: .*{said}"):
            pictures.read_mask(tmp_path / "m.png")


def test_one_warning_tells_of_all_doubtful_masks_of_a_scene(tmp_path):
    folder = nsff(tmp_path / "scene")
    (folder / "motion_masks").mkdir()
    for i in range(N):
        cv2.imwrite(str(folder / f"motion_masks/{i:05d}.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
    with pytest.warns(FileWarning, match=r"00000.png: all of it moves \(and 11 more masks like it\)") as caught:
        assert load(folder).motion_masks.all()
    assert len(caught) == 1 and "\n" not in str(caught[0].message)


def test_transparent_pixels_are_refused_and_opaque_ones_are_not(tmp_path):
    colours = np.random.default_rng(0).integers(0, 256, (9, 8, 3)).astype(np.uint8)
    for alpha, good in ((255, True), (254, False), (0, False), (np.arange(72).reshape(9, 8), False)):
        rgba = np.dstack([colours, np.broadcast_to(np.uint8(alpha), (9, 8))])
        for suffix in (".png", ".tiff"):
            path = tmp_path / f"a{suffix}"
            cv2.imwrite(str(path), rgba)
            if good:
                np.testing.assert_array_equal(pictures.to_bytes(pictures.read_image(path)), colours[..., ::-1])
                continue
            with pytest.raises(ValueError, match=f"a{suffix}: .* are transparent; lay it on a background"):
                pictures.read_image(path)


def test_deep_and_grey_pictures_are_read_and_pictures_of_floats_are_not(tmp_path, capfd):
    cv2.imwrite(str(tmp_path / "a.PNG"), np.full((4, 5, 3), 40000, np.uint16))
    np.testing.assert_allclose(pictures.read_image(tmp_path / "a.PNG"), np.float32(40000 / 65535))
    cv2.imwrite(str(tmp_path / "g.png"), np.full((4, 5), 7, np.uint8))
    np.testing.assert_array_equal(pictures.read_image(tmp_path / "g.png"), np.full((4, 5, 3), np.float32(7 / 255)))
    cv2.imwrite(str(tmp_path / "f.tiff"), np.ones((4, 5, 3), np.float32))
    with pytest.raises(ValueError, match="f.tiff: has pixels of type float32"):
        pictures.read_image(tmp_path / "f.tiff")
    assert capfd.readouterr().err == ""


def test_a_picture_that_claims_more_pixels_than_any_camera_has_is_refused(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), photograph(0))
    content = path.read_bytes()
    path.write_bytes(content[:16] + struct.pack(">II", 30_000, 30_000) + content[24:])
    with pytest.raises(ValueError, match=r"a.png: claims 30000x30000 pixels \(HxW\), more than"):
        pictures.read_image(path)


def test_hidden_names_are_ignored_in_every_folder(tmp_path):
    folder = nsff(tmp_path / "data" / "scene")
    for place in ("disp", "motion_masks", "flow_i1", "mv_images/00000"):
        (folder / place).mkdir(parents=True)
    for i in range(N):
        np.save(folder / f"disp/{i:05d}.npy", np.full((HEIGHT, WIDTH), i))
    files = [p for p in folder.rglob("*") if p.is_file()]
    for place in [folder, *(p for p in folder.rglob("*") if p.is_dir())]:
        (place / "._x.png").write_bytes(b"\0\5\x16\7")
    for file in files:
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7")
    for place in (".Trash-0", "__MACOSX", ".ipynb_checkpoints"):
        shutil.copytree(folder, tmp_path / "data" / place)
        (folder / place).mkdir()
    scene = load(tmp_path)
    assert scene.disparity[:, 0, 0].tolist() == list(range(N)) and scene.motion_masks is None


IDR = {
    "its own size": (dict(), 1),
    "of the other sign": (dict(sign=-1.0), 1),
    "its size said": (dict(scale=2.0, size=np.array([2 * HEIGHT, 2 * WIDTH])), 1),
    "off the middle, its size said": (dict(middle=(3.5, 20.0), size=np.array([HEIGHT, WIDTH])), 1),
    "DTU's": (dict(scale=25.0), 1),
}


@pytest.mark.parametrize("case", IDR)
def test_the_scale_of_idrs_matrices_is_known(tmp_path, case):
    options, factor = IDR[case]
    cameras = load(as_idr(nsff(tmp_path / "scene"), **options)).video.cameras
    middle = options.get("middle", (WIDTH / 2, HEIGHT / 2))
    np.testing.assert_allclose(cameras.intrinsics[:, 0, 0], FOCAL * factor, rtol=1e-5)
    scale = options.get("scale", 1.0)
    np.testing.assert_allclose(cameras.intrinsics[0, :2, 2] + 0.5, np.array(middle) + 0.5 / scale, rtol=1e-3)
    np.testing.assert_allclose(-cameras.camera_from_world[:, 0, 3], 0.1 * np.arange(N), atol=1e-5)
    np.testing.assert_allclose(cameras.camera_from_world[:, 2, 3], 6, rtol=1e-5)


@pytest.mark.parametrize(
    "options", [dict(scale=2.0), dict(scale=4 / 3), dict(middle=(3.5, 24.0)), dict(scale=1.15)], ids=str
)
def test_the_scale_of_idrs_matrices_is_never_guessed(tmp_path, options):
    folder = as_idr(nsff(tmp_path / "scene"), **options)
    with pytest.raises(
        ValueError, match=r"cameras_sphere.npz: its cameras look at pixel \([\d., ]+\).*48x64.*add `size`"
    ):
        load(folder)


DAMAGE = {
    "an archive for an array": (
        lambda f: (np.savez(f / "a.npz", a=np.zeros(3)), (f / "a.npz").rename(f / "poses_bounds.npy")),
        "poses_bounds.npy",
    ),
    "text": (lambda f: np.save(f / "poses_bounds.npy", np.full((N, 17), "x")), "poses_bounds.npy"),
    "sizes of 0": (lambda f: np.save(f / "poses_bounds.npy", np.zeros((N, 17))), "poses_bounds.npy"),
    "far too large": (lambda f: np.save(f / "poses_bounds.npy", np.full((N, 17), 1e300)), "poses_bounds.npy"),
    "bounds that are none": (
        lambda f: np.save(f / "poses_bounds.npy", np.array([row(i) for i in range(N)]) * ([1] * 15 + [-1, 1])),
        "poses_bounds.npy",
    ),
    "empty scene.json": (lambda f: (f / "scene.json").write_text(""), "scene.json"),
    "a list": (lambda f: (f / "scene.json").write_text("[]"), "scene.json"),
    "bounds of text": (lambda f: (f / "scene.json").write_text('{"near": "1", "far": 2}'), "scene.json"),
    "half the bounds": (lambda f: (f / "scene.json").write_text('{"near": 1}'), "scene.json"),
    "a name that is none": (lambda f: (f / "scene.json").write_text('{"name": 5}'), "scene.json"),
    "a fifo": (lambda f: ((f / "images/00003.png").unlink(), os.mkfifo(f / "images/00003.png")), "00003.png"),
    "poses that never end": (
        lambda f: ((f / "poses_bounds.npy").unlink(), (f / "poses_bounds.npy").symlink_to("/dev/zero")),
        "poses_bounds.npy: is a fifo, a device",
    ),
    "poses that never come": (
        lambda f: ((f / "poses_bounds.npy").unlink(), os.mkfifo(f / "poses_bounds.npy")),
        "poses_bounds.npy: is a fifo, a device",
    ),
    "endless": (lambda f: (f / "scene.json").symlink_to("/dev/zero"), "scene.json"),
}


@pytest.mark.parametrize("fault", DAMAGE)
def test_a_damaged_file_is_one_error_that_names_it(tmp_path, fault):
    folder = nsff(tmp_path / "scene")
    spoil, name = DAMAGE[fault]
    spoil(folder)
    with pytest.raises(ValueError) as caught:
        load(folder)
    assert name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_scene_json_may_be_in_any_encoding_that_says_so(tmp_path, encoding):
    folder = nsff(tmp_path / "scene")
    (folder / "scene.json").write_bytes('{"name": "Straße",\r\n "near": 2, "far": 8}'.encode(encoding))
    scene = load(folder)
    assert (scene.name, float(scene.video.near)) == ("Straße", 2)


def heic(folder):
    for file in (folder / "images").iterdir():
        file.rename(file.with_suffix(".heic"))


def foreign(folder):
    (folder / "poses_bounds.npy").unlink()
    (folder / "transforms_train.json").write_text("{}")
    (folder / "sparse").mkdir()


@pytest.mark.parametrize(
    ("spoil", "parts"),
    [
        (heic, ("has poses_bounds.npy, but no pictures", ".heic are not read", ".png, .jpg")),
        (foreign, ("none of poses_bounds.npy", "transforms_train.json is Blender's", "it has sparse, but no cameras")),
    ],
)
def test_an_unsupported_folder_is_told_what_is_missing(tmp_path, spoil, parts):
    folder = nsff(tmp_path / "scene")
    spoil(folder)
    with pytest.raises(ValueError) as caught:
        load(folder)
    assert all(part in str(caught.value) for part in ("in none of the supported layouts", *parts))
    (tmp_path / "film.mp4").write_bytes(b"")
    with pytest.raises(ValueError, match="film.mp4: is a file; give the folder of a scene"):
        load(tmp_path / "film.mp4")
