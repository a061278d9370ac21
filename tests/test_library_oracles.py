"""Our geometry, readers and files against libraries that others wrote, on inputs that hypothesis draws."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import normal, uniform
from scipy.spatial.transform import Rotation

from zestjax.cameras import Camera, project
from zestjax.frames.optical_flow import video_flow
from zestjax.io.flow_files import read_flo, write_flo
from zestjax.planesweep import plane_homography, sweep_grid, warp
from zestjax.resample import bilinear
from zestjax.simulate.motion import rotation_from_vector

several = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 2**32 - 1)
angles = st.lists(st.floats(-3, 3), min_size=3, max_size=3)


@st.composite
def cameras(draw):
    """A camera near the origin that looks about along z: float64 (K, R, t)."""
    rng = np.random.default_rng(draw(seeds))
    k = np.diag([rng.uniform(20, 90), rng.uniform(20, 90), 1])
    k[:2, 2], k[0, 1] = rng.uniform(5, 30, 2), rng.normal() / 5
    return k, Rotation.from_rotvec(rng.normal(size=3) / 6).as_matrix(), rng.normal(size=3) / 4


def ours(camera):
    k, rotation, translation = camera
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return Camera(jnp.asarray(k, jnp.float32), jnp.asarray(pose, jnp.float32))


read_zero, read_clamped = (jax.jit(lambda i, p, b=b: bilinear(i, p, border=b).values) for b in ("zero", "clamp"))
seen_on_plane, homography_of = jax.jit(warp), jax.jit(plane_homography)


@several
@given(seed=seeds, border=st.sampled_from(["zero", "clamp"]))
def test_bilinear_is_cv2_remap(seed, border):
    rng = np.random.default_rng(seed)
    image = rng.uniform(size=(7, 9, 3)).astype(np.float32)
    inside = border == "zero"  # outside, cv2 fades to 0 over one pixel where we stop at the border
    low, high = (0, [8, 6]) if inside else (-4, [13, 11])
    pixels = (np.round(rng.uniform(low, high, (11, 5, 2)) * 32) / 32).astype(np.float32)  # cv2 reads in 1/32 pixels
    theirs = cv2.remap(image, *np.moveaxis(pixels, -1, 0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose((read_zero if inside else read_clamped)(image, pixels), theirs, atol=2e-5)


@several
@given(camera=cameras(), seed=seeds)
def test_projection_is_cv2_project_points_without_skew(camera, seed):
    camera[0][0, 1] = 0  # cv2 knows no skew
    points = np.random.default_rng(seed).uniform([-1, -1, 1], [1, 1, 4], (20, 3))
    theirs = cv2.projectPoints(points, cv2.Rodrigues(camera[1])[0], camera[2], camera[0], None)[0][:, 0]
    seen = project(ours(camera), jnp.asarray(points, jnp.float32))
    front = np.asarray(seen.in_front)
    scale = np.maximum(1, np.abs(theirs))
    assert np.all(np.abs(seen.pixels - theirs)[front] / scale[front] < 2e-3 / np.maximum(0.05, seen.depth[front, None]))


@several
@given(reference=cameras(), source=cameras(), depth=st.floats(1.5, 20))
def test_homographies_are_those_cv2_finds_between_projected_points(reference, source, depth):
    """Four points of the plane, projected by cv2 into both views, fix the homography up to scale."""
    for camera in (reference, source):
        camera[0][0, 1] = 0
    corners = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) * depth / 3 * [1, 1, 3]
    world = (corners - reference[2]) @ reference[1]
    views = [cv2.projectPoints(world, cv2.Rodrigues(r)[0], t, k, None)[0][:, 0] for k, r, t in (reference, source)]
    theirs = cv2.getPerspectiveTransform(*(view.astype(np.float32) for view in views))
    found = np.asarray(homography_of(ours(reference), ours(source), jnp.float32(depth)), np.float64)
    inside = views[0].mean(0)[None, None]
    expected = cv2.perspectiveTransform(inside, theirs)
    np.testing.assert_allclose(cv2.perspectiveTransform(inside, found), expected, rtol=2e-3, atol=0.05)
    np.testing.assert_allclose(cv2.perspectiveTransform(views[0][None], found)[0], views[1], rtol=1e-3, atol=0.02)


@several
@given(seed=seeds)
def test_a_warp_is_cv2_warp_perspective(seed):
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.uniform(size=(24, 30, 2)).astype(np.float32), (0, 0), 2)
    homography = np.eye(3) + rng.normal(size=(3, 3)) * [[0.03, 0.03, 2], [0.03, 0.03, 2], [5e-4, 5e-4, 0]]
    theirs = cv2.warpPerspective(image, homography, (30, 24), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    found = seen_on_plane(image, homography.astype(np.float32), sweep_grid(24, 30))
    u, v = np.meshgrid(np.arange(30.0), np.arange(24.0))
    x, y, z = np.moveaxis(np.stack([u, v, 1 + 0 * u], -1) @ homography.T, -1, 0)
    inside = (x / z > 0.1) & (x / z < 28.9) & (y / z > 0.1) & (y / z < 22.9) & np.asarray(found.visible)
    np.testing.assert_allclose(found.values[inside], theirs[inside], atol=0.02)  # cv2 rounds to 1/32 pixels


@several
@given(vector=angles, power=st.integers(-8, 0))
def test_rotations_are_scipys(vector, power):
    vector = np.array(vector) * 10.0**power
    found = rotation_from_vector(jnp.asarray(vector, jnp.float32))
    np.testing.assert_allclose(found, Rotation.from_rotvec(vector).as_matrix(), atol=2e-6)


@several
@given(height=st.integers(1, 9), width=st.integers(1, 9), seed=seeds)
def test_flo_files_are_cv2s_both_ways(height, width, seed):
    import tempfile

    rng = np.random.default_rng(seed)
    flow, known = rng.normal(size=(height, width, 2)).astype(np.float32), rng.uniform(size=(height, width)) < 0.8
    with tempfile.TemporaryDirectory() as folder:
        place = str(Path(folder) / "a.flo")
        cv2.writeOpticalFlow(place, flow)
        np.testing.assert_array_equal(read_flo(place)[0], flow)
        write_flo(place, flow, known=known)
        np.testing.assert_array_equal(cv2.readOpticalFlow(place)[known], flow[known])
        back, valid = read_flo(place)
    np.testing.assert_array_equal(valid, known)
    np.testing.assert_array_equal(back, np.where(known[..., None], flow, 0))


def test_a_damaged_flo_file_is_named(tmp_path):
    path = tmp_path / "a.flo"
    write_flo(path, np.zeros((3, 4, 2)))
    content = path.read_bytes()
    for damaged in (b"", content[:11], content[:-1], b"XXXX" + content[4:], content + b"0"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="a.flo: is not a whole .flo file"):
            read_flo(path)
    with pytest.raises(ValueError, match=r"write_flo: `flow` should be \(H, W, 2\)"):
        write_flo(path, np.zeros((3, 4)))


def test_flow_of_real_pairs_is_near_their_truth():
    folder = Path(__file__).parents[2] / "shared" / "data" / "flyingchairs"
    if not folder.exists():
        pytest.skip("needs shared/data/flyingchairs beside the repository")
    errors = []
    for truth in sorted(folder.glob("*-gt.flo")):
        pair = [cv2.imread(str(folder / truth.name.replace("gt.flo", f"img{i}.png")))[..., ::-1] for i in (0, 1)]
        found, sure = video_flow(np.stack(pair))
        flow, known = read_flo(truth)
        np.testing.assert_array_equal(flow, cv2.readOpticalFlow(str(truth)))
        here = (sure[0, 0] > 0.5) & known[::2, ::2]
        errors.append(np.linalg.norm(found[0, 0] - flow.reshape(192, 2, 256, 2, 2).mean((1, 3)), axis=-1)[here].mean())
    assert np.median(errors) < 2, errors


def test_a_linear_map_is_jax_numpys_and_numpys():
    from zestjax.base.numerics import matmul, matvec

    a, b = normal(0, 5, 3, 3), uniform(1, 5, 3)
    np.testing.assert_allclose(matvec(a, b), np.einsum("nij,nj->ni", a, b), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(matmul(a, a), np.asarray(a) @ np.asarray(a), rtol=1e-5, atol=1e-5)
