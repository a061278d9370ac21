# %% [markdown]
# # jaxopt's solvers on one objective
#
# Solvers here have jaxopt's interface: `init_state(params, ...)`, `update(params, state, ...)`, and a state that is a
# pytree. Our `Adam` has it too, and `training_objective` is the function that all of them minimise. So any of them can
# be put under it, and compared where it matters: how far the loss comes down in the seconds you have.
#
# The objective is the colour error of one batch in all parameters of a small static model: deterministic, which is
# what line searches and quasi-Newton methods need. (With a new batch every step only `Adam` and `ArmijoSGD` make
# sense.)

# %%
import time
import warnings

import jax
import matplotlib.pyplot as plt
import numpy as np

from zestjax.frames.analysis import OwnMaps
from zestjax.frames.selection import KeyFrames
from zestjax.simulate.clips import training_clip
from zestjax.solve import Adam, fit_lbfgs
from zestjax.systems.fields import Static
from zestjax.systems.swept import Swept
from zestjax.systems.system import Space, System
from zestjax.testing import quick
from zestjax.train.batches import batch_from_clip, prepare_clip
from zestjax.train.learn import training_objective
from zestjax.train.rays import Rows
from zestjax.train.recipes import Recipe

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt is no longer developed, and says so
    import jaxopt

static = Static(KeyFrames(3), volume=Swept(widths=(4, 8)), width=16, depth=2)
system = System(Space(6), static, dynamic=None, frames=OwnMaps(6, (4, 6)))
recipe = Recipe(system, rays=Rows(8), height=16, width=24)
clip = training_clip(jax.random.key(3), height=recipe.height, width=recipe.width, frames=8, targets=4)
batch = batch_from_clip(jax.random.key(2), prepare_clip(jax.random.key(0), clip, system), recipe)
params = system.init(jax.random.key(1))
weights = dict(rec=1.0)
objective = training_objective(system, weights=weights)
print(sum(x.size for x in jax.tree.leaves(params.static)), "parameters are fitted")

# %% [markdown]
# What each frame says of itself learns from losses of its own, and none of them has a weight here: the gradient in
# its parameters is 0, and they stay as they are.
#
# ## The same number of seconds for each
#
# Every solver starts from the same parameters and takes updates for six seconds; its compile is not counted, but told.
# After each update the loss at the new parameters is looked at, outside the clock. All are compiled with `quick()`,
# without most optimisations: the zoom search has the objective's gradient in it several times, and takes two minutes to
# compile as for a long run. Updates then take some times as long, of all solvers alike.

# %%
SECONDS = 6.0
value = jax.jit(lambda p: objective(p, batch)[0])
common = dict(fun=objective, has_aux=True)
SOLVERS = {
    "Adam 5e-4 (the paper's)": Adam(**common, learning_rate=5e-4),
    "Adam 5e-3": Adam(**common, learning_rate=5e-3),
    "gradient descent, line search": jaxopt.GradientDescent(**common, implicit_diff=False),
    "L-BFGS, zoom": jaxopt.LBFGS(**common, linesearch="zoom", implicit_diff=False),
}
curves = {}
for name, solver in SOLVERS.items():
    update = jax.jit(solver.update, compiler_options=quick())
    began = time.perf_counter()
    now, state = params, solver.init_state(params, batch)
    jax.block_until_ready(update(now, state, batch))
    compiling, spent, curve = time.perf_counter() - began, 0.0, [(0.0, float(value(params)))]
    while spent < SECONDS and len(curve) < 2000:
        began = time.perf_counter()
        now, state = jax.block_until_ready(update(now, state, batch))
        spent += time.perf_counter() - began
        curve.append((spent, float(value(now))))
    curves[name] = np.array(curve)
    print(
        f"{name:32} {len(curve) - 1:5} updates, loss {curve[0][1]:.5f} -> {curve[-1][1]:.5f}, compile {compiling:.0f} s"
    )

# %%
figure, axis = plt.subplots(figsize=(6.4, 3.8), dpi=80)
for name, curve in curves.items():
    axis.plot(curve[:, 0], curve[:, 1], label=name)
axis.set(
    xlabel="seconds of updates", ylabel="colour error", yscale="log", title="one batch, all solvers from one start"
)
axis.grid(alpha=0.3)
axis.legend(fontsize=8)

# %% [markdown]
# Per second, not per step: an update with a line search asks for the objective several times. This objective has
# corners (leaky ReLUs, clipped values, the nearest cell), and it shows. Adam at the higher rate comes lowest, though
# it rattles, and may end above its lowest. L-BFGS drops fast at first and then stalls at a corner; which one, rounding
# decides, so that its end differs from run to run (0.0012 to 0.0020 were seen; with the line search that only tracks
# back, which compiles twice as long and is left out here, it differs more). On smooth problems of few parameters the
# order is the reverse: see the notebook on poses.
#
# ## In one call
#
# `zestjax.solve.fit_lbfgs` runs such a solver to its end as one compiled loop and says how it went: whether it
# converged, and the norm of the gradient where it stopped. It maps over batches and weights like everything else.

# %%
whole = lambda p: fit_lbfgs(objective, p, batch, weights, max_steps=60, linesearch="zoom")
fit = jax.jit(whole, compiler_options=quick())(params)
print(f"{int(fit.steps)} steps, loss {float(value(fit.params)):.5f}, gradient {float(fit.grad_norm):.1e}, "
      f"converged: {bool(fit.converged)}")  # fmt: skip
