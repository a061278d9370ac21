"""A step's batch is a function of (seed, step): the sliding window of clips, and the loop over pure steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.train import training
from zestjax.train.training import TrainState


def toy_step(params, opt_state, batch):
    """Gradient descent with momentum on |params - batch|^2."""
    grads = jax.tree.map(lambda p: p - batch, params)
    opt_state = jax.tree.map(lambda m, g: 0.9 * m + g, opt_state, grads)
    params = jax.tree.map(lambda p, m: p - 0.1 * m, params, opt_state)
    return params, opt_state, {"loss": jnp.sum(grads["w"] ** 2), "terms": {"rec": batch.sum()}}


def toy_state():
    return TrainState({"w": jnp.zeros(3, jnp.float32)}, {"w": jnp.zeros(3, jnp.float32)}, 0)


def toy_batch(step):
    return jax.random.normal(training.batch_key(step, seed=7), (3,))


@pytest.mark.parametrize("step", [0, 3, 4, 63, 64, 1000])
def test_the_window_holds_the_newest_clips(step):
    live = training.clip_window(step, window=16, steps_per_clip=4)
    assert live.stop == step // 4 + 1 and len(live) == min(16, step // 4 + 1)


def test_every_step_draws_from_its_window_and_the_draw_is_even():
    options = {"window": 8, "steps_per_clip": 2}
    offsets = []
    for step in range(100, 1100):
        index, live = training.clip_index(step, seed=1, **options), training.clip_window(step, **options)
        assert index in live
        offsets.append(live.stop - 1 - index)
    assert np.bincount(offsets, minlength=8).min() > 80


def test_the_draw_depends_on_seed_and_step_alone():
    draw = lambda seed: [training.clip_index(n, seed=seed, window=16, steps_per_clip=1) for n in range(20, 60)]
    assert draw(0) == draw(0) != draw(1)
    another = [training.clip_index(n, seed=0, window=16, steps_per_clip=1, draw=1) for n in range(20, 60)]
    assert another != draw(0)  # a step may see several


def test_a_limited_number_of_clips_is_used_again():
    seen = {training.clip_index(n, seed=0, window=16, steps_per_clip=1, count=5) for n in range(200)}
    assert seen == set(range(5))


def test_keys_differ_from_step_to_step():
    keys = {tuple(np.asarray(jax.random.key_data(training.batch_key(n, seed=0)))) for n in range(50)}
    assert len(keys) == 50


def test_a_run_split_in_two_ends_where_the_whole_one_does():
    whole = list(training.training_steps(toy_step, toy_state(), toy_batch, steps=9))
    half = list(training.training_steps(toy_step, toy_state(), toy_batch, steps=4))[-1][0]
    rest = list(training.training_steps(toy_step, half, toy_batch, steps=9))
    assert [state.step for state, _ in whole] == list(range(1, 10)) and len(rest) == 5
    np.testing.assert_array_equal(rest[-1][0].params["w"], whole[-1][0].params["w"])
    assert whole[-1][1].keys() == {"loss", "terms.rec"}


def test_a_finished_run_takes_no_step_and_asks_for_no_batch():
    def refuse(step):
        raise AssertionError("asked for a batch")

    state = toy_state()._replace(step=5)
    assert list(training.training_steps(toy_step, state, refuse, steps=5)) == []


def test_the_report_names_scalars_by_their_path_and_leaves_arrays_out():
    info = {"a": jnp.float32(1), "b": {"c": jnp.float32(2)}, "image": jnp.zeros((2, 2))}
    assert training.scalars(info) == {"a": 1.0, "b.c": 2.0}
    assert training.scalars(jnp.float32(3)) == {"total": 3.0}
