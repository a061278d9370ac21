"""Systems are expressions of parts: written, read, replaced, and made of parts that the package has never seen."""

import dataclasses
import json
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stage
from stage import MINI, PAPER

from zestjax.apps.earlier import Config, recipe_from_config, renamed
from zestjax.apps.weights import open_weights, recipe_from_metadata
from zestjax.base.parts import from_stored, part, to_stored
from zestjax.fields.heads import HeadParams, Reading
from zestjax.fields.static import StaticSample
from zestjax.fields.trunk import init_colour_head
from zestjax.frames.selection import KeyFrames
from zestjax.io.weights import WeightsError, save_weights
from zestjax.model import predict
from zestjax.nets.layers import dense, init_dense
from zestjax.novel_view import prepare, render_view
from zestjax.solve import Adam
from zestjax.systems import presets
from zestjax.systems.fields import Seen, Static
from zestjax.systems.mvsnerf import MVSNERF, MvsNerf
from zestjax.systems.sampling import Even
from zestjax.systems.system import Space, System
from zestjax.train.learn import training_objective
from zestjax.train.rays import Rows
from zestjax.train.recipes import PARTS, RECIPES, Cosine, Decaying, Fixed, Recipe, pairs

through_json = lambda value: json.loads(json.dumps(to_stored(value)))
NAMED = {name: value for name, value in vars(presets).items() if isinstance(value, System)} | {"MVSNERF": MVSNERF}


@pytest.mark.parametrize("name", NAMED)
def test_a_system_is_what_its_file_says(name):
    again = from_stored(through_json(NAMED[name]), PARTS)
    assert again == NAMED[name] and hash(again) == hash(NAMED[name]) and type(again) is System


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_is_what_its_file_says(name):
    recipe = dataclasses.replace(RECIPES[name], rate=Cosine(1e-3, 1e-5, 7))
    assert recipe_from_metadata({"recipe": through_json(recipe)}) == recipe


def test_the_named_systems_are_there_and_differ():
    assert NAMED.keys() >= {"ZEST", "STILL", "GEOMETRY", "MOTION", "NEITHER", "PAPER", "MVSNERF", "SVS", "NSFF"}
    assert len(set(NAMED.values())) == len(NAMED)


STORED = through_json(RECIPES["tiny"])


def changed(*path, value):
    """The stored recipe of `tiny` with one entry another."""
    tree = json.loads(json.dumps(STORED))
    place = tree
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return tree


@pytest.mark.parametrize(
    "stored, words",
    [
        (changed("part", value="os.system"), "a part is 'os.system', expected one of"),
        (changed("part", value=["Recipe"]), "a part is"),
        (changed("system", "tomorrow", value=1), "System has fields that this version does not know: tomorrow"),
        (changed("system", "space", "planes", value="8"), "Space has `planes` 8, which cannot be"),
        (changed("system", "space", "planes", value=8.0), "Space has `planes` 8.0, which cannot be"),
        (changed("system", "space", "planes", value=True), "Space has `planes` True, which cannot be"),
        (changed("system", "space", "planes", value=10**9), "more than 65536"),
        (changed("system", "space", "planes", value=1), "`planes` is 1, expected an integer from 2"),
        (changed("system", "space", value={"part": "Rows", "count": 4}), "System has `space`"),
        (changed("system", "static", "volume", "widths", value=[]), "`levels` is 0"),
        (changed("system", "static", "volume", "widths", value=[[8]]), "Swept has `widths`"),
        (changed("system", "static", "depth", value=10**4), "`depth` is 10000, expected an integer from 1 to 64"),
        (changed("system", "static", value=None), "System has `static` None, which cannot be"),
        (changed("system", "precision", value="half"), "precision"),
        (changed("weights", "terms", value=[["rec", "x"]]), "Fixed has `terms`"),
        (changed("weights", "terms", value=[["a", 1.0]] * 300), "300 entries"),
        ({"part": "Recipe"}, "Recipe: .*system"),
        ({"part": "Space"}, "it is a Space, expected a Recipe"),
        ([1, 2], "it is a tuple, expected a Recipe"),
        (json.loads('{"part":"Recipe","system":' * 40 + "1" + "}" * 40), "more than 16 deep|expected"),
    ],
)
def test_a_crafted_recipe_is_one_error(stored, words):
    with pytest.raises(WeightsError, match=words) as caught:
        recipe_from_metadata({"recipe": stored})
    assert "\n" not in str(caught.value)


