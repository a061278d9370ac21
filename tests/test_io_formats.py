"""Scenes as COLMAP, nerfstudio, instant-ngp, Nerfies and people's own tables leave them.

Cameras are written out by hand, or by COLMAP 4 itself, and are judged by where known points land; only the round trips
use zestjax's writers.
"""

import base64
import json
import os
import shutil
import subprocess
import sys
import warnings
import zlib

import cv2
import numpy as np
import pytest

from zestjax.cameras import Camera
from zestjax.io import colmap_model
from zestjax.io.colmap import write_colmap
from zestjax.io.idr import write_idr
from zestjax.io.lens import find_lens
from zestjax.io.llff import write_llff
from zestjax.io.nerfies import write_nerfies
from zestjax.io.reading import FileWarning
from zestjax.io.scenes import Target, load_scene
from zestjax.io.table import write_table
from zestjax.io.transforms import write_transforms
from zestjax.video import Video

WIDTH, HEIGHT = 64, 48

# Three pictures of two cameras with distortion, written by pycolmap 4.2.1; their points and where it saw them.
WRITTEN_BY_COLMAP_4 = {
    "cameras.bin": (
        "eNpjYoAARiBmAWIHKN+AARn4QYV9IXSDA5Q2d6gWWef+sGqL/Q651teBO+bt/7Py4yXfpAR7CB2wnwmojImguVDzGCwcZs0EgZX7Ad5eHN0="
    ),
    "frames.bin": (
        "eNpjZoAAViBmAuK3vWUnGN68ty/efbhCfuk8KL3OfpG67m+RvCn7Z80EgZtQeqU9hD5pzwg1hwlqFgiwATFIvDc9saX+93v707qPNvwvb7Hf"
        "4BLc+X/zPBgfatZJNDN3ws1khJoFAuxQ/ve15WrT/7+3l0yV1J1X1bKfARU0wGiYmQxIZsFodigbAF/fTfI="
    ),
    "images.bin": (
        "eNpjZoAAdiD+vrZcbfr/9/aSqZK686pa9jOgggYYPWsmCKy0h0kwAnFaUWJuaryBgaFeQV46AxtUpv3MtJ5Xj50cgjv2dAj3GDswQsVPP3i1"
        "RGO2mYNJiwH7jT+2DkxQ8Wuf7DdJ3nN0OPlb/Hhlka0DM1Rc78q2bSWpHg7XO/dvjbnn4MACFU8Uy74+b7mLw8b7d+OsXAwdWKHi867znO9Z"
        "YuHgdvumzbxf9g4w94Do3vTElvrf7+1P6z7a8L+8xX6DS3Dn/83zYPz9EN+d3A/zJYTeaY/sSyMUX+5KY/nJouDscDswgDPC0BDuyz/xkYsn"
        "HLdwsJd/a+a/0RruSzunUvHZs5wcjFwuKj//aQX35dwJnd46yz0cwmtE5Eq+2MF9+d9Q7cefJFeHldMuSQa26MJ9GXC9VpC53Mrhg4R8xanJ"
        "tnBfguTf9padYHjz3r549+EK+aXzoPQ6+0Xqur9F8qZAfXcTzZcn7ZmQfGmM4svWJ6uDL51zcrh3bGP7BEk9uC/1xHmP8Zy2dPgcqvHakskK"
        "7kuvmUU9p08BffnXb9YzQUu4Lxk2ntFY4ufh0DUxe9H8GzZwX/Lcc57I0+3q8Hx/+qqiXRpwX+oc3W57Xdnaoaum/onpfWu4LwFP291N"
    ),
    "points3D.bin": (
        "eNpjY4AARihdOlmCJYzvqv3TC0q3f9bd2n96oeu2z7UCDie45CAKPuxnhiplh9JsUJoVSjNB6f5DXzVi+j/ttzeN2+XJ88j+4CmQWVK4jGKE"
        "GsUINQpEw+T/rPx4yTfpgr31ff/e6Xm37BdI6d9VaRPDZRQT1CgmqFEgmgUq75ckEGG55YN9xsS3Nfamj+yvVrxUM+TA6UFmqFHMUKOYkTwK"
        "DKCsPSWv7R9Wiaxzf/hq/4pj3uadByVwGcUCNYoFagQLUtj5mHc6Jjx9sV9xQxHQYU+gwY/Tg6xQraxIGADpdlow"
    ),
    "rigs.bin": ("eNpjYoAARiiGsZmQ+CA2AAD8AAs="),
}
POINTS = np.array(
    [[0.329, -0.414, 4.123], [-1.16, 0.564, 6.738], [0.256, 0.413, 5.631], [1.044, 0.569, 4.008],
     [0.858, -0.84, 6.189], [-0.778, 0.654, 5.624]]
)  # fmt: skip
SEEN_BY_COLMAP = np.array(
    [
        [[37.780595, 19.547173], [22.606089, 29.987671], [35.735159, 29.447171], [48.792624, 33.737204],
         [41.309535, 17.266516], [24.642774, 31.978977]],
        [[38.250152, 17.192750], [24.779551, 27.692615], [37.207858, 26.976183], [49.306039, 30.954897],
         [42.773345, 14.758431], [26.464891, 29.577308]],
        [[37.615794, 15.049931], [25.793163, 26.008696], [37.584337, 25.069925], [48.614385, 28.846186],
         [43.086321, 12.364156], [27.140003, 27.871916]],
    ]
)  # fmt: skip

