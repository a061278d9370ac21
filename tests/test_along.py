"""Gaps along the optical flow: what a point's whole path through the video says of its depth and motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_grads_match, normal, uniform

from zestjax.cameras import Camera
from zestjax.frames import along, evidence
from zestjax.frames.evidence import Neighbours
from zestjax.planesweep import plane_depths

NEAR, FAR, PLANES, FRAMES = 1.5, 6.0, 7, 6
SIZE = (4, 6)  # cells
find = jax.jit(functools.partial(along.gaps_along, planes=PLANES))


def cameras_at(places, dtype=np.float32):
    """Cameras that look along z from (x, y, 0)."""
    pose = np.tile(np.eye(4, dtype=dtype), (len(places), 1, 1))
    pose[:, :2, 3] = -np.asarray(places)
    height, width = (4 * n for n in SIZE)
    intrinsics = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]], dtype)
    return Camera(np.tile(intrinsics, (len(places), 1, 1)), pose)


def beside(cameras, flow, sure):
    """`Neighbours` of all frames, those beyond the ends not trusted."""
    count = len(flow)
    there = np.clip(np.arange(count)[:, None] + [1, -1], 0, count - 1)
    exists = np.ones((count, 2, 1, 1), sure.dtype)
    exists[-1, 0] = exists[0, 1] = 0
    return Neighbours(flow, sure * exists, jax.tree.map(lambda x: x[there], cameras))


def drawn(seed, *, dtype=jnp.float32, spread=3.0, frames=FRAMES):
    """A video's cameras and `Neighbours` with random flow and trust."""
    rows, columns = (2 * n for n in SIZE)
    cameras = cameras_at(0.3 * np.asarray(normal(seed, frames, 2, dtype=dtype)), dtype)
    flow = spread * normal(seed + 1, frames, 2, rows, columns, 2, dtype=dtype)
    return cameras, beside(cameras, flow, uniform(seed + 2, frames, 2, rows, columns, dtype=dtype))


def pulls(flow):
    """(cells, cells): row c holds the bilinear weights of where cell c's flow (pixels) takes it; zero off the image."""
    height, width = SIZE
    matrix = np.zeros((height * width, height * width))
    for row in range(height):
        for column in range(width):
            u, v = column + flow[row, column, 0] / 4, row + flow[row, column, 1] / 4
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                continue
            for j in range(height):
                for i in range(width):
                    share = max(0, 1 - abs(u - i)) * max(0, 1 - abs(v - j))
                    matrix[row * width + column, j * width + i] = share
    return matrix


def gaps_by_matrices(cameras, beside):
    """The same by one dense matrix for each pair of frames, in float64."""
    depths, count = np.asarray(plane_depths(NEAR, FAR, PLANES, spacing="inverse"), np.float64), len(beside.flow)
    pose, size = np.asarray(cameras.camera_from_world, np.float64)[:, :2, 3], SIZE[0] * SIZE[1]
    flow, sure = np.zeros((count, 2, *SIZE, 2)), np.zeros((count, 2, *SIZE))
    for n in range(count):
        for k in range(2):
            blocks = lambda x: np.asarray(x, np.float64).reshape(SIZE[0], 2, SIZE[1], 2, -1).sum((1, 3))
            trust = blocks(beside.sure[n, k])
            weighted = blocks(np.asarray(beside.flow[n, k]) * np.asarray(beside.sure[n, k])[..., None])
            flow[n, k] = weighted / trust.clip(1e-30)
            sure[n, k] = trust[..., 0] / 4
    own = np.zeros((count, 2, PLANES, size))
    weights = np.stack([sure.mean(1), sure.prod(1)], 1).reshape(count, 2, size)
    for n in range(count):
        there = [min(n + 1, count - 1), max(n - 1, 0)]
        for e, depth in enumerate(depths):
            velocity = [flow[n, k] - 4 * SIZE[1] * (pose[there[k]] - pose[n]) / depth for k in range(2)]
            gap = lambda v: np.minimum(np.linalg.norm(v, axis=-1) / evidence.GAP, 1)
            support = (sure[n, 0] * (1 - gap(velocity[0])) + sure[n, 1] * (1 - gap(velocity[1]))) / 2
            own[n, 0, e] = support.ravel()
            own[n, 1, e] = (sure[n].prod(0) * (1 - gap(velocity[0] + velocity[1]))).ravel()
    found = np.zeros((count, 2, PLANES, size))
    for n in range(count):
        sums, total = own[n].copy(), weights[n].copy()
        for side, step in ((0, 1), (1, -1)):
            path, t = np.eye(size), n
            while 0 <= t + step < count:
                path = path @ (along.KEPT * sure[t, side].ravel()[:, None] * pulls(flow[t, side]))
                t += step
                sums += own[t] @ path.T
                total += weights[t] @ path.T
        found[n] = 1 - sums / (total + along.LEAST)[:, None]
    return np.moveaxis(found, 2, -1).reshape(count, 2, *SIZE, PLANES)


@pytest.mark.parametrize("seed", [0, 7])
def test_gaps_are_those_of_dense_matrices(seed):
    cameras, around = drawn(seed)
    expected = gaps_by_matrices(cameras, around)
    for found, wanted in zip(find(cameras, around, NEAR, FAR), np.moveaxis(expected, 1, 0), strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-5)


