"""What a frame's own pixels say of its depth and motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import assert_grads_match, normal, uniform, value_and_gradients

from zestjax.frames import cells as cells_module
from zestjax.frames import evidence, optical_flow
from zestjax.frames.evidence import FLOW_RANGE, GAP, TRUNCATION, Along, MatchingViews, Neighbours
from zestjax.planesweep import plane_depths

pooled = jax.jit(cells_module.pooled, static_argnums=1)
static_costs, flow_gaps = jax.jit(evidence.static_costs), jax.jit(evidence.flow_gaps)


def shifts(pairs):
    """(J, 3, 3) homographies that move by whole pixels."""
    matrix = np.broadcast_to(np.eye(3, dtype=np.float32), (len(pairs), 3, 3)).copy()
    matrix[:, :2, 2] = pairs
    return jnp.asarray(matrix)


def pooled_by_loop(image, factor):
    height, width, _ = image.shape
    rows, columns = -(-height // factor), -(-width // factor)
    out = np.zeros((rows, columns, image.shape[2]))
    for i in range(rows):
        for j in range(columns):
            inside = [
                image[min(factor * i + a, height - 1), min(factor * j + b, width - 1)].astype(np.float64)
                for a in range(factor)
                for b in range(factor)
            ]
            out[i, j] = np.mean(inside, axis=0)
    return out


@pytest.mark.parametrize("size", [(4, 6), (5, 7), (1, 1), (3, 2)])
def test_pooling_is_the_mean_of_blocks_with_the_edge_repeated(size):
    image = uniform(0, *size, 3)
    np.testing.assert_allclose(pooled(image, 2), pooled_by_loop(np.asarray(image), 2), rtol=1e-5)


@pytest.mark.parametrize("size", [(16, 24), (13, 18), (5, 9), (1, 2)])
def test_half_images_hold_whole_cells(size):
    half = cells_module.half_images(uniform(0, 2, *size, 3))
    assert half.shape == (2, 2 * -(-size[0] // 4), 2 * -(-size[1] // 4), 3)
    assert cells_module.cell_values(half).shape == (2, half.shape[1] // 2, half.shape[2] // 2, 12)


def test_a_cell_holds_its_four_pixels_row_by_row():
    half = uniform(1, 4, 6, 3)
    found = cells_module.cell_values(half)
    np.testing.assert_array_equal(found[1, 2].reshape(2, 2, 3), half[2:4, 4:6])


def cells(x, factor=2):
    """Mean over blocks of a (2h, 2w) map."""
    return x.reshape(x.shape[0] // factor, factor, x.shape[1] // factor, factor).mean((1, 3))


def static_by_loop(reference, images, pairs, valid):
    """Means over all sources and over the better half, of cells of 2 x 2 pixels."""
    height, width, _ = reference.shape
    found = []
    for image, (du, dv), ok in zip(images, pairs, valid, strict=True):
        cost, seen = np.zeros((height, width)), np.zeros((height, width))
        for i in range(height):
            for j in range(width):
                if ok and 0 <= i + dv < height and 0 <= j + du < width:
                    difference = np.abs(reference[i, j].astype(np.float64) - image[i + dv, j + du]).mean()
                    cost[i, j], seen[i, j] = min(difference / TRUNCATION, 1), 1
        found.append((cells(cost), cells(seen)))
    everywhere = np.ones((height // 2, width // 2))
    mean, best = everywhere.copy(), everywhere.copy()
    for place in np.ndindex(mean.shape):
        known = [(c[place], s[place]) for c, s in found if s[place] > 0]
        if known:
            mean[place] = sum(c for c, _ in known) / sum(s for _, s in known)
            each = sorted(c / s for c, s in known)
            best[place] = np.mean(each[: -(-len(each) // 2)])
    return mean, best


def sources(images, valid):
    return MatchingViews(jnp.asarray(images), None, jnp.asarray(valid, jnp.float32))


@pytest.mark.parametrize("valid", [[1, 1, 0], [1, 1, 1], [0, 1, 0]])
def test_static_costs_are_those_of_a_loop(valid):
    reference, images, pairs = uniform(0, 6, 8, 3), uniform(1, 3, 6, 8, 3), [(1, 0), (-2, 1), (0, 0)]
    images = 0.9 * reference[None] + 0.1 * images
    found = static_costs(reference, sources(images, valid), shifts(pairs))
    expected = static_by_loop(np.asarray(reference), np.asarray(images), pairs, valid)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_what_covers_a_point_in_half_the_sources_costs_nothing_in_the_better_half():
    image, other = uniform(2, 6, 8, 3), 1 - uniform(2, 6, 8, 3)
    mean, best = static_costs(image, sources(jnp.stack([image, other, other, image]), [1] * 4), shifts([(0, 0)] * 4))
    np.testing.assert_allclose(best, 0, atol=1e-6)
    assert mean.mean() > 0.3


def test_exchanges_sort():
    rows = uniform(3, 8, 5, 6)
    np.testing.assert_array_equal(jnp.stack(evidence._ascending(list(rows))), np.sort(rows, axis=0))


def gaps_by_loop(flow, sure, pairs):
    """Where each cell goes if it stands still is a shift of whole quarter-resolution pixels."""
    velocity = np.asarray(flow, np.float64) - 4 * np.asarray(pairs, np.float64)[:, None, None]
    length = lambda v: np.minimum(np.linalg.norm(v, axis=-1) / GAP, 1)
    total = sure.sum(0)
    mean = (sure * length(velocity)).sum(0) / np.where(total > 0, total, 1)
    even = 1 - sure[0] * sure[1] * (1 - length(velocity.sum(0)))
    return np.where(total > 0, mean, 1), even


def test_gaps_are_those_of_a_loop():
    flow, sure = 6 * normal(0, 2, 4, 5, 2), np.round(np.asarray(uniform(1, 2, 4, 5)), 1)
    sure[:, 0, 0] = 0
    found = flow_gaps(flow, jnp.asarray(sure), shifts([(1, 0), (-1, 1)]))
    for ours, theirs in zip(found, gaps_by_loop(flow, sure, [(1, 0), (-1, 1)]), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_what_moves_evenly_has_no_gap_at_its_plane_however_fast_it_is():
    here = jnp.asarray([[8.0, 4.0], [-4.0, 0.0]])[:, None, None] * jnp.ones((2, 3, 4, 1))  # of its plane
    velocity = jnp.asarray([[13.0, -5.0], [-13.0, 5.0]])[:, None, None]
    still, moving = flow_gaps(here + velocity, jnp.ones((2, 3, 4)), shifts([(2, 1), (-1, 0)]))
    np.testing.assert_allclose(moving, 0, atol=1e-6)
    np.testing.assert_array_equal(still, 1)
    still, moving = flow_gaps(here + velocity, jnp.ones((2, 3, 4)), shifts([(3, 1), (-1, 0)]))
    assert (moving > 0.9).all()


def test_nothing_to_compare_with_costs_one():
    image, hom = uniform(3, 6, 8, 3), shifts([(0, 0), (0, 0)])
    for cost in (*static_costs(image, sources(image[None], [0]), hom[:1]), *flow_gaps(zero_flow(), 0 * sure(), hom)):
        np.testing.assert_array_equal(cost, 1)


def zero_flow():
    return jnp.zeros((2, 3, 4, 2))


def sure():
    return jnp.ones((2, 3, 4))


@pytest.mark.parametrize("scale", [0.0, -1.0, 1e-12, 1e12])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_costs_stay_in_range_with_finite_gradients(scale, level):
    image, hom = jnp.full((6, 8, 3), level), shifts([(0, 0), (0, 0)]) * scale
    values, gradients = value_and_gradients(all_costs, image, hom, 1e3 * level * (zero_flow() + 1), sure())
    for cost in values:
        assert (cost >= 0).all() and (cost <= 1).all()
    for leaf in gradients:
        assert np.isfinite(leaf).all()


def all_costs(image, hom, flow, sure):
    valid = jnp.ones(2, image.dtype)
    static = evidence.static_costs(image, MatchingViews(jnp.stack([image, image]), None, valid), hom)
    return *static, *evidence.flow_gaps(flow, sure, hom)


def test_costs_match_finite_differences(x64):
    draw = functools.partial(uniform, dtype=jnp.float64)
    reference, images = draw(0, 6, 6, 3), draw(1, 2, 6, 6, 3)
    images = 0.95 * reference[None] + 0.05 * images
    hom = jnp.asarray(shifts([(0.3, 0.4), (-0.6, 0.2)]), jnp.float64)
    valid = jnp.ones(2, jnp.float64)
    cost = lambda r, i, f, s: (
        evidence.static_costs(r, MatchingViews(i, None, valid), hom),
        evidence.flow_gaps(f, s, hom),
    )
    assert_grads_match(cost, reference, images, 2 * draw(2, 2, 3, 3, 2), draw(3, 2, 3, 3), step=1e-7)


@pytest.fixture(scope="module")
def found():
    """Evidence of the stage's frame 2 from the others."""
    video = stage.video((32, 48))
    half = cells_module.half_images(jnp.asarray(video.images))
    flow = optical_flow.video_flow(video.images)
    taken = lambda frames: jax.tree.map(lambda x: x[np.array(frames)], video.cameras)
    find = jax.jit(functools.partial(evidence.frame_evidence, planes=9))
    camera = jax.tree.map(lambda x: x[2], video.cameras)
    far, path = [0, 1, 3, 4, 5], np.ones((2, 8, 12, 9), np.float32)
    run = lambda known, near: find(
        half[2], camera, MatchingViews(half[np.array(far)], taken(far), known * np.ones(5, np.float32)),
        Neighbours(flow.flow[2], near * flow.sure[2], taken([3, 1])), Along(*path), stage.NEAR, stage.FAR,
    )  # fmt: skip
    return run


