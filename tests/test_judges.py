"""Fine-tuning is judged by frames that it did not learn from."""

import types

import jax
import numpy as np
import pytest
import stage
from stage import MINI

from zestjax import novel_view
from zestjax.apps.finetune import Verdict, judged, judging_frames
from zestjax.apps.own_frames import known_of, own_frame_batches
from zestjax.io.scenes import Scene


def filmed(places):
    """The stage's `Video` of more frames, from these places."""
    images = np.stack([stage.shot(x, t / 2)[0] for t, x in enumerate(places)]).astype(np.float32)
    return stage.video()._replace(images=images, cameras=stage.cameras(places))


def test_those_that_stand_apart_judge():
    still = np.zeros((9, *stage.SIZE), bool)
    places = [0.0, 0.12, 0.23, 0.31, 0.39, 0.47, 0.55, 0.63, 1.5]
    assert judging_frames(filmed(places), still, ()) == (0, 8)  # 0.12 and 0.87 from the next one
    assert judging_frames(filmed(places), still, (0,)) == (1, 8)
    assert judging_frames(filmed(places), still, (0, 1)) == ()


def test_a_frame_in_which_everything_moves_cannot_judge():
    moving = np.zeros((10, *stage.SIZE), bool)
    moving[9] = True
    places = [*np.linspace(0, 0.5, 9), 2.0]
    assert 9 not in judging_frames(filmed(places), moving, ()) != ()
    assert judging_frames(filmed(places), np.ones_like(moving), ()) == ()


def test_judges_are_no_targets_but_serve():
    known = known_of(Scene("stage", filmed(np.linspace(0, 0.5, 9)), ()))
    batch_at = own_frame_batches(known, stage.recipe_of(MINI), seed=0, kept=(2, 5))
    batches = [batch_at(step) for step in range(0, 32, 4)]
    assert not {2, 5} & {int(batch.inputs.time) for batch in batches}
    assert any(2 in np.asarray(batch.inputs.key.times) for batch in batches)


@pytest.mark.parametrize("before, after, worse", [(30.0, 30.1, False), (30.0, 29.9, True), (30.0, float("nan"), True)])
def test_a_verdict_says_what_is_kept(before, after, worse):
    verdict = Verdict((0, 7), before, after)
    assert verdict.worse == worse and verdict.told["kept"] == ("start" if worse else "trained")
    assert ("the start's weights are kept" in str(verdict)) == worse and "frames 0 and 7" in str(verdict)


def test_parameters_that_are_worse_lose():
    video, params = stage.video(), stage.params_of(MINI)
    scene = novel_view.prepare(params, video, system=MINI)
    moving = np.zeros(video.images.shape[:3], bool)
    moving[1, :8] = True
    spoilt = jax.tree.map(lambda x: np.full_like(x, 0.5), params)
    model = types.SimpleNamespace(params=params, system=MINI)
    same = judged(model, params, scene, moving, (1, 4), ())
    assert same.before == same.after and not same.worse
    found = judged(model, spoilt._replace(analysis=params.analysis), scene, moving, (1, 4), ())
    assert found.before == same.before != found.after
    errors = []
    for i in (1, 4):
        camera = jax.tree.map(lambda x, i=i: jax.numpy.asarray(x[i]), video.cameras)
        shown = novel_view.render_view(params, scene, camera, i, system=MINI, exclude=(i,)).static
        errors.append(np.square(np.asarray(shown) - video.images[i]).mean(-1)[~moving[i]])
    assert same.before == pytest.approx(-10 * np.log10(np.concatenate(errors).mean()), abs=1e-4)
