"""From frames to pixels: what is switched off is not there, what is not valid says nothing, and nothing breaks."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import assert_grads_match, uniform
from stage import MINI, PAPER, STILL

from zestjax.cameras import Camera, project
from zestjax.fields.heads import Blend, Direct
from zestjax.fields.static import StaticSample
from zestjax.frames.cells import cells_of, grown
from zestjax.frames.evidence import FLOW_CHANNELS, Evidence
from zestjax.rays import depths_from_fractions
from zestjax.systems import presets
from zestjax.systems.fields import Dynamic, Static
from zestjax.systems.sampling import Even, Guided, march
from zestjax.systems.swept import Pyramid, Swept
from zestjax.systems.system import Space, System, filled, last_resort
from zestjax.train.recipes import RECIPES
from zestjax.video import Frames, Inputs


def shapes_of(system):
    return jax.eval_shape(system.init, jax.random.key(0))


def evidence_of(system=MINI, seed=0):
    """Bytes of evidence of K key-frames and M slots; None in a system that asks no frame."""
    if system.frames is None:
        return None
    draw = lambda *s: np.random.default_rng(seed).integers(0, 256, s).astype(np.uint8)
    views = system.static.frames.count + (0 if system.dynamic is None else system.dynamic.frames.count)
    planes = system.frames.planes
    return Evidence(*(draw(views, 4, 6, n) for n in (*(planes,) * 6, FLOW_CHANNELS, 2, 12)))


def rendered(params, inputs, evidence, system=MINI):
    return stage.forward(system)(params, inputs, evidence, stage.pixels())


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def assert_all_finite(tree):
    for leaf in jax.tree.leaves(tree):
        assert np.isfinite(leaf).all()


# Presets and parameters.


@pytest.mark.parametrize("name", list(RECIPES))
def test_a_preset_has_the_parts_it_names(name):
    system = RECIPES[name].system
    params = shapes_of(system)
    assert params.static.volume and params.dynamic.volume and params.static.net and params.dynamic.net
    assert (params.analysis is None) == (name == "paper") == (params.static.net.head.views is None)
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(params))


ABLATIONS = {
    "both volumes": lambda system: system,
    "geometry volume": presets.without_motion_volume,
    "motion volume": presets.without_geometry_volume,
    "neither": presets.without_volumes,
    "still": presets.still,
    "still without volumes": lambda system: presets.still(presets.without_volumes(system)),
}


@pytest.mark.parametrize("name", ABLATIONS)
@pytest.mark.parametrize("base", [MINI, PAPER], ids=["mini", "paper"])
def test_every_ablation_traces_and_lacks_what_it_leaves_out(base, name):
    system = ABLATIONS[name](base)
    params = shapes_of(system)
    assert (params.static.volume is None) == (name in ("motion volume", "neither", "still without volumes"))
    assert (params.dynamic is None) == name.startswith("still")
    assert params.dynamic is None or (params.dynamic.volume is None) == (name in ("geometry volume", "neither"))
    assert (params.analysis is not None) == (base is MINI and "without" not in name and name != "neither")
    inputs, evidence = stage.inputs_of(system)[0], evidence_of(system)
    out = jax.eval_shape(functools.partial(stage.rays, system=system), params, inputs, evidence, stage.pixels())
    assert out.colour.shape == (64, 3) and out.depth.shape == (64,)
    assert (out.dynamic is None) == (system.dynamic is None) == (inputs.slots is None)


def test_the_papers_preset_has_the_papers_shapes():
    system = presets.PAPER
    params = shapes_of(system)
    static, dynamic = params.static, params.dynamic
    assert static.volume.regulariser.stem.conv.kernel.shape[-2] == 32 + 3 * 8
    assert dynamic.volume.regulariser.stem.conv.kernel.shape[-2] == 32 + 3 * 4
    assert [k.kernel.shape for k in static.net.trunk.layers] == [(63, 256), *[(256, 256)] * 4, (319, 256)] + [
        (256, 256)
    ] * 2
    assert dynamic.net.trunk.layers[0].kernel.shape == (84, 256)
    assert static.net.trunk.condition.kernel.shape == (8 + 4 * 8, 256)
    assert static.net.head.colour.hidden.kernel.shape == (256 + 27, 128)

    frames = lambda n: Frames(spec(n, 288, 512, 3), Camera(spec(n, 3, 3), spec(n, 4, 4)), spec(n), spec(n))
    spec = lambda *s: jax.ShapeDtypeStruct(s, jnp.float32)
    inputs = Inputs(frames(8), frames(4), Camera(spec(3, 3), spec(4, 4)), *[spec()] * 4)
    volumes = lambda p, i: [seen.volume.cells for seen in system.encode(p, i, None)[1:3]]
    assert [v.shape for v in jax.eval_shape(volumes, params, inputs)] == [(128, 72, 128, 8)] * 2
    out = jax.eval_shape(functools.partial(stage.rays, system=system), params, inputs, None, spec(100, 2))
    assert out.weights.shape == (100, 128) and out.dynamic.flow_forward.shape == (100, 128, 3)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda: dataclasses.replace(MINI, space=Space(5, camera="key_frame")), "a guided sampler .* key_frame's"),
        (lambda: dataclasses.replace(presets.without_volumes(MINI), sampler=Guided()), "guided sampler with 0 volumes"),
        (lambda: dataclasses.replace(MINI, static=Static(volume=Swept(occupied=False))), "volume without logits"),
        (lambda: dataclasses.replace(MINI, frames=None), "own depths without `frames`"),
        (lambda: dataclasses.replace(PAPER, frames=MINI.frames), "no volume's tables read"),
        (lambda: dataclasses.replace(MINI, precision="float16"), "precision"),
        (lambda: Static(volume=None, head=Blend()), "Static: the head looks at views"),
        (lambda: Dynamic(volume=None), "Dynamic: the head looks at views"),
        (lambda: Dynamic(depth=0), "Dynamic: `depth` is 0, expected an integer from 1"),
        (lambda: Static(width=2.0), "Static: `width` is 2.0"),
        (lambda: Static(modulation="subtract"), "modulation"),
        (lambda: Space(1), "Space: `planes` is 1, expected an integer from 2"),
        (lambda: Space(4, "log"), "spacing"),
        (lambda: Even(0), "Even: `samples` is 0"),
        (lambda: Even(4, "metre"), "unit"),
        (lambda: Pyramid(2), "Pyramid: `channels` is 2"),
        (lambda: Swept(widths=(8, 0)), r"Swept: `widths\[1\]` is 0"),
    ],
)
def test_choices_that_do_not_fit_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


def test_systems_are_values():
    """Compared and hashed by what they are made of, so that equal ones share a compiled program."""
    again = System(
        Space(5), dataclasses.replace(MINI.static), dataclasses.replace(MINI.dynamic), Guided(), frames=MINI.frames
    )
    assert again == MINI and hash(again) == hash(MINI) and again is not MINI
    assert dataclasses.replace(MINI, space=Space(6)) != MINI
    assert presets.NEITHER == presets.without_motion_volume(presets.MOTION)
    assert presets.SVS == dataclasses.replace(presets.PAPER, dynamic=None) and Direct() == Direct()


# What is off is not in the program.


def program(system):
    arguments = stage.params_of(system), stage.inputs_of(system)[0], evidence_of(system), stage.pixels()
    return stage.operations(functools.partial(stage.rays, system=system), *arguments)


def test_a_static_scene_has_neither_a_dynamic_field_nor_a_motion_volume_in_its_program():
    whole, still = program(MINI), program(STILL)
    without = program(presets.without_motion_volume(MINI))
    for name in ("conv_general_dilated", "scan", "gather"):  # the motion volume's
        assert still[name] == without[name] < whole[name]
    assert still["dot_general"] < without["dot_general"] < whole["dot_general"]
    assert (
        whole["scan"] - 1 == 2 * (still["scan"] - 1) > 0
    )  # each volume is one sweep; one looks for the frames' ground


def test_slots_are_not_even_among_the_inputs_of_a_static_scene():
    inputs, frames = stage.inputs_of(STILL)
    assert inputs.slots is None and len(frames) == STILL.static.frames.count


# What is not valid says nothing.


def test_a_slot_or_key_frame_that_is_not_valid_influences_nothing():
    params, (inputs, _), evidence = stage.params_of(MINI), stage.inputs_of(time=5), evidence_of()
    assert inputs.slots.valid.tolist() == [1, 1, 0]  # the video ends
    inputs = inputs._replace(key=inputs.key._replace(valid=np.array([1, 1, 0], np.float32)))
    empty = lambda f: f._replace(
        images=f.images.at[2].set(0.3),
        cameras=jax.tree.map(lambda x: x * np.array([1, 1, 2.0])[:, None, None].astype("f"), f.cameras),
    )
    other = inputs._replace(key=empty(inputs.key), slots=empty(inputs.slots))
    noise = evidence_of(seed=7)
    replaced = jax.tree.map(lambda a, b: np.concatenate([a[:2], b[2:3], a[3:5], b[5:]]), evidence, noise)
    assert_same(rendered(params, inputs, evidence), rendered(params, other, replaced))


def test_a_valid_frame_matters():
    params, (inputs, _), evidence = stage.params_of(MINI), stage.inputs_of(), evidence_of()
    other = inputs._replace(slots=inputs.slots._replace(images=inputs.slots.images.at[0].set(0.3)))
    assert not np.array_equal(rendered(params, inputs, evidence).colour, rendered(params, other, evidence).colour)


# Nothing breaks.


def both(inputs, change):
    """Inputs with the frames of either field changed."""
    return inputs._replace(key=change(inputs.key), slots=None if inputs.slots is None else change(inputs.slots))


def blind(inputs):
    """Inputs whose source cameras all look away from the target's view."""
    away = np.diag([-1.0, 1, -1, 1]).astype(np.float32)
    turn = lambda f: f._replace(
        cameras=f.cameras._replace(camera_from_world=away @ np.asarray(f.cameras.camera_from_world))
    )
    return both(inputs, turn)