CAMERAS_TXT = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
4 PINHOLE 64 48 60 50 30 25
"""
IMAGES_TXT = """\
# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
2 1 0 0 0 -0.5 0 0 4 shot 10.png
10.5 20.5 1 30.5 20.5 -1
1 0.70710678 0 0 0.70710678 0 0 1 4 shot 9.png

3 1 0 0 0 -0.25 0 0 4 shot 11.png

"""
POINTS_TXT = """\
# 3D point list with one line of data per point:
1 0.5 0.2 4 255 0 0 0.3 2 0 1 0
2 0.1 -0.2 4.5 255 0 0 0.3
3 -0.1 0.2 5 255 0 0 0.3
"""


def shade(i):
    return 20 * i + 10


def picture(i, size=(HEIGHT, WIDTH)):
    return np.full((*size, 3), shade(i), np.uint8)


def write_pictures(folder, names):
    folder.mkdir(parents=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), picture(i))


def colmap_text(folder, *, place="sparse/0"):
    write_pictures(folder / "images", ["shot 9.png", "shot 10.png", "shot 11.png"])
    (folder / place).mkdir(parents=True, exist_ok=True)
    for name, text in (("cameras", CAMERAS_TXT), ("images", IMAGES_TXT), ("points3D", POINTS_TXT)):
        (folder / place / f"{name}.txt").write_text(text)
    return folder


def colmap_4(folder):
    write_pictures(folder / "images", [f"frame_{i + 1:03d}.png" for i in range(3)])
    (folder / "sparse/0").mkdir(parents=True)
    for name, text in WRITTEN_BY_COLMAP_4.items():
        (folder / "sparse/0" / name).write_bytes(zlib.decompress(base64.b64decode(text)))
    return folder


def load(folder, **options):
    return load_scene(folder, protocol="strict", **options)


def pixel(video, i, point):
    """Where frame i sees a point of the world, by plain arithmetic."""
    k, pose = (np.asarray(leaf[i], np.float64) for leaf in video.cameras)
    seen = k @ (pose[:3, :3] @ np.asarray(point) + pose[:3, 3])
    return seen[:2] / seen[2]


def shown(video):
    """Which picture each frame is, by its shade."""
    return [round((float(image.mean()) * 255 - 10) / 20) for image in video.images]


def test_a_model_written_by_hand_in_text_sees_a_point_where_arithmetic_says(tmp_path):
    scene = load(colmap_text(tmp_path / "kite"))
    assert (scene.name, scene.layout) == ("kite", "colmap")
    assert shown(scene.video) == [0, 1, 2]  # 9, 10, 11: by number, though the model has them in another order
    # of frame 1: x = 0.5 - 0.5 = 0, y = 0.2, z = 4, so column 60 * 0 + 30, row 50 * 0.05 + 25, less half a pixel
    np.testing.assert_allclose(pixel(scene.video, 1, [0.5, 0.2, 4]), [29.5, 27], atol=1e-4)
    # frame 0 is turned by 90 degrees about z: (x, y) becomes (-y, x), and z is 5
    np.testing.assert_allclose(pixel(scene.video, 0, [0.5, 0.2, 4]), [60 * -0.04 + 29.5, 50 * 0.1 + 24.5], atol=1e-4)
    assert 4 * 0.9 < scene.video.near < 4.5 and 5 < scene.video.far < 6.1 / 0.9


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_a_model_is_found_where_programs_leave_it(tmp_path, place):
    scene = load(colmap_text(tmp_path / "kite", place=place))
    assert scene.layout == "colmap" and len(scene.video.images) == 3


def test_an_undistorted_workspace_is_called_as_its_folder(tmp_path):
    colmap_text(tmp_path / "kite/dense", place="sparse")
    assert load(tmp_path / "kite").name == "kite"


def test_a_model_of_colmap_4_is_read_beside_its_rigs_and_frames(tmp_path):
    model = colmap_model.read_model(colmap_4(tmp_path) / "sparse/0")
    assert sorted(image.name for image in model.images) == ["frame_001.png", "frame_002.png", "frame_003.png"]
    np.testing.assert_allclose(model.points, POINTS)
    scene = load(tmp_path)
    assert shown(scene.video) == [0, 1, 2]
    for i, seen in enumerate(SEEN_BY_COLMAP):
        kind = model.cameras[1 if i < 2 else 2]
        has = kind.parameters
        f = [has.get("fx", has.get("f")), has.get("fy", has.get("f"))]
        k = np.array([[f[0], 0, has["cx"]], [0, f[1], has["cy"]], [0, 0, 1]])
        bend = np.array([has.get(name, 0) for name in ("k1", "k2", "p1", "p2")])
        straight = cv2.undistortPoints(seen[:, None], k, bend)[:, 0]  # what COLMAP saw, without its lens
        ours = [np.linalg.inv(scene.video.cameras.intrinsics[i]) @ [*pixel(scene.video, i, p), 1] for p in POINTS]
        np.testing.assert_allclose(np.array(ours)[:, :2], straight, atol=2e-5)


@pytest.mark.parametrize("bend", [(0.12, -0.02, 0, 0), (-0.15, 0.03, 0.003, -0.002)])
def test_an_undistorted_picture_has_its_dots_where_the_pinhole_sees_them(tmp_path, bend):
    k, distortion = np.array([[150.0, 0, 79.0], [0, 145, 61], [0, 0, 1]]), np.array(bend)
    grid = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 5), np.linspace(-0.25, 0.25, 4)), -1).reshape(-1, 2)
    rays = np.concatenate([grid, np.ones((len(grid), 1))], -1)
    dots = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), k, distortion)[0][:, 0]
    stored = np.zeros((120, 160, 3), np.float32)
    rows, columns = np.mgrid[:120, :160]
    for u, v in dots:
        stored += np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 4)[..., None].astype(np.float32)
    (tmp_path / "images").mkdir()
    frames = []
    for i in range(2):
        cv2.imwrite(str(tmp_path / f"images/{i}.png"), np.clip(stored * 255, 0, 255).astype(np.uint8))
        pose = np.eye(4)
        pose[0, 3] = 0.01 * i
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()})
    said = dict(w=160, h=120, fl_x=150, fl_y=145, cx=79.5, cy=61.5, near=1, far=9, camera_model="OPENCV")
    said |= dict(zip(("k1", "k2", "p1", "p2"), bend, strict=True))
    (tmp_path / "transforms.json").write_text(json.dumps(said | {"frames": frames}))
    video = load(tmp_path).video
    image, new = video.images[0, :, :, 0], video.cameras.intrinsics[0]
    for ray in rays:
        u, v = (new @ ray)[:2]
        if not (6 < u < 153 and 6 < v < 113):
            continue
        top, left = round(v) - 4, round(u) - 4
        patch = image[top : top + 9, left : left + 9]
        weight = patch / patch.sum()
        found = [(weight.sum(0) * np.arange(9)).sum() + left, (weight.sum(1) * np.arange(9)).sum() + top]
        np.testing.assert_allclose(found, [u, v], atol=0.1)
    assert load(tmp_path, height=60).video.images.shape == (2, 60, 80, 3)


def test_a_lens_that_folds_the_picture_is_refused_and_one_that_bends_nothing_is_none():
    k = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    assert find_lens("here", k, np.zeros(8), (48, 64)) is None
    for bad in ([-3, 0, 0, 0, 0, 0, 0, 0], [1e300, 0, 0, 0, 0, 0, 0, 0], [0, 0, 5, 5, 0, 0, 0, 0]):
        with pytest.raises(ValueError, match=r"here: distortion by .* folds pictures of 48x64"):
            find_lens("here", k, np.array(bad, float), (48, 64))


def test_the_largest_model_is_read_and_pictures_that_are_not_registered_are_left_out(tmp_path):
    folder = colmap_text(tmp_path / "kite", place="sparse/1")
    shutil.copytree(folder / "sparse/1", folder / "sparse/0")
    (folder / "sparse/0/images.txt").write_text("\n".join(IMAGES_TXT.splitlines()[:5]))
    cv2.imwrite(str(folder / "images/shot 12.png"), picture(3))
    with pytest.warns(FileWarning) as told:
        scene = load(folder)
    said = [str(warning.message) for warning in told]
    assert any("0 with 1, 1 with 3); 1 is read" in text for text in said)
    assert any("not registered 1 of 4 pictures (shot 12.png)" in text for text in said)
    assert shown(scene.video) == [0, 1, 2]


def test_depth_bounds_come_from_scene_json_where_a_model_has_no_points(tmp_path):
    folder = colmap_text(tmp_path / "kite")
    (folder / "sparse/0/points3D.txt").unlink()
    with pytest.raises(ValueError, match='depth bounds are not known; write scene.json beside it, {"near"'):
        load(folder)
    (folder / "scene.json").write_text('{"near": 2, "far": 7, "name": "flying kite"}')
    scene = load(folder)
    assert (scene.name, float(scene.video.near), float(scene.video.far)) == ("flying kite", 2, 7)


INSTANT_NGP = """
{
  "camera_angle_x": 0.97995949,
  "camera_angle_y": 0.77317399,
  "fl_x": 60.0, "fl_y": 59.0, "k1": 0, "k2": 0, "p1": 0, "p2": 0,
  "cx": 33.0, "cy": 24.5, "w": 64.0, "h": 48.0, "aabb_scale": 16, "near": 1.0, "far": 9.0,
  "frames": [
    {"file_path": "./images/0010.png", "sharpness": 20.1,
     "transform_matrix": [[1, 0, 0, 0.5], [0, 1, 0, 0.25], [0, 0, 1, 2], [0, 0, 0, 1]]},
    {"file_path": "./images/0009.png", "sharpness": 30.1,
     "transform_matrix": [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]}
  ]
}
"""


def instant_ngp(folder):
    write_pictures(folder / "images", ["0009.png", "0010.png"])
    (folder / "transforms.json").write_text(INSTANT_NGP)
    return folder


def test_transforms_of_instant_ngp_see_a_point_where_arithmetic_says(tmp_path):
    scene = load(instant_ngp(tmp_path / "fox"))
    assert (scene.name, scene.layout) == ("fox", "transforms") and shown(scene.video) == [0, 1]
    # 0010.png stands at (0.5, 0.25, 2), looks along -z, y up: (0.7, 0.5, -2) lies 0.2 right of it, 0.25 above, 4 ahead
    at = [60 * 0.2 / 4 + 33 - 0.5, -59 * 0.25 / 4 + 24.5 - 0.5]
    np.testing.assert_allclose(pixel(scene.video, 1, [0.7, 0.5, -2]), at, atol=1e-4)
    # 0009.png is turned about its axis: its right is the world's y, its up the world's -x
    at = [60 * 0.5 / 4 + 33 - 0.5, -59 * -0.7 / 4 + 24.5 - 0.5]
    np.testing.assert_allclose(pixel(scene.video, 0, [0.7, 0.5, -2]), at, atol=1e-4)


def test_transforms_may_say_an_angle_a_camera_a_frame_times_and_a_split(tmp_path):
    folder = instant_ngp(tmp_path / "fox")
    content = json.loads(INSTANT_NGP)
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_y"):
        del content[key]
    for i, frame in enumerate(content["frames"]):
        frame |= {"time": 0.5 * i, "file_path": frame["file_path"].removesuffix(".png")}
    content["frames"][0]["fl_x"] = 40.0
    (folder / "transforms.json").write_text(json.dumps(content | {"val_filenames": ["images/0009.png"]}))
    scene = load_scene(folder)
    assert shown(scene.video) == [1, 0] and [target.time for target in scene.targets] == [1]
    focal = 32 / np.tan(0.97995949 / 2)
    np.testing.assert_allclose(scene.video.cameras.intrinsics[1], [[focal, 0, 31.5], [0, focal, 23.5], [0, 0, 1]])
    np.testing.assert_allclose(scene.video.cameras.intrinsics[0], [[40, 0, 31.5], [0, 40, 23.5], [0, 0, 1]])


NERFIES_CAMERA = """
{"orientation": [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], "position": [%s, 2.0, 3.0],
 "focal_length": 60.0, "principal_point": [33.0, 24.5], "image_size": [64, 48], "skew": 0.0,
 "pixel_aspect_ratio": 1.1, "radial_distortion": [0.0, 0.0, 0.0], "%s": [0.0, 0.0]}
