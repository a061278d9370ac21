"""The caster against loops and closed forms; images, depths, flows and visibility against one another."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.cameras import Camera, project
from zestjax.resample import bilinear
from zestjax.simulate import rigs, textures
from zestjax.simulate.cast import Placed, blocked, nearest_hit
from zestjax.simulate.ceiling import ceiling
from zestjax.simulate.layout import Layout, affine, sized
from zestjax.simulate.motion import affine_inverse, all_bodies, carried, movement, rotation_from_vector
from zestjax.simulate.render import render, seen_surface, with_noise
from zestjax.simulate.shade import texel
from zestjax.simulate.truth import correspond, motion_mask, moving_bodies, without_movers
from zestjax.simulate.types import Effects, SimulatedScene
from zestjax.video import Video

HEIGHT, WIDTH = 36, 64
RENDER = jax.jit(partial(render, height=HEIGHT, width=WIDTH, samples=3))
SURFACE = jax.jit(partial(seen_surface, height=HEIGHT, width=WIDTH))
CORRESPOND = jax.jit(correspond)


def camera_at(*positions, yaw=0.0):
    angles = np.tile([yaw, 0, 0], (len(positions), 1))
    cameras = rigs.cameras_at(positions, angles, rigs.intrinsics_from_view(HEIGHT, WIDTH, 0.6))
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[0] if len(positions) == 1 else leaf), cameras)


def smooth_atlas(slots=4):
    """Textures without fine detail, so that resampling an image costs little."""
    chance = np.random.default_rng(1)
    tiles = [np.stack([textures.noise_tile(chance, coarsest=3, decay=0.2) for _ in range(3)], -1) for _ in range(slots)]
    return textures.packed_atlas((np.stack(tiles) * 255).astype(np.uint8))


def toy_scene(effects=None, *, ambient=1.0):
    """A room, a block that slides and turns, a ball that hangs from it, a ball that swells, a still ball."""
    layout = Layout()
    layout.box(shape=sized((4, 2, 4)), position=(0, 0, 2), hollow=True, textures=(0, 1, 2), tile=3.0)
    block = layout.box(
        shape=sized((0.4, 0.3, 0.3)),
        position=(-0.4, 0.2, 2.6),
        textures=(3,),
        velocity=(0.05, 0, 0.01),
        spin=(0, 0.08, 0),
    )
    layout.ball(
        shape=sized((0.2, 0.2, 0.2), offset=(0, -0.6, 0)), parent=block, textures=(1,), swing=(0, 0, 0.2), rate=0.7
    )
    strain = np.array([[0.3, 0.1, 0], [0, -0.2, 0], [0, 0, 0.1]])
    layout.ball(shape=sized((0.5, 0.4, 0.3)), position=(0.9, 0, 3.2), textures=(2,), strain=strain, rate=0.5)
    layout.ball(shape=sized((0.3, 0.3, 0.3)), position=(0.3, 0.5, 3.9), textures=(0,), gloss=0.5)
    effects = Effects() if effects is None else effects
    scene = layout.scene(
        atlas=smooth_atlas(), light=(-1, -1.5, 0.5), ambient=ambient, effects=effects, boxes=3, balls=4
    )
    return jax.tree.map(jnp.asarray, scene)


@pytest.fixture(scope="module")
def scene():
    return toy_scene()


def crossing_by_loops(matrix, box, origin, direction):
    """(in, out) of one ray at one unit body, in float64: faces one by one, or the roots of the quadratic."""
    o, d = matrix[:3, :3] @ origin + matrix[:3, 3], matrix[:3, :3] @ direction
    if not box:
        a, b, c = d @ d, 2 * o @ d, o @ o - 1
        roots = np.roots([a, b, c])
        return None if abs(roots[0].imag) > 0 else sorted(roots.real)
    found = []
    for axis in range(3):
        for side in (-1, 1):
            t = (side - o[axis]) / d[axis]
            at = np.delete(o + t * d, axis)
            found += [t] if np.all(np.abs(at) <= 1) else []
    return None if len(found) < 2 else (min(found), max(found))


def test_the_nearest_hit_and_the_shadow_equal_loops_over_faces_and_roots():
    chance = np.random.default_rng(0)
    linear = chance.normal(size=(5, 3, 3)) * 0.5 + np.eye(3)
    matrices = np.stack(
        [affine(linear=m, offset=offset) for m, offset in zip(linear, chance.normal(size=(5, 3)), strict=True)]
    )
    present, hollow = np.array([True, True, False, True, True]), np.array([False, True, False, False, False])
    origins, directions = chance.normal(size=(2, 3, 200))
    placed = Placed(jnp.asarray(matrices), jnp.asarray(present), jnp.asarray(hollow))
    rays = tuple(jnp.asarray(origins, jnp.float32)), tuple(jnp.asarray(directions, jnp.float32))
    hit, dark = nearest_hit(placed, *rays, boxes=3), blocked(placed, *rays, boxes=3)
    for ray in range(200):
        best, body, shade = np.inf, -1, False
        for i in np.flatnonzero(present):
            span = crossing_by_loops(matrices[i].astype(float), i < 3, origins[:, ray], directions[:, ray])
            if span is None:
                continue
            t = span[1] if hollow[i] else span[0]
            if 1e-3 < t < best:
                best, body = t, i
            shade |= not hollow[i] and span[0] < 1 and span[1] > 0
        assert hit.body[ray] == body and bool(dark[ray]) == shade
        np.testing.assert_allclose(hit.distance[ray], best, rtol=1e-4)


def test_depth_of_a_wall_and_of_a_ball_is_the_closed_form():
    layout = Layout()
    layout.box(shape=sized((50, 50, 1)), position=(0, 0, 6), textures=(0,))
    layout.ball(shape=sized((0.5, 0.5, 0.5)), position=(0, 0, 3), textures=(0,))
    scene = layout.scene(atlas=smooth_atlas(1), light=(0, 0, 0), ambient=1, effects=Effects(), boxes=3, balls=4)
    camera = camera_at((0, 0, 0))
    frame = SURFACE(jax.tree.map(jnp.asarray, scene), camera, 0.0)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    focal = float(camera.intrinsics[0, 0])
    x, y = (u - (WIDTH - 1) / 2) / focal, (v - (HEIGHT - 1) / 2) / focal
    squared = 1 + x**2 + y**2
    inside = 9 - squared * (9 - 0.25)
    expected = np.where(inside > 0, (3 - np.sqrt(np.maximum(inside, 0))) / squared, 5.0)
    np.testing.assert_allclose(frame.depth, expected, rtol=1e-4)
    np.testing.assert_array_equal(frame.body, np.where(inside > 0, 3, 0))
    np.testing.assert_allclose(project(camera, frame.point).pixels, np.stack([u, v], -1), atol=2e-3)


def test_depth_and_flow_reproduce_the_other_image_where_it_sees(scene):
    here, there = camera_at((0, 0, 0)), camera_at((0.15, -0.05, 0.1), yaw=-0.03)
    frame, other = RENDER(scene, here, 1.0), RENDER(scene, there, 3.0)
    link = CORRESPOND(scene, frame, here, 1.0, there, 3.0)
    v, u = jnp.meshgrid(jnp.arange(HEIGHT), jnp.arange(WIDTH), indexing="ij")
    target = jnp.stack([u, v], -1).astype(jnp.float32) + link.flow
    found = bilinear(other.image, target)
    depth = bilinear(other.depth[..., None], target).values[..., 0]
    smooth = np.asarray(link.visible & found.visible & (jnp.abs(depth / link.depth - 1) < 0.02))
    assert smooth.mean() > 0.6
    assert (np.asarray(link.visible) & ~smooth).mean() < 0.12  # outlines, where bilinear depth mixes two surfaces
    error = np.asarray(found.values - frame.image)[smooth]
    assert -10 * np.log10(np.mean(error**2)) > 30
    hidden = np.asarray(found.visible & ~link.visible & (link.depth > 0))
    assert np.mean(np.asarray(depth < link.depth)[hidden]) > 0.8  # what is not visible is behind something


def test_forward_and_backward_flows_undo_each_other(scene):
    camera = camera_at((0, 0, 0))
    frame = SURFACE(scene, camera, 2.0)
    bodies = all_bodies(scene)
    moved = carried(frame.point, frame.body, movement(bodies, 2.0, 5.0))
    back = carried(moved, frame.body, movement(bodies, 5.0, 2.0))
    np.testing.assert_allclose(back, frame.point, atol=2e-5)
    assert float(jnp.max(jnp.abs(moved - frame.point))) > 0.1


def test_the_motion_mask_is_what_moves_and_nothing_else(scene):
    frame = SURFACE(scene, camera_at((0, 0, 0)), 2.0)
    moves = moving_bodies(all_bodies(scene))
    np.testing.assert_array_equal(moves[jnp.array([0, 1, 3, 4, 5])], [False, True, True, True, False])
    mask = motion_mask(scene, frame, 2.0)
    np.testing.assert_array_equal(mask, moves[frame.body])
    alone = SURFACE(without_movers(scene), camera_at((0, 0, 0)), 2.0)
    assert set(np.unique(alone.body)) == {0, 5}
    np.testing.assert_array_equal(alone.depth[~mask], frame.depth[~mask])
    assert bool(jnp.all(alone.depth >= frame.depth))


def test_a_child_follows_its_parent_in_closed_form():
    layout = Layout()
    arm = layout.box(shape=sized((1, 0.1, 0.1)), textures=(0,), position=(0, 0, 5), spin=(0, np.pi / 2, 0))
    layout.ball(shape=sized((0.1,) * 3), textures=(0,), position=(1, 0, 0), parent=arm, velocity=(0.5, 0, 0))
    scene = layout.scene(atlas=smooth_atlas(1), light=(0, 0, 0), ambient=1, effects=Effects(), boxes=1, balls=1)
    moved = movement(jax.tree.map(jnp.asarray, all_bodies(scene)), 0.0, 1.0)
    tip = carried(jnp.array([[1.0, 0, 5]]), jnp.array([1]), moved)
    np.testing.assert_allclose(tip, [[0, 0, 5 - 1.5]], atol=1e-5)


def test_rotations_are_rotations_and_differentiable_at_rest(x64):
    vectors = jnp.asarray(np.random.default_rng(0).normal(size=(20, 3)))
    matrices = rotation_from_vector(vectors)
    series, power = np.eye(3), np.eye(3)
    for k in range(1, 30):
        power = power @ _skew(np.asarray(vectors[0])) / k
        series = series + power
    np.testing.assert_allclose(matrices[0], series, atol=1e-10)
    matrices = np.asarray(matrices)
    np.testing.assert_allclose(matrices @ np.swapaxes(matrices, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12)
    slope = jax.jacobian(rotation_from_vector)(jnp.zeros(3))
    np.testing.assert_allclose(slope[..., 2], _skew([0, 0, 1]), atol=1e-12)
    some = jnp.asarray(np.random.default_rng(1).normal(size=(4, 4))).at[3].set(jnp.array([0, 0, 0, 1.0]))
    np.testing.assert_allclose(affine_inverse(some), np.linalg.inv(some), atol=1e-10)


def _skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


ALL = Effects(jnp.float32(0.6), jnp.float32(0.5), jnp.float32(0.5), jnp.ones((6, 3)), jnp.float32(0.02))


def test_an_effect_that_is_not_named_is_not_in_the_program():
    camera = camera_at((0, 0, 0))
    noisy = lambda scene: with_noise(jax.random.key(0), RENDER(scene, camera, 1.0).image, scene.effects)
    size = lambda effects: len(jax.jit(noisy).lower(toy_scene(effects)).as_text().splitlines())
    bare = size(Effects())
    for name in Effects._fields:
        assert size(Effects()._replace(**{name: getattr(ALL, name)})) > bare, name
    compiled = lambda effects: str(jax.jit(noisy).lower(toy_scene(effects)).compile().as_text()).count(" = ")
    assert compiled(ALL) > 1.2 * compiled(Effects())


def test_noise_has_its_deviation_and_leaves_a_clean_scene_alone():
    grey = jnp.full((40, 40, 3), 0.5)
    noisy = with_noise(jax.random.key(0), grey, ALL)
    assert abs(float(jnp.std(noisy)) - 0.02) < 1e-3
    assert with_noise(jax.random.key(0), grey, Effects()) is grey


def test_the_ceiling_of_a_scene_without_light_effects_is_nearly_the_truth(scene):
    rig = camera_at(*((0.1 * i - 0.15, 0, 0) for i in range(4)))
    images = jnp.stack([RENDER(scene, Camera(*(leaf[i] for leaf in rig)), float(i)).image for i in range(4)])
    simulated = SimulatedScene("toy", scene, rig, np.arange(4), 1.0, 8.0, HEIGHT, WIDTH)
    camera = camera_at((0.05, 0.03, 0))
    found = ceiling(simulated, Video(images, rig, jnp.float32(1), jnp.float32(8)), camera, 2)
    truth = RENDER(scene, camera, 2.0).image
    assert -10 * np.log10(float(jnp.mean((found.image - truth) ** 2))) > 28
    assert float(found.unseen) < 0.05 and float(jnp.max(found.views)) == 4


def test_a_packed_texel_is_the_tile_s_colour_at_its_centre_and_mirrored_beyond():
    tiles = np.random.default_rng(0).integers(0, 256, (2, textures.TILE, textures.TILE, 3), np.uint8)
    atlas = jnp.asarray(textures.packed_atlas(tiles))
    column, row = jnp.array([3, 100, 255]), jnp.array([0, 17, 254])
    u, v = ((x.astype(jnp.float32) + 0.5) / textures.TILE for x in (column, row))
    for across in (u, 2 - u, u + 2):
        colour = jnp.stack(texel(atlas, jnp.int32(1), across, v, jnp.zeros(3, jnp.int32)), -1)
        np.testing.assert_allclose(colour, tiles[1][row, column] / 255, atol=2e-3)
    coarse = jnp.stack(texel(atlas, jnp.int32(0), u, v, jnp.full(3, textures.LEVELS - 1)), -1)
    np.testing.assert_allclose(coarse, np.full((3, 3), 0.5), atol=0.1)


def test_training_and_bench_photographs_are_disjoint_and_there():
    training, bench = (set(textures.PHOTOGRAPHS[split]) for split in ("training", "bench"))
    assert not training & bench
    for name in training | bench:
        assert textures.photograph(name).ndim == 3
    with pytest.raises(ValueError, match="nothing.png.*reinstall scikit-image"):
        textures.photograph("nothing.png")


def test_too_many_bodies_are_refused():
    layout = Layout()
    for _ in range(3):
        layout.box(shape=sized((1, 1, 1)), textures=(0,))
    with pytest.raises(ValueError, match="3 boxes, expected at most 2"):
        layout.scene(atlas=smooth_atlas(1), light=(0, 0, 0), ambient=1, effects=Effects(), boxes=2)