def test_where_all_agree_a_path_says_what_each_frame_says():
    cameras = cameras_at(np.zeros((FRAMES, 2)))
    shape = (FRAMES, 2, *(2 * n for n in SIZE))
    around = beside(cameras, np.zeros((*shape, 2), np.float32), np.ones(shape, np.float32))
    found = find(cameras, around, NEAR, FAR)
    away = np.abs(np.arange(FRAMES) - 2)
    for gaps, own in ((found.still, [0.5, 1, 1, 1, 1, 0.5]), (found.moving, [0, 1, 1, 1, 1, 0])):
        weight = float(np.sum(np.array(own) * along.KEPT**away))
        np.testing.assert_allclose(gaps[2], along.LEAST / (weight + along.LEAST), rtol=1e-4)


def test_a_path_knows_the_depth_of_what_moves_where_a_frame_does_not():
    # A camera that jerks twice: the frames between see no parallax beside the motion, those about a jerk do.
    x = 0.1 * np.array([0, 1, 2, 3, 5, 6, 7, 8.0])
    cameras, depths = (
        cameras_at(np.stack([x, 0 * x], -1)),
        np.asarray(plane_depths(NEAR, FAR, PLANES, spacing="inverse")),
    )
    focal, plane, speed = 4 * SIZE[1], 2, 0.02
    steps = (np.diff(x) * -1 + speed) * focal / depths[plane]
    rows, columns = (2 * n for n in SIZE)
    flow = np.zeros((8, 2, rows, columns, 2), np.float32)
    flow[:-1, 0, ..., 0], flow[1:, 1, ..., 0] = steps[:, None, None], -steps[:, None, None]
    around = beside(cameras, flow, np.ones((8, 2, rows, columns), np.float32))
    inner = np.s_[1:-1, 2:-2]
    gaps = np.asarray(find(cameras, around, NEAR, FAR).moving)
    for frame in (1, 2, 5, 6):
        here, pair = jax.tree.map(lambda leaf, n=frame: leaf[n], (cameras, around))
        alone = along._own(depths, (here, pair.cameras, *evidence.cell_flow(pair.flow, pair.sure)))
        if frame in (1, 6):
            assert np.ptp(np.asarray(alone)[..., PLANES : 2 * PLANES][inner], axis=-1).max() < 1e-4
        assert (gaps[frame].argmin(-1)[inner] == plane).all()


def test_a_video_backwards_has_the_same_gaps_backwards():
    cameras, around = drawn(20)
    turned = lambda tree: jax.tree.map(lambda x: x[::-1], tree)
    swapped = jax.tree.map(lambda x: x[::-1, ::-1], around)
    forward, backward = find(cameras, around, NEAR, FAR), find(turned(cameras), swapped, NEAR, FAR)
    for a, b in zip(forward, backward, strict=True):
        np.testing.assert_allclose(a[::-1], b, atol=1e-5)


def test_a_frame_whose_flow_nobody_trusts_is_no_part_of_any_path():
    cameras, around = drawn(30)
    cut = np.array(around.sure)
    cut[3] = cut[2, 0] = cut[4, 1] = 0
    other = np.array(around.flow)
    other[3] = 50
    found = find(cameras, around._replace(sure=cut), NEAR, FAR)
    for a, b in zip(found, find(cameras, around._replace(sure=cut, flow=other), NEAR, FAR), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a[3], 1)


def of_three(around, dtype=jnp.float32):
    """Gaps of the drawn video of three frames from its flow and a share of its trust."""
    cameras = drawn(40, frames=3, dtype=dtype)[0]
    near, far = jnp.asarray(NEAR, dtype), jnp.asarray(FAR, dtype)
    replaced = lambda flow, share: around._replace(flow=flow, sure=share * around.sure)
    return lambda flow, share: along.gaps_along(cameras, replaced(flow, share), near, far, planes=2)


@pytest.fixture(scope="module")
def extreme():
    """Flow to gaps and gradients of the video of three frames, compiled once."""
    around = drawn(40, frames=3)[1]
    found = of_three(around)
    total = lambda flow, share: sum(jnp.sum(gaps) for gaps in found(flow, share))
    compiled = jax.jit(lambda flow, share: (found(flow, share), jax.grad(total, argnums=(0, 1))(flow, share)))
    return lambda flow, trust: compiled(jnp.full_like(around.flow, flow), jnp.full_like(around.sure, trust))


@pytest.mark.parametrize("flow", [0.0, 1e3, -1e8])
@pytest.mark.parametrize("trust", [0.0, 1e-12, 1.0])
def test_gaps_stay_in_range_with_finite_gradients(extreme, flow, trust):
    gaps, gradients = extreme(flow, trust)
    assert all(((x >= 0) & (x <= 1)).all() for x in gaps)
    assert all(np.isfinite(x).all() for x in gradients)


def test_gaps_match_finite_differences(x64):
    around = drawn(40, dtype=jnp.float64, spread=0.7, frames=3)[1]
    assert_grads_match(of_three(around, jnp.float64), around.flow, jnp.full_like(around.sure, 0.8), step=1e-7)
