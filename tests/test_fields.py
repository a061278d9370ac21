"""The fields: what the views say of a point, whether they are trusted, and what is made of it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_grads_match, normal, uniform, value_and_gradients

from zestjax.cameras import Camera, unproject
from zestjax.fields import conditioning, dynamic, static
from zestjax.fields import heads as heads_module
from zestjax.fields.conditioning import SourceViews, ViewSamples
from zestjax.fields.heads import Blend, Direct
from zestjax.fields.trunk import blend_of_views, init_trunk, lifted, pooled_views, trunk, view_scores
from zestjax.frames import trust

V, P, WIDTH, CHANNELS = 3, 5, 6, 4


def eye_cameras(count):
    intrinsics = np.array([[10.0, 0, 5.5], [0, 10, 3.5], [0, 0, 1]], np.float32)
    poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    poses[:, 0, 3] = -0.1 * np.arange(count)
    return jax.tree.map(jnp.asarray, Camera(np.tile(intrinsics, (count, 1, 1)), poses))


def views_of(tables, valid=None):
    count = tables.shape[0]
    valid = jnp.ones(count) if valid is None else jnp.asarray(valid, jnp.float32)
    return SourceViews(tables, eye_cameras(count), valid, jnp.arange(count, dtype=jnp.float32))


sample_views = jax.jit(conditioning.sample_views)


# Views at points.


def bilinear_by_loop(table, u, v):
    x, y = int(np.floor(u)), int(np.floor(v))
    x, y = min(x, table.shape[1] - 2), min(y, table.shape[0] - 2)
    a, b = u - x, v - y
    top = (1 - a) * table[y, x] + a * table[y, x + 1]
    return (1 - b) * top + b * ((1 - a) * table[y + 1, x] + a * table[y + 1, x + 1])


def test_views_are_sampled_where_the_points_project_to():
    tables = np.asarray(uniform(0, V, 8, 12, 3))
    points = np.random.default_rng(1).uniform([-1, -0.8, 1.5], [1, 0.8, 4], (1, 40, 3)).astype("f")
    found = jax.tree.map(np.asarray, sample_views(views_of(jnp.asarray(tables)), jnp.asarray(points)))
    seen = 0
    for i in range(V):
        for p, (x, y, z) in enumerate(points[0].astype(np.float64)):
            u, v = 10 * (x - 0.1 * i) / z + 5.5, 10 * y / z + 3.5
            inside = 0 <= u <= 11 and 0 <= v <= 7
            assert found.visible[i, p] == inside
            expected = bilinear_by_loop(tables[i].astype(np.float64), u, v) if inside else 0
            np.testing.assert_allclose(found.colour[i, :, p], expected, atol=1e-4)
            seen += inside
    assert 40 < seen < 120
    assert not found.moving.any() and not found.gap.any()


def test_points_behind_or_outside_and_views_that_are_not_valid_show_nothing():
    tables = jnp.ones((V, 8, 12, 6))
    points = jnp.asarray([[[0.0, 0, 2], [0, 0, -2], [0, 0, 0], [90, 0, 2]]])
    found = sample_views(views_of(tables, [1, 1, 0]), points)
    np.testing.assert_array_equal(found.visible, [[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]])
    for part in (found.colour.sum(1), found.moving, found.gap):
        np.testing.assert_array_equal(part * (1 - found.visible), 0)


def test_the_gap_says_how_far_a_views_surface_lies_in_front():
    maps = jnp.concatenate([jnp.ones((1, 8, 12, 4)), jnp.full((1, 8, 12, 1), 0.5), jnp.full((1, 8, 12, 1), 0.1)], -1)
    camera = jax.tree.map(lambda x: x[0], eye_cameras(1))
    depth = jnp.asarray([2.0, 2.5, 1 / 0.6, 100.0, 1.0])
    points = unproject(camera, jnp.full((5, 2), 4.0), depth)
    gap = sample_views(views_of(maps), points[None]).gap[0]
    np.testing.assert_allclose(gap, [0, 1, -1, 3, -3], atol=1e-5)
    np.testing.assert_allclose(conditioning.on_surface(gap), np.exp(-np.square([0.0, 1, -1, 3, -3])), atol=1e-5)
    np.testing.assert_allclose(conditioning.hidden(gap), 1 - np.exp(-np.square([0.0, 1, 0, 3, 0])), atol=1e-5)
    inverse, tolerance = jnp.full(5, 0.5), jnp.full(5, 0.1)
    near = np.abs((0.5 - 1 / np.asarray(depth)) / 0.1) < 3  # where the gap is not clipped, the two forms are one
    np.testing.assert_allclose(
        conditioning.on_surface(gap)[near], trust.agreement(inverse, tolerance, 1 / depth)[near], atol=1e-5
    )


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e9])
@pytest.mark.parametrize("sign", [1, -1])
def test_views_of_points_anywhere_are_finite_with_finite_gradients(scale, sign):
    tables = jnp.concatenate([jnp.ones((1, 8, 12, 5)), jnp.full((1, 8, 12, 1), 1e-6)], -1)
    values, gradients = value_and_gradients(sampled, tables, sign * scale * uniform(0, 1, 4, 3))
    for leaf in jax.tree.leaves((values, gradients)):
        assert np.isfinite(leaf).all()


def sampled(tables, points):
    return conditioning.sample_views(views_of(tables), points)


def test_views_match_finite_differences_in_their_tables_and_points(x64):
    to64 = functools.partial(jax.tree.map, lambda x: jnp.asarray(x, jnp.float64))
    tables = uniform(0, 2, 8, 12, 6, low=0.4, high=0.6, dtype=jnp.float64)
    points = uniform(1, 1, 4, 3, low=-0.3, high=0.3, dtype=jnp.float64) + jnp.asarray([[[0, 0, 2.0]]])
    assert_grads_match(lambda t, p: tuple(conditioning.sample_views(to64(views_of(t)), p)[::2]), tables, points)


def test_a_mean_over_views_is_weighted_and_of_nothing_is_nothing():
    weights, values = np.asarray(uniform(0, V, P)).copy(), np.asarray(uniform(1, V, 2, P))
    weights[:, 0] = 0
    expected = np.einsum("vp,vcp->cp", weights, values) / np.maximum(weights.sum(0), 1e-12)
    np.testing.assert_allclose(conditioning.over_views(jnp.asarray(weights), jnp.asarray(values)), expected, rtol=1e-5)


def test_there_is_no_parallax_from_the_targets_own_place():
    cameras, here = eye_cameras(V), jnp.asarray([[[0.0, 0, 2], [0.2, 0.1, 3]]])
    shift = jax.jit(conditioning.parallax)(cameras, here, 2 * here)
    np.testing.assert_allclose(shift[0], 0, atol=1e-5)
    # A camera at x = 0.1 i sees the two points focal * 0.1 i * (1 / z - 1 / 2 z) apart.
    np.testing.assert_allclose(shift[1:], [[0.25, 1 / 6], [0.5, 1 / 3]], rtol=1e-4)
    assert (jax.jit(conditioning.parallax)(cameras, here, -here) == 200).all()


# The network's parts.


def trunk_by_loop(params, x, condition, how):
    to = lambda d: (np.asarray(d.kernel, np.float64), np.asarray(d.bias, np.float64))
    rows = []
    for point, given in zip(np.asarray(x, np.float64), np.asarray(condition, np.float64), strict=True):
        kernel, bias = to(params.condition)
        gain, state = given @ kernel + bias, point
        for layer in params.layers:
            kernel, bias = to(layer)
            state = np.concatenate([point, state]) if len(kernel) > len(state) else state
            state = state @ kernel + bias
            state = np.maximum(state * gain if how == "multiply" else state + gain, 0)
        rows.append(state)
    return np.array(rows)


@pytest.mark.parametrize("how", ["multiply", "add"])
@pytest.mark.parametrize("depth", [1, 2, 7])
def test_the_trunk_is_that_of_a_loop(how, depth):
    params = init_trunk(jax.random.key(0), 3, 4, width=WIDTH, depth=depth)
    assert len(params.layers) == depth and (depth < 6 or params.layers[5].kernel.shape[0] == WIDTH + 3)
    x, condition = normal(0, P, 3), normal(1, P, 4)
    found = jax.jit(trunk, static_argnames="modulation")(params, x, condition, modulation=how)
    np.testing.assert_allclose(found, trunk_by_loop(params, x, condition, how), rtol=1e-4, atol=1e-5)


def test_an_unknown_modulation_is_refused():
    with pytest.raises(ValueError, match="modulation"):
        trunk(None, None, None, modulation="subtract")


@functools.cache
def fields():
    """Parameters of both fields with a blend head, and of a static one with a direct head."""

    def sizes(head, features, summaries):
        init = lambda key: head.init(key, features=features, width=WIDTH, directions=3)
        reads = head.channels(volume=CHANNELS, views=V, summaries=summaries)
        return dict(n_point=3, n_condition=reads, width=WIDTH, depth=2, head=init)

    still = lambda head: sizes(head, static.VIEW_FEATURES, static.SUMMARIES)
    moving = sizes(BLEND, dynamic.VIEW_FEATURES, dynamic.SUMMARIES + 2 * V)
    make = lambda key: (
        static.init_static(key, **still(BLEND)),
        dynamic.init_dynamic(key, n_volume=CHANNELS, looks=True, **moving),
        static.init_static(key, **still(DIRECT)),
    )
    return jax.jit(make)(jax.random.key(0))


BLEND, DIRECT = Blend(), Direct()


@pytest.fixture(scope="module", autouse=True)
def drawn():
    """The parameters are drawn once, in float32 and outside of any trace."""
    for leaf in jax.tree.leaves(fields()):
        assert np.isfinite(leaf).all() and leaf.dtype == jnp.float32


def heads(features, weights, hidden, colour, visible):
    head = jax.tree.map(lambda x: x.astype(features.dtype), fields()[0].head.views)
    lift = lifted(head, features)
    scores = view_scores(head, lift, hidden)
    return pooled_views(lift, weights).T, scores, blend_of_views(scores, weights, visible, colour).T


def heads_by_loop(features, weights, hidden, colour, visible):
    head = jax.tree.map(lambda x: np.asarray(x, np.float64), fields()[0].head.views)
    features, weights, hidden, colour = (np.asarray(x, np.float64) for x in (features, weights, hidden, colour))
    pooled, scores, blended = [], np.zeros((V, P)), []
    for p in range(P):
        query = hidden[p] @ head.query.kernel + head.query.bias
        total, share, mixed = 0, 0, np.zeros(3)
        whole = 0
        for v in range(V):
            lift = features[v, :, p] @ head.lift.kernel + head.lift.bias
            total = total + (weights[v, p] + 1e-3) * np.maximum(lift, 0)
            share += weights[v, p] + 1e-3
            scores[v, p] = (np.maximum(lift + query, 0) @ head.score.kernel + head.score.bias)[0]
            chosen = np.exp(8 * np.tanh(scores[v, p] / 8)) * (weights[v, p] + 1e-4) * visible[v, p]
            mixed, whole = mixed + chosen * colour[v, :, p], whole + chosen
        pooled.append(total / share)
        blended.append(mixed / max(whole, 1e-9))
    return np.array(pooled), scores, np.array(blended)


def head_inputs(dtype=jnp.float32):
    visible = np.ones((V, P))
    visible[0, 1] = 0
    visible[:, 2] = 0
    draw = functools.partial(uniform, dtype=dtype)
    features = normal(0, V, static.VIEW_FEATURES, P, dtype=dtype)
    return features, draw(1, V, P), normal(2, P, WIDTH, dtype=dtype), draw(3, V, 3, P), jnp.asarray(visible, dtype)


def test_views_are_pooled_scored_and_blended_as_in_a_loop():
    for found, expected in zip(jax.jit(heads)(*head_inputs()), heads_by_loop(*head_inputs()), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_the_order_of_views_does_not_matter():
    turned = jax.tree.map(lambda x: x if x.shape == (P, WIDTH) else x[::-1], head_inputs())
    pooled, scores, blended = jax.jit(heads)(*head_inputs())
    again = jax.jit(heads)(*turned)
    np.testing.assert_allclose(again[0], pooled, atol=1e-5)
    np.testing.assert_allclose(again[1][::-1], scores, atol=1e-5)
    np.testing.assert_allclose(again[2], blended, atol=1e-5)


def test_a_blend_lies_among_the_colours_that_are_seen():
    features, weights, hidden, colour, visible = head_inputs()
    blended = jax.jit(heads)(features, weights, hidden, colour, visible)[2]
    shown = np.where(visible[:, None] > 0, colour, np.nan)[..., [0, 1, 3, 4]]
    assert (blended[np.array([0, 1, 3, 4])].T >= np.nanmin(shown, 0) - 1e-5).all()
    assert (blended[np.array([0, 1, 3, 4])].T <= np.nanmax(shown, 0) + 1e-5).all()
    np.testing.assert_array_equal(blended[2], 0)


def test_heads_match_finite_differences(x64):
    assert_grads_match(lambda *a: heads(*a, head_inputs(jnp.float64)[4]), *head_inputs(jnp.float64)[:4])


# Both fields.


def both(colour, visible, moving, gap, volume):
    """Static, dynamic and direct samples of P points seen as told."""
    dtype = colour.dtype
    still, moved, direct = jax.tree.map(lambda x: x.astype(dtype), fields())
    samples = ViewSamples(colour, visible, moving, gap)
    point, direction = uniform(5, P, 3, dtype=dtype), uniform(6, P, 3, dtype=dtype)
    shift, times = uniform(7, V, P, dtype=dtype), jnp.arange(V, dtype=dtype) - 1
    early = dynamic.early_flow(moved, point, volume, reach=0.15)
    of_still = BLEND(still.head, volume, samples, static.static_views(samples, shift, times))
    of_moved = BLEND(moved.head, volume, samples, dynamic.dynamic_views(samples, shift, times))
    shown = dynamic.shown_moving(samples, shift, times)
    return (
        static.static_field(still, point, direction, of_still),
        dynamic.dynamic_field(moved, point, direction, of_moved, reach=0.15, early=early, shown=shown),
        static.static_field(direct, point, direction, DIRECT(direct.head, volume, samples, None)),
    )


def seen(dtype=jnp.float32):
    draw = functools.partial(uniform, dtype=dtype)
    gap = draw(2, V, P, low=-2, high=2)
    return draw(0, V, 3, P), jnp.ones((V, P), dtype), draw(1, V, P), gap, normal(3, P, CHANNELS, dtype=dtype)


@pytest.mark.parametrize("gap", [-3.0, 0.0, 3.0])
@pytest.mark.parametrize("moving", [0.0, 1.0])
@pytest.mark.parametrize("visible", [0.0, 1.0])
@pytest.mark.parametrize("volume", [0.0, 1e4])
def test_fields_are_bounded_and_finite_with_finite_gradients(gap, moving, visible, volume):
    fill = lambda x: jnp.full((V, P), x)
    args = (visible * seen()[0], fill(visible), fill(moving), fill(gap), jnp.full((P, CHANNELS), volume))
    values, gradients = value_and_gradients(both, *args)
    for leaf in jax.tree.leaves((values, gradients)):
        assert np.isfinite(leaf).all()
    for field in values:
        assert (field.density >= 0).all() and (field.colour >= 0).all() and (field.colour <= 1).all()
    flows = np.concatenate([values[1].flow_forward, values[1].flow_backward])
    assert (np.abs(flows) <= 0.15 * 1.2 + 1e-6).all()
    for confidence in (values[1].confidence_forward, values[1].confidence_backward):
        assert (confidence >= 0).all() and (confidence <= 1).all()


def test_fields_match_finite_differences(x64):
    assert_grads_match(lambda c, v: both(c, *seen(jnp.float64)[1:4], v)[1:], seen(jnp.float64)[0], seen(jnp.float64)[4])


def test_a_view_that_sees_nothing_changes_no_field():
    points = jnp.asarray(np.random.default_rng(1).uniform([-1, -0.8, 1.5], [1, 0.8, 4], (1, P, 3)), jnp.float32)
    tables, volume = uniform(0, V, 8, 12, 6), seen()[-1]

    def show(level):
        found = conditioning.sample_views(views_of(tables.at[1].set(level), [1, 0, 1]), points)
        return both(found.colour, found.visible, found.moving, found.gap, volume)

    nothing, still_nothing = (jax.jit(show)(level) for level in (0.0, 1.0))
    jax.tree.map(np.testing.assert_array_equal, nothing, still_nothing)
    colour, visible, moving, gap, _ = seen()
    visible = visible.at[1].set(0)
    weights = static.static_views(ViewSamples(colour, visible, moving, gap), uniform(7, V, P), jnp.arange(3.0)).weights
    assert (weights[1] == 0).all() and (weights[0] > 0).all()


def without_residual(params):
    """The field with a colour head that says nothing: only the views' colours are left."""
    silent = jax.tree.map(jnp.zeros_like, params.head.colour)
    return params._replace(head=params.head._replace(colour=silent))


