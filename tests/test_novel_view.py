"""Novel views of a prepared video: whole images, whatever their size, and frames that serve nothing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from stage import MINI, PAPER, STILL

from zestjax import novel_view
from zestjax.fields import dynamic
from zestjax.model import predict
from zestjax.novel_view import prepare, render_inputs, render_view
from zestjax.rays import pixel_grid
from zestjax.systems.fields import Place
from zestjax.systems.targets import target_inputs

CAMERA = stage.camera(0.1)


@pytest.fixture(scope="module")
def scene():
    """Parameters and a prepared video."""
    params = stage.params_of(MINI)
    return params, prepare(params, stage.video(), system=MINI)


@pytest.fixture(scope="module")
def view(scene):
    return render_view(*scene, CAMERA, 2, system=MINI)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_a_view_has_the_videos_size_and_its_ranges(view):
    height, width = stage.SIZE
    for image in (view.colour, view.static, view.dynamic):
        assert image.shape == (height, width, 3) and (image >= 0).all() and (image <= 1).all()
    assert view.flow.shape == (height, width, 2) and np.isfinite(view.flow).all()
    assert (view.depth >= stage.NEAR - 1e-3).all() and (view.depth <= stage.FAR + 1e-3).all()
    for share in (view.opacity, view.dynamicness):
        assert share.shape == (height, width) and (share >= 0).all() and (share <= 1 + 1e-5).all()


def test_rows_are_those_of_the_whole_image(scene, view):
    params, prepared = scene
    inputs, frames = stage.inputs_of(MINI)
    maps = jax.tree.map(lambda x: x[frames], prepared.maps)

    def whole(params, inputs, maps):
        return predict(params, inputs, maps, pixel_grid(*stage.SIZE).reshape(-1, 2), system=MINI)

    out = jax.jit(whole)(params, inputs, maps)
    np.testing.assert_allclose(np.clip(out.colour, 0, 1).reshape(view.colour.shape), view.colour, atol=2e-5)
    np.testing.assert_allclose(out.depth.reshape(view.depth.shape), view.depth, rtol=1e-4)


@pytest.mark.parametrize("name, size", [("BLOCK_ROWS", 3), ("BLOCK_ROWS", 16), ("BLOCK_POINTS", 700)])
def test_the_block_size_does_not_matter(scene, view, name, size, monkeypatch):
    params, prepared = scene
    inputs, frames = stage.inputs_of(MINI)
    maps = jax.tree.map(lambda x: x[frames], prepared.maps)
    monkeypatch.setattr(novel_view, name, size)
    render = jax.jit(functools.partial(render_inputs.__wrapped__, system=MINI))
    for a, b in zip(render(params, inputs, maps), view, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


def test_an_excluded_frame_influences_nothing(scene):
    params, _ = scene
    video = stage.video()
    images = video.images.copy()
    images[2] = 1 - images[2]
    away = video.cameras.camera_from_world.copy()
    away[2, 0, 3] += 0.5
    changed = video._replace(images=images, cameras=video.cameras._replace(camera_from_world=away))
    views = [
        render_view(params, prepare(params, v, system=MINI), CAMERA, 2, system=MINI, exclude=(2,))
        for v in (video, changed)
    ]
    assert same(*views)
    free = [render_view(params, prepare(params, v, system=MINI), CAMERA, 2, system=MINI) for v in (video, changed)]
    assert not same(*free) and not same(views[0], free[0])


def test_where_the_frame_of_its_time_is_missing_another_stands_in_for_it(scene, monkeypatch):
    show = lambda: render_view(*scene, CAMERA, 2, system=MINI, exclude=(2,))
    stood = show()
    held = jax.device_get(scene[1])  # as from a file
    assert same(render_view(scene[0], held, CAMERA, 2, system=MINI, exclude=(2,)), stood)
    monkeypatch.setattr(novel_view, "with_stand_in", lambda *_, **__: None)
    assert not same(show(), stood)


def test_what_moves_is_shown_where_a_frame_sees_it_from_the_targets_own_place(scene, monkeypatch):
    """The view of an input's own camera at its own time, and what is left of it without the word of that input."""
    own = jax.tree.map(lambda x: x[2], stage.video().cameras)
    inputs, frames = target_inputs(*stage.video(), own, 2, system=MINI)
    maps = jax.tree.map(lambda x: x[frames], scene[1].maps)
    show = lambda: jax.jit(lambda p: MINI.render(p, MINI.encode(p, inputs, maps), inputs, stage.pixels()).blend)(
        scene[0]
    )
    told = show()
    monkeypatch.setattr(dynamic, "SHOWN", 0.0)
    assert float((told - show()).max()) > 0.2


