"""Learning across scenes: the objective of a system, and one training step.

R        rays of a target, in equal blocks
V        source frames: of the static field, then of the dynamic one
The volumes are computed once a step, and memory is one block's (`blocks.in_blocks`).
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from zestjax.base.backend import quick
from zestjax.base.checks import check_option
from zestjax.base.precision import geometry_at, network_at
from zestjax.frames.assembly import dequantised
from zestjax.losses.objective import measured, present, weighted_sum
from zestjax.systems.system import Params, System
from zestjax.train.blocks import in_blocks, recomputed
from zestjax.train.measures import make_measures
from zestjax.train.terms import FRAMES, VOLUMES, check_answers, check_weights, frames_only, scene_terms, weights_of

SIMULATED_WEIGHTS = dict(
    rec=20.0, static_rec=8.0, dynamic_rec=4.0, b=1e-3, depth_ce=0.1, mask=0.05, flow3d=0.2, frame_ce=0.1, frame_mask=0.1
)  # the shipped weights' terms, with the simulator's exact answers
STAGES = ("all", "frames", "views")
SHOWN = "shown"  # beside the terms: colours of rays that are seen as a whole


def stage_weights(stage: str, *, weights: Mapping[str, Any]) -> dict[str, Any]:
    """The weights of one stage of training: what each frame says of itself (`frames`), all else with that held as it
    is (`views`), or both (`all`).

    Raises:
      ValueError: another stage.
    """
    check_option("stage_weights", stage=(stage, STAGES))
    kept = {"all": set(weights), "frames": set(FRAMES)}.get(stage, set(weights) - set(FRAMES))
    return {name: weight for name, weight in weights.items() if name in kept}


def training_objective(
    system: System,
    *,
    weights: Mapping[str, Any],
    blocks: int = 1,
    own: Mapping[str, Callable] = {},
    whole: bool = False,
) -> Callable:
    """What a system is taught by, as one function: for `jax.grad`, our Adam, and every solver of jaxopt.

    Args:
      system: `System`.
      weights: numbers by term; one that is absent is not in the program (see `losses.objective`).
      blocks: of rays. The objective is the mean of each block's own, and memory is one block's; with more than one its
        total alone has a gradient. In reverse mode, whatever the blocks: the convolutions know no other.
      own: measures of yours, by term: `measure(prediction, truth) -> ()` of a block of rays.
      whole: measures see all rays at once, as a term of a patch must. What a block computed is then computed again for
        its gradient; terms hold the rays' colours (R, 3) as SHOWN.

    Returns:
      `objective(params, batch, weights) -> (total, terms)`: weights are other numbers or arrays for the same terms, by
      default those given here. A batch is a `Batch`, or a `FrameBatch` where weights are `terms.frames_only`.

    Raises:
      ValueError: a weight whose term cannot be measured here, with what it needs.
    """
    declared = present(weights)
    check_weights("training_objective", system, declared, own=own)
    of_block = _ray_loss(system, own, blocks if whole else 1, shows=whole)
    rays = of_block if whole else in_blocks(of_block, blocks, where="training_objective")

    def objective(params: Params, batch, weights=declared):
        weights = {name: weights[name] for name in declared}
        batch = geometry_at(system.precision, batch)
        maps = None if params.analysis is None else _maps(system, params.analysis, batch, weights)
        if frames_only(weights):
            terms = scene_terms(maps, (None, None), batch, weights)
            return weighted_sum(terms, weights), terms
        network, inputs = network_at(system.precision, params), batch.inputs
        scene = system.encode(network, inputs, maps)
        volumes = scene.static.volume, None if scene.dynamic is None else scene.dynamic.volume
        of_scene = scene_terms(maps, volumes, batch, weights)
        of_rays = {name: _array(w, batch) for name, w in weights.items() if name not in {*VOLUMES, *FRAMES}}
        if not of_rays:
            return weighted_sum(of_scene, weights), of_scene
        held = inputs, jax.lax.stop_gradient(_with_volumes(scene, (None, None)))
        value, terms = rays((params, volumes, of_rays), held, batch.truth)
        total = value + weighted_sum(of_scene, weights_of(of_scene, weights)) if of_scene else value
        return total, of_scene | terms

    return objective


def _array(weight, batch):
    """A weight that the blocks' gradient is taken in too."""
    return jnp.asarray(weight, batch.truth.colour.dtype)