def test_the_wall_is_at_its_plane_by_colour_and_by_flow(found):
    parts = jax.tree.map(np.asarray, found(1, 1))
    assert all(cost.shape == (8, 12, 9) for cost in parts[:6])
    assert [x.shape[-1] for x in parts[6:]] == [evidence.FLOW_CHANNELS, 2, 12]
    depths = np.asarray(plane_depths(stage.NEAR, stage.FAR, 9, spacing="inverse"))
    wall = int(np.argmin(np.abs(1 / depths - 1 / stage.WALL)))
    _, _, card, _ = stage.shot(stage.PLACES[2], 2, (32, 48))
    share = card.reshape(8, 4, 12, 4).mean((1, 3))
    alone = (share == 0)[2:-2, 2:-2]
    assert alone.sum() > 5
    for cost in (parts.static, parts.best, parts.still):
        best = cost.argmin(-1)[2:-2, 2:-2][alone]
        assert np.median(np.abs(best - wall)) <= 1


def test_evidence_is_in_range_and_without_sources_it_says_nothing(found):
    for part in found(1, 1):
        assert (part >= 0).all() and (part <= 1).all()
    nothing = found(0, 0)
    for cost in nothing[:6]:
        np.testing.assert_array_equal(cost, 1)
    np.testing.assert_array_equal(nothing.flow, 0.5)
    np.testing.assert_array_equal(nothing.sure, 0)


def test_flow_channels_are_what_the_flow_has_beyond_the_far_plane():
    flow = jnp.asarray([[10.0, -6.0], [200.0, 0.0]])[:, None, None] * jnp.ones((2, 4, 6, 1))
    found = evidence._flow_channels(Neighbours(flow, jnp.ones((2, 4, 6)), None), shifts([(1, -2), (0, 0)]))
    each = found.reshape(2, 3, 4, 4)  # cells, their pixels, both neighbours' u and v
    np.testing.assert_allclose(each[0, 0, 0], [0.5 + 8 / (2 * FLOW_RANGE), 0.5 - 2 / (2 * FLOW_RANGE), 1, 0.5])
    assert (found == found[:1, :1]).all()
