"""What each loss measures on a block of rays, and that what is missing counts in nothing."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from oracles import weights_by_loop
from stage import PAPER

from zestjax.base.parts import part
from zestjax.fields.conditioning import SourceViews
from zestjax.fields.dynamic import DynamicSample
from zestjax.frames.selection import Slots
from zestjax.losses.objective import PAPER_WEIGHTS, measured
from zestjax.systems import presets
from zestjax.systems.fields import Seen
from zestjax.systems.sampling import march
from zestjax.systems.system import Params, Prediction, Scene
from zestjax.train import measures
from zestjax.train.measures import make_measures, slot_valid, slots_about, warped

ALL = PAPER_WEIGHTS | dict(static_rec=1.0, mask=1.0, flow3d=1.0)


@functools.cache
def measure(system=PAPER, chain=False):
    """Compiled: (params, inputs, evidence, truth) -> every term, the prediction, and the paths followed."""

    def run(params, inputs, evidence, truth):
        scene = stage.encoded(params, inputs, evidence, system)
        prediction = system.render(params, scene, inputs, truth.pixels)
        terms = make_measures(system, params, scene, inputs, chain=chain)
        paths = warped(system, params, scene, inputs, prediction, chain=chain)
        return measured(terms, prediction, truth, ALL), prediction, paths

    return jax.jit(run)


def case(system=PAPER):
    """Arguments of `measure`, for every third ray."""
    batch = stage.batch(system)
    truth = jax.tree.map(lambda x: x[::3], batch.truth)._replace(jitter=None)
    return stage.params_of(system), batch.inputs, batch.evidence, truth


@pytest.fixture(scope="module")
def found():
    return jax.tree.map(lambda x: np.asarray(x, np.float64), measure()(*case()))


def test_a_slot_is_known_by_its_time_and_validity():
    slots = slots_about(stage.inputs_of(time=5)[0])
    assert [float(slot_valid(slots, k)) for k in (-1, 0, 1, 2)] == [1, 1, 0, 0]
    slots = slots_about(stage.inputs_of(time=0)[0])
    assert [float(slot_valid(slots, k)) for k in (-1, 0, 1)] == [0, 1, 1]


def test_all_terms_are_finite_and_not_negative(found):
    terms = found[0]
    assert terms.keys() == ALL.keys()
    for name, term in terms.items():
        assert np.isfinite(term) and term >= 0, name


def test_colour_terms_are_their_means(found):
    terms, shown, _ = found
    truth = case()[3]
    np.testing.assert_allclose(terms["rec"], np.mean((shown.colour - truth.colour) ** 2), rtol=1e-4)
    static = np.mean((shown.static_colour - truth.static) ** 2, -1)
    np.testing.assert_allclose(terms["static_rec"], np.average(static, weights=truth.static_valid), rtol=1e-4)
    share = 1e-3 + (1 - 2e-3) * shown.dynamicness
    entropy = -(truth.moving * np.log(share) + (1 - truth.moving) * np.log(1 - share))
    np.testing.assert_allclose(terms["mask"], entropy.mean(), rtol=1e-4)


def test_the_photometric_term_compares_each_neighbours_warped_colour(found):
    terms, _, paths = found
    each = paths.confidence[..., None] * (paths.colour - case()[3].colour) ** 2
    assert paths.valid.tolist() == [1, 1] and paths.colour.shape[0] == 2
    np.testing.assert_allclose(terms["pho"], each.mean(), rtol=1e-4)


def test_flow_terms_are_their_means_in_world_units(found):
    terms, shown, paths = found
    there, back = paths.there, paths.back
    confidence = np.stack([shown.dynamic.confidence_forward, shown.dynamic.confidence_backward])
    assert there.shape == (2, *shown.weights.shape, 3)
    np.testing.assert_allclose(terms["min"], np.abs(there).mean(), rtol=1e-4)
    np.testing.assert_allclose(terms["temp"], np.mean((there[0] + there[1]) ** 2), rtol=1e-3)
    np.testing.assert_allclose(terms["cyc"], np.mean(confidence[..., None] * np.abs(there + back)), rtol=1e-4)
    np.testing.assert_allclose(terms["w"], np.mean(1 - confidence), rtol=1e-3)


def test_the_flow_of_what_moves_is_compared_near_its_surface(found):
    terms, shown, paths = found
    truth = case()[3]
    near = np.exp(-(((shown.marched.depths / truth.depth[:, None] - 1) / 0.05) ** 2)) * truth.flow_valid[:, None]
    error = [
        np.minimum(np.abs(paths.there[i] - truth.flow[:, None, i]) / truth.depth[:, None, None], 1) for i in range(2)
    ]
    expected = 5 * sum(np.sum(near[..., None] * e) / max(3 * near.sum(), 1e-30) for e in error)
    np.testing.assert_allclose(terms["flow3d"], expected, rtol=1e-3, atol=1e-6)


def test_a_neighbour_that_does_not_exist_counts_in_nothing():
    params, inputs, evidence, truth = case()
    alone = inputs._replace(slots=inputs.slots._replace(valid=np.zeros_like(inputs.slots.valid)))
    terms, _, paths = measure()(params, alone, evidence, truth)
    assert not paths.valid.any()
    for name in ("pho", "w", "cyc", "min", "sp", "temp", "geo"):
        assert terms[name] == 0, name


def test_what_is_not_known_counts_in_nothing():
    params, inputs, evidence, truth = case()
    zero = lambda x: np.zeros_like(x)
    nothing = truth._replace(
        known=zero(truth.known), flow_valid=zero(truth.flow_valid), static_valid=zero(truth.static_valid),
        depth=zero(truth.depth), flow=np.full_like(truth.flow, np.nan),
    )  # fmt: skip
    terms, _, _ = measure()(params, inputs, evidence, nothing)
    for name in ("depth", "geo", "flow3d", "static_rec"):
        assert terms[name] == 0, name


def test_gradients_are_finite_where_nothing_is_known():
    params, inputs, evidence, truth = case()
    truth = truth._replace(
        known=np.zeros_like(truth.known), flow_valid=np.zeros_like(truth.flow_valid), depth=np.zeros_like(truth.depth)
    )
    grads = gradient()(params, inputs, evidence, truth)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(grads))


@functools.cache
def gradient():
    """Compiled: the gradient of the sum of all terms in the parameters."""

    def total(params, inputs, evidence, truth):
        terms, _, _ = measure()(params, inputs, evidence, truth)
        return sum(terms.values())

    return jax.jit(jax.grad(total))


def test_smooth_terms_match_a_finite_difference_in_the_dynamic_field(x64):
    """Along one direction of the field's parameters, in float64."""
    system = presets.without_volumes(PAPER)
    to64 = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tree)
    params = to64(stage.params_of(system))
    _, inputs, _, truth = to64(case())
    rng = np.random.default_rng(0)
    draw = lambda: jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)) / 10, params.dynamic)
    direction = draw()
    # Biases of 0 would put units whose inputs are all dead exactly on the kink of their ReLU.
    params = params._replace(dynamic=jax.tree.map(jnp.add, params.dynamic, draw()))

    def total(t):
        moved = params._replace(dynamic=jax.tree.map(lambda x, d: x + t * d, params.dynamic, direction))
        scene = stage.encoded(moved, inputs, None, system)
        prediction = system.render(moved, scene, inputs, truth.pixels)
        terms = make_measures(system, moved, scene, inputs)
        weights = dict(rec=1.0, w=1.0, temp=1.0, mask=1.0)  # pho holds its weights, by design
        return sum(measured(terms, prediction, truth, weights).values())

    both = jax.jit(jax.value_and_grad(total))
    numeric = (both(jnp.float64(1e-6))[0] - both(jnp.float64(-1e-6))[0]) / 2e-6
    assert numeric != 0
    np.testing.assert_allclose(both(jnp.float64(0))[1], numeric, rtol=1e-4)


