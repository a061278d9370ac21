"""Weights of frames that were not yet followed along the flow: the net sees and says what it did."""

import jax
import jax.numpy as jnp
import numpy as np
from oracles import normal, uniform

from zestjax.apps.earlier import with_paths
from zestjax.frames import analysis
from zestjax.frames.evidence import FLOW_CHANNELS, Evidence

PLANES, WIDE = 6, 4
MIX, KERNEL, BIAS = (f".analysis.net.{name}" for name in ("mix.conv.kernel", "head.kernel", "head.bias"))
BEFORE = ("static", "best", "still", "around static", "around best", "around still", "moving", "around moving")


def earlier():
    """Arrays of a net as it was: four costs of a plane, each seen by itself, and eight believed."""
    channels, out = 4 * PLANES + 2 * 8 + 4 + FLOW_CHANNELS + 2 + 12, 2 * PLANES + 8 + 2 + 4
    return {
        MIX: np.asarray(normal(0, 1, 1, channels, WIDE)),
        KERNEL: np.asarray(normal(1, 1, 1, WIDE, out)),
        BIAS: np.asarray(normal(2, out)),
        ".static.net.mix.conv.kernel": np.ones((1, 1, channels, 2), np.float32),
    }


def costs():
    """Today's (12, 1, h, w, E), and those of before, of which none is a path's."""
    found = np.asarray(uniform(3, analysis.COSTS, 1, 3, 5, PLANES))
    names = ["static", "best", "still", "still along"]
    names = [*names, *(f"around {name}" for name in names), "moving", "moving along"]
    names = [*names, "around moving", "around moving along"]
    return found, found[[names.index(name) for name in BEFORE]]


def channels_before(evidence, costs, ground, still):
    planes = np.linspace(-1, 1, PLANES, dtype=np.float32)
    least = [2 * cost.min(-1) - 1 for cost in costs] + [planes[cost.argmin(-1)] for cost in costs]
    summaries = np.stack([*least, *(2 * ground - 1), *(2 * still - 1)], -1)
    alone = [2 * costs[i] - 1 for i in (0, 1, 2, 6)]
    rest = [8 * evidence.flow - 4, 2 * evidence.sure - 1, 2 * evidence.colours - 1]
    return np.concatenate([*alone, summaries, *rest], -1)


def test_a_net_sees_what_it_saw():
    arrays, (today, before) = earlier(), costs()
    draw = lambda seed, n: np.asarray(uniform(seed, 1, 3, 5, n))
    evidence = Evidence(*(None,) * 6, draw(4, FLOW_CHANNELS), draw(5, 2), draw(6, 12))
    ground, still = (np.asarray(uniform(seed, 2, 1, 3, 5)) for seed in (7, 8))
    seen = analysis._channels(evidence, jnp.asarray(today), jnp.asarray(ground), jnp.asarray(still))
    found = np.asarray(seen) @ with_paths(arrays)[MIX][0, 0]
    expected = channels_before(evidence, before, ground, still) @ arrays[MIX][0, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_a_net_says_what_it_said_and_of_paths_what_is_said_before_anything_is_learned():
    arrays = earlier()
    renewed = with_paths(arrays)
    cuts = np.cumsum([PLANES, PLANES, analysis.COSTS, 1, 1])
    for name in (KERNEL, BIAS):
        now, before = np.split(renewed[name], cuts, -1), np.split(arrays[name], [*cuts[:2], *(cuts[2:] - 4)], -1)
        for i in (0, 1, 3, 4, 5):
            np.testing.assert_array_equal(now[i], before[i])
        np.testing.assert_array_equal(now[2][..., [0, 1, 2, 4, 5, 6, 8, 10]], before[2])
        assert not now[2][..., [3, 7, 9, 11]].any()


def test_what_is_todays_and_what_is_not_of_frames_stays_what_it_is():
    arrays = earlier()
    renewed = with_paths(arrays)
    assert set(renewed) == set(arrays)
    np.testing.assert_array_equal(renewed[".static.net.mix.conv.kernel"], arrays[".static.net.mix.conv.kernel"])
    again = with_paths(renewed)
    params = jax.eval_shape(lambda: analysis.init_analysis(jax.random.key(0), planes=PLANES, widths=(WIDE, WIDE)))
    assert again[MIX].shape == params.net.mix.conv.kernel.shape and again[BIAS].shape == params.net.head.bias.shape
    for name in arrays:
        np.testing.assert_array_equal(again[name], renewed[name])


def test_arrays_of_anything_are_no_reason_to_fail():
    for odd in ({MIX: np.zeros((1, 1, 7, 2))}, {MIX: np.zeros((1, 1, 50, 2)), BIAS: np.zeros(14), KERNEL: np.zeros(3)}):
        assert set(with_paths(odd)) == set(odd)
