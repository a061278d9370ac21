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

from zestjax.batches import batch_from_clip, prepare_clip
from zestjax.learn import step_gradients
from zestjax.losses.objective import Terms
from zestjax.model import init_params
from zestjax.presets import preset
from zestjax.simulate.clips import training_clip
from zestjax.solve import Adam

config = preset("tiny")
size = dict(height=config.height, width=config.width, frames=8, targets=4)
clips = [training_clip(jax.random.key(i), **size) for i in (12, 5)]
prepared = [prepare_clip(jax.random.key(0), clip, config) for clip in clips]
learned_from = [batch_from_clip(jax.random.key(i), prepared[0], config) for i in range(24)]
held_back = [batch_from_clip(jax.random.key(i), prepared[1], config) for i in range(8)]

# %% [markdown]
# ## The step, for one and for many
#
# Two weights are swept: that of the motion mask, and that of the entropy of the blend. The others are Python numbers,
# which stay constants of the program. `vmap` says which arguments differ from run to run (0) and which are shared
# (None).

# %%
solver = Adam(learning_rate=2e-3, clip_norm=1.0)


def step(params, state, batch, mask, b):
    weights = Terms(rec=20.0, static_rec=8.0, depth_ce=0.1, frame_ce=0.1, frame_mask=0.1, mask=mask, b=b)
    grads, terms, total = step_gradients(config, weights=weights)(params, batch)
    return *solver.apply(params, state, grads, total), (terms.rec, terms.mask)


many = jax.jit(jax.vmap(step, in_axes=(0, 0, None, 0, 0)))
one = jax.jit(step)

MASK = np.array([0, 0.005, 0.02, 0.05, 0.2, 0.5, 2, 5], np.float32)
start = init_params(jax.random.key(1), config)
copies = lambda tree: jax.tree.map(lambda x: jnp.broadcast_to(x, (len(MASK), *x.shape)), tree)
params, state = copies(start), copies(solver.init_state(start))
entropy = jnp.full(len(MASK), 1e-3)
params, state, _ = many(params, state, learned_from[0], jnp.asarray(MASK), entropy)
began = time.perf_counter()
for i in range(1, 120):
    params, state, _ = many(params, state, learned_from[i % len(learned_from)], jnp.asarray(MASK), entropy)
jax.block_until_ready(params)
together = (time.perf_counter() - began) / 119

middle = jnp.float32(0.05), jnp.float32(1e-3)
single = one(start, solver.init_state(start), learned_from[0], *middle)[:2]
began = time.perf_counter()
for i in range(1, 30):
    single = one(*single, learned_from[i % len(learned_from)], *middle)[:2]
jax.block_until_ready(single)
alone = (time.perf_counter() - began) / 29
print(f"eight together: {1e3 * together:.0f} ms a step; one after the other: {8e3 * alone:.0f} ms")

# %% [markdown]
# On a CPU the eight share the cores, and the gain is small; on an accelerator, which a model of this size leaves
# idle, they cost little more than one. Either way there is one compile instead of eight, and the runs see the same
# batches, so that their differences are the weights' alone.
#
# ## What the weight does
#
# The models are judged on the scene they learned from, and on one that none has seen.


# %%
@jax.jit
@jax.vmap
def measures(params, batch):
    """Squared colour error and motion mask loss of a batch."""
    terms = step_gradients(config, weights=Terms(rec=1.0, mask=1.0))(params, batch)[1]
    return terms.rec, terms.mask


def judged(batches):
    each = [measures(params, jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * len(MASK)), b)) for b in batches]
    return np.asarray(each).mean(0)


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
# error on the unseen scene after one more step, in the weight of the mask. Its sign says which way to turn the knob.


# %%
def after_a_step(mask, params, state):
    params, _, _ = step(params, state, learned_from[0], mask, jnp.float32(1e-3))
    return step_gradients(config, weights=Terms(rec=1.0))(params, held_back[0])[2]


first = jax.tree.map(lambda x: x[3], (params, state))
slope = jax.jit(jax.jacfwd(after_a_step))(jnp.float32(MASK[3]), *first)
print(f"slope of the unseen scene's colour error in the weight of the mask at {MASK[3]}: {float(slope):+.2e}")