"""


def nerfies(folder):
    """Two instants; the second camera's pictures are held out, and one of an instant that no frame has."""
    names = ["0_00003", "0_00007", "1_00003", "1_00005"]
    write_pictures(folder / "rgb/2x", [f"{name}.png" for name in names])
    (folder / "camera").mkdir()
    for i, name in enumerate(names):
        key = "tangential" if i else "tangential_distortion"
        (folder / f"camera/{name}.json").write_text(NERFIES_CAMERA % (10 + 0.1 * i, key))
    entry = lambda name: {"warp_id": int(name[2:]), "appearance_id": int(name[2:]), "camera_id": int(name[0])}
    (folder / "metadata.json").write_text(json.dumps({name: entry(name) for name in names}))
    ids = {"count": 4, "num_exemplars": 2, "ids": names, "train_ids": names[1::-1], "val_ids": names[2:]}
    (folder / "dataset.json").write_text(json.dumps(ids))
    (folder / "scene.json").write_text('{"scale": 0.5, "center": [10, 2, 1], "near": 0.2, "far": 4}')
    return folder


def test_nerfies_cameras_see_a_point_where_arithmetic_says(tmp_path):
    with pytest.warns(FileWarning, match="1 of 2 held-out pictures are of instants that no frame has"):
        scene = load_scene(nerfies(tmp_path / "broom"))
    assert scene.layout == "nerfies" and shown(scene.video) == [0, 1]
    assert [(t.time, t.camera_name, shown_of(t.image)) for t in scene.targets] == [(0, "cam01", 2)]
    # the first camera stands at ((10 - 10) / 2, 0, (3 - 1) / 2) = (0, 0, 1), looks along -z, its down is the world's -y
    at = [60 * 0.2 / 3 + 33 - 0.5, 66 * -0.3 / 3 + 24.5 - 0.5]
    np.testing.assert_allclose(pixel(scene.video, 0, [0.2, 0.3, -2]), at, atol=1e-4)


