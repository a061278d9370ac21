"""Every loss: its published formula, its zero, its masks, its extremes, its gradient; then the authors' values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match, distortion_by_loop, normal, uniform

from zestjax.losses import adversarial, means, photometric, priors, regularisers, scene_flow, supervision

R, S, M = 3, 5, 2


def arguments(dtype=jnp.float32):
    """(loss, its arguments, extra options) for each loss that averages a residual, at an ordinary point."""
    colour, flow = uniform(0, R, 3, dtype=dtype), normal(1, R, S, 3, dtype=dtype)
    warped, confidence = uniform(2, M, R, 3, dtype=dtype), uniform(3, R, S, dtype=dtype)
    points, pixels = normal(4, R, S, 3, dtype=dtype), normal(5, R, 2, dtype=dtype)
    depth = 1 + uniform(6, R, S, dtype=dtype)
    edges = jnp.asarray(np.tile(np.linspace(0, 1, S + 1), (R, 1)), dtype)
    return {
        "reconstruction": (photometric.reconstruction_loss, (colour, warped[0])),
        "photometric": (photometric.photometric_loss, (warped, colour, uniform(7, M, R, dtype=dtype))),
        "cycle": (scene_flow.cycle_loss, (flow, points, confidence)),
        "minimum_flow": (scene_flow.minimum_flow_loss, (flow,)),
        "spatial_smoothness": (scene_flow.spatial_smoothness_loss, (flow, points)),
        "temporal": (scene_flow.temporal_loss, (flow, points)),
        "geometric": (priors.geometric_loss, (pixels, 2 * pixels)),
        "depth": (priors.depth_loss, (depth, depth**2)),
        "blend_entropy": (regularisers.blend_entropy_loss, (confidence,)),
        "disocclusion": (regularisers.disocclusion_loss, (confidence,)),
        "distortion": (regularisers.distortion_loss, (confidence / S, edges)),
        "edge_aware_depth": (
            regularisers.edge_aware_depth_loss,
            (uniform(8, R, 4, 4, dtype=dtype), uniform(9, R, 4, 4, 3, dtype=dtype)),
        ),  # fmt: skip
        "depth_cross_entropy": (
            supervision.depth_cross_entropy_loss,
            (-uniform(10, R, S, dtype=dtype), jnp.array([0.3, 1.8, 3.1], dtype)),
        ),  # fmt: skip
        "motion_mask": (supervision.motion_mask_loss, (confidence, confidence[::-1])),
        "scene_flow": (supervision.scene_flow_loss, (flow, points)),
    }


CASES = list(arguments())


@pytest.mark.parametrize("name", CASES)
def test_every_loss_is_a_finite_scalar_that_ignores_what_is_not_valid(name):
    """One ray (or neighbour) out of the mean is one ray left out of the arguments; none left is exactly 0."""
    loss, args = arguments()[name]
    leading = args[0].shape[0]
    shape = args[0].shape if name == "depth" else (leading,)
    mask = np.ones(shape, np.float32)
    mask[0] = 0

    @jax.jit
    def program(args, mask):
        whole, gradients = jax.value_and_grad(lambda args: loss(*args))(args)
        rest = [x[1:] if x.shape[0] == leading else x for x in args]
        return whole, gradients, loss(*args, valid=mask), loss(*rest), loss(*args, valid=0 * mask)

    whole, gradients, masked, left, none = program(args, jnp.asarray(mask))
    assert whole.shape == () and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((whole, gradients)))
    np.testing.assert_allclose(masked, left, rtol=1e-5)
    assert none == 0


@pytest.mark.parametrize("name", CASES)
def test_gradients_match_finite_differences(name, x64):
    loss, args = arguments(jnp.float64)[name]
    assert_grads_match(loss, *args)


def test_reconstruction_is_the_mean_squared_error():
    colour, target = uniform(0, 2, 7, 3)
    expected = np.mean((np.asarray(colour, np.float64) - np.asarray(target, np.float64)) ** 2)
    np.testing.assert_allclose(photometric.reconstruction_loss(colour, target), expected, rtol=1e-6)


def test_photometric_matches_the_papers_sum():
    warped, target, confidence = uniform(0, M, R, 3), uniform(1, R, 3), uniform(2, M, R)
    total = 0.0
    for k in range(M):
        for r in range(R):
            total += float(confidence[k, r]) * float(((warped[k, r] - target[r]) ** 2).sum())
    ours = photometric.photometric_loss(warped, target, confidence)
    np.testing.assert_allclose(ours, total / (M * R * 3), rtol=1e-5)


def test_a_missing_neighbour_may_hold_anything():
    warped = uniform(0, M, R, 3).at[1].set(jnp.nan)
    loss = lambda w: photometric.photometric_loss(w, uniform(1, R, 3), uniform(2, M, R), valid=jnp.array([1.0, 0.0]))
    assert_finite(loss, warped)
    alone = photometric.photometric_loss(warped[:1], uniform(1, R, 3), uniform(2, M, R)[:1])
    np.testing.assert_allclose(loss(warped), alone, rtol=1e-6)


def test_going_there_and_back_costs_nothing():
    flow, confidence = normal(0, R, S, 3), uniform(1, R, S)
    assert scene_flow.cycle_loss(flow, -flow, confidence) == 0
    assert scene_flow.cycle_loss(flow, flow, 0 * confidence) == 0


@pytest.mark.parametrize("norm, power", [("absolute", 1), ("squared", 2)])
def test_cycle_matches_the_papers_sum(norm, power):
    there, back, confidence = normal(0, R, S, 3), normal(1, R, S, 3), uniform(2, R, S)
    cost = (
        np.asarray(confidence, np.float64)[..., None]
        * np.abs(np.asarray(there, np.float64) + np.asarray(back, np.float64)) ** power
    )
    np.testing.assert_allclose(scene_flow.cycle_loss(there, back, confidence, norm=norm), cost.mean(), rtol=1e-5)
    released = scene_flow.cycle_loss(there, back, confidence, norm=norm, normalise="confidence")
    np.testing.assert_allclose(released, cost.sum() / (3 * np.asarray(confidence, np.float64).sum()), rtol=1e-5)


def test_opposite_components_cancel_only_in_the_released_form():
    flow = jnp.broadcast_to(jnp.array([1.0, -1.0, 0.0]), (R, S, 3))
    np.testing.assert_allclose(scene_flow.minimum_flow_loss(flow), 2 / 3, rtol=1e-6)
    assert scene_flow.minimum_flow_loss(flow, sum_components=True) == 0


def test_constant_velocity_costs_nothing():
    flow = normal(0, R, S, 3)
    assert scene_flow.temporal_loss(flow, -flow) == 0
    same = jnp.broadcast_to(flow[:, :1], flow.shape)
    assert scene_flow.spatial_smoothness_loss(same, normal(1, R, S, 3)) == 0


def test_spatial_smoothness_matches_the_papers_sum():
    flow, points = normal(0, R, S, 3), normal(1, R, S, 3)
    costs = []
    for f, x in zip(np.asarray(flow, np.float64), np.asarray(points, np.float64), strict=True):
        for s in range(S - 1):
            costs.append(np.exp(-2 * np.linalg.norm(x[s] - x[s + 1])) * np.abs(f[s] - f[s + 1]).mean())
    np.testing.assert_allclose(scene_flow.spatial_smoothness_loss(flow, points), np.mean(costs), rtol=1e-5)


def test_spatial_smoothness_is_finite_where_points_coincide():
    assert_finite(scene_flow.spatial_smoothness_loss, normal(0, R, S, 3), jnp.zeros((R, S, 3)))


def test_depth_loss_forgets_scale_and_shift():
    depth = 1 + uniform(0, 2, 9)
    loss = jax.jit(priors.depth_loss)
    np.testing.assert_allclose(loss(depth, 3 * depth + 7), 0, atol=1e-5)
    assert loss(depth, -depth) > 1


@pytest.mark.parametrize("case", ["flat_prior", "flat_depth", "empty", "gaps"])
def test_depth_loss_is_finite_where_the_reference_divides_by_zero(case):
    depth, target, valid = 1 + uniform(0, 2, 9), 1 + uniform(1, 2, 9), jnp.ones((2, 9))
    depth = jnp.full_like(depth, 2.0) if case == "flat_depth" else depth
    target = {"flat_prior": jnp.full_like(target, 3.0), "gaps": target.at[:, 2].set(jnp.nan)}.get(case, target)
    valid = {"empty": 0 * valid, "gaps": valid.at[:, 2].set(0)}.get(case, valid)
    value, slope = jax.jit(jax.value_and_grad(lambda d, t, v: priors.depth_loss(d, t, valid=v)))(depth, target, valid)
    assert np.isfinite(value) and np.isfinite(slope).all()
    assert (value == 0) == (case in ("flat_prior", "empty"))


def test_entropy_is_finite_and_zero_at_exactly_zero_and_one():
    ends = jnp.array([0.0, 1.0])
    for symmetric in (False, True):
        np.testing.assert_allclose(regularisers.blend_entropy_loss(ends, symmetric=symmetric), 0, atol=1e-6)
        assert_finite(lambda b, s=symmetric: regularisers.blend_entropy_loss(b, symmetric=s), ends)
    logits = jnp.array([-200.0, -5.0, 0.0, 5.0, 200.0])
    assert_finite(lambda z: regularisers.blend_entropy_loss(z, given="logit"), logits)
    same = regularisers.blend_entropy_loss(jax.nn.sigmoid(logits), symmetric=True)
    np.testing.assert_allclose(regularisers.blend_entropy_loss(logits, given="logit", symmetric=True), same, rtol=1e-4)


def test_confidence_of_one_costs_nothing():
    assert regularisers.disocclusion_loss(jnp.ones((M, R, S))) == 0
    np.testing.assert_allclose(regularisers.disocclusion_loss(jnp.zeros((M, R, S))), 1)


def test_distortion_matches_the_published_double_sum():
    weights, edges = uniform(0, 2, 6) / 6, jnp.asarray(np.sort(uniform(1, 2, 7)))
    expected = np.mean([distortion_by_loop(w, e) for w, e in zip(weights, edges, strict=True)])
    np.testing.assert_allclose(regularisers.distortion_loss(weights, edges), expected, rtol=1e-5)


def test_smoothness_is_free_across_strong_edges_only():
    step = jnp.broadcast_to(jnp.repeat(jnp.array([1.0, 2.0]), 4), (8, 8))
    flat, edged = jnp.zeros((8, 8, 3)), 50 * jnp.repeat(step[..., None], 3, axis=-1)
    loss = jax.jit(regularisers.edge_aware_depth_loss)
    assert loss(step, flat) > 0.05
    np.testing.assert_allclose(loss(step, edged), 0, atol=1e-6)


def test_cross_entropy_is_shared_by_the_planes_around_the_true_depth():
    log_p = jax.nn.log_softmax(normal(0, 4))
    loss = jax.jit(supervision.depth_cross_entropy_loss)
    ours = loss(log_p, jnp.float32(1.25))
    np.testing.assert_allclose(ours, -(0.75 * log_p[1] + 0.25 * log_p[2]), rtol=1e-5)
    assert loss(log_p, jnp.float32(3.5)) == 0


def test_motion_mask_loss_is_finite_at_certainty_and_least_at_the_truth():
    ends = jnp.array([0.0, 1.0])
    assert_finite(lambda x: supervision.motion_mask_loss(x, 1 - ends), ends)
    assert supervision.motion_mask_loss(ends, ends) < 0.01 < supervision.motion_mask_loss(1 - ends, ends)


def test_masks_are_aligned_from_the_left_and_misfits_are_named():
    cost = jnp.arange(6.0).reshape(2, 3)
    assert means.mean_over_valid("f", cost, valid=jnp.array([1, 0])) == 1
    with pytest.raises(ValueError, match=r"f: `valid` of shape \(3,\) does not cover"):
        means.mean_over_valid("f", cost, valid=jnp.ones(3))


def test_unknown_options_list_the_known_ones():
    with pytest.raises(ValueError, match="'absolute', 'squared'"):
        scene_flow.cycle_loss(jnp.ones((R, S, 3)), jnp.ones((R, S, 3)), jnp.ones((R, S)), norm="huber")
    with pytest.raises(ValueError, match="'count', 'confidence'"):
        means.mean_over_valid("f", jnp.ones(3), normalise="sum")
    with pytest.raises(ValueError, match="expected at least 2"):
        scene_flow.spatial_smoothness_loss(jnp.ones((R, 1, 3)), jnp.ones((R, 1, 3)))


def test_a_gradient_step_tells_two_kinds_of_patch_further_apart():
    shapes = jax.eval_shape(lambda key: adversarial.init_discriminator(key, widths=(4, 8)), jax.random.key(0))
    params = jax.tree.map(lambda leaf: 0.3 * normal(leaf.size, *leaf.shape), shapes)
    real, rendered = uniform(0, 1, 8, 8, 3), 0.5 + 0.01 * normal(1, 1, 8, 8, 3)

    @jax.jit
    def step(p):
        score = lambda p: adversarial.discriminator(p, jnp.concatenate([real, rendered]), spectral=False)
        verdict = lambda p: adversarial.discriminator_loss(score(p)[:1], score(p)[1:])
        before, slope = jax.value_and_grad(verdict)(p)
        p = jax.tree.map(lambda x, g: x - 0.01 * g, p, slope)
        return before, verdict(p), score(p)

    before, after, scores = step(params)
    assert scores.shape == (2, 2, 2)
    assert after < before
    assert adversarial.generator_loss(jnp.ones(3)) == 0


def test_spectral_norm_is_the_largest_singular_value():
    kernel = normal(0, 3, 3, 4, 6)
    expected = np.linalg.svd(np.asarray(kernel, np.float64).reshape(-1, 6), compute_uv=False)[0]
    np.testing.assert_allclose(adversarial.spectral_norm(kernel, iterations=60), expected, rtol=1e-4)
