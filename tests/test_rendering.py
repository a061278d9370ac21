"""Volume rendering against loops, closed forms, invariances and the authors' recorded values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import (
    assert_finite,
    assert_grads_match,
    blend_by_loop,
    density_blend_by_loop,
    uniform,
    weights_by_loop,
)

from zestjax import rendering


def random_ray(seed, *, samples=32):
    density, lengths = uniform(seed, 2, samples)
    return 4 * density, 0.1 * lengths


@pytest.mark.parametrize("seed", range(3))
def test_weights_match_the_published_sum(seed):
    density, lengths = random_ray(seed)
    expected = weights_by_loop(density, lengths)
    np.testing.assert_allclose(rendering.weights_from_density(density, lengths), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_blended_weights_match_the_published_sum(seed):
    static, dynamic, blend = uniform(seed, 3, 32)
    ours = jax.jit(rendering.blend_weights)(static, dynamic, blend)
    np.testing.assert_allclose(ours, blend_by_loop(static, dynamic, blend), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_density_blended_weights_match_the_papers_equations(seed):
    static, dynamic, blend, lengths = uniform(seed, 4, 32)
    ours = jax.jit(rendering.density_blend_weights)(3 * static, 3 * dynamic, blend, lengths)
    expected = density_blend_by_loop(3 * static, 3 * dynamic, blend, lengths)
    np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-7)


def test_uniform_slab_has_the_closed_form_opacity():
    density, lengths = jnp.full(64, 0.7), jnp.full(64, 0.05)
    opacity = rendering.weights_from_density(density, lengths).sum()
    np.testing.assert_allclose(opacity, 1 - np.exp(-0.7 * 64 * 0.05), rtol=1e-6)


def test_splitting_an_interval_does_not_change_the_ray():
    density, lengths = random_ray(0)
    colour = uniform(1, 32, 3)
    whole = rendering.composite(rendering.weights_from_density(density, lengths), colour)
    twice = lambda x: jnp.repeat(x, 2, axis=0)
    split = rendering.composite(rendering.weights_from_density(twice(density), twice(lengths / 2)), twice(colour))
    np.testing.assert_allclose(split.values, whole.values, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(split.opacity, whole.opacity, rtol=1e-5)


@pytest.mark.parametrize("last_length", [0.1, 1e10], ids=["finite", "far_end_1e10"])
@pytest.mark.parametrize("density_scale", [0.0, 1e-30, 1e-8, 1.0, 1e8, 1e20])
def test_weights_are_finite_and_bounded(density_scale, last_length):
    density, lengths = random_ray(0)
    density, lengths = density_scale * density, lengths.at[-1].set(last_length)
    weights = rendering.weights_from_density(density, lengths)
    assert (weights >= 0).all() and weights.sum() <= 1 + 1e-6
    assert_finite(rendering.weights_from_density, density, lengths)


@pytest.mark.parametrize("blend", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_blend_is_finite_when_a_field_is_opaque_or_absent(alpha, blend):
    full = lambda x: jnp.full(8, x)
    assert_finite(rendering.blend_weights, full(alpha), full(alpha), full(blend))


@pytest.mark.parametrize("blend", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("density", [0.0, 1e-20, 1.0, 1e20])
def test_density_blend_is_finite_and_bounded(density, blend):
    full = lambda x: jnp.full(8, x)
    weights = rendering.density_blend_weights(full(density), full(density), full(blend), full(0.3))
    assert (jnp.stack(weights) >= 0).all() and jnp.stack(weights).sum() <= 1 + 1e-6
    assert_finite(rendering.density_blend_weights, full(density), full(density), full(blend), full(0.3))


def test_a_wall_before_an_opaque_sample_keeps_the_exact_gradient():
    """Behind an opacity of 1, a sum of logarithms (or 1e-10 added to 1) has lost the wall's own gradient."""
    behind = lambda wall: rendering.blend_weights(jnp.stack([wall, jnp.float32(1)]), jnp.zeros(2), jnp.zeros(2)).static[
        1
    ]
    np.testing.assert_allclose(jax.grad(behind)(jnp.float32(1)), -1.0)


