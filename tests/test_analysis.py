"""Each frame's own depth: the mode of a distribution over planes, below a plane's width, and its spread."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match, normal

from zestjax.frames import analysis
from zestjax.frames.analysis import frame_maps, init_analysis, plane_moments
from zestjax.frames.evidence import FLOW_CHANNELS, Evidence

moments = jax.jit(plane_moments)


def moments_by_loop(logits, reach=2):
    """Of one distribution, in float64."""
    logits = np.asarray(logits, np.float64)
    whole = np.exp(logits - logits.max())
    whole /= whole.sum()
    mode = int(np.argmax(logits))
    near = [i for i in range(len(logits)) if abs(i - mode) <= reach]
    part = whole[near] / whole[near].sum()
    mean = sum(p * i for p, i in zip(part, near, strict=True))
    variance = sum(p * (i - mean) ** 2 for p, i in zip(part, near, strict=True))
    spread = 0.7 + np.sqrt(variance + 1e-6) + 2 * (1 - whole[near].sum())
    return mean / (len(logits) - 1), spread / (len(logits) - 1)


def test_moments_are_those_of_a_loop():
    logits = 3 * normal(0, 40, 9)
    found = moments(logits)
    expected = np.array([moments_by_loop(row) for row in logits]).T
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-5)


@pytest.mark.parametrize("plane", [0, 3, 8])
def test_a_certain_plane_is_found_exactly(plane):
    coordinate, tolerance = moments(jnp.zeros((1, 9)).at[0, plane].set(50))
    np.testing.assert_allclose(coordinate, plane / 8, atol=1e-6)
    np.testing.assert_allclose(tolerance, 0.7 / 8, atol=1e-3)


def test_two_surfaces_are_not_averaged_but_doubted():
    coordinate, tolerance = moments(jnp.zeros((1, 9)).at[0, 1].set(9.0).at[0, 7].set(8.9))
    np.testing.assert_allclose(coordinate, 1 / 8, atol=1e-2)
    assert tolerance > 1.5 / 8


def test_a_constant_added_to_all_planes_changes_nothing():
    logits = normal(1, 20, 9)
    for a, b in zip(moments(logits), moments(logits + 7), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, 1e4, -1e4])
@pytest.mark.parametrize("plane", [0, 4, 8])
def test_moments_are_finite_and_bounded(value, plane):
    logits = jnp.zeros((1, 9)).at[0, plane].set(value)
    coordinate, tolerance = moments(logits)
    assert 0 <= coordinate <= 1 and 0 < tolerance < 1
    assert_finite(plane_moments, logits)


def test_moments_match_finite_differences(x64):
    assert_grads_match(plane_moments, 2 * normal(2, 6, 9, dtype=jnp.float64))


def evidence(seed=0, frames=3, planes=6):
    draw = lambda c: np.random.default_rng(seed).uniform(size=(frames, 4, 6, c)).astype(np.float32)
    return Evidence(*(draw(n) for n in (*(planes,) * 6, FLOW_CHANNELS, 2, 12)))


@pytest.fixture(scope="module")
def analysed():
    params = jax.jit(lambda key: init_analysis(key, planes=6, widths=(4, 6)))(jax.random.key(0))
    total = lambda p, e: sum(jnp.sum(x) for x in frame_maps(p, e))
    return params, jax.jit(lambda e: (frame_maps(params, e), jax.grad(total, argnums=(0, 1))(params, e)))


def test_maps_have_their_shapes_and_ranges(analysed):
    maps, _ = analysed[1](evidence())
    assert maps.logits.shape == (3, 4, 6, 6)
    assert maps.moving_logits.shape == (3, 8, 12)
    assert (maps.coordinate >= 0).all() and (maps.coordinate <= 1).all() and (maps.tolerance > 0).all()


def test_frames_do_not_see_each_other(analysed):
    whole = analysed[1](evidence())[0]
    other = jax.tree.map(lambda a, b: np.concatenate([a[:2], b[2:]]), evidence(), evidence(seed=5))
    changed = analysed[1](other)[0]
    for a, b in zip(whole, changed, strict=True):
        np.testing.assert_allclose(a[:2], b[:2], atol=1e-5)
        assert not np.allclose(a[2], b[2])


def test_low_cost_at_a_plane_is_a_surface_there_before_anything_is_learned(analysed):
    """With a net that says nothing, the surface is the plane that the costs, and what is below, speak for."""
    params = jax.tree.map(jnp.zeros_like, analysed[0])
    found = evidence()._replace(
        **{name: jnp.asarray(evidence()[0]).at[..., 2].set(0) for name in ("static", "best", "still", "still_along")}
    )
    maps = jax.jit(frame_maps)(params, found)
    np.testing.assert_array_equal(maps.logits.argmax(-1), 2)


def test_the_surrounding_mean_leaves_out_what_is_outside():
    x = normal(3, 2, 4, 7, 3)
    found = analysis._surrounding_mean(x)
    for i, j in np.ndindex(4, 7):
        block = np.asarray(x)[:, max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3]
        np.testing.assert_allclose(found[:, i, j], block.mean((1, 2)), atol=1e-5)


def test_what_moves_stands_on_the_still_surface_below_it():
    planes, still_at = 6, 4
    costs = np.ones((analysis.COSTS, 1, 5, 3, planes), np.float32)
    costs[:, :, 3:, :, still_at] = 0  # the ground, of the two lowest rows; above it nothing agrees anywhere
    ground, still = analysis._ground(jnp.asarray(costs))
    np.testing.assert_allclose(ground[0], still_at / (planes - 1), atol=1e-4)
    np.testing.assert_allclose(still[:, :, 3:], 1)
    assert (still[0, :, :3] < 1e-5).all()


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_constant_evidence_gives_finite_maps_and_gradients(analysed, value):
    for leaf in jax.tree.leaves(analysed[1](jax.tree.map(lambda x: np.full_like(x, value), evidence()))):
        assert np.isfinite(leaf).all()


def test_told_that_nothing_moves_the_maps_say_so(analysed):
    maps = jax.jit(lambda e: frame_maps(analysed[0], e, still=True))(evidence())
    assert bool(jnp.all(jax.nn.sigmoid(maps.moving_logits) < 1e-12))
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in maps)