def without_frames(inputs):
    none = lambda f: f._replace(valid=np.zeros_like(f.valid))
    return both(inputs, none)


def painted(value):
    def fill(inputs):
        paint = lambda f: f._replace(images=jnp.full_like(f.images, value))
        return both(inputs, paint)

    return fill


def identical(inputs):
    same = lambda f: f._replace(
        images=jnp.broadcast_to(f.images[:1], f.images.shape),
        cameras=jax.tree.map(lambda x: np.repeat(x[:1], len(x), 0), f.cameras),
    )
    return both(inputs, same)._replace(camera=jax.tree.map(lambda x: jnp.asarray(x[0]), inputs.key.cameras))


def far_away(inputs):
    """The planes reach so far that the one past the last lies behind the camera, or at infinity."""
    return inputs._replace(near=np.float32(1e-3), far=np.float32(1e5))


EXTREMES = [lambda i: i, blind, without_frames, painted(0.0), painted(1.0), identical, far_away]
NAMES = ["plain", "blind", "no frames", "black", "white", "identical", "far"]


@pytest.mark.parametrize("change", EXTREMES, ids=NAMES)
@pytest.mark.parametrize("system", [MINI, STILL, PAPER], ids=["mini", "still", "paper"])
def test_renders_are_finite_and_bounded_whatever_the_frames(system, change):
    params, (inputs, _) = stage.params_of(system), stage.inputs_of(system)
    out = rendered(params, change(inputs), evidence_of(system), system)
    assert_all_finite(out)
    for share in (out.colour, out.static_colour, out.dynamicness):
        assert (share > -1e-4).all() and (share < 1 + 1e-3).all()
    assert (out.opacity >= 0).all() and (out.opacity < 4 / 3 + 1e-3).all()  # of two fields that share their samples