@pytest.mark.parametrize("form", rendering.BLEND_FORMS)
def test_blend_at_its_ends_is_one_field_alone(form):
    static, dynamic, lengths = uniform(1, 3, 16)
    only = rendering.blend_weights_from_density(static, dynamic, jnp.ones(16), lengths, form=form)
    np.testing.assert_array_equal(only.static, 0)
    np.testing.assert_allclose(only.dynamic, rendering.weights_from_density(dynamic, lengths), rtol=1e-5)
    none = rendering.blend_weights_from_density(static, dynamic, jnp.zeros(16), lengths, form=form)
    np.testing.assert_allclose(none.static, rendering.weights_from_density(static, lengths), rtol=1e-5)


@pytest.mark.parametrize("form", rendering.BLEND_FORMS)
def test_swapping_the_fields_swaps_their_weights(form):
    static, dynamic, blend, lengths = uniform(2, 4, 16)
    here = rendering.blend_weights_from_density(static, dynamic, blend, lengths, form=form)
    there = rendering.blend_weights_from_density(dynamic, static, 1 - blend, lengths, form=form)
    np.testing.assert_allclose(here.static, there.dynamic, rtol=1e-5, atol=1e-7)


def test_gradients_match_finite_differences(x64):
    static, dynamic, blend, lengths = uniform(3, 4, 5, dtype=jnp.float64)
    assert_grads_match(rendering.weights_from_density, static, lengths)
    assert_grads_match(rendering.blend_weights, static, dynamic, blend)
    assert_grads_match(rendering.density_blend_weights, static, dynamic, blend, lengths)


def test_small_opacity_is_not_rounded_to_zero():
    tiny = jnp.array([1e-9], jnp.float32)
    assert rendering.alpha_from_density(tiny, jnp.ones(1))[0] == np.float32(1e-9)


def test_background_shows_through_what_opacity_leaves():
    weights, colour = jnp.array([0.25, 0.25]), jnp.zeros((2, 3))
    over = rendering.composite(weights, {"rgb": colour}, background={"rgb": 1.0})
    np.testing.assert_allclose(over.values["rgb"], 0.5)
    np.testing.assert_allclose(over.opacity, 0.5)


def test_lengths_shared_by_all_rays_need_no_leading_axes():
    density, lengths = uniform(4, 3, 8), uniform(5, 8)
    shared = rendering.weights_from_density(density, lengths)
    np.testing.assert_array_equal(shared, rendering.weights_from_density(density, jnp.broadcast_to(lengths, (3, 8))))


def test_no_gradient_reaches_held_weights():
    weights, confidence = uniform(6, 2, 8)
    held = jax.grad(rendering.confidence_map)(weights, confidence)
    np.testing.assert_array_equal(held, 0)
    free = jax.grad(lambda w: rendering.confidence_map(w, confidence, hold_weights=False))(weights)
    np.testing.assert_array_equal(free, confidence)


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_transforms_agree(batch):
    """Mapped and broadcast calls give one answer: the loop's, ray by ray."""
    density, lengths = uniform(0, 2, *batch, 8)
    mapped = rendering.weights_from_density
    for _ in batch:
        mapped = jax.vmap(mapped)
    for fn in (rendering.weights_from_density, mapped):
        weights = np.asarray(jax.jit(fn)(density, lengths))
        for ray in np.ndindex(*batch):
            expected = weights_by_loop(np.asarray(density)[ray], np.asarray(lengths)[ray])
            np.testing.assert_allclose(weights[ray], expected, rtol=1e-5, atol=1e-7)


def test_mismatched_samples_are_named():
    with pytest.raises(ValueError, match="weights_from_density: axis S of `lengths` is 31, expected 32"):
        rendering.weights_from_density(jnp.ones(32), jnp.ones(31))


def test_an_unknown_blend_form_lists_the_known_ones():
    with pytest.raises(ValueError, match="'opacity', 'density'"):
        rendering.blend_weights_from_density(*jnp.ones((4, 8)), form="sigma")
