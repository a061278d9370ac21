"""What a frame's own pixels say of its depth and motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import assert_grads_match, uniform, value_and_gradients

from zestjax import evidence
from zestjax.evidence import TRUNCATION, Sources
from zestjax.planesweep import plane_depths

pooled = jax.jit(evidence.pooled, static_argnums=1)
static_cost, moving_cost = jax.jit(evidence.static_cost), jax.jit(evidence.moving_cost)


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
    half = evidence.half_images(uniform(0, 2, *size, 3))
    assert half.shape == (2, 2 * -(-size[0] // 4), 2 * -(-size[1] // 4), 3)
    assert evidence.cell_colours(half).shape == (2, half.shape[1] // 2, half.shape[2] // 2, 12)


def test_a_cell_holds_its_four_pixels_row_by_row():
    half = uniform(1, 4, 6, 3)
    found = evidence.cell_colours(half)
    np.testing.assert_array_equal(found[1, 2].reshape(2, 2, 3), half[2:4, 4:6])


def static_by_loop(reference, images, pairs, valid):
    height, width, _ = reference.shape
    out = np.ones((height, width))
    for i in range(height):
        for j in range(width):
            costs = []
            for image, (du, dv), ok in zip(images, pairs, valid, strict=True):
                if ok and 0 <= i + dv < height and 0 <= j + du < width:
                    difference = np.abs(reference[i, j].astype(np.float64) - image[i + dv, j + du]).mean()
                    costs.append(min(difference / TRUNCATION, 1))
            out[i, j] = np.mean(costs) if costs else 1
    return out


def sources(images, valid):
    return Sources(jnp.asarray(images), None, jnp.asarray(valid, jnp.float32))


def test_the_static_cost_is_that_of_a_loop():
    reference, images, pairs = uniform(0, 6, 8, 3), uniform(1, 3, 6, 8, 3), [(1, 0), (-2, 1), (0, 0)]
    images = 0.9 * reference[None] + 0.1 * images
    found = static_cost(reference, sources(images, [1, 1, 0]), shifts(pairs))
    expected = static_by_loop(np.asarray(reference), np.asarray(images), pairs, [1, 1, 0])
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_point_that_moves_evenly_costs_nothing_at_its_plane():
    texture = np.asarray(uniform(2, 12, 16, 3))
    roll = lambda k: np.roll(texture, k, axis=(0, 1))
    here, before, after = roll(0), roll(-1), roll(1)
    cost = moving_cost(here, before, after, shifts([(0, 0), (0, 0)]), jnp.ones(2))
    np.testing.assert_allclose(cost[2:-2, 2:-2], 0, atol=1e-6)
    still = static_cost(here, sources(np.stack([before, after]), [1, 1]), shifts([(0, 0), (0, 0)]))
    assert still.mean() > 0.5


def test_one_neighbour_alone_decides_and_none_costs_one():
    texture = uniform(3, 6, 8, 3)
    noise = uniform(4, 6, 8, 3)
    hom = shifts([(0, 0), (0, 0)])
    np.testing.assert_allclose(moving_cost(texture, texture, noise, hom, jnp.asarray([1.0, 0])), 0, atol=1e-6)
    np.testing.assert_array_equal(moving_cost(texture, texture, noise, hom, jnp.zeros(2)), 1)
    np.testing.assert_array_equal(static_cost(texture, sources(texture[None], [0]), hom[:1]), 1)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1e-12, 1e12])
@pytest.mark.parametrize("level", [0.0, 1.0])
def test_costs_stay_in_range_with_finite_gradients(scale, level):
    image, hom = jnp.full((6, 8, 3), level), shifts([(0, 0), (0, 0)]) * scale
    values, gradients = value_and_gradients(both_costs, 3)(image, hom, jnp.ones(2))
    for cost in values:
        assert (cost >= 0).all() and (cost <= 1).all()
    for leaf in gradients:
        assert np.isfinite(leaf).all()


def both_costs(image, hom, valid):
    return (
        evidence.static_cost(image, Sources(jnp.stack([image, image]), None, valid), hom),
        evidence.moving_cost(image, image, image, hom, valid),
    )


def test_costs_match_finite_differences(x64):
    draw = functools.partial(uniform, dtype=jnp.float64)
    reference, images = draw(0, 5, 6, 3), draw(1, 2, 5, 6, 3)
    images = 0.95 * reference[None] + 0.05 * images
    hom = jnp.asarray(shifts([(0.3, 0.4), (-0.6, 0.2)]), jnp.float64)
    valid = jnp.ones(2, jnp.float64)
    cost = lambda r, i: (
        evidence.static_cost(r, Sources(i, None, valid), hom),
        evidence.moving_cost(r, i[0], i[1], hom, valid),
    )
    assert_grads_match(cost, reference, images, step=1e-7)


@pytest.fixture(scope="module")
def found():
    """Evidence of the stage's frame 2 from the others."""
    video = stage.video((32, 48))
    half = evidence.half_images(jnp.asarray(video.images))
    pick = lambda frames, valid: Sources(
        half[np.array(frames)], jax.tree.map(lambda x: x[np.array(frames)], video.cameras), jnp.asarray(valid)
    )
    find = jax.jit(functools.partial(evidence.frame_evidence, planes=9))
    camera = jax.tree.map(lambda x: x[2], video.cameras)
    ones = lambda n: np.ones(n, np.float32)
    run = lambda far, near: find(
        half[2], camera, pick([0, 1, 3, 4, 5], far * ones(5)), pick([1, 3], near * ones(2)), stage.NEAR, stage.FAR
    )
    return run


def test_the_wall_and_the_card_are_at_their_planes(found):
    static, moving, colours = jax.tree.map(np.asarray, found(1, 1))
    assert static.shape == moving.shape == (8, 12, 9) and colours.shape == (8, 12, 12)
    depths = np.asarray(plane_depths(stage.NEAR, stage.FAR, 9, spacing="inverse"))
    wall = int(np.argmin(np.abs(1 / depths - 1 / stage.WALL)))
    _, _, card, _ = stage.shot(stage.PLACES[2], 2, (32, 48))
    share = card.reshape(8, 4, 12, 4).mean((1, 3))
    alone = (share == 0)[2:-2, 2:-2]
    best = static.argmin(-1)[2:-2, 2:-2][alone]
    assert alone.sum() > 5 and np.median(np.abs(best - wall)) <= 1


def test_evidence_is_in_range_and_without_sources_it_says_nothing(found):
    for part in found(1, 1):
        assert (part >= 0).all() and (part <= 1).all()
    static, moving, _ = found(0, 0)
    np.testing.assert_array_equal(static, 1)
    np.testing.assert_array_equal(moving, 1)
