"""Learning across scenes: the measures of a batch, and one training step.

R        rays of the crop, in blocks
V        source frames, key-frames then slots
A step's gradient is summed over blocks of rays inside the loop, and the volumes are computed once.
"""

import jax
import jax.numpy as jnp

from zestjax.analysis import frame_maps
from zestjax.assembly import dequantised
from zestjax.losses.means import mean_over_valid
from zestjax.losses.objective import Terms, measured, weighted_sum
from zestjax.losses.supervision import depth_cross_entropy_loss
from zestjax.measures import make_measures
from zestjax.model import Encoding, assemble, reference_frustum, volumes
from zestjax.prediction import render_rays
from zestjax.schedules import cosine
from zestjax.solve import Adam

FRAME_WEIGHTS = Terms(
    rec=20.0, static_rec=8.0, b=1e-3, depth_ce=0.1, mask=0.05, flow3d=0.2, frame_ce=0.1, frame_mask=0.1
)  # the shipped weights' terms, with the simulator's exact answers
RAY_TERMS = ("rec", "static_rec", "mask", "b", "flow3d", "pho", "w", "cyc", "min", "sp", "temp", "geo", "depth")
SCENE_TERMS = ("depth_ce", "frame_ce", "frame_mask")


def scene_terms(maps, encoded, batch, weights):
    """`Terms` of what is known of a scene before any ray: depths of the volumes and of the frames, moving pixels."""
    geometry, motion = encoded
    log = lambda logits: jax.nn.log_softmax(jnp.moveaxis(logits, 0, -1), axis=-1)

    def depth_ce(_, batch):
        total = jnp.zeros(())
        if geometry is not None:
            total += depth_cross_entropy_loss(
                log(geometry.logits), batch.static_planes, valid=batch.static_planes_valid
            )
        if motion is not None:
            total += depth_cross_entropy_loss(log(motion.logits), batch.moving_planes, valid=batch.moving_planes_valid)
        return total

    def frame_ce(_, batch):
        valid = jnp.broadcast_to(batch.frame_valid[:, None, None], batch.frame_planes.shape)
        return depth_cross_entropy_loss(jax.nn.log_softmax(maps.logits, axis=-1), batch.frame_planes, valid=valid)

    def frame_mask(_, batch):
        logits, moving = maps.moving_logits, batch.frame_moving
        loss = jax.nn.softplus(logits) - logits * moving
        return mean_over_valid("learn", loss, valid=batch.frame_valid)

    measures = Terms(depth_ce=depth_ce, frame_ce=frame_ce, frame_mask=frame_mask)
    return measured(measures, None, batch, _only(weights, SCENE_TERMS))


def _only(weights, names):
    return Terms(**{name: getattr(weights, name) for name in names})


def make_train_step(config, *, steps, weights=FRAME_WEIGHTS, peak=2e-3, floor=2e-5, warmup=50):
    """A run's solver and its compiled step.

    Args:
      config: `presets.Config`. weights: `Terms`.
      steps: length of the cosine schedule; peak, floor, warmup: its learning rates and rise.

    Returns:
      (init(params) -> opt_state, step(params, opt_state, batch) -> (params, opt_state, {name: value})); the step
      donates params and opt_state.
    """
    rate = lambda step: cosine(step, peak=peak, floor=floor, steps=max(steps, warmup + 1), warmup=warmup)
    solver = Adam(learning_rate=rate, clip_norm=1.0)
    step = train_step(config, weights=weights, solver=solver)
    return solver.init_state, jax.jit(step, donate_argnums=(0, 1))


def train_step(config, *, weights=FRAME_WEIGHTS, solver):
    """One step of training across scenes.

    Args:
      config: `presets.Config`.
      weights: `Terms` of numbers; a term of weight 0 or None is not in the program.
      solver: `solve.Adam` (or anything with its `apply`).

    Returns:
      `step(params, opt_state, batch) -> (params, opt_state, terms)`, pure; jit it with donated arguments.
    """
    terms_of_rays = _only(weights, RAY_TERMS if config.dynamic else ("rec",))

    def scene(params, batch):
        maps = None
        if params.analysis is not None:
            maps = frame_maps(params.analysis, dequantised(batch.evidence))
        encoded = volumes(params, batch.inputs, maps, config=config)
        guided = all(v is None or v.logits is not None for v in encoded)
        known = [n for n in SCENE_TERMS if (n == "depth_ce" and guided) or (n != "depth_ce" and maps is not None)]
        terms = scene_terms(maps, encoded, batch, _only(weights, known))
        return (encoded, weighted_sum(terms, _only(weights, known))), (maps, terms)

    def rays(params, encoded, tables, inputs, truth):
        encoding = Encoding(*encoded, *tables[:2], reference_frustum(inputs, config), tables[2])
        prediction = render_rays(params, encoding, inputs, truth.pixels, config=config)
        measures = make_measures(params, encoding, inputs, config=config)
        terms = measured(measures, prediction, truth, terms_of_rays)
        return weighted_sum(terms, terms_of_rays), terms

    def step(params, opt_state, batch):
        (encoded, _), pull, (maps, terms) = jax.vjp(lambda p: scene(p, batch), params, has_aux=True)
        encoding = jax.lax.stop_gradient(assemble(batch.inputs, maps, encoded, config=config))
        tables = (encoding.key, encoding.slots, encoding.guides)
        blocks = jax.tree.map(lambda x: x.reshape(config.ray_blocks, -1, *x.shape[1:]), batch.truth)
        gradient = jax.value_and_grad(rays, argnums=(0, 1), has_aux=True)

        def block(carry, truth):
            (_, found), grads = gradient(params, encoded, tables, batch.inputs, truth)
            return jax.tree.map(jnp.add, carry, (found, grads)), None

        shapes = jax.eval_shape(gradient, params, encoded, tables, batch.inputs, jax.tree.map(lambda x: x[0], blocks))
        zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), (shapes[0][1], shapes[1]))
        (found, (towards_params, towards_encoded)), _ = jax.lax.scan(block, zeros, blocks)
        found, towards_params, towards_encoded = jax.tree.map(
            lambda x: x / config.ray_blocks, (found, towards_params, towards_encoded)
        )
        (through,) = pull((towards_encoded, jnp.ones(())))
        grads = jax.tree.map(jnp.add, towards_params, through)
        terms = Terms(*(a if a is not None else b for a, b in zip(terms, found, strict=True)))
        total = weighted_sum(terms, Terms(*(w if t is not None else None for t, w in zip(terms, weights, strict=True))))
        params, opt_state = solver.apply(params, opt_state, grads, total)
        return params, opt_state, terms._asdict() | {"total": total}

    return step
