"""What is compiled once stays compiled: another camera, time, frame or step needs no new program."""

import jax
import jax.numpy as jnp
import pytest
import stage
from stage import MINI

from zestjax import novel_view
from zestjax.train.batches import batch_from_clip, prepare_clip


@pytest.fixture
def compiled(caplog):
    """Names of the programs compiled so far."""
    told = lambda: [record.getMessage() for record in caplog.records if "Compiling" in record.getMessage()]
    with jax.log_compiles(True):
        jax.jit(lambda x: x + 1)(1.0)
        assert told(), "jax does not say what it compiles"
        yield told


def test_other_cameras_times_and_frames_are_rendered_by_the_same_programs(compiled):
    params = stage.params_of(MINI)
    scene = novel_view.prepare(params, stage.video(), system=MINI)
    view = lambda x, time, exclude: novel_view.render_view(
        params, scene, jax.tree.map(jnp.asarray, stage.camera(x)), time, system=MINI, exclude=exclude
    )
    for exclude in ((), (2,)):
        view(0.1, 2, exclude)
    before = len(compiled())
    for time in (0, 3, 5):
        view(0.02 * time - 0.1, time, ())
        view(0.02 * time - 0.1, time, (time,))
    assert compiled()[before:] == []


def test_another_video_of_that_size_is_prepared_by_the_same_programs(compiled):
    params, video = stage.params_of(MINI), stage.video()
    novel_view.prepare(params, video, system=MINI)
    before = len(compiled())
    novel_view.prepare(params, video._replace(images=1 - video.images, near=video.near / 2), system=MINI)
    assert compiled()[before:] == []


def test_every_target_of_every_clip_is_learned_from_by_one_program(compiled):
    recipe = stage.recipe_of(MINI)
    prepared = [prepare_clip(jax.random.key(i), stage.clip(), MINI) for i in range(2)]
    init, step = recipe.trainer(steps=9)
    step, params = jax.jit(step), stage.params_of(MINI)
    state = init(params)
    params, state, _ = step(params, state, batch_from_clip(jax.random.key(0), prepared[0], recipe))
    before = len(compiled())
    for number in range(1, 6):
        batch = batch_from_clip(jax.random.key(number), prepared[number % 2], recipe, step=number)
        params, state, _ = step(params, state, batch)
    assert compiled()[before:] == []
