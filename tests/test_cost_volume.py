"""Cost volumes against stacked statistics, at the true depth, under trust, and as MVSNeRF published them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from oracles import assert_finite

from zestjax import cameras, cost_volume, planesweep
from zestjax.cameras import Camera
from zestjax.frames.trust import Trust

V, D, H, W, C = 3, 4, 7, 8, 4
K = np.array([[10.0, 0, 3.5], [0, 9, 3.0], [0, 0, 1]], "f")
sweep = jax.jit(cost_volume.cost_volume, static_argnames=("per_view", "planes_at_once"))


def ring(dtype=jnp.float32):
    positions = jnp.asarray([[0.0, 0, 0], [0.8, 0.1, 0], [-0.5, 0.4, 0.3]])
    pose = cameras.look_at(positions, jnp.tile(jnp.asarray([[0.0, 0, 4]]), (V, 1)), up=jnp.asarray([0.0, -1, 0]))
    return Camera(jnp.tile(jnp.asarray(K, dtype), (V, 1, 1)), pose.astype(dtype))


@functools.cache
def scene(dtype=jnp.float32):
    """`drawn`, compiled at once: a hundred small programs take ten times as long."""
    return jax.jit(drawn, static_argnums=0)(dtype)


def drawn(dtype):
    """tables, homographies, grid, trust maps and depths of a small sweep."""
    views, depths = ring(dtype), planesweep.plane_depths(2.0, 8.0, D, spacing="inverse").astype(dtype)
    homographies = planesweep.homographies(jax.tree.map(lambda x: x[0], views), views, depths)
    keys = jax.random.split(jax.random.key(0), 3)
    tables = jax.random.normal(keys[0], (V, H, W, C), dtype)
    static, surface = (jax.random.uniform(key, (V, H, W), dtype) for key in keys[1:])
    maps = Trust(static, 0.1 + 0.4 * surface, jnp.full((V, H, W), 0.1, dtype))
    return tables, homographies, planesweep.sweep_grid(H, W, dtype=dtype), maps, depths


def read_by_loop(table, u, v):
    """Bilinear in float64, or None outside."""
    if not (0 <= u <= W - 1 and 0 <= v <= H - 1):
        return None
    i, j = min(int(v), H - 2), min(int(u), W - 2)
    upper = table[i, j] * (1 - u + j) + table[i, j + 1] * (u - j)
    lower = table[i + 1, j] * (1 - u + j) + table[i + 1, j + 1] * (u - j)
    return upper * (1 - v + i) + lower * (v - i)


def volume_by_loop(tables, homographies, depths, maps=None, floor=1e-3):
    """Cell by cell in float64: np.average over the views that see, weighted by the printed trust."""
    tables, homographies = np.float64(tables), np.float64(homographies)
    maps = None if maps is None else [np.float64(m)[..., None] for m in maps]
    mean, variance, count = np.zeros((2, D, H, W, C)), np.zeros((D, H, W, C)), np.zeros((D, H, W))
    mean = mean[0]
    for d, y, x in np.ndindex(D, H, W):
        values, weights = [], []
        for view in range(V):
            q = homographies[d, view] @ [x, y, 1.0]
            value = read_by_loop(tables[view], q[0] / q[2], q[1] / q[2]) if q[2] > 0 else None
            if value is None:
                continue
            weight = 1.0
            if maps is not None:
                static, surface, tolerance = (read_by_loop(m[view], q[0] / q[2], q[1] / q[2])[0] for m in maps)
                hidden = max(surface - 1 / (q[2] * float(depths[d])), 0) / tolerance
                weight = floor + (1 - floor) * static * np.exp(-(hidden**2))
            values.append(value)
            weights.append(weight)
        if values:
            mean[d, y, x] = np.average(values, axis=0, weights=weights)
            variance[d, y, x] = np.average((np.array(values) - mean[d, y, x]) ** 2, axis=0, weights=weights)
            count[d, y, x] = sum(weights)
    return mean, variance, count


def interior(homographies, grid):
    """Cells that no view sees within rounding of its border, where a loop in float64 may differ."""
    u, v, _, _ = planesweep.carry(homographies, grid)
    gap = jnp.minimum(jnp.minimum(abs(u), abs(u - W + 1)), jnp.minimum(abs(v), abs(v - H + 1)))
    return (gap[:, 1:] > 2e-3).all(1)


@pytest.mark.parametrize("trusting", [False, True])
def test_statistics_are_those_of_the_views_that_see_and_are_trusted(trusting):
    tables, homographies, grid, maps, depths = scene()
    maps = maps if trusting else None
    volume = sweep(tables, homographies, grid, trust=maps, depths=depths)
    homographies = homographies.at[:, 0].set(jnp.eye(3))  # the reference sees itself: no rounding at its border
    keep = interior(homographies, grid)
    assert keep.mean() > 0.9
    expected = volume_by_loop(tables, homographies, depths, maps)
    for ours, theirs in zip(volume[:3], expected, strict=True):
        np.testing.assert_allclose(ours[keep], theirs[keep], atol=2e-4)


def stacked(tables, homographies, maps, *, grid, depths, floor=1e-3, per_view=2):
    """The same statistics from stacked samples, two-pass, with JAX's own gradient."""

    def view(table, homography, static, inverse_depth, tolerance, depth):
        rows = jnp.concatenate([table, jnp.stack([static, inverse_depth, tolerance], -1)], -1)
        values, seen = planesweep.warp(rows, homography, grid)
        _, _, share, _ = planesweep.carry(homography, grid)
        hidden = jax.nn.relu(values[..., C + 1] - 1 / (share * depth)) / jnp.where(seen, values[..., C + 2], 1)
        weight = jnp.where(seen, floor + (1 - floor) * values[..., C] * jnp.exp(-(hidden**2)), 0)
        return values[..., :C], weight[..., None]

    per_plane = jax.vmap(view, in_axes=(0, 0, 0, 0, 0, None))
    values, weights = jax.vmap(per_plane, in_axes=(None, 0, None, None, None, 0))(tables, homographies, *maps, depths)
    count = weights.sum(1)
    share = weights / jnp.where(count > 0, count, 1)[:, None]
    mean = (values * share).sum(1)
    variance = ((values - mean[:, None]) ** 2 * share).sum(1)
    return mean, variance, count[..., 0], jnp.moveaxis(values[..., C - per_view :], 1, -2)