def test_what_no_file_can_hold_is_refused_when_written():
    with pytest.raises(TypeError, match="a part holds a ndarray"):
        to_stored(Fixed(np.zeros(3)))


def test_decaying_weights_are_those_of_their_step():
    weights = Decaying(pairs(dict(rec=1.0, geo=0.02)), every=10)
    assert weights(0) == {"rec": 1.0, "geo": 0.02} and weights(25) == pytest.approx({"rec": 1.0, "geo": 0.0002})
    traced = jax.jit(weights)(jnp.int32(25))
    np.testing.assert_allclose(traced["geo"], 0.0002, rtol=1e-5)


def test_a_step_is_taught_by_the_weights_of_its_number():
    """The total of a step follows the decaying weight, the terms do not."""
    recipe = dataclasses.replace(stage.recipe_of(MINI), weights=Decaying(pairs(dict(rec=1.0, b=0.5)), ("b",), 1))
    init, step = recipe.trainer(steps=10)
    params, batch = stage.params_of(MINI), stage.batch()
    state = init(params)._replace(iter_num=jnp.int32(2))
    terms = jax.jit(step)(params, state, batch)[2]
    np.testing.assert_allclose(terms["total"], terms["rec"] + 0.005 * terms["b"], rtol=1e-5)


# Files of 0.1.


def test_a_configuration_of_the_first_version_is_the_recipe_of_today():
    small = {name: list(v) if isinstance(v, tuple) else v for name, v in dataclasses.asdict(Config("small")).items()}
    assert recipe_from_config(small) == RECIPES["small"]
    tiny = dict(height=32, width=48, planes=8, evidence_planes=8, frame_widths=[8, 12], volume_widths=[4, 8])
    tiny |= dict(key_frames=4, field_width=16, field_depth=2, crop_rows=8, ray_blocks=2)
    assert recipe_from_config(small | tiny) == RECIPES["tiny"]
    for name, flags in {
        "zest-geometry": dict(motion=False), "zest-motion": dict(geometry=False),
        "zest-none": dict(geometry=False, motion=False),
    }.items():  # fmt: skip
        assert recipe_from_config(small | flags).system == presets.ABLATED[name](presets.ZEST)
    assert recipe_from_config(small | dict(dynamic=False)).system == presets.STILL
    paper = dict(
        planes=128, spacing="depth", encoder="pyramid", features=32, volume_widths=[8, 16, 32, 64],
        key_frame_choice="spread", slots=[-2, -1, 1, 2], reference="key_frame", trust=False, field_width=256,
        field_depth=8, point_levels=10, view_levels=4, sampling="regular", samples=128, head="direct",
        conditioning="concatenated", rays="uniform", mined_rays=512, crop_rows=2, ray_blocks=8, height=288, width=512,
    )  # fmt: skip
    assert recipe_from_config(small | paper).system == presets.PAPER
    with pytest.raises(ValueError, match="in a form that this version has not"):
        recipe_from_config(small | dict(trust=False))


def test_arrays_of_the_first_version_have_their_places():
    assert renamed(".geometry.regulariser.stem") == ".static.volume.regulariser.stem"
    assert renamed(".dynamic.motion[1].bias") == ".dynamic.net.early[1].bias"
    assert renamed(".static.views.query.bias") == ".static.net.head.views.query.bias"
    assert renamed(".analysis.net.mix") == ".analysis.net.mix"


# Parts that the package has never seen.


@part
class Fog:
    """A static field of one's own: colour and density of a point by one layer, whatever the frames show."""

    frames: KeyFrames = KeyFrames(2)
    density: float = 1.0

    def init(self, key):
        return init_dense(key, 3, 4)

    def encode(self, params, inputs, maps, frustum, depths):
        return Seen(None, None)

    def __call__(self, params, seen, marched, place):
        out = dense(params, marched.coords.reshape(-1, 3)).reshape(*marched.depths.shape, 4)
        density = self.density * jax.nn.softplus(out[..., 3])
        return StaticSample(density, jax.nn.sigmoid(out[..., :3]), 0 * density, 0 * density)


@part
class Squared:
    """A sampler of one's own: denser near the camera."""

    samples: int = 6
    guided: ClassVar[bool] = False
    fills: ClassVar[bool] = False

    def guide(self, volumes):
        return None

    def fractions(self, guides, pixels, jitter):
        even = (jnp.arange(self.samples, dtype=pixels.dtype) + 0.5) / self.samples
        return jnp.broadcast_to(even**2, (pixels.shape[0], self.samples))

    def lengths(self, fractions, depths, inputs, norm, planes):
        return jnp.ones_like(depths)