# Two frames away, in a field that is written down.


def drifting(coords, time, xp=np):
    """`DynamicSample` of (..., 3) points at a time: nothing of it is constant."""
    x, y, z = (coords[..., i] for i in range(3))
    wave = lambda a, b, c, d: xp.sin(a * x + b * y + c * z + d * time)
    forward, backward = (xp.stack([s * wave(i, 2, 3, s) for i in range(3)], -1) for s in (0.04, -0.03))
    colour = 0.5 + 0.4 * xp.stack([wave(3, 1, -2, i) for i in range(3)], -1)
    certain = [0.5 + 0.4 * wave(4, -3, 1, s) for s in (1, -1)]
    return DynamicSample(2 + wave(5, 2, 1, 0.7), colour, 0 * x, forward, backward, *certain)


@part
class Drifting:
    """A dynamic field that is written down, and says where it is asked."""

    frames: Slots = Slots((-2, -1, 0, 1, 2))

    def __call__(self, params, seen, marched, place):
        assert place.duration == stage.FRAMES
        ASKED.append((int(place.time), (seen.views.times + place.time).tolist()))
        return drifting(marched.coords, jnp.float32(place.time), jnp)


ASKED: list = []
PARAMS = Params(None, None, None)
CHAINED = dataclasses.replace(PAPER, dynamic=Drifting())


@pytest.fixture
def followed():
    """Compiled: (which slots are valid, chain) -> `Warped`, photometric term; what it started from; where it asked."""
    inputs = stage.inputs_of(CHAINED, time=2)[0]
    slots = SourceViews(None, None, inputs.slots.valid, slots_about(inputs).times)
    frustum = CHAINED.space.frustum(inputs)
    scene = Scene(frustum, Seen(None, None), Seen(None, slots), None)
    pixels = np.array([[3, 4], [12, 8], [20, 11]], np.float32)
    marched = march(CHAINED.sampler, CHAINED.space, frustum, None, inputs, pixels)
    prediction = Prediction(*[None] * 11, drifting(marched.coords, 2.0, jnp), marched)
    shown = case()[3]._replace(colour=np.linspace(0, 1, 9, dtype=np.float32).reshape(3, 3))

    @functools.partial(jax.jit, static_argnames="chain")
    def run(valid, *, chain):
        ASKED.clear()
        given = (CHAINED, PARAMS, scene, inputs._replace(slots=inputs.slots._replace(valid=valid)))
        paths = warped(*given, prediction, chain=chain)
        terms = make_measures(*given, chain=chain)
        return paths, terms["pho"](prediction, shown)

    return run, jax.tree.map(lambda x: np.asarray(x, np.float64), marched), shown.colour, frustum, ASKED


