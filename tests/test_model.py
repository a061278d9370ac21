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

from zestjax import model, prediction
from zestjax.cameras import Camera, project
from zestjax.evidence import FLOW_CHANNELS, Evidence
from zestjax.fields.static import StaticSample
from zestjax.presets import PRESETS, preset
from zestjax.rays import depths_from_fractions


def shapes_of(config):
    return jax.eval_shape(functools.partial(model.init_params, config=config), jax.random.key(0))


def evidence_of(config=MINI, seed=0):
    """Bytes of evidence of K key-frames and M slots."""
    draw = lambda *s: np.random.default_rng(seed).integers(0, 256, s).astype(np.uint8)
    views, planes = config.key_frames + len(config.slots), config.evidence_planes
    return Evidence(*(draw(views, 4, 6, n) for n in (planes, planes, planes, planes, FLOW_CHANNELS, 2, 12)))


def rendered(params, inputs, evidence, config=MINI):
    return stage.forward(config)(params, inputs, evidence, stage.pixels())


def assert_same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def assert_all_finite(tree):
    for leaf in jax.tree.leaves(tree):
        assert np.isfinite(leaf).all()


# Presets and parameters.


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_has_the_parts_it_names(name):
    config, params = PRESETS[name], shapes_of(PRESETS[name])
    assert params.geometry and params.motion and params.static and params.dynamic
    assert (params.analysis is None) == (config.encoder == "pyramid") == (params.static.views is None)
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(params))


@pytest.mark.parametrize(
    "geometry, motion, dynamic",
    [(True, True, True), (True, False, True), (False, True, True), (False, False, True), (False, True, False)],
)
@pytest.mark.parametrize("base", [MINI, PAPER], ids=["mini", "paper"])
def test_every_ablation_traces_and_lacks_what_it_switches_off(base, geometry, motion, dynamic):
    config = dataclasses.replace(base, geometry=geometry, motion=motion, dynamic=dynamic)
    params = shapes_of(config)
    assert (params.geometry is not None) == geometry and (params.dynamic is not None) == dynamic
    assert (params.motion is not None) == (motion and dynamic)
    used = config.encoder == "frames" and (geometry or (motion and dynamic))
    assert (params.analysis is not None) == used
    inputs, evidence = stage.inputs_of(config)[0], evidence_of(config) if used else None
    out = jax.eval_shape(functools.partial(stage.rays, config=config), params, inputs, evidence, stage.pixels())
    assert out.colour.shape == (64, 3) and out.depth.shape == (64,) and (out.dynamic is None) == (not dynamic)


def test_the_papers_preset_has_the_papers_shapes():
    config = PRESETS["paper"]
    params = shapes_of(config)
    assert params.geometry.regulariser.stem.conv.kernel.shape[-2] == 32 + 3 * 8
    assert params.motion.regulariser.stem.conv.kernel.shape[-2] == 32 + 3 * 4
    assert [k.kernel.shape for k in params.static.trunk.layers] == [(63, 256), *[(256, 256)] * 4, (319, 256)] + [
        (256, 256)
    ] * 2
    assert params.dynamic.trunk.layers[0].kernel.shape == (84, 256)
    assert params.static.trunk.condition.kernel.shape == (8 + 4 * 8, 256)
    assert params.static.colour.hidden.kernel.shape == (256 + 27, 128)

    frames = lambda n: model.Frames(spec(n, 288, 512, 3), Camera(spec(n, 3, 3), spec(n, 4, 4)), spec(n), spec(n))
    spec = lambda *s: jax.ShapeDtypeStruct(s, jnp.float32)
    inputs = model.Inputs(frames(8), frames(4), Camera(spec(3, 3), spec(4, 4)), *[spec()] * 4)
    encode = functools.partial(model.encode, config=config)
    encoding = jax.eval_shape(lambda p, i: encode(p, i, None)[:4], params, inputs)
    assert encoding[0].cells.shape == encoding[1].cells.shape == (128, 72, 128, 8)
    out = jax.eval_shape(functools.partial(stage.rays, config=config), params, inputs, None, spec(100, 2))
    assert out.weights.shape == (100, 128) and out.dynamic.flow_forward.shape == (100, 128, 3)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (dict(head="direct"), "do not fit"), (dict(encoder="pyramid"), "do not fit"),
        (dict(conditioning="concatenated"), "do not fit"), (dict(reference="key_frame"), "guided sampling"),
        (dict(planes=1), "at least 2"), (dict(spacing="log"), "spacing"),
    ],
)  # fmt: skip
def test_choices_that_do_not_fit_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        preset("small", **wrong)
    with pytest.raises(ValueError, match="small"):
        preset("large")


# What is off is not in the program.


def program(config):
    params = stage.params_of(config)
    inputs = stage.inputs_of(config)[0]
    evidence = evidence_of(config) if params.analysis is not None else None
    return stage.operations(functools.partial(stage.rays, config=config), params, inputs, evidence, stage.pixels())