def shown_of(image):
    return round((float(image.mean()) * 255 - 10) / 20)


def test_nerfies_pictures_of_instants_between_the_frames_are_held_out_frames(tmp_path):
    folder = nerfies(tmp_path / "broom")
    ids = {"train_ids": ["0_00003", "0_00007"], "val_ids": ["1_00005"]}
    (folder / "dataset.json").write_text(json.dumps(ids))
    scene = load_scene(folder)
    assert shown(scene.video) == [0, 3, 1] and [(t.time, t.exclude) for t in scene.targets] == [(1, (1,))]


def test_transparent_pixels_of_nerfies_pictures_have_their_stored_colours(tmp_path):
    folder = nerfies(tmp_path / "broom")
    pixels = np.concatenate([picture(0), np.full((HEIGHT, WIDTH, 1), 255, np.uint8)], -1)
    pixels[:5, :, 3] = 0
    cv2.imwrite(str(folder / "rgb/2x/0_00003.png"), pixels)
    with pytest.warns(FileWarning) as told:
        assert shown(load(folder).video) == [0, 1]
    assert any("2x: has transparent pixels, whose stored colours are used" in str(each.message) for each in told)


TABLE = """\
file,time,width,height,fx,fy,cx,cy,qw,qx,qy,qz,tx,ty,tz,near,far,role,camera
shots/b.png,20,64,48,60,50,32,24,1,0,0,0,-0.5,0,1,2,8,input,
shots/a.png,10,64,48,60,50,32,24,2,0,0,2,0,0,1,1.5,7,input,
shots/c.png,10,64,48,60,50,32,24,1,0,0,0,0.25,0,1,2,9,target,side
"""
TABLE_OF_MATRICES = """\
file,time,width,height,fx,fy,cx,cy,m00,m01,m02,m03,m10,m11,m12,m13,m20,m21,m22,m23,near,far
shots/b.png,20,64,48,60,50,32,24,1,0,0,-0.5,0,1,0,0,0,0,1,1,2,8
shots/a.png,10,64,48,60,50,32,24,0,-1,0,0,1,0,0,0,0,0,1,1,1.5,7
"""