def _ray_loss(system, own, blocks, *, shows):
    """`loss((params, volumes, weights), (inputs, scene without volumes), truth) -> (total, terms)` of a block, itself
    rendered in blocks."""

    def render(shared, rays):
        (params, scene, inputs), (pixels, jitter) = shared, rays
        return system.render(params, scene, inputs, pixels, jitter=jitter)

    rendered = recomputed(render, blocks, where="training_objective")

    def loss(shared, held, truth):
        (params, volumes, weights), (inputs, scene) = shared, held
        params, scene = network_at(system.precision, params), _with_volumes(scene, volumes)
        prediction = rendered((params, scene, inputs), (truth.pixels, truth.jitter))
        check_answers("training_objective", {k: w for k, w in weights.items() if k not in own}, truth)
        measures = make_measures(system, params, scene, inputs) | own
        terms = measured(measures, prediction, truth, weights)
        shown = {SHOWN: prediction.colour} if shows else {}
        return weighted_sum(terms, weights), terms | shown

    return loss


def _with_volumes(scene, volumes):
    """The `Scene` with the two fields' volumes replaced."""
    static, dynamic = volumes
    moving = None if scene.dynamic is None else scene.dynamic._replace(volume=dynamic)
    return scene._replace(static=scene.static._replace(volume=static), dynamic=moving)


def _maps(system, params, batch, weights):
    """`FrameMaps` of a batch's frames, constant where no term of their own has a weight."""
    params = params if weights_of(FRAMES, weights) else jax.lax.stop_gradient(params)
    evidence = geometry_at(system.precision, dequantised(batch.evidence))
    return system.frames(network_at(system.precision, params), evidence)


def train_step(
    objective: Callable, solver: Any, *, weights: Callable | None = None, axes: tuple[str, ...] = ()
) -> Callable:
    """One step of training.

    Args:
      objective: `objective(params, batch) -> (total, terms)`, of `training_objective`.
      solver: `solve.Adam`, or anything with its `apply`.
      weights: of the number of the step, where they change with it; by default the objective's own.
      axes: of the mesh that it runs on, in a `jax.shard_map`: it steps along the mean of all devices' gradients.

    Returns:
      `step(params, opt_state, batch) -> (params, opt_state, terms)`, pure, the terms with `total`; jit it with donated
      arguments.
    """

    def step(params, opt_state, batch):
        now = () if weights is None else (weights(opt_state.iter_num),)
        taught = jax.value_and_grad(objective, has_aux=True)(params, batch, *now)
        (total, terms), grads = _mean_over(axes, taught) if axes else taught
        params, opt_state = solver.apply(params, opt_state, grads, total)
        return params, opt_state, terms | {"total": total}

    return step


def _mean_over(axes, tree):
    """Means over the devices of a mesh, sent as one vector: a message for each array costs more than what it holds."""
    flat, unravel = ravel_pytree(tree)
    return unravel(jax.lax.pmean(flat, axes))


class Fault(NamedTuple):
    """What of a step is not finite. terms: names of losses. leaves: paths of parameters. frames: the targets' times,
    none of a step that has no target."""

    terms: tuple[str, ...]
    leaves: tuple[str, ...]
    frames: tuple[int, ...]

    def __str__(self):
        some = lambda names: ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        lost = f"loss {some(self.terms)}" if self.terms else "no loss"
        where = f", target frame {some(tuple(map(str, self.frames)))}" if self.frames else ""
        return f"not finite: {lost}{where}; gradient of {some(self.leaves) if self.leaves else 'no parameter'}"


def find_fault(objective: Callable, params: Any, batch: Any) -> Fault:
    """`Fault` of a step's losses and gradients; the program of one objective is compiled once, at a step's cost."""
    grads, terms = jax.jit(_finite, static_argnames="objective", compiler_options=quick())(
        params, batch, objective=objective
    )
    named = jax.tree_util.tree_leaves_with_path(grads)
    leaves = tuple(jax.tree_util.keystr(path) for path, good in named if not good)
    lost = tuple(name for name, good in terms.items() if not good)
    times = np.ravel(batch.inputs.time) if hasattr(batch, "inputs") else ()
    return Fault(lost, leaves, tuple(map(int, times)))


def _finite(params, batch, *, objective):
    """Which gradients and which terms are finite."""
    (_, terms), grads = jax.value_and_grad(objective, has_aux=True)(params, batch)
    return jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), (grads, terms))
