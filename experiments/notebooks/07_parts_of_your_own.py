# %% [markdown]
# # Parts of your own
#
# A system is a value made of parts: two fields, a sampler, a mix, and what is asked of the frames. A part is a frozen
# class of choices with the methods of its protocol. This notebook writes a field, a sampler, a head and a loss that the
# library has never seen, puts them into systems with `replace`, trains these for a few steps, and stores one.

# %%
import json
import time
from dataclasses import replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

from zestjax.base.parts import from_stored, part, to_stored
from zestjax.fields.heads import HeadParams, Reading
from zestjax.fields.static import StaticSample
from zestjax.fields.trunk import init_colour_head
from zestjax.frames.selection import KeyFrames
from zestjax.nets.layers import dense, init_dense
from zestjax.nets.positional import positional_encoding
from zestjax.simulate.clips import training_clip
from zestjax.solve import Adam
from zestjax.systems.fields import Seen
from zestjax.systems.presets import STILL, ZEST
from zestjax.systems.system import Space, System
from zestjax.train.batches import batch_from_clip, prepare_clip
from zestjax.train.learn import training_objective
from zestjax.train.recipes import PARTS, TINY

replace(ZEST, dynamic=None) == STILL, hash(ZEST) == hash(replace(ZEST))

# %% [markdown]
# ## A field
#
# `init` makes its parameters, `encode` says once a target what it reads of the frames, and a call gives density and
# colour of the samples of rays. This one reads nothing: it learns one scene by heart, as NeRF does. `blend_logit` says
# which field a sample belongs to; where there is no dynamic field nothing asks.


# %%
@part
class ByHeart:
    frames: KeyFrames = KeyFrames(1)  # the size of a view is that of its key-frames
    width: int = 64
    levels: int = 6

    def init(self, key):
        sizes = (3 * (1 + 2 * self.levels), self.width, self.width, 4)
        keys = jax.random.split(key, 3)
        return tuple(init_dense(k, a, b) for k, a, b in zip(keys, sizes[:-1], sizes[1:], strict=True))

    def encode(self, params, inputs, maps, frustum, depths):
        return Seen(volume=None, views=None)

    def __call__(self, params, seen, marched, place):
        first, second, last = params
        state = positional_encoding(marched.points.reshape(-1, 3) / 4, levels=self.levels)
        for layer in (first, second):
            state = jax.nn.relu(dense(layer, state))
        out = dense(last, state).reshape(*marched.depths.shape, 4)
        density = jax.nn.softplus(out[..., 3])
        return StaticSample(density, jax.nn.sigmoid(out[..., :3]), 0 * density, 0 * density)


# %% [markdown]
# ## A sampler
#
# Where a ray is looked at, as fractions from near to far, and what a sample stands for. `guided` would say that it
# needs the volumes' own opinion, `fills` that a ray which sees nothing shows its samples' colours.


# %%
@part
class Nearer:
    samples: int = 24
    power: float = 1.5
    guided: ClassVar[bool] = False
    fills: ClassVar[bool] = True

    def guide(self, volumes):
        return None

    def fractions(self, guides, pixels, jitter):
        even = (jnp.arange(self.samples, dtype=pixels.dtype) + 0.5) / self.samples
        return jnp.broadcast_to(even**self.power, (pixels.shape[0], self.samples))

    def lengths(self, fractions, depths, inputs, norm, planes):
        return jnp.ones_like(depths)


# %% [markdown]
# ## A head
#
# What a field of ours reads of its views at a point, and the colour it makes of it: here the mean of what they show.


# %%
@part
class MeanOfViews:
    looks: ClassVar[bool] = False

    def channels(self, *, volume, views, summaries):
        return max(volume, 1)

    def init(self, key, *, features, width, directions):
        return HeadParams(init_colour_head(key, width, directions), None)

    def __call__(self, params, volume, samples, views):
        seen = jnp.maximum(jnp.sum(samples.visible, 0), 1)[:, None]
        return Reading(volume, lambda state, direction: jnp.sum(samples.colour, 0).T / seen)


# %% [markdown]
# ## Systems of them
#
# An expression each. What a system lacks is not in its program: neither of these has a dynamic field.

# %%
tiny = TINY.system
SYSTEMS = {
    "by heart": System(Space(8), ByHeart(), None, Nearer(), frames=None),
    "mean of the views": replace(tiny, static=replace(tiny.static, head=MeanOfViews()), dynamic=None),
    "tiny, still": replace(tiny, dynamic=None),
}


def smooth(prediction, truth):
    """A loss of our own: the depth of neighbouring rays is alike."""
    return jnp.mean(jnp.abs(jnp.diff(jnp.log(prediction.depth))))


# %% [markdown]
# ## Trained for a few steps
#
# `training_objective` is one function of parameters and a batch: here for our Adam, as well for `jax.grad` or jaxopt's
# solvers. Our loss is weighed by its name like the others.

# %%
clip = training_clip(jax.random.key(7), height=TINY.height, width=TINY.width, frames=8, targets=4)


def trained(system, steps=60):
    recipe = replace(TINY, system=system)
    prepared = prepare_clip(jax.random.key(0), clip, system)
    batches = [batch_from_clip(jax.random.key(i), prepared, recipe) for i in range(8)]
    objective = training_objective(system, weights=dict(rec=1.0, smooth=0.002), own={"smooth": smooth}, blocks=2)
    solver = Adam(fun=objective, has_aux=True, learning_rate=5e-3, clip_norm=1.0)
    params = system.init(jax.random.key(1))
    state, step, losses = solver.init_state(params, batches[0]), jax.jit(solver.update), []
    params, state = step(params, state, batches[0])
    start = time.perf_counter()
    for i in range(steps):
        params, state = step(params, state, batches[i % 8])
        losses.append(float(state.value))
    return losses, (time.perf_counter() - start) / steps


curves = {name: trained(system) for name, system in SYSTEMS.items()}
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
for name, (losses, seconds) in curves.items():
    axes.plot(losses, label=f"{name}: {1000 * seconds:.0f} ms a step")
axes.set(xlabel="step", ylabel="loss", yscale="log")
axes.legend()
# %% [markdown]
# ## Stored
#
# A part is written as its class's name and its choices. A file names parts from the list that its reader is given, and
# nothing else is ever made of it; `apps.weights.open_weights(path, parts=(ByHeart, Nearer))` takes the list.

# %%
stored = json.dumps(to_stored(SYSTEMS["by heart"]))
assert from_stored(json.loads(stored), (*PARTS, ByHeart, Nearer)) == SYSTEMS["by heart"]
try:
    from_stored(json.loads(stored), PARTS)
except ValueError as error:
    print(str(error)[:60])
stored[:200]