def test_the_gradient_written_by_hand_is_that_of_the_stacked_form(x64):
    tables, homographies, grid, maps, depths = scene(jnp.float64)
    # Neither form is differentiable where a view sees the very edge of its image: move off it.
    homographies = homographies + 1e-3 * jax.random.normal(jax.random.key(3), homographies.shape, jnp.float64)

    def streamed(tables, homographies, maps):
        options = {"trust": maps, "depths": depths, "per_view": 2, "planes_at_once": 2}
        return tuple(cost_volume.cost_volume(tables, homographies, grid, **options))

    plain = lambda *args: stacked(*args, grid=grid, depths=depths)
    shapes = jax.eval_shape(plain, tables, homographies, maps)
    rng = np.random.default_rng(0)
    cotangent = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in shapes)
    both = []
    for fn in (streamed, plain):

        @jax.jit
        def value_and_pull(cotangent, *args, fn=fn):
            value, pull = jax.vjp(fn, *args)
            return value, pull(cotangent)

        both.append(value_and_pull(cotangent, tables, homographies, maps))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8), *both)


def test_gradients_match_finite_differences(x64):
    tables, homographies, grid, maps, depths = scene(jnp.float64)
    homographies = homographies + 1e-3 * jax.random.normal(jax.random.key(3), homographies.shape, jnp.float64)

    @jax.jit
    def smooth(tables, static):
        trust = maps._replace(static=static)
        volume = cost_volume.cost_volume(tables, homographies, grid, trust=trust, depths=depths, floor=0.1)
        return volume.mean, volume.variance, volume.count

    check_grads(smooth, (tables, maps.static), order=1, modes=("rev",), rtol=1e-5, atol=1e-6)