def in_world(frustum, coords):
    """Points of a pinhole at x = 0.1 that is not turned, depth linear."""
    k = np.asarray(frustum.camera.intrinsics, np.float64)
    depth = stage.NEAR + coords[..., 2] * (stage.FAR - stage.NEAR)
    u, v = coords[..., 0] * (frustum.width - 1), coords[..., 1] * (frustum.height - 1)
    place = lambda pixel, i: (pixel - k[i, 2]) / k[i, i] * depth - np.asarray(frustum.camera.camera_from_world)[i, 3]
    return np.stack([place(u, 0), place(v, 1), depth], -1)


def followed_by_loop(marched, frustum):
    """(colour, confidence) of t + 1, t + 2, t - 1, t - 2; flows there and back of the first and the third."""
    shown, flows = [], []
    for sign in (1, -1):
        coords, certain = marched.coords, 1.0
        for step in (1, 2):
            before = drifting(coords, 2 + sign * (step - 1))
            moved = coords + (before.flow_forward if sign > 0 else before.flow_backward)
            certain = certain * (before.confidence_forward if sign > 0 else before.confidence_backward)
            after = drifting(moved, 2 + sign * step)
            weights = np.stack([weights_by_loop(*ray) for ray in zip(after.density, marched.lengths, strict=True)])
            shown.append(((weights[..., None] * after.colour).sum(1), (weights * certain).sum(1)))
            if step == 1:
                home = moved + (after.flow_backward if sign > 0 else after.flow_forward)
                here, there, back = (in_world(frustum, x) for x in (coords, moved, home))
                flows.append((there - here, back - there))
            coords = moved
    return shown, flows


def test_a_chain_goes_on_from_where_the_step_before_ended(followed):
    run, marched, target, frustum, asked = followed
    paths, pho = run(np.ones(5, np.float32), chain=True)
    assert asked == [(time, [0, 1, 2, 3, 4]) for time in (3, 4, 1, 0)] * 2  # also of the photometric term's own
    shown, flows = followed_by_loop(marched, frustum)
    assert paths.colour.shape == (4, 3, 3) and paths.confidence.shape == (4, 3) and paths.valid.tolist() == [1] * 4
    for i, (colour, confidence) in enumerate(shown):
        np.testing.assert_allclose(paths.colour[i], colour, atol=2e-6)
        np.testing.assert_allclose(paths.confidence[i], confidence, atol=2e-6)
    for i, (there, back) in enumerate(flows):
        np.testing.assert_allclose(paths.there[i], there, atol=1e-5)
        np.testing.assert_allclose(paths.back[i], back, atol=1e-5)
    each = [confidence[:, None] * (colour - target) ** 2 for colour, confidence in shown]
    np.testing.assert_allclose(pho, np.mean(each), rtol=1e-5)
    alone, one = run(np.ones(5, np.float32), chain=False)
    np.testing.assert_allclose(alone.colour, np.stack([shown[i][0] for i in (0, 2)]), atol=2e-6)
    np.testing.assert_allclose(one, np.mean([each[0], each[2]]), rtol=1e-5)


@pytest.mark.parametrize(
    "missing, valid",
    [((), (1, 1, 1, 1)), ((-2,), (1, 1, 1, 0)), ((-1,), (1, 1, 0, 0)), ((1,), (0, 0, 1, 1)), ((2, -1), (1, 0, 0, 0)),
     ((0,), (1, 1, 1, 1))],
)  # fmt: skip
def test_a_chain_ends_at_the_first_frame_that_is_missing(followed, missing, valid):
    """A frame two away does not count where the one between does not exist, and in no mean."""
    run, marched, target, frustum, _ = followed
    present = np.array([offset not in missing for offset in CHAINED.dynamic.frames.offsets], np.float32)
    paths, pho = run(present, chain=True)
    assert paths.valid.tolist() == list(valid)
    shown, _ = followed_by_loop(marched, frustum)
    each = [c[:, None] * (colour - target) ** 2 for (colour, c), v in zip(shown, valid, strict=True) if v]
    np.testing.assert_allclose(pho, np.mean(each), rtol=1e-5)


def test_at_a_neighbour_the_slots_are_named_from_its_own_time():
    """At t + 1 the slot of time t + 1 is read where the point is, not one flow away."""
    views = SourceViews(None, None, None, np.array([-1.0, 0, 1]))
    assert measures._seen_from(Seen(None, views), 1).views.times.tolist() == [-2, -1, 0]
    assert measures._seen_from(Seen(None, None), 1).views is None