@pytest.mark.parametrize("opacity", [0.0, 0.3, 1.0, 4 / 3])
def test_a_filled_ray_shows_a_mean_of_colours(opacity):
    colour, behind = opacity * jnp.asarray([[0.2, 0.5, 1.0]]), jnp.asarray([[1.0, 0.5, 0.2]])
    share = min(opacity, 1)
    found = filled(colour, jnp.full((1,), opacity), behind)
    np.testing.assert_allclose(found, share * np.array([[0.2, 0.5, 1.0]]) + (1 - share) * behind, rtol=1e-5)


def marching(planes, samples, spacing="inverse"):
    """A still system without volumes, its inputs; (inputs, pixels, jitter) -> `Marched`."""
    system = dataclasses.replace(
        presets.still(presets.without_volumes(MINI)), space=Space(planes, spacing), sampler=Even(samples)
    )
    inputs = stage.inputs_of(system)[0]

    def run(inputs, pixels, jitter=None):
        frustum = system.space.frustum(inputs)
        return march(system.sampler, system.space, frustum, None, inputs, pixels, jitter=jitter)

    return system, inputs, run


def test_half_an_infinite_plane_is_held_at_a_finite_distance():
    _, inputs, run = marching(planes=3, samples=1)
    inputs = inputs._replace(near=np.float32(1.0), far=np.float32(2.0))
    one = depths_from_fractions(jnp.float32(1), inputs.near, 1.5 * inputs.far, spacing="inverse")
    assert one == 3
    assert_all_finite(run(inputs, jnp.zeros((1, 2))))
    # 1 / depth is 0 one plane past the middle sample where 2 far / near = 2 (planes - 1) = 4.
    assert_all_finite(run(inputs._replace(near=jnp.float32(1), far=jnp.float32(4 / 3)), jnp.zeros((1, 2))))