def test_each_statistic_alone_has_its_own_gradient():
    """An unused statistic's gradient is skipped, not computed as zeros: the sum of the parts is the whole."""
    tables, homographies, grid, _, _ = scene()

    @jax.jit
    def gradients(tables):
        fields = ("mean", "variance", "count")
        part = lambda name: lambda t: getattr(cost_volume.cost_volume(t, homographies, grid), name).sum()
        return [jax.grad(part(name))(tables) for name in fields], jax.grad(lambda t: sum(part(n)(t) for n in fields))(
            tables
        )

    (mean, variance, count), whole = gradients(tables)
    np.testing.assert_allclose(mean + variance, whole, atol=1e-5)
    np.testing.assert_array_equal(count, 0)


def test_no_gradient_is_asked_of_the_cameras_unless_they_are_fitted():
    tables, homographies, grid, _, _ = scene()
    total = lambda t, h: cost_volume.cost_volume(t, h, grid).variance.sum()
    size = lambda argnums: len(str(jax.make_jaxpr(jax.grad(total, argnums=argnums))(tables, homographies)))
    assert size(0) < size((0, 1))


def test_agreeing_views_have_no_variance_however_bright():
    _, homographies, grid, _, _ = scene()
    tables = jnp.full((V, H, W, C), 1e3) + jnp.asarray([0.0, 0.25, -0.25])[:, None, None, None]
    volume = sweep(tables, homographies, grid)
    assert (volume.variance >= 0).all() and (volume.variance < 0.05).all()
    np.testing.assert_allclose(sweep(jnp.full((V, H, W, C), 1e3), homographies, grid).variance, 0, atol=1e-6)


def test_a_single_view_that_sees_has_no_variance():
    """The other two look away."""
    tables, homographies, grid, _, _ = scene()
    volume = sweep(tables, homographies.at[:, 1:].set(-jnp.eye(3)), grid)
    np.testing.assert_array_equal(volume.variance, 0)
    np.testing.assert_allclose(volume.mean[0, 1:-1, 1:-1], tables[0, 1:-1, 1:-1], atol=1e-4)
    np.testing.assert_array_equal(volume.count[:, 1:-1, 1:-1], 1)


def test_what_no_view_sees_is_zero_and_finite():
    tables, homographies, grid, maps, depths = scene()
    blind = jnp.broadcast_to(-jnp.eye(3), homographies.shape)
    volume = lambda t, h, m: cost_volume.cost_volume(t, h, grid, trust=m, depths=depths, per_view=1)
    for leaf in volume(tables, blind, maps):
        np.testing.assert_array_equal(leaf, 0)
    assert_finite(volume, tables, blind, maps)


def test_where_no_view_is_trusted_all_that_see_are_averaged():
    tables, homographies, grid, maps, depths = scene()
    distrusted = maps._replace(static=jnp.zeros_like(maps.static))
    plain = sweep(tables, homographies, grid)
    volume = sweep(tables, homographies, grid, trust=distrusted, depths=depths)
    np.testing.assert_allclose(volume.mean, plain.mean, atol=1e-4)
    np.testing.assert_allclose(volume.variance, plain.variance, atol=1e-3)
    np.testing.assert_allclose(volume.count, 1e-3 * plain.count, rtol=1e-4)


def test_a_covered_view_leaves_the_mean():
    """Two views of a wall of 1 at the last plane; something near, of colour 9, covers all of the second."""
    tables, homographies, grid, maps, depths = scene()
    tables = jnp.ones((V, H, W, C)).at[1].set(9)
    surface = jnp.full((V, H, W), 1 / 8.5).at[1].set(1 / 2.0)
    maps = Trust(jnp.ones((V, H, W)), surface, jnp.full((V, H, W), 0.05))
    plain, volume = sweep(tables, homographies, grid), sweep(tables, homographies, grid, trust=maps, depths=depths)
    assert plain.mean[-1].max() > 3
    np.testing.assert_allclose(volume.mean[-1, 1:-1, 1:-1], 1, atol=0.02)


