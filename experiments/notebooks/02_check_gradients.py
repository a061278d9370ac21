# %% [markdown]
# # Is the gradient the slope?
#
# The loss of the full model goes through warps, volumes, sampled surfaces, compositing and networks. Here its
# gradient is compared with finite differences, and the error is plotted against the step: the shape of the curve
# tells a wrong gradient from rounding, and from a kink.

# %%
import functools

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from zestjax.analysis import frame_maps
from zestjax.assembly import dequantised
from zestjax.batches import batch_from_clip, prepare_clip
from zestjax.learn import step_gradients
from zestjax.losses.objective import Terms, measured, weighted_sum
from zestjax.measures import make_measures
from zestjax.model import encode, init_params
from zestjax.numerics import safe_norm
from zestjax.precision import geometry_at, network_at
from zestjax.prediction import render_rays
from zestjax.presets import preset
from zestjax.rendering import weights_from_density
from zestjax.simulate.clips import training_clip
from zestjax.testing import assert_grads_match, explain_gradient, held

config = preset(
    "tiny", height=16, width=24, planes=6, evidence_planes=6, frame_widths=(4, 6), volume_widths=(4, 8), key_frames=3,
    slots=(-1, 0, 1), crop_rows=4,
)  # fmt: skip
clip = training_clip(jax.random.key(3), height=config.height, width=config.width, frames=8, targets=4)
batch = batch_from_clip(jax.random.key(2), prepare_clip(jax.random.key(0), clip, config), config)
params = init_params(jax.random.key(1), config)

# %% [markdown]
# ## What a correct gradient looks like
#
# Start with one function: the weights of samples along a ray. A central difference errs by the square of the step,
# and by the rounding of the function divided by the step. The first shrinks with the step, the second grows, and
# between them lies a valley whose floor is as deep as the precision allows.

# %%
STEPS = np.logspace(-9, -0.5, 35)


def slopes(fn, x, way):
    """The slope by gradient, and by central differences at every step."""
    along = jax.jit(lambda t: fn(jax.tree.map(lambda a, b: a + t * b, x, way)))
    like = lambda t: jnp.asarray(t, jax.tree.leaves(x)[0].dtype)
    exact = jax.jit(jax.grad(along))(like(0.0))
    numeric = [(along(like(h)) - along(like(-h))) / (2 * h) for h in STEPS]
    return float(exact), np.array(numeric, np.float64)


def ray(density):
    return jnp.sum(weights_from_density(density, jnp.ones_like(density)) * jnp.arange(8.0, dtype=density.dtype))


draw = np.random.default_rng(0)
density, way = draw.uniform(0, 1, 8), draw.normal(size=8)
curves = {}
for name, dtype in (("float32", jnp.float32), ("float64", jnp.float64)):
    with jax.enable_x64(dtype == jnp.float64):
        exact, numeric = slopes(ray, jnp.asarray(density, dtype), jnp.asarray(way, dtype))
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
WEIGHTS = Terms(rec=1.0, static_rec=1.0, b=1e-2)


def loss(params, batch):
    maps = frame_maps(params.analysis, geometry_at("float64", dequantised(batch.evidence)))
    encoding = encode(params, batch.inputs, maps, config=config)
    prediction = render_rays(params, encoding, batch.inputs, batch.truth.pixels, config=config)
    measures = make_measures(params, encoding, batch.inputs, config=config)
    return weighted_sum(measured(measures, prediction, batch.truth, WEIGHTS), WEIGHTS)


with jax.enable_x64(True):
    exact_params, exact_batch = network_at("float64", params), geometry_at("float64", batch)
    plain = functools.partial(loss, batch=exact_batch)
    way = jax.tree.map(lambda x: jnp.asarray(draw.normal(size=x.shape) * 0.1), exact_params)
    curves = {}
    for name, fn in (("as it is", plain), ("with what is held, held", held(plain, exact_params))):
        exact, numeric = slopes(fn, exact_params, way)
        curves[name] = np.abs(numeric - exact) / abs(exact)
plot(curves, "a training step's loss, all parameters, float64")
print({name: f"{curve.min():.1e}" for name, curve in curves.items()})

# %% [markdown]
# Held, the curve falls as a valley should: the gradient is the slope. Not held, it stays at a plateau: that is not an
# error of the gradient but the effect of what was stopped. To the right both curves rise where the step passes kinks
# (the corners of leaky ReLUs and of clipped values), to the left rounding takes over.
#
# In one line, for any loss over any pytree:

# %%
with jax.enable_x64(True):
    assert_grads_match(plain, exact_params, directions=1, step=1e-7, rtol=1e-4)
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
# names the loss, the target frame and the parameters (`learn.find_fault`). The training gradient itself, which is
# summed block by block over rays, agrees with the plain one above:

# %%
blocked, terms, value = jax.jit(step_gradients(config, weights=WEIGHTS))(params, batch)
print({k: round(float(v), 4) for k, v in terms._asdict().items() if v is not None}, "total", round(float(value), 4))