def table(folder, text=TABLE):
    write_pictures(folder / "shots", ["a.png", "b.png", "c.png"])
    (folder / "cameras.csv").write_text(text)
    return folder


@pytest.mark.parametrize("text", [TABLE, TABLE_OF_MATRICES, "\ufeff" + TABLE.replace("\n", "\r\n")])
def test_a_table_of_cameras_sees_a_point_where_arithmetic_says(tmp_path, text):
    scene = load(table(tmp_path / "own", text))
    assert scene.layout == "table" and shown(scene.video) == [0, 1]
    np.testing.assert_allclose(pixel(scene.video, 1, [0.9, 0.2, 3]), [60 * 0.4 / 4 + 32, 50 * 0.2 / 4 + 24], atol=1e-4)
    np.testing.assert_allclose(pixel(scene.video, 0, [0.9, 0.2, 3]), [60 * -0.2 / 4 + 32, 50 * 0.9 / 4 + 24], atol=1e-4)


def test_a_table_may_have_held_out_pictures(tmp_path):
    scene = load_scene(table(tmp_path / "own"))
    assert [(t.time, t.camera_name, shown_of(t.image)) for t in scene.targets] == [(0, "side", 2)]
    assert (float(scene.video.near), float(scene.video.far)) == (1.5, 9)


