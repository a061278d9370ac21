"""Encoding volumes: what the frames' own depths vote, and what a sweep makes of the frames that may be trusted."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import assert_grads_match, uniform

from zestjax import encoding
from zestjax.cameras import resized
from zestjax.encoding import SweepViews, encode_volume, init_volume
from zestjax.planesweep import homographies, plane_depths, sweep_grid

D, V, SIZE = 4, 3, (4, 6)
DEPTHS = plane_depths(jnp.float32(1.5), jnp.float32(6), D, spacing="inverse")


def quarter(camera):
    return resized(jax.tree.map(jnp.asarray, camera), 0.25, 0.25)


REFERENCE = stage.camera(0.1)
SOURCES = stage.cameras([0.0, 0.2, -0.3])
TIMES = np.float32([-1, 0, 1])


def votes_by_loop(samples, shares, depths):
    out = np.zeros((4, *samples.shape[:-1]))
    for cell in np.ndindex(samples.shape[:-1]):
        moving, surface, tolerance = samples[cell].astype(np.float64)
        if tolerance > 0:
            point = 1 / (shares[cell] * depths[cell[0]])
            through = min(max((point - surface) / tolerance / 3, 0), 1) ** 2
            out[(slice(None), *cell)] = 1, moving, np.exp(-(((surface - point) / tolerance) ** 2)), through
    return out


def planes_and_samples():
    hom = homographies(quarter(REFERENCE), quarter(SOURCES), DEPTHS)
    samples = np.array(uniform(0, D, *SIZE, V, 3, low=0.05, high=0.8))
    samples[:, :2, 3:, 1] = 0  # not seen
    return hom, samples


def test_votes_are_those_of_a_loop():
    hom, samples = planes_and_samples()
    found = jax.jit(encoding.cell_votes)(samples, hom, sweep_grid(*SIZE), DEPTHS)
    # Cameras side by side see a point at the same depth.
    expected = votes_by_loop(samples, np.ones(samples.shape[:-1]), np.asarray(DEPTHS, np.float64))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4)


def counted(samples):
    hom = homographies(quarter(REFERENCE), quarter(SOURCES), DEPTHS)
    wide = lambda x: jnp.asarray(x, samples.dtype)
    votes = encoding.cell_votes(samples, wide(hom), wide(sweep_grid(*SIZE)), wide(DEPTHS))
    return encoding._geometry_votes(votes), encoding._motion_votes(votes, wide(TIMES))


def test_votes_match_finite_differences(x64):
    samples = np.asarray(uniform(0, D, *SIZE, V, 3, low=0.1, high=0.8, dtype=jnp.float64))
    assert_grads_match(counted, jnp.asarray(samples), step=1e-7)


@pytest.mark.parametrize("tolerance", [0.0, 1e-6, 1.0])
@pytest.mark.parametrize("surface", [0.0, 0.25, 10.0])
def test_votes_are_finite_and_bounded(surface, tolerance):
    samples = jnp.broadcast_to(jnp.asarray([1.0, surface, tolerance]), (D, *SIZE, V, 3))
    (still, vote), (moving, motion_vote) = jax.jit(counted)(samples)
    for share in (still, moving):
        assert (share >= 0).all() and (share <= 1).all()
    for logit in (vote, motion_vote):
        assert np.isfinite(logit).all() and (np.abs(logit) <= encoding.VOTE_GAIN + 1e-5).all()
    assert vote.shape == motion_vote.shape == (D, *SIZE)


OPTIONS = {
    "geometry": dict(colours="mean", trusted=True, motion_votes=False),
    "motion": dict(colours="mean", trusted=True, motion_votes=True),
    "paper": dict(colours="all", trusted=False, motion_votes=False),
}
FEATURES = {"geometry": 0, "motion": 0, "paper": 4}


@functools.cache
def volume(kind):
    """Parameters, and the compiled volume of tables with the gradient of its sum."""
    options, paper = OPTIONS[kind], kind == "paper"
    make = lambda key: init_volume(
        key, features=FEATURES[kind], views=V, widths=(4, 8), pyramid_widths=(2, 2, 4) if paper else None,
        occupied=not paper, **options,
    )  # fmt: skip
    params = jax.jit(make)(jax.random.key(0))
    views = lambda tables, valid: SweepViews(tables, quarter(SOURCES), valid, jnp.asarray(TIMES))
    run = lambda params, tables, valid: encode_volume(
        params, views(tables, valid), quarter(REFERENCE), SIZE, DEPTHS, **options
    )
    total = lambda *args: jnp.sum(run(*args).cells ** 2)
    return params, jax.jit(lambda *args: (run(*args), jax.grad(total, argnums=(0, 1))(*args)))


def tables_of(kind, seed=0):
    channels = 4 + 3 if kind == "paper" else encoding.CELL_COLOURS + 3
    tables = np.array(uniform(seed, V, *SIZE, channels, low=0.1, high=0.9))
    return jnp.asarray(tables)


@pytest.mark.parametrize("kind", list(OPTIONS))
def test_volumes_have_their_shapes(kind):
    params, run = volume(kind)
    assert (params.pyramid is None) == (params.occupied is not None)
    out, _ = run(params, tables_of(kind), jnp.ones(V))
    assert out.cells.shape == (D, *SIZE, 4 + (out.logits is not None))
    if out.logits is not None:
        np.testing.assert_allclose(out.cells[..., -1].sum(0), 1, rtol=1e-5)
        np.testing.assert_allclose(out.cells[..., -1], jax.nn.softmax(out.logits, axis=0), rtol=1e-6)


@pytest.mark.parametrize("kind", list(OPTIONS))
def test_a_view_that_is_not_valid_influences_nothing(kind):
    params, run = volume(kind)
    valid = jnp.asarray([1.0, 0, 1])
    changed = tables_of(kind).at[1].set(tables_of(kind, seed=9)[1])
    ours, theirs = run(params, tables_of(kind), valid), run(params, changed, valid)
    jax.tree.map(np.testing.assert_array_equal, ours[0], theirs[0])
    np.testing.assert_array_equal(ours[1][1][1], 0)
    assert not np.array_equal(run(params, changed, jnp.ones(V))[0].cells, ours[0].cells)


@pytest.mark.parametrize("kind", list(OPTIONS))
@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("valid", [0.0, 1.0])
def test_volumes_of_nothing_or_of_constants_are_finite_with_finite_gradients(kind, level, valid):
    params, run = volume(kind)
    tables = jnp.full_like(tables_of(kind), level)
    if OPTIONS[kind]["trusted"]:
        tables = tables.at[..., -1].set(max(level, 1e-3))
    for leaf in jax.tree.leaves(run(params, tables, jnp.full(V, valid))):
        assert np.isfinite(leaf).all()


def test_surfaces_that_the_frames_agree_on_are_found_before_anything_is_learned():
    params, run = volume("geometry")
    params = jax.tree.map(jnp.zeros_like, params)
    tables = tables_of("geometry")
    plane = 2
    tables = tables.at[..., -3].set(0.0).at[..., -2].set(1 / DEPTHS[plane]).at[..., -1].set(0.03)
    out, _ = run(params, tables, jnp.ones(V))
    assert (out.logits.argmax(0) == plane).all()
    moving, _ = volume("motion")[1](jax.tree.map(jnp.zeros_like, volume("motion")[0]), tables, jnp.ones(V))
    assert (moving.logits[plane] <= 0).all()  # nothing moves there