def test_a_static_scene_has_neither_a_dynamic_field_nor_a_motion_volume_in_its_program():
    whole, still = program(MINI), program(STILL)
    without = program(dataclasses.replace(MINI, motion=False))
    for name in ("conv_general_dilated", "scan", "gather"):  # the motion volume's
        assert still[name] == without[name] < whole[name]
    assert still["dot_general"] < without["dot_general"] < whole["dot_general"]
    assert (
        whole["scan"] - 1 == 2 * (still["scan"] - 1) > 0
    )  # each volume is one sweep; one looks for the frames' ground


def test_slots_are_not_read_by_a_static_scene():
    inputs, params = stage.inputs_of(STILL)[0], stage.params_of(STILL)
    changed = inputs._replace(slots=jax.tree.map(lambda x: x + 1, inputs.slots))
    evidence = evidence_of()
    assert_same(rendered(params, inputs, evidence, STILL), rendered(params, changed, evidence, STILL))


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


def blind(inputs):
    """Inputs whose source cameras all look away from the target's view."""
    away = np.diag([-1.0, 1, -1, 1]).astype(np.float32)
    turn = lambda f: f._replace(
        cameras=f.cameras._replace(camera_from_world=away @ np.asarray(f.cameras.camera_from_world))
    )
    return inputs._replace(key=turn(inputs.key), slots=turn(inputs.slots))


def without_frames(inputs):
    none = lambda f: f._replace(valid=np.zeros_like(f.valid))
    return inputs._replace(key=none(inputs.key), slots=none(inputs.slots))


def filled(value):
    def fill(inputs):
        paint = lambda f: f._replace(images=jnp.full_like(f.images, value))
        return inputs._replace(key=paint(inputs.key), slots=paint(inputs.slots))

    return fill


def identical(inputs):
    same = lambda f: f._replace(
        images=jnp.broadcast_to(f.images[:1], f.images.shape),
        cameras=jax.tree.map(lambda x: np.repeat(x[:1], len(x), 0), f.cameras),
    )
    return inputs._replace(
        key=same(inputs.key),
        slots=same(inputs.slots),
        camera=jax.tree.map(lambda x: jnp.asarray(x[0]), inputs.key.cameras),
    )


def far_away(inputs):
    """The planes reach so far that the one past the last lies behind the camera, or at infinity."""
    return inputs._replace(near=np.float32(1e-3), far=np.float32(1e5))


EXTREMES = [lambda i: i, blind, without_frames, filled(0.0), filled(1.0), identical, far_away]
NAMES = ["plain", "blind", "no frames", "black", "white", "identical", "far"]


@pytest.mark.parametrize("change", EXTREMES, ids=NAMES)
@pytest.mark.parametrize("config", [MINI, STILL, PAPER], ids=["mini", "still", "paper"])
def test_renders_are_finite_and_bounded_whatever_the_frames(config, change):
    params, (inputs, _) = stage.params_of(config), stage.inputs_of(config)
    evidence = evidence_of(config) if params.analysis is not None else None
    out = rendered(params, change(inputs), evidence, config)
    assert_all_finite(out)
    for share in (out.colour, out.static_colour, out.dynamicness):
        assert (share > -1e-4).all() and (share < 1 + 1e-3).all()
    assert (out.opacity >= 0).all() and (out.opacity < 4 / 3 + 1e-3).all()  # of two fields that share their samples


@pytest.mark.parametrize("opacity", [0.0, 0.3, 1.0, 4 / 3])
def test_a_filled_ray_shows_a_mean_of_colours(opacity):
    colour, behind = opacity * jnp.asarray([[0.2, 0.5, 1.0]]), jnp.asarray([[1.0, 0.5, 0.2]])
    share = min(opacity, 1)
    found = prediction.filled(colour, jnp.full((1,), opacity), behind)
    np.testing.assert_allclose(found, share * np.array([[0.2, 0.5, 1.0]]) + (1 - share) * behind, rtol=1e-5)


def test_half_an_infinite_plane_is_held_at_a_finite_distance():
    config = dataclasses.replace(STILL, geometry=False, planes=3, samples=1)
    inputs = stage.inputs_of(config)[0]._replace(near=np.float32(1.0), far=np.float32(2.0))
    encoding = stage.encoded(None, inputs, None, config)
    one = depths_from_fractions(jnp.float32(1), inputs.near, 1.5 * inputs.far, spacing="inverse")
    assert one == 3
    marched = prediction.march(encoding, inputs.camera, inputs.near, inputs.far, jnp.zeros((1, 2)), config=config)
    assert_all_finite(marched)
    # 1 / depth is 0 one plane past the middle sample where 2 far / near = 2 (planes - 1) = 4.
    marched = prediction.march(
        encoding, inputs.camera, jnp.float32(1), jnp.float32(4 / 3), jnp.zeros((1, 2)), config=config
    )
    assert_all_finite(marched)