def coloured():
    """View 0 is red, view 1 green, view 2 blue, everywhere."""
    return jnp.broadcast_to(jnp.eye(3)[:, :, None], (V, 3, P))


def shown_by(field, moving, gap, parallax=9.0):
    """(P, 3) colours of a field of points at gaps (V,) behind surfaces that move or not, (V,)."""
    wide = lambda x: jnp.broadcast_to(jnp.asarray(x, jnp.float32)[:, None], (V, P))
    samples = ViewSamples(coloured(), jnp.ones((V, P)), wide(moving), wide(gap))
    point, volume, times = uniform(5, P, 3), uniform(6, P, CHANNELS), jnp.arange(3.0)
    params = without_residual(fields()[field])
    if field == 0:
        views = static.static_views(samples, jnp.zeros((V, P)), times)
        return static.static_field(params, point, point, BLEND(params.head, volume, samples, views)).colour
    views = dynamic.dynamic_views(samples, jnp.full((V, P), parallax), times)
    return dynamic.dynamic_field(params, point, point, BLEND(params.head, volume, samples, views)).colour


def test_a_point_hidden_behind_a_frames_own_surface_does_not_take_its_colour():
    colour = shown_by(0, [0, 0, 0], [3.0, 0.0, 3.0])
    np.testing.assert_allclose(colour, np.broadcast_to([0, 1.0, 0], (P, 3)), atol=5e-3)


