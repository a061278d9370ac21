"""A stage to test the model on, drawn exactly by numpy: a textured wall at depth 4, a card at depth 2 that slides.

H W      16 x 24 unless a test says otherwise; the focal length is W
x t      a camera looks along z from (x, 0, 0); the card's left edge is at t / 10 - 0.4, world units
"""

import collections
import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.cameras import Camera
from zestjax.frames.analysis import OwnMaps, frame_maps
from zestjax.frames.assembly import dequantised
from zestjax.frames.selection import KeyFrames, Slots
from zestjax.losses.objective import PAPER_WEIGHTS
from zestjax.model import predict
from zestjax.rays import pixel_grid
from zestjax.simulate.clips import Clip
from zestjax.solve import Adam
from zestjax.systems import presets
from zestjax.systems.fields import Dynamic, Static
from zestjax.systems.sampling import Even
from zestjax.systems.swept import Pyramid, Swept
from zestjax.systems.system import Space, System
from zestjax.systems.targets import target_inputs
from zestjax.train.batches import PreparedClip, batch_from_clip, prepare_clip
from zestjax.train.learn import SIMULATED_WEIGHTS, train_step, training_objective
from zestjax.train.rays import Pixels, Rows
from zestjax.train.recipes import Recipe
from zestjax.train.terms import measurable
from zestjax.video import Video

SIZE = (16, 24)
WALL, CARD, NEAR, FAR = 4.0, 2.0, 1.5, 6.0
FRAMES = 6

_MINI = dict(volume=Swept(widths=(4, 8)), width=8, depth=2)
MINI = System(Space(5), Static(KeyFrames(3), **_MINI), Dynamic(Slots((-1, 0, 1)), **_MINI), frames=OwnMaps(6, (4, 6)))
STILL = presets.still(MINI)
_PAPER = dict(
    volume=Swept(Pyramid(8), (4, 8), occupied=False), width=8, depth=6, point_levels=2, view_levels=1,
)  # fmt: skip
PAPER = dataclasses.replace(
    presets.PAPER, space=Space(4, "depth", "key_frame", "strided"), sampler=Even(4),
    static=dataclasses.replace(presets.PAPER.static, frames=KeyFrames(3, "spread"), **_PAPER),
    dynamic=dataclasses.replace(presets.PAPER.dynamic, **_PAPER),
)  # fmt: skip
ROWS, PIXELS, BLOCKS = Rows(4), Pixels(4 * 24, 8), 2


def recipe_of(system):
    """How the stage teaches a system."""
    rays = ROWS if system.space.cells == "pooled" else PIXELS
    return Recipe(system, rays=rays, blocks=BLOCKS, height=16, width=24)


def usual_weights(system):
    """Those of the simulator's terms that a system can measure."""
    return measurable(system, SIMULATED_WEIGHTS)


@functools.cache
def _objective(system, weights, blocks):
    return training_objective(system, weights=dict(weights), blocks=blocks)


def objective(system, weights=None, *, blocks=BLOCKS):
    """`training_objective`, one function for the same choices."""
    weights = usual_weights(system) if weights is None else weights
    return _objective(system, tuple(weights.items()), blocks)


def gradients(system, weights=None, *, blocks=BLOCKS):
    """(params, batch) -> (gradient, terms, total)."""
    taught = jax.value_and_grad(objective(system, weights, blocks=blocks), has_aux=True)

    def both(params, batch):
        (total, terms), grads = taught(params, batch)
        return grads, terms, total

    return both


def painted(x, y):
    """(..., 3) smooth colours of the wall."""
    waves = [np.sin(5 * x + 2 * y), np.sin(3 * x - 4 * y + 1), np.cos(6 * y + x)]
    return 0.5 + 0.35 * np.stack(waves, -1)


def shot(x, t, size=SIZE):
    """image (H, W, 3), depth (H, W), moving (H, W) and the wall alone (H, W, 3)."""
    height, width = size
    v, u = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    across, down = (u - (width - 1) / 2) / width, (v - (height - 1) / 2) / width
    wall = painted(x + WALL * across, WALL * down)
    place = x + CARD * across - (t / 10 - 0.4)
    moving = (place >= 0) & (place < 0.5) & (np.abs(CARD * down) < 0.4)
    card = 1 - painted(4 * place, 4 * CARD * down)[..., ::-1]
    return np.where(moving[..., None], card, wall), np.where(moving, CARD, WALL), moving, wall


def camera(x, size=SIZE):
    """Host `Camera` at (x, 0, 0)."""
    height, width = size
    pose = np.eye(4, dtype=np.float32)
    pose[0, 3] = -x
    inner = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]], np.float32)
    return Camera(inner, pose)


def cameras(places, size=SIZE):
    """Host `Camera` (N, ...)."""
    return jax.tree.map(lambda *rows: np.stack(rows), *(camera(x, size) for x in places))