def made_video(count=9, *, centred=False):
    rng = np.random.default_rng(0)
    k = np.tile([[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], (count, 1, 1)).astype(np.float32)
    poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    for i in range(count):
        poses[i, :3, :3] = cv2.Rodrigues(rng.normal(0, 0.1, 3))[0]
        poses[i, :3, 3] = rng.normal(0, 0.2, 3)
        if not centred:
            k[i, :2, 2] += rng.uniform(-2, 2, 2)
            k[i, 1, 1] = 58 + i % 2
    images = rng.integers(0, 256, (count, HEIGHT, WIDTH, 3)).astype(np.float32) / np.float32(255)
    return Video(images, Camera(k, poses), np.float32(2), np.float32(9))


def other_views(video):
    for time in (1, 4):
        camera = Camera(video.cameras.intrinsics[0], video.cameras.camera_from_world[0])
        yield Target(time, "cam03", camera, video.images[0])


WRITERS = {
    "colmap": lambda folder, video: write_colmap(folder, "toy", video, points=np.ones((3, 3))),
    "colmap, text": lambda folder, video: write_colmap(folder, "toy", video, binary=False),
    "transforms": lambda folder, video: write_transforms(folder, "toy", video),
    "nerfies": lambda folder, video: write_nerfies(folder, "toy", video, held_out=other_views(video)),
    "table": lambda folder, video: write_table(folder, "toy", video, held_out=other_views(video)),
    "llff": lambda folder, video: write_llff(folder, video),
    "idr": lambda folder, video: write_idr(folder, video),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_written_scene_comes_back(tmp_path, kind):
    video = made_video(centred=kind == "llff")
    for _ in range(2):  # the second replaces the first
        WRITERS[kind](tmp_path / "toy", video)
    scene = load_scene(tmp_path / "toy")
    assert (scene.name, scene.layout) == ("toy", kind.split(",")[0])
    np.testing.assert_allclose(scene.video.images, video.images, atol=1e-6)
    for read, wrote in zip(scene.video.cameras, video.cameras, strict=True):
        np.testing.assert_allclose(read, wrote, atol=3e-5 if kind in ("idr", "llff") else 1e-5)
    bounds = (float(scene.video.near), float(scene.video.far))
    assert (bounds[0] <= 2 and bounds[1] >= 9) if kind == "idr" else bounds == (2, 9)
    if kind in ("nerfies", "table"):
        assert [target.time for target in scene.targets] == [1, 4]
        for read, wrote in zip(scene.targets, other_views(video), strict=True):
            np.testing.assert_allclose(read.image, wrote.image, atol=1e-6)
            np.testing.assert_allclose(read.camera.camera_from_world, wrote.camera.camera_from_world, atol=1e-6)
    else:
        assert [target.time for target in scene.targets] == [0, 8]


@pytest.mark.parametrize("kind", WRITERS)
def test_a_writer_leaves_other_peoples_folders_alone(tmp_path, kind):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="not an earlier result"):
        WRITERS[kind](tmp_path, made_video(centred=True))
    assert os.listdir(tmp_path) == ["notes.txt"]


def replaced(name, old, new):
    """A fault: a text in a file, another in its place."""

    def spoil(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return spoil


def cut(name, size):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size])


def claimed(name, at, count):
    def spoil(folder):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[:at] + count.to_bytes(8, "little") + content[at + 8 :])

    return spoil


def squashed(name):
    return lambda folder: cv2.imwrite(str(folder / name), picture(0, (48, 48)))


