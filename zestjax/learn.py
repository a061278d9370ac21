"""Learning across scenes: the measures of a batch, and one training step.

R        rays of the crop, in blocks
V        source frames, key-frames then slots
A step's gradient is summed over blocks of rays inside the loop, and the volumes are computed once.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.analysis import frame_maps
from zestjax.assembly import dequantised
from zestjax.checks import check_option
from zestjax.evidence import pooled
from zestjax.losses.means import mean_over_valid
from zestjax.losses.objective import Terms, absent, measured, present, weighted_sum
from zestjax.losses.supervision import depth_cross_entropy_loss
from zestjax.measures import FRAME_TERMS, RAY_TERMS, SCENE_TERMS, check_weights, make_measures, measurable
from zestjax.model import Encoding, assemble, reference_frustum, volumes
from zestjax.precision import geometry_at, network_at
from zestjax.prediction import render_rays
from zestjax.schedules import cosine
from zestjax.solve import Adam

FRAME_WEIGHTS = Terms(
    rec=20.0, static_rec=8.0, dynamic_rec=4.0, b=1e-3, depth_ce=0.1, mask=0.05, flow3d=0.2, frame_ce=0.1, frame_mask=0.1
)  # the shipped weights' terms, with the simulator's exact answers
STAGES = ("all", "frames", "views")
MOVER_SHARE = 4  # a cell that moves counts so many times one that does not, in the frames' depths


def scene_terms(maps, encoded, batch, weights):
    """`Terms` of what is known of a scene before any ray: depths of the volumes and of the frames, moving pixels."""
    geometry, motion = encoded
    log = lambda logits: jax.nn.log_softmax(jnp.moveaxis(logits, 0, -1), axis=-1)

    def depth_ce(_, batch):
        total = jnp.zeros((), batch.static_planes.dtype)
        if geometry is not None:
            total += depth_cross_entropy_loss(
                log(geometry.logits), batch.static_planes, valid=batch.static_planes_valid
            )
        if motion is not None:
            total += depth_cross_entropy_loss(log(motion.logits), batch.moving_planes, valid=batch.moving_planes_valid)
        return total

    def frame_ce(_, batch):
        moving = pooled(batch.frame_moving[..., None], 2)[..., 0]
        valid = batch.frame_valid[:, None, None] * (1 + (MOVER_SHARE - 1) * moving) / MOVER_SHARE
        return depth_cross_entropy_loss(jax.nn.log_softmax(maps.logits, axis=-1), batch.frame_planes, valid=valid)

    def frame_mask(_, batch):
        logits, moving = maps.moving_logits, batch.frame_moving
        loss = jax.nn.softplus(logits) - logits * moving
        return mean_over_valid("learn", loss, valid=batch.frame_valid)

    measures = Terms(depth_ce=depth_ce, frame_ce=frame_ce, frame_mask=frame_mask)
    return measured(measures, None, batch, _only(weights, SCENE_TERMS))


def _blocks(truth, count):
    """`Truth` of R rays as (count, R / count, ...)."""
    rays = truth.pixels.shape[0]
    if rays % count:
        raise ValueError(f"train_step: a crop of {rays} rays has no {count} equal blocks; change `ray_blocks`.")
    return jax.tree.map(lambda x: x.reshape(count, -1, *x.shape[1:]), truth)


def _only(weights, names):
    return Terms(**{name: getattr(weights, name) for name in names})


def stage_weights(stage, *, weights=FRAME_WEIGHTS):
    """The `Terms` of one stage of training: what each frame says of itself (`frames`), all else with that held as it
    is (`views`), or both (`all`).

    Raises:
      ValueError: another stage.
    """
    check_option("stage_weights", stage=(stage, STAGES))
    names = {"all": Terms._fields, "frames": FRAME_TERMS}.get(stage) or set(Terms._fields) - set(FRAME_TERMS)
    return _only(weights, names)


def frames_only(weights):
    """Whether nothing is asked of any view, so that volumes and rays are not in the program."""
    return all(absent(w) for name, w in weights._asdict().items() if name not in FRAME_TERMS)


def make_train_step(config, *, steps, weights=None, peak=2e-3, floor=2e-5, warmup=50):
    """A run's solver and its compiled step.

    Args:
      config: `presets.Config`.
      steps: length of the cosine schedule.
      weights: `Terms`, see `train_step`.
      peak: the schedule's highest learning rate.
      floor: its last one.
      warmup: steps of its rise.

    Returns:
      (init(params) -> opt_state, step(params, opt_state, batch) -> (params, opt_state, {name: value})); the step
      donates params and opt_state.
    """
    rate = lambda step: cosine(step, peak=peak, floor=floor, steps=max(steps, warmup + 1), warmup=warmup)
    solver = Adam(learning_rate=rate, clip_norm=1.0)
    step = train_step(config, weights=weights, solver=solver)
    return solver.init_state, jax.jit(step, donate_argnums=(0, 1))


def train_step(config, *, weights=None, solver):
    """One step of training across scenes.

    Args:
      config: `presets.Config`.
      weights: `Terms` of numbers; a term of weight 0 or None is not in the program. By default those of `FRAME_WEIGHTS`
        that the configuration can measure.
      solver: `solve.Adam` (or anything with its `apply`).

    Returns:
      `step(params, opt_state, batch) -> (params, opt_state, terms)`, pure; jit it with donated arguments. The objective
      is the mean over the blocks of rays of each block's own. It raises `ValueError` if the rays cannot be shared
      evenly among `config.ray_blocks`. With `frames_only` weights there are no rays and a `FrameBatch` serves.

    Raises:
      ValueError: a weight whose term cannot be measured here, with what it needs.
    """
    gradients = step_gradients(config, weights=weights)

    def step(params, opt_state, batch):
        grads, terms, total = gradients(params, batch)
        params, opt_state = solver.apply(params, opt_state, grads, total)
        return params, opt_state, terms._asdict() | {"total": total}

    return step


class Fault(NamedTuple):
    """What of a step is not finite. terms: names of losses. leaves: paths of parameters. frame: the target's time, or
    None of a step that has no target."""

    terms: tuple[str, ...]
    leaves: tuple[str, ...]
    frame: int | None

    def __str__(self):
        some = lambda names: ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        lost = f"loss {some(self.terms)}" if self.terms else "no loss"
        where = "" if self.frame is None else f", target frame {self.frame}"
        return f"not finite: {lost}{where}; gradient of {some(self.leaves) if self.leaves else 'no parameter'}"


def find_fault(params, batch, *, config, weights=None):
    """`Fault` of a step's losses and gradients; its program is compiled once, at the cost of a step's."""
    weights = measurable(config, FRAME_WEIGHTS) if weights is None else weights
    grads, terms = _finite(params, batch, jax.tree.map(jnp.float32, present(weights)), config=config)
    named = jax.tree_util.tree_leaves_with_path(grads)
    leaves = tuple(jax.tree_util.keystr(path) for path, good in named if not good)
    lost = tuple(name for name, good in terms.items() if good is not None and not good)
    return Fault(lost, leaves, int(batch.inputs.time) if hasattr(batch, "inputs") else None)


@functools.partial(jax.jit, static_argnames="config")
def _finite(params, batch, weights, *, config):
    """Which gradients and which terms are finite. The weights are arrays: another value compiles nothing."""
    grads, terms, _ = step_gradients(config, weights=weights)(params, batch)
    return jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), (grads, terms._asdict()))


def step_gradients(config, *, weights=None):
    """`gradients(params, batch) -> (gradients, `Terms`, their weighted sum)` of `train_step`, see there."""
    weights = measurable(config, FRAME_WEIGHTS) if weights is None else present(weights)
    check_weights("train_step", config, weights)
    if frames_only(weights):
        return _frames_gradients(config, weights)
    rays = functools.partial(_rays, config=config, weights=_only(weights, RAY_TERMS))

    def gradients(params, batch):
        batch = geometry_at(config.precision, batch)
        scene = lambda p: _scene(p, batch, config=config, weights=weights)
        (encoded, of_scene), pull, (maps, terms) = jax.vjp(scene, params, has_aux=True)
        encoding = jax.lax.stop_gradient(assemble(batch.inputs, maps, encoded, config=config))
        tables = (encoding.key, encoding.slots, encoding.guides)
        gradient = jax.value_and_grad(rays, argnums=(0, 1), has_aux=True)

        def of_block(truth):
            (_, found), grads = gradient(params, encoded, tables, batch.inputs, truth)
            return found, grads

        found, (towards_params, towards_encoded) = mean_over_blocks(of_block, _blocks(batch.truth, config.ray_blocks))
        (through,) = pull((towards_encoded, jnp.ones_like(of_scene)))
        grads = jax.tree.map(jnp.add, towards_params, through)
        terms = Terms(*(a if a is not None else b for a, b in zip(terms, found, strict=True)))
        return grads, terms, weighted_sum(terms, weights)

    return gradients


def _frames_gradients(config, weights):
    """`step_gradients` of the frames' own terms alone."""

    def gradients(params, batch):
        def loss(analysis):
            maps = _analysed(analysis, batch, config)
            terms = scene_terms(maps, (None, None), batch, weights)
            return weighted_sum(terms, weights), terms

        (total, terms), towards = jax.value_and_grad(loss, has_aux=True)(params.analysis)
        grads = jax.tree.map(jnp.zeros_like, params)._replace(analysis=towards)
        return grads, terms, total

    return gradients


