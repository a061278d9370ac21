"""One of the processes that share a step: `mesh_child.py PORT COUNT INDEX few|all`, of terms. The first prints, by
case, how far the parameters are from those of a single device, and how far they went. In float64: there Adam's eps is
above the rounding of a gradient."""

import json
import sys
from dataclasses import replace

import jax

jax.distributed.initialize(f"127.0.0.1:{sys.argv[1]}", int(sys.argv[2]), int(sys.argv[3]))
jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import stage  # noqa: E402

from zestjax.base.trees import tree_cast  # noqa: E402
from zestjax.train.batches import stacked  # noqa: E402
from zestjax.train.mesh import mesh_of, mesh_trainer  # noqa: E402

STEPS = 3


def trained(trainer, start, batch):
    init, step = trainer
    params = jax.tree.map(jnp.array, start)
    state = init(params)
    for _ in range(STEPS):
        params, state, terms = step(params, state, batch)
    return jax.device_get((params, terms))


def furthest(one, other):
    return max(jax.tree.leaves(jax.tree.map(lambda a, b: float(np.abs(a - b).max(initial=0)), one, other)))


few = sys.argv[4] == "few"
system = replace(stage.STILL if few else stage.MINI, precision="float64")
recipe = stage.recipe_of(system).weighted(dict(rec=1.0, depth_ce=0.1) if few else stage.usual_weights(system))
start = tree_cast(stage.params_of(system), jnp.float64)
both = [stage.batch(system, kind) for kind in range(2)]
found = {}
for name, clips, batch in (("rays", 1, both[0]), ("clips", 2, stacked(both))):
    chosen = replace(recipe, clips=clips)
    mesh = mesh_of(chosen, jax.devices())
    params, terms = trained(mesh_trainer(chosen, mesh, steps=9), start, batch)
    if jax.process_index() == 0:
        init, step = chosen.trainer(steps=9)
        alone, said = trained((init, jax.jit(step)), start, batch)
        found[name] = {
            "mesh": dict(mesh.shape), "params": furthest(params, alone), "terms": furthest(terms, said),
            "moved": furthest(params, jax.device_get(start)),
        }  # fmt: skip
if jax.process_index() == 0:
    print(json.dumps(found))