IMAGES, CAMERAS, OF_4 = "sparse/0/images.txt", "sparse/0/cameras.txt", "sparse/0/images.bin"
FAULTS = {
    "a missing picture": (colmap_text, lambda f: (f / "images/shot 9.png").unlink(), "shot 9.png: is missing"),
    "no picture at all": (colmap_text, lambda f: replaced(IMAGES, "shot", "slow")(f), "none of its pictures"),
    "a place outside": (colmap_text, replaced(IMAGES, "shot 9.png", "../../secret.png"), "'../../secret.png'"),
    "a place from the root": (colmap_text, replaced(IMAGES, "shot 9.png", "/etc/passwd"), "'/etc/passwd'"),
    "a picture twice": (colmap_text, replaced(IMAGES, "shot 9.png", "shot 10.png"), "lists a picture twice"),
    "a turn of no length": (colmap_text, replaced(IMAGES, "1 0 0 0 -0.5", "0 0 0 0 -0.5"), "is no rotation"),
    "a pose of NaN": (colmap_text, replaced(IMAGES, "-0.5 0 0", "nan 0 0"), "not finite"),
    "a camera that misses": (colmap_text, replaced(IMAGES, "0 0 4 shot 10", "0 0 5 shot 10"), "of camera 5, which is"),
    "an unknown kind": (colmap_text, replaced(CAMERAS, "PINHOLE", "SPYGLASS"), "of kind SPYGLASS, none of"),
    "a fisheye": (colmap_text, replaced(CAMERAS, "PINHOLE 64 48 60 50 30 25", "OPENCV_FISHEYE 64 48 1 1 1 1 0 0 0 0"),
                  "OPENCV_FISHEYE.*image_undistorter"),
    "too few numbers": (colmap_text, replaced(CAMERAS, " 25\n", "\n"), "fx, fy, cx, cy"),
    "another size": (colmap_text, replaced(CAMERAS, "64 48", "64 64"), "poses are of 64x64"),
    "a middle outside": (colmap_text, replaced(CAMERAS, "30 25", "300 25"), "looks at pixel"),
    "a squashed picture": (colmap_text, squashed("images/shot 9.png"), "shot 9.png: has 48x48 pixels"),
    "several folders": (colmap_text, lambda f: ((f / "images/side").mkdir(), shutil.move(
        f / "images/shot 9.png", f / "images/side"), replaced(IMAGES, "shot 9.png", "side/shot 9.png")(f)),
        "several folders"),
    "half a list": (colmap_4, cut(OF_4, 100), "it ends too early|can hold"),
    "an empty list": (colmap_4, cut(OF_4, 0), "images.bin: is not COLMAP's list of images"),
    "half the points": (colmap_4, cut("sparse/0/points3D.bin", 100), "points3D.bin: is not"),
    "a huge count": (colmap_4, claimed(OF_4, 0, 2**62), "it claims 4,611,686,018,427,387,904 entries"),
    "a huge count of points": (colmap_4, claimed("sparse/0/points3D.bin", 0, 2**40), "points3D.bin.*it claims"),
    "a kind by number": (colmap_4, claimed("sparse/0/cameras.bin", 12, 2**20 + 99), "of kind number 99|THIN|kind"),
    "no frames": (instant_ngp, replaced("transforms.json", '"frames"', '"shots"'), "should hold `frames`"),
    "no bounds": (instant_ngp, replaced("transforms.json", '"near"', '"nearest"'), "has no `near` and `far`; add them"),
    "a fisheye of nerfstudio": (
        instant_ngp, replaced("transforms.json", '"w"', '"camera_model": "OPENCV_FISHEYE", "w"'), "OPENCV_FISHEYE"),
    "a file outside": (instant_ngp, replaced("transforms.json", "./images/0009", "../images/0009"), "../images/0009"),
    "a file of Windows outside": (
        instant_ngp, replaced("transforms.json", "./images/0009.png", "..\\\\0009.png"), "0009.png"),
    "a frame twice": (instant_ngp, replaced("transforms.json", "0009", "0010"), "lists 0010.png twice"),
    "a missing frame": (instant_ngp, lambda f: (f / "images/0010.png").unlink(), "0010.png: is missing"),
    "several folders without times": (instant_ngp, lambda f: ((f / "more").mkdir(), shutil.move(
        f / "images/0009.png", f / "more"), replaced("transforms.json", "images/0009", "more/0009")(f)), "no order"),
    "a scaled pose": (instant_ngp, replaced("transforms.json", "[0, 0, 1, 2]", "[0, 0, 3, 2]"), "is not rigid"),
    "one time for two": (instant_ngp, replaced("transforms.json", '"sharpness"', '"time": 3, "sharpness"'),
                         "both of time 3; several cameras"),
    "NaN in JSON": (instant_ngp, replaced("transforms.json", "[0, 0, 1, 2]", "[0, 0, NaN, 2]"), "NaN"),
    "pictures of another size": (instant_ngp, replaced("transforms.json", '"h": 48.0', '"h": 64.0'), "of 64x64"),
    "no instants": (nerfies, replaced("metadata.json", "_id", "_no"), "has no instant of"),
    "two at one instant": (nerfies, replaced("metadata.json", '"warp_id": 7', '"warp_id": 3'), "both of instant 3"),
    "a name outside": (nerfies, replaced("dataset.json", '"0_00007", "0', '"../0_00007", "0'), "metadata.json|outside"),
    "no camera": (nerfies, lambda f: (f / "camera/0_00007.json").unlink(), "0_00007.json: could not be read"),
    "no scale": (nerfies, replaced("scene.json", '"scale": 0.5', '"scale": 0'), "`scale` is 0"),
    "a column that misses": (table, replaced("cameras.csv", "fx", "focal"), "has no column `fx`"),
    "no poses": (table, replaced("cameras.csv", "qx", "q1"), "has no columns of poses"),
    "no number": (table, replaced("cameras.csv", "-0.5", "left"), "picture 1 has 'left' as `tx`"),
    "one of no rotation": (table, replaced("cameras.csv", "2,0,0,2", "0,0,0,0"), "is no rotation"),
    "two of one time": (table, replaced("cameras.csv", "b.png,20", "b.png,10"), "two inputs of time 10"),
    "a target alone": (table, replaced("cameras.csv", "c.png,10", "c.png,11"), "time 11 has no input"),
    "a role": (table, replaced("cameras.csv", "target", "extra"), "has the role 'extra'"),
    "too many cells": (table, replaced("cameras.csv", "input,\n", "input,,\n"), "cells for 19 columns"),
    "a file out of it": (table, replaced("cameras.csv", "shots/b.png", "C:/b.png"), "'C:/b.png'"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_input_is_one_line_that_names_the_file(tmp_path, fault):
    make, spoil, message = FAULTS[fault]
    folder = make(tmp_path / "scene")
    spoil(folder)
    with pytest.raises(ValueError, match=message) as caught, warnings.catch_warnings():
        warnings.simplefilter("ignore", FileWarning)
        load(folder)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def test_masks_of_transforms_are_left_out_with_a_word(tmp_path):
    folder = instant_ngp(tmp_path)
    replaced("transforms.json", '"sharpness"', '"mask_path": "masks/a.png", "sharpness"')(folder)
    with pytest.warns(FileWarning, match="names files by mask_path, which are not read"):
        load(folder)


OPENS = """
import sys
from zestjax.io.scenes import load_scene
video = load_scene(sys.argv[1], protocol="strict", height=288).video
print([int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM")][0], *video.images.shape)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is counted by Linux")
def test_300_frames_of_1080p_open_in_less_than_a_gigabyte(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (1080, 1920, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "0.jpg"), cv2.GaussianBlur(noise, (0, 0), 2))
    rows = ["file,time,width,height,fx,fy,cx,cy,qw,qx,qy,qz,tx,ty,tz,near,far"]
    for i in range(300):
        if i:
            os.link(tmp_path / "0.jpg", tmp_path / f"{i}.jpg")
        rows.append(f"{i}.jpg,{i},1920,1080,1600,1600,959.5,539.5,1,0,0,0,{0.01 * i},0,0,2,50")
    (tmp_path / "cameras.csv").write_text("\n".join(rows))
    done = subprocess.run([sys.executable, "-c", OPENS, tmp_path], capture_output=True, text=True, check=True)
    kilobytes, *shape = map(int, done.stdout.split())
    assert shape == [300, 288, 512, 3] and kilobytes < 1e6


def test_films_of_several_cameras_are_refused_with_what_to_do(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", np.zeros((2, 17)))
    for i in range(2):
        (tmp_path / f"cam{i:02d}.mp4").write_bytes(b"")
    with pytest.raises(ValueError, match=r"2 films of several cameras at one time \(cam00.mp4 to cam01.mp4\)"):
        load(tmp_path)


def test_an_unknown_folder_is_told_what_was_looked_for_and_found(tmp_path):
    (tmp_path / "sparse").mkdir()
    with pytest.raises(ValueError) as caught:
        load(tmp_path)
    for part in (
        "it has sparse, but no cameras and images",
        "none of poses_bounds.npy",
        "transforms.json",
        "cameras.csv",
    ):
        assert part in str(caught.value)


def test_a_folder_in_two_layouts_is_read_by_the_one_asked_for(tmp_path):
    folder = colmap_text(tmp_path / "both")
    shutil.copy(folder / "images/shot 9.png", folder / "images/0009.png")
    shutil.copy(folder / "images/shot 10.png", folder / "images/0010.png")
    (folder / "transforms.json").write_text(INSTANT_NGP)
    assert load(folder).layout == "transforms"
    with pytest.warns(FileWarning, match="not registered 2 of 5"):
        assert load(folder, layout="colmap").layout == "colmap"