@part
class Mean:
    """A head of one's own: the mean of what the views show."""

    looks: ClassVar[bool] = False

    def channels(self, *, volume, views, summaries):
        return max(volume, 1)

    def init(self, key, *, features, width, directions):
        return HeadParams(init_colour_head(key, width, directions), None)

    def __call__(self, params, volume, samples, views):
        seen = jnp.sum(samples.visible, 0)[:, None]
        mean = jnp.sum(samples.colour, 0).T / jnp.maximum(seen, 1)
        return Reading(volume, lambda state, direction: mean)


OWN = {
    "field and sampler": System(Space(4), Fog(), None, Squared(), frames=None),
    "field beside ours": dataclasses.replace(
        presets.without_volumes(MINI), static=Fog(density=0.5), sampler=Squared(5)
    ),
    "head": dataclasses.replace(PAPER, static=dataclasses.replace(PAPER.static, head=Mean()), dynamic=None),
    "sampler of ours": dataclasses.replace(presets.still(MINI), sampler=Squared()),
}


@pytest.mark.parametrize("name", OWN)
def test_parts_of_ones_own_train_render_and_are_stored(name, tmp_path):
    system = OWN[name]
    params, batch = system.init(jax.random.key(0)), stage.batch(system)
    objective = training_objective(system, weights=dict(rec=1.0), blocks=2)
    solver = Adam(fun=objective, has_aux=True, learning_rate=0.02)
    state, step, losses = solver.init_state(params), jax.jit(solver.update), []
    for _ in range(6):
        params, state = step(params, state, batch)
        losses.append(float(state.value))
    assert losses[-1] < losses[0] and np.isfinite(losses).all()
    view = render_view(params, prepare(params, stage.video(), system=system), stage.camera(0.1), 2, system=system)
    assert view.colour.shape == (*stage.SIZE, 3) and np.isfinite(view.colour).all()
    own = (Fog, Squared, Mean)
    save_weights(tmp_path / "w", params, metadata={"recipe": to_stored(Recipe(system, rays=Rows(4))), "system": "own"})
    model = open_weights(tmp_path / "w", parts=own)
    assert model.system == system and model.name == "own"
    jax.tree.map(np.testing.assert_array_equal, model.params, params)
    with pytest.raises(WeightsError, match=f"{tmp_path / 'w'}: .*a part is '(Fog|Squared|Mean)', expected one of"):
        open_weights(tmp_path / "w")


def test_predict_is_the_whole_model_in_one_call():
    params, (inputs, frames) = stage.params_of(MINI), stage.inputs_of()
    evidence = jax.tree.map(lambda x: x[frames], stage.prepared().evidence)
    maps = stage.maps_of(params, evidence)
    shown = jax.jit(lambda p: predict(p, inputs, maps, stage.pixels(), system=MINI))(params)
    same = stage.forward(MINI)(params, inputs, evidence, stage.pixels())
    np.testing.assert_allclose(shown.colour, same.colour, atol=1e-5)


def test_mvsnerf_is_a_system_like_the_others():
    assert MVSNERF.dynamic is None and isinstance(MVSNERF.static, MvsNerf) and MVSNERF.static.frames.least == 3
    small = dataclasses.replace(MVSNERF, space=Space(4, "depth", "key_frame", "strided"), static=MvsNerf(padding=2))
    inputs, frames = stage.inputs_of(small)
    assert inputs.slots is None and len(frames) == 3
    with pytest.raises(ValueError, match="KeyFrames: a view needs 3 source frames, 2 are left"):
        stage.inputs_of(small, exclude=(0, 1, 2, 3))


def test_presets_take_their_parts_from_one_list():
    """Whatever a preset is made of can be read from a file."""

    def parts_in(value):
        if isinstance(value, tuple):
            return set().union(*map(parts_in, value)) if value else set()
        if not dataclasses.is_dataclass(value):
            return set()
        return {type(value)}.union(*(parts_in(getattr(value, f.name)) for f in dataclasses.fields(value)))

    assert set().union(*map(parts_in, RECIPES.values()), *map(parts_in, NAMED.values())) <= {*PARTS}
    assert Even in PARTS and Static in PARTS
