# %% [markdown]
# # Is the gradient the slope?
#
# The loss of the full model goes through warps, volumes, sampled surfaces, compositing and networks. Here its
# gradient is compared with finite differences, and the error is plotted against the step: the shape of the curve
# tells a wrong gradient from rounding, and from a kink.

# %%
import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from zestjax.base.numerics import safe_norm
from zestjax.base.trees import tree_cast
from zestjax.frames.analysis import OwnMaps
from zestjax.frames.selection import KeyFrames, Slots
from zestjax.rendering import weights_from_density
from zestjax.simulate.clips import training_clip
from zestjax.systems.fields import Dynamic, Static
from zestjax.systems.swept import Swept
from zestjax.systems.system import Space, System
from zestjax.testing import assert_grads_match, explain_gradient, held, quick
from zestjax.train.batches import batch_from_clip, prepare_clip
from zestjax.train.learn import training_objective
from zestjax.train.rays import Rows
from zestjax.train.recipes import Recipe

small = dict(volume=Swept(widths=(4, 8)), width=16, depth=2)
system = System(
    Space(6), Static(KeyFrames(3), **small), Dynamic(Slots((-1, 0, 1)), **small), frames=OwnMaps(6, (4, 6))
)  # fmt: skip
recipe = Recipe(system, rays=Rows(4), height=16, width=24)
clip = training_clip(jax.random.key(3), height=recipe.height, width=recipe.width, frames=8, targets=4)
batch = batch_from_clip(jax.random.key(2), prepare_clip(jax.random.key(0), clip, system), recipe)
params = system.init(jax.random.key(1))

# %% [markdown]
# ## What a correct gradient looks like
#
# Start with one function: the weights of samples along a ray. A central difference errs by the square of the step,
# and by the rounding of the function divided by the step. The first shrinks with the step, the second grows, and
# between them lies a valley whose floor is as deep as the precision allows. (`quick()` are compiler options: these
# programs run a few times, and compiling them is most of the wait.)

# %%
STEPS = np.logspace(-9, -0.5, 35)


def slope(fn, x, way):
    """The slope of `fn` at `x` along `way`, by its gradient."""
    grads = jax.jit(jax.grad(fn), compiler_options=quick())(x)
    return float(sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(grads), jax.tree.leaves(way), strict=True)))


def differences(fn, x, way):
    """The same by central differences, at every step."""
    along = jax.jit(lambda t: fn(jax.tree.map(lambda a, b: a + t * b, x, way)), compiler_options=quick())
    like = lambda t: jnp.asarray(t, jax.tree.leaves(x)[0].dtype)
    return np.array([(along(like(h)) - along(like(-h))) / (2 * h) for h in STEPS], np.float64)


def ray(density):
    return jnp.sum(weights_from_density(density, jnp.ones_like(density)) * jnp.arange(8.0, dtype=density.dtype))


draw = np.random.default_rng(0)
density, way = draw.uniform(0, 1, 8), draw.normal(size=8)
curves = {}
for name, dtype in (("float32", jnp.float32), ("float64", jnp.float64)):
    with jax.enable_x64(dtype == jnp.float64):
        at = ray, jnp.asarray(density, dtype), jnp.asarray(way, dtype)
        exact, numeric = slope(*at), differences(*at)
    curves[name] = np.abs(numeric - exact) / abs(exact)


def plot(curves, title):
    figure, axis = plt.subplots(figsize=(5.2, 3.4), dpi=80)
    for name, curve in curves.items():
        axis.loglog(STEPS, np.maximum(curve, 1e-13), label=name)
    axis.set(xlabel="step", ylabel="relative error of the slope", title=title)
    axis.grid(alpha=0.3)
    axis.legend()


plot(curves, "weights along a ray")

# %% [markdown]
# In float32 the valley bottoms out near 1e-5: no check in float32 can tell a gradient that is wrong by 1e-5 from a
# right one. In float64 it reaches 1e-10. That is why `assert_grads_match` raises everything to float64 for the check,
# whatever the precision you work in.
#
# ## The full model
#
# The same for the loss of a whole training step in all of its parameters, along one random direction. Guides, trusted
# maps and the places where neighbours are looked at are held on purpose (`stop_gradient`): moving them is not part of
# the gradient. A plain finite difference moves them all the same, and disagrees. So the check must hold them too,
# which is what `zestjax.testing.held` does: it records what passes a `stop_gradient` once and plays it back.

# %%
WEIGHTS = dict(rec=1.0, static_rec=1.0, b=1e-2)
objective = training_objective(dataclasses.replace(system, precision="float64"), weights=WEIGHTS)


def plain(params):
    return objective(params, batch)[0]


with jax.enable_x64(True):
    exact_params = tree_cast(params, jnp.float64)
    way = jax.tree.map(lambda x: jnp.asarray(draw.normal(size=x.shape) * 0.1), exact_params)
    exact, curves = slope(plain, exact_params, way), {}
    for name, fn in (("as it is", plain), ("with what is held, held", held(plain, exact_params))):
        curves[name] = np.abs(differences(fn, exact_params, way) - exact) / abs(exact)
plot(curves, "a training step's loss, all parameters, float64")
print({name: f"{curve.min():.1e}" for name, curve in curves.items()})

# %% [markdown]
# Held, the curve falls as a valley should: the gradient is the slope. Not held, it stays at a plateau: that is not an
# error of the gradient but the effect of what was stopped. To the right both curves rise where the step passes kinks
# (the corners of leaky ReLUs and of clipped values), to the left rounding takes over.
#
# In one line, for any loss over any pytree, with the system as it is used, in float32: its program is run in float64.
# What the loss needs beside the parameters, and should not move, is `constant`.

# %%
usual = training_objective(system, weights=WEIGHTS)
assert_grads_match(lambda p, b: usual(p, b)[0], params, constant=(batch,), directions=1, step=1e-7, rtol=1e-4)
print("the gradient of the whole model is its slope")

# %% [markdown]
# ## When it is not
#
# A gradient can be finite and wrong, or right and not finite. The first shows in the plot; here is the second. The
# length of a flow that is exactly 0 has no slope: `jnp.linalg.norm` answers NaN, and one NaN spoils every parameter
# that the loss reaches. `explain_gradient` names the operation and the line.


# %%
def flow_lengths(flow):
    return {"naive": jnp.mean(jnp.linalg.norm(flow, axis=-1)), "safe": jnp.mean(safe_norm(flow))}


print(explain_gradient(flow_lengths, jnp.zeros((4, 3))))

# %% [markdown]
# In a training run the same question is asked for you: a step whose gradient is not finite is skipped, and the log
# names the loss, the target frame and the parameters (`learn.find_fault`). In training the gradient is summed block by
# block over rays, so that memory is one block's. It agrees with the plain one for losses that are means over all rays;
# a loss that a mask leaves some out of, such as `static_rec`, is the mean of the blocks' own means.

# %%
gradients = []
for blocks in (1, 4):
    taught = training_objective(system, weights=dict(rec=1.0, b=1e-2), blocks=blocks)
    (value, terms), found = jax.jit(jax.value_and_grad(taught, has_aux=True), compiler_options=quick())(params, batch)
    gradients.append(np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(found)]))
    print(blocks, "blocks:", {name: round(float(x), 4) for name, x in terms.items()}, "total", round(float(value), 4))
whole, blocked = gradients
print(f"the gradients differ by {np.linalg.norm(blocked - whole) / np.linalg.norm(whole):.0e} of their length")