def test_the_static_field_does_not_take_the_colour_of_what_moves():
    colour = shown_by(0, [1, 1, 0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(colour, np.broadcast_to([0, 0, 1.0], (P, 3)), atol=5e-3)


def test_the_dynamic_field_takes_the_colour_of_what_moves_where_the_point_is():
    colour = shown_by(1, [0, 1, 1], [0.0, 0.0, 3.0])
    assert (colour[:, 1] > 0.9).all() and (colour[:, 2] < 1e-3).all()
    assert (colour[:, 1] > 10 * colour[:, 0]).all()


def test_from_the_targets_own_time_and_place_the_colour_is_what_is_seen_there():
    """View 0 is of the target's time. Whatever it says of motion and depth, from the same place it shows the answer."""
    colour = shown_by(1, [0, 1, 1], [0.0, 0.0, 3.0], parallax=0.0)
    elsewhere = shown_by(1, [0, 1, 1], [0.0, 0.0, 3.0], parallax=4.0)
    assert (colour[:, 0] > 0.3).all() and (colour[:, 0] > 10 * elsewhere[:, 0]).all()
    np.testing.assert_allclose(shown_by(1, [1, 1, 1], [0.0, 0.0, 0.0], parallax=0.0)[:, 0], 1, atol=0.1)


def test_what_moves_is_shown_by_a_view_of_the_targets_time_and_place_alone():
    fill = lambda rows: jnp.broadcast_to(jnp.asarray(rows, jnp.float32)[:, None], (V, P))
    told = lambda moving, visible, shift, times: dynamic.shown_moving(
        conditioning.ViewSamples(jnp.zeros((V, 3, P)), fill(visible), fill(moving), fill([0] * V)),
        fill(shift), jnp.asarray(times, jnp.float32),
    )  # fmt: skip
    np.testing.assert_allclose(told([0.7, 1, 1], [1, 1, 1], [0, 0, 0], [0, -1, 1]), 0.7)
    np.testing.assert_allclose(told([0.7, 1, 1], [0, 1, 1], [0, 0, 0], [0, -1, 1]), 0)
    np.testing.assert_allclose(told([1, 1, 1], [1, 1, 1], [1, 0, 0], [0, -1, 1]), np.exp(-1), rtol=1e-6)
    np.testing.assert_allclose(told([1, 1, 1], [1, 1, 1], [200, 0, 0], [0, -1, 1]), 0)


def test_the_blend_is_told_of_it():
    wide, (params, point) = jnp.ones((V, P)), (fields()[1], uniform(5, P, 3))
    samples = ViewSamples(coloured(), wide, wide, 0 * wide)
    views = dynamic.dynamic_views(samples, 9 * wide, jnp.arange(3.0))
    reading = BLEND(params.head, uniform(6, P, CHANNELS), samples, views)
    blend = lambda shown: dynamic.dynamic_field(params, point, point, reading, shown=shown).blend_logit
    np.testing.assert_allclose(blend(jnp.full(P, 0.5)) - blend(None), 0.5 * dynamic.SHOWN, rtol=1e-5)


def test_without_views_or_volume_a_field_is_conditioned_on_a_constant():
    np.testing.assert_array_equal(heads_module.concatenated(jnp.zeros((P, 0)), None), np.ones((P, 1)))
    volume = uniform(0, P, 2)
    np.testing.assert_array_equal(heads_module.concatenated(volume, None), volume)
    colour, visible, moving, gap, _ = seen()
    rows = heads_module.concatenated(volume, ViewSamples(colour, visible, moving, gap))
    np.testing.assert_array_equal(rows[3, 2:6], [*colour[0, :, 3], 1])
    np.testing.assert_array_equal(rows[3, 10:14], [*colour[2, :, 3], 1])
