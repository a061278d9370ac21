# %% [markdown]
# # Compose a loss and weight it
#
# A loss here is a plain function of a prediction and of what is true. Losses and weights are dicts of numbers by name,
# and the total is their weighted sum. This notebook writes a loss that the library does not know, checks it before it
# is trusted, adds it to the others, and shows what it buys and what it costs.
#
# Everything runs on a small simulated clip, whose truth is exact, with the `tiny` recipe.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from zestjax.base.numerics import safe_norm
from zestjax.frames.assembly import dequantised
from zestjax.losses.means import mean_over_valid
from zestjax.metrics import psnr
from zestjax.model import predict
from zestjax.simulate.clips import training_clip
from zestjax.solve import Adam
from zestjax.testing import assert_finite, assert_grads_match, explain_gradient
from zestjax.train.batches import batch_from_clip, prepare_clip
from zestjax.train.learn import training_objective
from zestjax.train.recipes import TINY

system, height, width = TINY.system, TINY.height, TINY.width
clip = training_clip(jax.random.key(3), height=height, width=width, frames=8, targets=4)
prepared = prepare_clip(jax.random.key(0), clip, system)
batches = [batch_from_clip(jax.random.key(i), prepared, TINY) for i in range(16)]
params = system.init(jax.random.key(1))
f"{len(clip.images)} frames of {height} x {width}; a batch is {len(batches[0].truth.pixels)} rays"

# %% [markdown]
# ## From parameters to a prediction
#
# What each frame says about itself, then the volumes of the target and the rays through them. Both are pure functions
# of arrays, so the whole is one: it can be compiled, differentiated and mapped.


# %%
@jax.jit
def predicted(params, batch):
    maps = system.frames(params.analysis, dequantised(batch.evidence))
    return predict(params, batch.inputs, maps, batch.truth.pixels, system=system)


prediction = predicted(params, batches[0])
{name: getattr(prediction, name).shape for name in ("colour", "depth", "dynamicness", "weights")}

# %% [markdown]
# ## A loss of our own
#
# Squared colour errors forgive blur. A batch is whole rows of the target, so neighbouring rays are neighbouring
# pixels, and we can ask that colours *change* from pixel to pixel as they do in the truth. The first attempt takes
# the length of the difference of the two changes, with NumPy's norm.


# %%
def across(colour):
    rows = colour.reshape(-1, width, 3)
    return rows[:, 1:] - rows[:, :-1]


def naive_edge_loss(colour, target):
    return jnp.mean(jnp.linalg.norm(across(colour) - across(target), axis=-1))


target = jnp.asarray(batches[0].truth.colour)
try:
    assert_finite(naive_edge_loss, target, target)
except AssertionError as error:
    print(error)

# %% [markdown]
# `assert_finite` looks at the value and at every gradient: where the rendered change equals the true one, the norm is
# 0 and its slope 0 / 0. In training this strikes at the first flat region that is rendered exactly.
# `explain_gradient` says where it comes from.

# %%
print(explain_gradient(lambda c: {"edge": naive_edge_loss(c, target)}, target))

# %% [markdown]
# `numerics.safe_norm` has slope 0 there. `mean_over_valid` is how every loss in the library averages: what a mask
# leaves out may even be NaN. The two checks below are all it takes: finite, and the gradient is the slope.


# %%
def edge_loss(colour, target, *, valid=None):
    return mean_over_valid("edge_loss", safe_norm(across(colour) - across(target)), valid=valid)


assert_finite(edge_loss, target, target)
assert_grads_match(edge_loss, jnp.asarray(prediction.colour), target)
print("finite where colours are equal, and the gradient matches finite differences")

# %% [markdown]
# ## Into the objective
#
# `training_objective` makes one function of a system and its weights: `objective(params, batch) -> (total, terms)`.
# Ours joins the library's losses under a name of its own, as a measure of a prediction and the truth. A loss is
# measured only if its weight is not absent (`None` or the number 0): what is absent is not in the compiled program.

# %%
WEIGHTS = dict(rec=20.0, static_rec=8.0, b=1e-3, mask=0.05)


def edge(prediction, truth):
    return edge_loss(prediction.colour, truth.colour)


objective = training_objective(system, weights=WEIGHTS | {"edge": 1.0}, own={"edge": edge})
print(explain_gradient(lambda p: objective(p, batches[0])[1], params))

# %% [markdown]
# The table gives the value of each loss and how hard it pulls at each part of the model: a quick way to choose a
# weight is to let a new loss pull about as hard as the old ones. The rows before weighting say that a weight near 1
# does that. Weights can also be told at the call, `objective(params, batch, weights)`, as numbers or as arrays: one
# program then serves every weight, as here and in the notebooks on single terms and on sweeps.
#
# ## With and without
#
# The same 200 steps from the same start, with weights 0 and 2 of our loss; held-back batches measure.


# %%
solver = Adam(fun=objective, has_aux=True, learning_rate=2e-3, clip_norm=1.0)
update = jax.jit(solver.update)


def trained(weights, steps=200):
    now, state = params, solver.init_state(params, batches[0], weights)
    for i in range(steps):
        now, state = update(now, state, batches[i % 12], weights)
    return now


shown = []
for edge_weight in (0.0, 2.0):
    fitted = trained(WEIGHTS | {"edge": edge_weight})
    colours = [predicted(fitted, b).colour for b in batches[12:]]
    truths = [jnp.asarray(b.truth.colour) for b in batches[12:]]
    score = np.mean([psnr(c[None], t[None]) for c, t in zip(colours, truths, strict=True)])
    edges = np.mean([edge_loss(c, t) for c, t in zip(colours, truths, strict=True)])
    shown.append(colours[0])
    print(f"weight {edge_weight}: PSNR {score:.2f} dB, edge loss {edges:.4f}")

# %%
images = [np.asarray(x).reshape(-1, width, 3).clip(0, 1) for x in (*shown, truths[0])]
figure, axes = plt.subplots(3, 1, figsize=(6, 3.6), dpi=80)
for axis, image, title in zip(axes, images, ("weight 0", "weight 2", "truth"), strict=True):
    axis.imshow(image)
    axis.set_title(title, fontsize=9)
    axis.axis("off")

# %% [markdown]
# Changes from pixel to pixel come nearer to the truth's. Whether the picture is better for it is for the pictures, and
# for the scores on scenes of your own, to say.