@pytest.fixture(params=["depth", "inverse"])
def jittered(request):
    """Compiled: places in the strata -> `Marched` of five samples a ray; the system; the inputs; the pixels."""
    system, inputs, run = marching(planes=5, samples=5, spacing=request.param)
    pixels = stage.pixels()
    return jax.jit(lambda jitter: run(inputs, pixels, jitter)), system, inputs, pixels


def test_jittered_samples_are_each_in_its_stratum(jittered):
    run, system, _, pixels = jittered
    draw = lambda key: jax.random.uniform(jax.random.key(key), (len(pixels), 5))
    found = [jax.tree.map(lambda x: np.asarray(x, np.float64), run(draw(key))) for key in (0, 1, 0)]
    even = (lambda d: d) if system.space.spacing == "depth" else (lambda d: 1 / d)
    near, far = even(stage.NEAR), even(stage.FAR)
    for marched, key in zip(found, (0, 1, 0), strict=True):
        fractions = (even(marched.depths) - near) / (far - near)
        np.testing.assert_allclose(fractions, (np.arange(5) + np.asarray(draw(key))) / 5, atol=1e-5)
        np.testing.assert_allclose(marched.coords[..., 2], fractions, atol=1e-5)
        assert (np.diff(marched.depths) > 0).all()
        # The camera stands at x = 0.1 and looks along z; the intervals tile the ray from near to far.
        across = (np.asarray(pixels, np.float64) - [11.5, 7.5]) / 24
        points = np.stack([*np.moveaxis(across[:, None] * marched.depths[..., None], -1, 0), marched.depths], -1)
        np.testing.assert_allclose(marched.points, points + [0.1, 0, 0], atol=1e-5)
        whole = (stage.FAR - stage.NEAR) * np.sqrt(1 + (across**2).sum(-1))
        np.testing.assert_allclose(marched.lengths.sum(-1), whole, rtol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, found[0], found[2])
    assert (found[0].depths != found[1].depths).mean() > 0.99


def test_jitter_is_about_the_regular_samples(jittered):
    run, system, inputs, pixels = jittered
    same = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    jax.tree.map(same, run(jnp.full((len(pixels), 5), 0.5)), run(None))
    even = (lambda d: d) if system.space.spacing == "depth" else (lambda d: 1 / d)
    draws = [np.random.default_rng(key).uniform(size=(len(pixels), 5)).astype(np.float32) for key in range(20)]
    mean = np.mean([even(np.asarray(run(draw).depths, np.float64)) for draw in draws], (0, 1))
    width = abs(even(stage.FAR) - even(stage.NEAR)) / 5
    regular = even(np.asarray(run(None).depths, np.float64)[0])
    assert (abs(mean - regular) < 5 * width / np.sqrt(12 * 20 * len(pixels))).all()
    params = stage.params_of(system)
    scene = system.encode(params, inputs, None)
    rendered = jax.jit(lambda jitter: system.render(params, scene, inputs, pixels, jitter=jitter).marched)
    np.testing.assert_allclose(rendered(draws[0]).depths, run(draws[0]).depths, rtol=1e-6)


# Parts.


@pytest.mark.parametrize("size", [1, 2, 5, 9, 13, 16])
def test_maps_grow_to_where_their_cells_are(size):
    cells = cells_of(size)
    for factor, count in ((4, cells), (2, 2 * cells)):
        ramp = jnp.broadcast_to(jnp.arange(count, dtype=jnp.float32)[None, :, None], (1, count, count))
        wide = grown(ramp, (size, size), factor=factor)
        expected = np.clip((np.arange(size) - (factor - 1) / 2) / factor, 0, count - 1)
        np.testing.assert_allclose(wide[0, :, 0], expected, atol=1e-5)