def test_excluding_nothing_is_no_exclusion(scene, view):
    assert same(render_view(*scene, CAMERA, 2, system=MINI, exclude=()), view)


def test_a_view_is_a_function_of_its_time(scene, view):
    other = render_view(*scene, CAMERA, 3, system=MINI)
    assert not np.array_equal(other.colour, view.colour)


BEHIND = CAMERA._replace(camera_from_world=np.diag([-1.0, 1, -1, 1]).astype(np.float32))


@pytest.mark.parametrize("camera, time", [(CAMERA, stage.FRAMES + 3), (BEHIND, 2)], ids=["no slot", "sees nothing"])
def test_inputs_that_render_view_would_refuse_render_something_finite(scene, camera, time):
    params, prepared = scene
    video = prepared.video
    inputs, frames = target_inputs(video.images, video.cameras, video.near, video.far, camera, time, system=MINI)
    view = render_inputs(params, inputs, jax.tree.map(lambda x: x[frames], prepared.maps), system=MINI)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(view))


def test_bytes_render_as_the_colours_they_show(scene, view):
    video = stage.video()
    quantised = video._replace(images=np.round(video.images * 255).astype(np.uint8))
    shown = render_view(scene[0], prepare(scene[0], quantised, system=MINI), CAMERA, 2, system=MINI)
    assert np.abs(shown.colour - view.colour).mean() < 0.01


@pytest.mark.parametrize("size", [(13, 18), (9, 5), (1, 1)])
def test_images_of_any_size_are_rendered(scene, size):
    video = stage.video(size)
    out = render_view(scene[0], prepare(scene[0], video, system=MINI), stage.camera(0.1, size), 2, system=MINI)
    assert out.colour.shape == (*size, 3) and all(np.isfinite(x).all() for x in jax.tree.leaves(out))


def test_a_system_without_maps_of_frames_renders_too():
    params = stage.params_of(PAPER)
    prepared = prepare(params, stage.video(), system=PAPER)
    assert prepared.footage is None and prepared.maps is None
    inputs, _ = stage.inputs_of(PAPER, exclude=(2,))
    assert 2 not in inputs.key.times
    out = jax.eval_shape(functools.partial(render_inputs, system=PAPER), params, inputs, None)
    assert out.colour.shape == (*stage.SIZE, 3) and out.flow.shape == (*stage.SIZE, 2)


def test_what_is_static_does_not_flow():
    """The flow of an image is that of its dynamic share: without weight in the dynamic field it is 0."""
    rays, samples = 4, 3
    points = jnp.asarray(np.random.default_rng(0).uniform(0.4, 0.6, (rays, samples, 3)), jnp.float32)
    place = Place(MINI.space.frustum(stage.inputs_of(MINI)[0]), "inverse", np.float32(2), np.float32(6))
    world = place.world(points)
    marched = type("Marched", (), dict(coords=points, points=world))
    dynamic = type("Dynamic", (), dict(flow_forward=jnp.full_like(points, 0.1)))
    prediction = lambda share: type(
        "Prediction", (), dict(marched=marched, dynamic=dynamic, dynamic_weights=share * weights, weights=weights)
    )
    weights = jnp.full((rays, samples), 1 / samples)
    flow = lambda share: novel_view._induced_flow(prediction(share), place, CAMERA)
    np.testing.assert_array_equal(flow(0.0), 0)
    assert (flow(1.0)[:, 0] > 0.5).all()


def test_told_that_nothing_moves_the_dynamic_branch_is_not_in_the_program(scene, view):
    params = scene[0]._replace(dynamic=None)
    still = render_view(params, prepare(params, stage.video(), system=STILL), CAMERA, 2, system=STILL)
    assert still.dynamic is None and still.flow is None and not still.dynamicness.any()
    assert same(still.colour, still.static) and np.isfinite(still.colour).all()
    assert still.colour.shape == view.colour.shape