PLACES = [0.25 * np.sin(1.3 * t) for t in range(FRAMES)]


def video(size=SIZE):
    """`Video` of six frames."""
    images = np.stack([shot(x, t, size)[0] for t, x in enumerate(PLACES)]).astype(np.float32)
    return Video(images, cameras(PLACES, size), np.float32(NEAR), np.float32(FAR))


def clip():
    """`Clip` of six frames and two targets, at the times 2 and 3."""
    times, places = [2, 3], [0.1, -0.15]
    frames, targets = (
        [np.stack(part) for part in zip(*(shot(x, t) for x, t in pairs), strict=True)]
        for pairs in (zip(PLACES, range(FRAMES), strict=True), zip(places, times, strict=True))
    )
    bytes_of = lambda x: np.round(255 * x).astype(np.uint8)
    step = np.array([0.1, 0, 0])
    flow = np.stack([s * step * targets[2][..., None] for s in (1, -1)], 1)
    seen, shown = cameras(PLACES), cameras(places)
    return Clip(
        bytes_of(frames[0]), frames[1].astype(np.float32), frames[2], *seen, np.float32(NEAR), np.float32(FAR),
        bytes_of(targets[0]), targets[1].astype(np.float32), targets[2], flow.astype(np.float16),
        bytes_of(targets[3]), np.full_like(targets[1], WALL, np.float32), np.ones_like(targets[2]), *shown,
        np.array(times, np.int32),
    )  # fmt: skip


def params_of(system, seed=0):
    """`Params` drawn by numpy, which compiles nothing."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(system.init, jax.random.key(0))

    def draw(path, s):
        if s.ndim > 1:
            return jnp.asarray(rng.normal(size=s.shape) / np.sqrt(np.prod(s.shape[:-1])), s.dtype)
        name = jax.tree_util.keystr(path)
        return jnp.full(s.shape, float("scale" in name or "condition" in name), s.dtype)

    return jax.tree_util.tree_map_with_path(draw, shapes)


@functools.cache
def prepared(system=MINI):
    """`PreparedClip` of the stage with frame 4 a hole."""
    found = prepare_clip(jax.random.key(0), clip(), system)
    assert len(found.holes) == 1
    return found


@functools.cache
def batch(system=MINI, kind=0):
    """A `Batch` of the stage: of target `kind`, in the middle rows, where the card is."""
    whole = prepared(system)
    shown = PreparedClip(whole.clip, whole.evidence, ())
    for seed in range(100):
        found = batch_from_clip(jax.random.key(seed), shown, recipe_of(system))
        if found.inputs.time == whole.clip.target_time[kind] and found.truth.moving.any():
            return found
    raise AssertionError("no batch shows the card")


def inputs_of(system=MINI, *, time=2, exclude=(), size=SIZE):
    """`Inputs` of a view from x = 0.1 at a time, and which frames they hold."""
    shown = video(size)
    return target_inputs(
        shown.images, shown.cameras, NEAR, FAR, camera(0.1, size), time, system=system, exclude=exclude
    )


def maps_of(params, evidence):
    """`FrameMaps` of quantised evidence; None of None."""
    return None if evidence is None else frame_maps(params.analysis, dequantised(evidence))


def encoded(params, inputs, evidence, system):
    """`Scene` of inputs, from their frames' quantised evidence."""
    return system.encode(params, inputs, maps_of(params, evidence))


def rays(params, inputs, evidence, pixels, *, system):
    """`Prediction` of pixels."""
    return predict(params, inputs, maps_of(params, evidence), pixels, system=system)


@functools.cache
def forward(system=MINI):
    """Compiled, kept: (params, inputs, evidence, pixels) -> `Prediction`."""
    return jax.jit(functools.partial(rays, system=system))


def step(system=MINI, weights=None):
    """Compiled, kept: a training step with Adam; `init`."""
    weights = usual_weights(system) if weights is None else weights
    return _step(system, tuple(weights.items()))


@functools.cache
def _step(system, weights):
    solver = Adam(learning_rate=3e-3, clip_norm=1.0)
    return jax.jit(train_step(objective(system, dict(weights)), solver)), solver.init_state


def paper_step():
    """The shrunk paper preset's, with the paper's losses."""
    return step(PAPER, PAPER_WEIGHTS)


def pixels():
    """(64, 2) some of the target's pixels."""
    return pixel_grid(*SIZE).reshape(-1, 2)[::6]


def equations(program):
    """Every equation of a program, those of inner programs too, each once."""
    inner_program = lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")
    for equation in getattr(program, "jaxpr", program).eqns:
        yield equation
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=inner_program):
            if inner_program(inner):
                yield from equations(inner)


def operations(fn, *args):
    """How many primitives a function's program holds, by name; inner programs counted once."""
    return collections.Counter(equation.primitive.name for equation in equations(jax.make_jaxpr(fn)(*args)))