@pytest.fixture(params=["depth", "inverse"])
def jittered(request):
    """Compiled: places in the strata -> `Marched` of five samples a ray; the configuration; the inputs; the pixels."""
    config = dataclasses.replace(STILL, geometry=False, samples=5, spacing=request.param)
    inputs = stage.inputs_of(config)[0]
    encoding, pixels = stage.encoded(None, inputs, None, config), stage.pixels()
    run = lambda jitter: prediction.march(
        encoding, inputs.camera, inputs.near, inputs.far, pixels, config=config, jitter=jitter
    )
    return jax.jit(run), config, inputs, pixels, encoding


def test_jittered_samples_are_each_in_its_stratum(jittered):
    run, config, _, pixels, _ = jittered
    draw = lambda key: jax.random.uniform(jax.random.key(key), (len(pixels), 5))
    found = [jax.tree.map(lambda x: np.asarray(x, np.float64), run(draw(key))) for key in (0, 1, 0)]
    even = (lambda d: d) if config.spacing == "depth" else (lambda d: 1 / d)
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
    run, config, inputs, pixels, encoding = jittered
    same = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    jax.tree.map(same, run(jnp.full((len(pixels), 5), 0.5)), run(None))
    even = (lambda d: d) if config.spacing == "depth" else (lambda d: 1 / d)
    draws = [np.random.default_rng(key).uniform(size=(len(pixels), 5)).astype(np.float32) for key in range(20)]
    mean = np.mean([even(np.asarray(run(draw).depths, np.float64)) for draw in draws], (0, 1))
    width = abs(even(stage.FAR) - even(stage.NEAR)) / 5
    regular = even(np.asarray(run(None).depths, np.float64)[0])
    assert (abs(mean - regular) < 5 * width / np.sqrt(12 * 20 * len(pixels))).all()
    params = stage.params_of(config)
    rendered = jax.jit(
        lambda jitter: prediction.render_rays(params, encoding, inputs, pixels, config=config, jitter=jitter).marched
    )
    np.testing.assert_allclose(rendered(draws[0]).depths, run(draws[0]).depths, rtol=1e-6)


# Parts.


@pytest.mark.parametrize("size", [1, 2, 5, 9, 13, 16])
def test_maps_grow_to_where_their_cells_are(size):
    cells = model.cells_of(size)
    for factor, count in ((4, cells), (2, 2 * cells)):
        ramp = jnp.broadcast_to(jnp.arange(count, dtype=jnp.float32)[None, :, None], (1, count, count))
        grown = model._grown(ramp, (size, size), factor=factor)
        expected = np.clip((np.arange(size) - (factor - 1) / 2) / factor, 0, count - 1)
        np.testing.assert_allclose(grown[0, :, 0], expected, atol=1e-5)


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
        prediction.guided_coordinates(guides, pixels), guided_by_loop(guides, pixels), rtol=1e-5, atol=1e-6
    )


def test_guided_coordinates_match_finite_differences(x64):
    pixels = uniform(1, 5, 2, low=2, high=12, dtype=jnp.float64)
    assert_grads_match(prediction.guided_coordinates, uniform(0, 2, 4, 6, dtype=jnp.float64), pixels)


@pytest.mark.parametrize("config", [MINI, PAPER], ids=["guided", "regular"])
def test_samples_lie_on_their_rays_between_the_bounds(config):
    params, (inputs, _) = stage.params_of(config), stage.inputs_of(config)
    out = rendered(params, inputs, evidence_of(config) if params.analysis is not None else None, config)
    marched = out.marched
    assert (np.diff(marched.depths) >= 0).all()
    assert marched.depths.min() >= stage.NEAR - 1e-4 and marched.depths.max() <= stage.FAR + 1e-4
    shown = jax.tree.map(np.asarray, project(inputs.camera, marched.points))
    np.testing.assert_allclose(shown.pixels, np.broadcast_to(stage.pixels()[:, None], shown.pixels.shape), atol=1e-3)
    np.testing.assert_allclose(shown.depth, marched.depths, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(marched.directions, axis=-1), 1, rtol=1e-5)
    if config is PAPER:
        spread = np.linalg.norm(marched.points[:, -1] - marched.points[:, 0], axis=-1) * 4 / 3
        np.testing.assert_allclose(marched.lengths.sum(-1), spread, rtol=1e-4)


def test_a_ray_that_sees_nothing_shows_its_samples_by_density():
    sample = lambda density: StaticSample(density, jnp.asarray([[[1.0, 0, 0], [0, 0, 1]]]), density, density)
    np.testing.assert_allclose(prediction.last_resort(sample(jnp.zeros((1, 2)))), [[0.5, 0, 0.5]])
    np.testing.assert_allclose(prediction.last_resort(sample(jnp.asarray([[3.0, 1]]))), [[0.75, 0, 0.25]], rtol=1e-5)


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
