"""Data parallel training: the devices of a mesh share the clips of a step, and the blocks of their rays.

CLIPS, RAYS    the axes of a mesh: a device has an equal part of the clips, and of each clip's blocks an equal part
host           a process of `jax.distributed`: it computes on its own devices, and every one has the whole batch

What a step computes is the recipe's; the mesh says where. So parameters are those of one device, but for the order in
which a mean is summed. A scene's volumes are computed by all devices that share its rays: clips are shared first.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from zestjax.train.recipes import Recipe
from zestjax.train.terms import frames_only

CLIPS, RAYS = "clips", "rays"


def ray_parts(recipe: Recipe) -> int:
    """Parts in which devices can compute the rays of one clip: its blocks, or 1 where a term sees them as a whole, or
    none."""
    return 1 if recipe.own or frames_only(recipe.weights(0)) else recipe.blocks


def shares(recipe: Recipe, count: int) -> tuple[int, int]:
    """How many devices of `count` share the clips of a step, and how many the rays of one clip.

    Raises:
      ValueError: there are no so many equal parts.
    """
    clips = math.gcd(recipe.clips, count)
    rays, parts = count // clips, ray_parts(recipe)
    if parts % rays:
        raise ValueError(
            f"shares: {count} devices cannot have equal parts of a step of clips={recipe.clips}, each in {parts} "
            "blocks of rays that may be apart; take a number of devices that divides, or set `clips` or `blocks`."
        )
    return clips, rays


def mesh_of(recipe: Recipe, devices: Sequence[Any]) -> Mesh:
    """The mesh of devices that share a step of a recipe; raises as `shares`."""
    return Mesh(np.array(devices).reshape(shares(recipe, len(devices))), (CLIPS, RAYS))


def mesh_trainer(recipe: Recipe, mesh: Mesh, *, steps: int) -> tuple[Callable, Callable]:
    """`Recipe.trainer` on a mesh of `mesh_of`, its step compiled.

    Args:
      recipe: `Recipe`.
      mesh: of the devices of all hosts.
      steps: of the run.

    Returns:
      (init(params) -> opt_state, step(params, opt_state, batch) -> (params, opt_state, terms)). Each host gives the
      same; what comes back lies on every device, what was given is donated. A batch is the whole one, on the host.
    """
    part = replace(recipe, clips=recipe.clips // mesh.shape[CLIPS], blocks=recipe.blocks // mesh.shape[RAYS])
    init, of_part = part.trainer(steps=steps, axes=mesh.axis_names)
    single, everywhere = part.clips < recipe.clips and part.clips == 1, NamedSharding(mesh, PartitionSpec())

    def of_device(params, opt_state, batch):
        return of_part(params, opt_state, jax.tree.map(lambda x: x[0], batch) if single else batch)

    @jax.jit(donate_argnums=(0, 1))
    def compiled(params, opt_state, batch):
        cut = (PartitionSpec(), PartitionSpec(), _cuts(recipe, batch))
        shared = jax.shard_map(of_device, mesh=mesh, in_specs=cut, out_specs=PartitionSpec(), check_vma=False)
        return shared(params, opt_state, batch)

    def step(params, opt_state, batch):
        params, opt_state = jax.device_put((params, opt_state), everywhere)
        return compiled(params, opt_state, jax.tree.map(_placed, batch, _shardings(recipe, mesh, batch)))

    return init, step


def _cuts(recipe, batch) -> Any:
    """A `PartitionSpec` for each leaf of a batch."""
    clips = (CLIPS,) if recipe.clips > 1 else ()
    of_scene, of_rays = PartitionSpec(*clips), PartitionSpec(*clips, RAYS)
    cuts = jax.tree.map(lambda _: of_scene, batch)
    return cuts._replace(truth=jax.tree.map(lambda _: of_rays, batch.truth)) if hasattr(batch, "truth") else cuts


def _shardings(recipe, mesh, batch) -> Any:
    return jax.tree.map(lambda cut: NamedSharding(mesh, cut), _cuts(recipe, batch))


def _placed(x, sharding):
    """An array of the host, each part on its device."""
    x = np.asarray(x)
    return jax.make_array_from_callback(x.shape, sharding, lambda index: x[index])