def guided_by_loop(guides, pixels):
    height, width = guides.shape[1:]
    rows = []
    for u, v in np.asarray(pixels, np.float64):
        found = []
        for guide in np.asarray(guides, np.float64):
            x, y = (min(max((p - 1.5) / 4, 0), n - 1) for p, n in ((u, width), (v, height)))
            left, top = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
            right, down = min(left + 1, width - 1), min(top + 1, height - 1)
            corners = [guide[top, left], guide[top, right], guide[down, left], guide[down, right]]
            a, b = x - left, y - top
            mixed = (corners[0] * (1 - a) + corners[1] * a) * (1 - b) + (corners[2] * (1 - a) + corners[3] * a) * b
            found += [*corners, mixed]
        rows.append(sorted(found))
    return np.array(rows)


@pytest.mark.parametrize("shape", [(2, 4, 6), (1, 1, 3), (1, 1, 1)])
def test_rays_are_sampled_at_their_cells_surfaces(shape):
    guides = uniform(0, *shape)
    pixels = jnp.asarray([[0, 0], [23, 15], [1.5, 1.5], [7, 9], [-3, 40], [12.3, 4.1]], jnp.float32)
    np.testing.assert_allclose(
        Guided().fractions(guides, pixels, None), guided_by_loop(guides, pixels), rtol=1e-5, atol=1e-6
    )


def test_guided_coordinates_match_finite_differences(x64):
    pixels = uniform(1, 5, 2, low=2, high=12, dtype=jnp.float64)
    assert_grads_match(lambda g, p: Guided().fractions(g, p, None), uniform(0, 2, 4, 6, dtype=jnp.float64), pixels)


@pytest.mark.parametrize("system", [MINI, PAPER], ids=["guided", "regular"])
def test_samples_lie_on_their_rays_between_the_bounds(system):
    params, (inputs, _) = stage.params_of(system), stage.inputs_of(system)
    out = rendered(params, inputs, evidence_of(system), system)
    marched = out.marched
    assert (np.diff(marched.depths) >= 0).all()
    assert marched.depths.min() >= stage.NEAR - 1e-4 and marched.depths.max() <= stage.FAR + 1e-4
    shown = jax.tree.map(np.asarray, project(inputs.camera, marched.points))
    np.testing.assert_allclose(shown.pixels, np.broadcast_to(stage.pixels()[:, None], shown.pixels.shape), atol=1e-3)
    np.testing.assert_allclose(shown.depth, marched.depths, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(marched.directions, axis=-1), 1, rtol=1e-5)
    if system is PAPER:
        spread = np.linalg.norm(marched.points[:, -1] - marched.points[:, 0], axis=-1) * 4 / 3
        np.testing.assert_allclose(marched.lengths.sum(-1), spread, rtol=1e-4)


def test_a_ray_that_sees_nothing_shows_its_samples_by_density():
    sample = lambda density: StaticSample(density, jnp.asarray([[[1.0, 0, 0], [0, 0, 1]]]), density, density)
    np.testing.assert_allclose(last_resort(sample(jnp.zeros((1, 2)))), [[0.5, 0, 0.5]])
    np.testing.assert_allclose(last_resort(sample(jnp.asarray([[3.0, 1]]))), [[0.75, 0, 0.25]], rtol=1e-5)


def test_colours_and_weights_agree_with_each_other():
    out = rendered(stage.params_of(MINI), stage.inputs_of()[0], evidence_of())
    np.testing.assert_allclose(out.weights.sum(-1), out.opacity, rtol=1e-5)
    np.testing.assert_allclose(out.dynamic_weights.sum(-1), out.dynamicness, rtol=1e-5, atol=1e-6)
    assert (out.opacity >= out.dynamicness - 1e-6).all()


def test_a_scene_moved_and_turned_as_a_whole_looks_the_same():
    params, (inputs, _), evidence = stage.params_of(MINI), stage.inputs_of(), evidence_of()
    angle = 0.4
    world = np.eye(4)
    world[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    world[:3, 3] = [0.3, -0.2, 0.5]
    move = lambda c: c._replace(
        camera_from_world=jnp.asarray(np.asarray(c.camera_from_world) @ np.linalg.inv(world), jnp.float32)
    )
    frames = lambda f: f._replace(cameras=move(f.cameras))
    moved = inputs._replace(key=frames(inputs.key), slots=frames(inputs.slots), camera=move(inputs.camera))
    # Directions are those of the reference camera, so nothing depends on the world's axes.
    a, b = rendered(params, inputs, evidence), rendered(params, moved, evidence)
    assert np.mean(np.abs(a.colour - b.colour)) < 2e-3
    np.testing.assert_allclose(a.depth, b.depth, rtol=2e-2)
