# %% [markdown]
# # A sweep over loss weights in one program
#
# Parameters, optimiser state and weights are pytrees, and a training step is a pure function of them. So a sweep is a
# `vmap`: eight models with eight different weights learn side by side from the same batches, in one compiled program.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from zestjax.simulate.clips import training_clip
from zestjax.solve import Adam
from zestjax.testing import quick
from zestjax.train.batches import batch_from_clip, prepare_clip
from zestjax.train.learn import training_objective
from zestjax.train.recipes import TINY

system = TINY.system
size = dict(height=TINY.height, width=TINY.width, frames=8, targets=4)
clips = [training_clip(jax.random.key(i), **size) for i in (12, 5)]
prepared = [prepare_clip(jax.random.key(0), clip, system) for clip in clips]
learned_from = [batch_from_clip(jax.random.key(i), prepared[0], TINY) for i in range(24)]
held_back = [batch_from_clip(jax.random.key(i), prepared[1], TINY) for i in range(8)]

# %% [markdown]
# ## The step, for one and for many
#
# One weight is swept, that of the motion mask. The others are Python numbers, which stay constants of the program.
# `vmap` says which arguments differ from run to run (0) and which are shared (None).

# %%
WEIGHTS = dict(rec=20.0, static_rec=8.0, b=1e-3, depth_ce=0.1, frame_ce=0.1, frame_mask=0.1, mask=0.05)
objective = training_objective(system, weights=WEIGHTS)
solver = Adam(fun=lambda p, batch, mask: objective(p, batch, WEIGHTS | {"mask": mask})[0],
              learning_rate=2e-3, clip_norm=1.0)  # fmt: skip
many = jax.jit(jax.vmap(solver.update, in_axes=(0, 0, None, 0)))
one = jax.jit(solver.update)

MASK = jnp.array([0, 0.005, 0.02, 0.05, 0.2, 0.5, 2, 5])
start = system.init(jax.random.key(1))
copies = lambda tree: jax.tree.map(lambda x: jnp.broadcast_to(x, (len(MASK), *x.shape)), tree)
params, state = many(copies(start), copies(solver.init_state(start)), learned_from[0], MASK)
began = time.perf_counter()
for i in range(1, 120):
    params, state = many(params, state, learned_from[i % len(learned_from)], MASK)
jax.block_until_ready(params)
together = (time.perf_counter() - began) / 119

single = one(start, solver.init_state(start), learned_from[0], MASK[3])
began = time.perf_counter()
for i in range(1, 30):
    single = one(*single, learned_from[i % len(learned_from)], MASK[3])
jax.block_until_ready(single)
alone = (time.perf_counter() - began) / 29
print(f"eight together: {1e3 * together:.0f} ms a step; one after the other: {8e3 * alone:.0f} ms")

# %% [markdown]
# On a CPU the eight share the cores, and the gain is small, or none; on an accelerator, which a model of this size
# leaves idle, they cost little more than one. Either way there is one compile instead of eight, and the runs see the
# same batches, so that their differences are the weights' alone.
#
# ## What the weight does
#
# The models are judged on the scene they learned from, and on one that none has seen.

# %%
judge = training_objective(system, weights=dict(rec=1.0, mask=1.0))
terms = jax.jit(jax.vmap(lambda params, batch: judge(params, batch)[1], in_axes=(0, None)), compiler_options=quick())


def judged(batches):
    """Squared colour errors and motion mask losses of all models, means over batches."""
    each = [terms(params, batch) for batch in batches]
    return [np.mean([found[name] for found in each], axis=0) for name in ("rec", "mask")]


scores = {"the scene learned from": judged(learned_from[:8]), "an unseen scene": judged(held_back)}
figure, axes = plt.subplots(1, 2, figsize=(8, 3), dpi=80)
print(f"{'weight':>8}", *(f"{name:>36}" for name in scores))
for name, (rec, mask) in scores.items():
    axes[0].plot(np.maximum(MASK, 1e-3), -10 * np.log10(rec), "o-", label=name)
    axes[1].plot(np.maximum(MASK, 1e-3), mask, "o-", label=name)
for i, weight in enumerate(MASK):
    cells = (f"PSNR {-10 * np.log10(rec[i]):5.2f} dB, mask loss {mask[i]:.3f}" for rec, mask in scores.values())
    print(f"{weight:8g}", *(f"{cell:>36}" for cell in cells))
for axis, what in zip(axes, ("PSNR, dB", "motion mask loss"), strict=True):
    axis.set(xscale="log", xlabel="weight of `mask` (0 at the left end)", ylabel=what)
    axis.grid(alpha=0.3)
axes[0].legend(fontsize=8)
figure.tight_layout()

# %% [markdown]
# A weight buys its own loss on what is learned from. Whether that carries over to another scene is a different
# question, which one clip cannot answer: most of what is learned from it is the clip. That is what the two curves
# side by side are for, and why the shipped weights were chosen on scenes that training never draws.

# %% [markdown]
# ## Gradients in the weights
#
# Weights are arguments like any other, so one can also ask for the slope of a result in a weight: here of the colour
# error on the unseen scene after one more step, in the weight of the mask: a gradient through a gradient. Its sign says
# which way to turn the knob.


# %%
def after_a_step(mask, params, state):
    params, _ = solver.update(params, state, learned_from[0], mask)
    return judge(params, held_back[0])[1]["rec"]


first = jax.tree.map(lambda x: x[3], (params, state))
slope = jax.jit(jax.grad(after_a_step), compiler_options=quick())(MASK[3], *first)
print(f"slope of the unseen scene's colour error in the weight of the mask at {MASK[3]:g}: {float(slope):+.2e}")
