"""A view is a pure function of its camera and its time: compiled, mapped, differentiated."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from stage import MINI, PAPER

from zestjax.cameras import Camera
from zestjax.frames.selection import key_frames, neighbours
from zestjax.novel_view import prepare, render_inputs, render_view
from zestjax.testing import quick

CAMERA = jax.tree.map(jnp.asarray, stage.camera(0.1))


@pytest.fixture(scope="module")
def scene():
    """Parameters and a prepared video."""
    params = stage.params_of(MINI)
    return params, prepare(params, stage.video(), system=MINI)


def colour(scene, camera, time, **options):
    return render_view(*scene, camera, time, system=MINI, **options).colour


def close(a, b):
    np.testing.assert_allclose(a, b, atol=2e-5)


@pytest.mark.parametrize("exclude", [(), (4,), (0, 3, 8)])
def test_frames_are_chosen_alike_whether_traced_or_not(exclude):
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(9, 3)).astype(np.float32)
    for time in range(-1, 10):
        target = rng.normal(size=3).astype(np.float32)
        for count in (3, 8, 12):
            known = key_frames(positions, count, target=target, time=time, exclude=exclude)
            found = jax.jit(lambda c, t, n=count: key_frames(positions, n, target=c, time=t, exclude=exclude))
            jax.tree.map(np.testing.assert_array_equal, found(target, time), known)
        around = jax.jit(lambda t: neighbours(9, t, offsets=(-2, -1, 0, 1, 2), exclude=exclude))
        jax.tree.map(
            np.testing.assert_array_equal, around(time), neighbours(9, time, offsets=range(-2, 3), exclude=exclude)
        )


def test_a_compiled_view_is_the_view(scene):
    plain = colour(scene, CAMERA, 3)
    close(jax.jit(lambda camera, time: colour(scene, camera, time))(CAMERA, 3), plain)
    close(jax.jit(colour)(scene, CAMERA, 3), plain)  # the scene may be an argument, too
    close(jax.jit(lambda camera: colour(scene, camera, 3))(CAMERA), plain)


def test_views_are_mapped_over_cameras_and_times(scene):
    cameras = jax.tree.map(lambda *rows: jnp.stack(rows), CAMERA, jax.tree.map(jnp.asarray, stage.camera(-0.15)))
    times = jnp.array([3, 1])
    found = jax.jit(jax.vmap(lambda camera, time: colour(scene, camera, time)))(cameras, times)
    for i in range(2):
        alone = jax.tree.map(lambda x, i=i: x[i], cameras)
        close(found[i], colour(scene, alone, int(times[i])))


def test_what_is_excluded_is_excluded_where_the_camera_is_traced(scene):
    plain = colour(scene, CAMERA, 2, exclude=(2,))
    close(jax.jit(lambda camera: colour(scene, camera, 2, exclude=(2,)))(CAMERA), plain)
    with pytest.raises(ValueError, match="novel_view.render_view: `prepared` is traced"):
        jax.jit(lambda scene: colour(scene, CAMERA, 2, exclude=(2,)))(scene)


def turned(x):
    """`Camera` at x[0] aside, turned by x[1] and x[2]."""
    a, b = jnp.cross(jnp.eye(3), jnp.array([x[1], x[2], 0 * x[1]])), jnp.eye(3)
    pose = jnp.eye(4).at[:3, :3].set(b + a + a @ a / 2).at[0, 3].set(-0.1 - x[0])
    return Camera(jnp.asarray(stage.camera(0.1).intrinsics, pose.dtype), pose)


def test_the_gradient_in_a_pose_matches_a_finite_difference(x64):
    """Of even samples: where guided ones lie is held."""
    to64 = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tree)
    params = to64(stage.params_of(PAPER))
    prepared = prepare(params, stage.video(), system=PAPER)
    wide = dataclasses.replace(PAPER, precision="float64")
    target = jnp.asarray(stage.shot(0.12, 2)[0])
    loss = jax.jit(lambda x: jnp.mean((render_view(params, prepared, turned(x), 2, system=wide).colour - target) ** 2))
    start = jnp.array([0.01, 0.02, -0.01])
    slope = jax.jit(jax.grad(loss))(start)
    assert slope.dtype == jnp.float64 and (slope != 0).all()
    steps = 1e-6 * np.eye(3)
    expected = [(loss(start + step) - loss(start - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(slope, expected, rtol=1e-3, atol=1e-8)


def test_the_gradient_in_a_pose_is_finite_and_leads_towards_the_picture(scene):
    target = colour(scene, turned(jnp.zeros(3)), 2)
    loss = jax.jit(jax.value_and_grad(lambda x: jnp.mean((colour(scene, turned(x), 2) - target) ** 2)))
    away = jnp.array([0.05, 0.0, 0.0])
    value, slope = loss(away)
    assert np.isfinite(slope).all() and slope[0] > 0 and value > 1e-4 and loss(jnp.zeros(3))[0] < 1e-9


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda camera, time: (tuple(camera), time), "`camera` should be a `Camera`, got `tuple`"),
        (lambda camera, time: (jax.tree.map(lambda x: jnp.stack([x, x]), camera), time), "is a batch .*jax.vmap"),
        (lambda camera, time: (camera._replace(camera_from_world=camera.camera_from_world[:3]), time), "0 0 0 1"),
        (lambda camera, time: (camera, time + 0.5), "`time` is a traced float32, expected an integer"),
        (lambda camera, time: (camera, time[None]), r"`time` should be \(\)"),
    ],
)
def test_what_is_traced_is_looked_at_too(scene, change, words):
    with pytest.raises(ValueError, match=f"novel_view.render_view: .*{words}"):
        jax.jit(lambda camera, time: colour(scene, *change(camera, time)))(CAMERA, 2)


@pytest.mark.parametrize("time", [-4, -1, stage.FRAMES, stage.FRAMES + 9])
def test_a_traced_time_outside_the_video_has_no_slots_and_is_finite(scene, time):
    assert np.isfinite(jax.jit(lambda time: colour(scene, CAMERA, time))(time)).all()


@pytest.mark.parametrize("known", [True, False], ids=["known while compiling", "given"])
def test_a_view_compiled_quickly_is_the_view(known):
    """Rows of the sources lie on rows of the target: which one is read must not hang on how sums are rounded."""
    params, (inputs, frames) = stage.params_of(MINI), stage.inputs_of(MINI)
    maps = jax.tree.map(lambda x: x[frames], prepare(params, stage.video(), system=MINI).maps)
    view = lambda inputs: render_inputs(params, inputs, maps, system=MINI)
    fn, args = (lambda: view(inputs), ()) if known else (view, (inputs,))
    compiled = lambda options: jax.jit(fn, compiler_options=options)(*args).colour
    close(compiled(quick()), compiled({"xla_backend_optimization_level": 3}))