def test_the_variance_is_smallest_at_the_true_depth():
    """A pattern painted on the plane z = 4 of the reference camera, in eight planes of which one is there."""
    grid = planesweep.sweep_grid(H, W)

    def paint(reference, view):
        to_reference = jnp.linalg.inv(planesweep.plane_homography(reference, view, jnp.float32(4.0)))
        u, v, _, _ = planesweep.carry(to_reference, grid)
        return jnp.stack([jnp.sin(0.7 * u), jnp.cos(0.8 * v)], -1)

    @jax.jit
    def swept(depths):
        views = ring()
        reference = jax.tree.map(lambda x: x[0], views)
        tables = jax.vmap(paint, in_axes=(None, 0))(reference, views)
        return cost_volume.cost_volume(tables, planesweep.homographies(reference, views, depths), grid)

    volume = swept(jnp.asarray([2.0, 2.5, 3.2, 4.0, 5.0, 6.0]))
    cost = jnp.where(volume.count[..., None] >= 2, volume.variance, jnp.nan)
    assert int(jnp.nanargmin(jnp.nanmean(cost, axis=(1, 2, 3)))) == 3


@pytest.mark.parametrize("planes_at_once", [3, 100])
def test_blocks_of_planes_change_nothing(planes_at_once):
    tables, homographies, grid, maps, depths = scene()
    alone = sweep(tables, homographies, grid, trust=maps, depths=depths, per_view=2)
    together = sweep(tables, homographies, grid, trust=maps, depths=depths, per_view=2, planes_at_once=planes_at_once)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), alone, together)


def test_the_order_of_views_changes_nothing():
    tables, homographies, grid, _, _ = scene()
    there, back = sweep(tables, homographies, grid), sweep(tables[::-1], homographies[:, ::-1], grid)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), there[:3], back[:3])


def test_each_views_colours_are_its_warps_side_by_side():
    tables, homographies, grid, _, _ = scene()
    colours = jax.jit(cost_volume.sweep_colours)(tables[..., 1:], homographies, grid)
    samples = sweep(tables, homographies, grid, per_view=3).samples
    np.testing.assert_allclose(colours, samples.reshape(D, H, W, V * 3), atol=1e-6)
    warped = planesweep.warp(tables[2, ..., 1:], homographies[1, 2], grid).values
    np.testing.assert_allclose(colours[1, ..., 6:], warped, atol=1e-5)


def test_memory_does_not_grow_with_views_times_planes():
    def temporary(views, planes):
        tables, homographies = jnp.zeros((views, 32, 32, 8)), jnp.zeros((planes, views, 3, 3))
        grid = planesweep.sweep_grid(32, 32)
        loss = lambda t: cost_volume.cost_volume(t, homographies, grid).variance.sum()
        analysis = jax.jit(jax.grad(loss)).lower(tables).compile().memory_analysis()
        return None if analysis is None else analysis.temp_size_in_bytes

    few, many = temporary(2, 16), temporary(10, 16)
    if few is None:
        pytest.skip("this backend reports no memory use")
    one_sweep = 16 * 32 * 32 * 8 * 4  # bytes of one view's samples
    assert many - few < one_sweep


def test_wrong_arguments_are_refused():
    tables, homographies, grid, maps, depths = scene()
    with pytest.raises(ValueError, match="axis V of `homographies` is 3, expected 2 from `tables`"):
        cost_volume.cost_volume(tables[:2], homographies, grid)
    with pytest.raises(ValueError, match="`trust` needs `depths`"):
        cost_volume.cost_volume(tables, homographies, grid, trust=maps)
    with pytest.raises(ValueError, match="axis D of `depths`"):
        cost_volume.cost_volume(tables, homographies, grid, trust=maps, depths=depths[1:])
    with pytest.raises(ValueError, match="`per_view` is 9"):
        cost_volume.cost_volume(tables, homographies, grid, per_view=9)
    with pytest.raises(ValueError, match="multiple of 4, got 6x8"):
        cost_volume.quarter_colours(jnp.zeros((6, 8, 3)))