def _analysed(params, batch, config):
    """`FrameMaps` of a batch's frames."""
    evidence = geometry_at(config.precision, dequantised(batch.evidence))
    return frame_maps(network_at(config.precision, params), evidence)


def _scene(params, batch, *, config, weights):
    """((volumes, weighted loss of what needs no ray), (maps, its terms))."""
    maps = None
    if params.analysis is not None:
        held = config.hold_trust and not config.features and all(absent(getattr(weights, n)) for n in FRAME_TERMS)
        analysis = jax.lax.stop_gradient(params.analysis) if held else params.analysis
        maps = _analysed(analysis, batch, config)
    encoded = volumes(network_at(config.precision, params), batch.inputs, maps, config=config)
    weights = _only(weights, SCENE_TERMS)
    terms = scene_terms(maps, encoded, batch, weights)
    return (encoded, weighted_sum(terms, weights)), (maps, terms)


def _rays(params, encoded, tables, inputs, truth, *, config, weights):
    """(weighted loss of a block of rays, its terms)."""
    (geometry, motion), (key, slots, guides) = encoded, tables
    params = network_at(config.precision, params)
    encoding = Encoding(geometry, motion, key, slots, reference_frustum(inputs, config), guides)
    prediction = render_rays(params, encoding, inputs, truth.pixels, config=config)
    terms = measured(make_measures(params, encoding, inputs, config=config), prediction, truth, weights)
    return weighted_sum(terms, weights), terms


def mean_over_blocks(fn, blocks):
    """Mean of a tree-valued function over the leading axis of `blocks`, summed inside the loop: one block in memory."""
    count = jax.tree.leaves(blocks)[0].shape[0]
    shapes = jax.eval_shape(fn, jax.tree.map(lambda x: x[0], blocks))
    zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    total, _ = jax.lax.scan(lambda carry, block: (jax.tree.map(jnp.add, carry, fn(block)), None), zeros, blocks)
    return jax.tree.map(lambda x: x / count, total)
