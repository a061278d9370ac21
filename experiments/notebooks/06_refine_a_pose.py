# %% [markdown]
# # Refine a camera's pose, and differentiate through the answer
#
# Cameras come from somewhere, and are never quite right. Here a pose is refined by least squares, first from points,
# then from the picture itself, and then the *answer* is differentiated: how does the refined pose depend on what it
# was computed from? No iteration is unrolled for that; the implicit function theorem needs only the optimum.

# %%
import warnings

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from zestjax.cameras import Camera, project, unproject
from zestjax.rays import pixel_grid
from zestjax.resample import bilinear
from zestjax.simulate.clips import training_clip
from zestjax.simulate.motion import rotation_from_vector
from zestjax.solve import fit_least_squares

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt is no longer developed, and says so
    from jaxopt.implicit_diff import custom_root

jax.config.update("jax_enable_x64", True)
clip = training_clip(jax.random.key(3), height=96, width=144, frames=4, targets=2)
raise_ = lambda x: jnp.asarray(x, jnp.float64)
first, second = (Camera(raise_(clip.intrinsics[i]), raise_(clip.camera_from_world[i])) for i in (0, 2))

# %% [markdown]
# ## A pose as six numbers
#
# A small motion is a rotation vector and a translation, applied on top of the camera we have. At 0 both are smooth:
# the library's rotation has its Taylor series there, not 0 / 0.


# %%
def moved(camera, motion):
    """The camera after a motion (6,): rotation vector, then translation in its own axes."""
    pose = jnp.eye(4, dtype=motion.dtype).at[:3, :3].set(rotation_from_vector(motion[:3])).at[:3, 3].set(motion[3:])
    return camera._replace(camera_from_world=pose @ camera.camera_from_world)


draw = np.random.default_rng(0)
still = np.flatnonzero(~clip.moving[0].ravel())
chosen = draw.choice(still, 40, replace=False)
pixels = pixel_grid(96, 144, dtype=jnp.float64).reshape(-1, 2)
points = unproject(first, pixels[chosen], raise_(clip.depth[0].ravel()[chosen]))
seen = project(second, points).pixels  # where the second camera sees them
unit = float(np.median(clip.depth[0]))
wrong = moved(second, raise_(np.r_[0.03, -0.05, 0.02, 0.03 * unit, -0.02 * unit, 0.04 * unit]))
off = jnp.linalg.norm(project(wrong, points).pixels - seen, axis=-1)
print(f"the wrong camera sees the points {float(off.mean()):.1f} pixels away, up to {float(off.max()):.1f}")

# %% [markdown]
# ## Gauss-Newton on points
#
# The residual is what separates pixels; `fit_least_squares` takes it as it is. Gauss-Newton squares the error at
# every step once it is near.


# %%
def apart(motion, seen):
    return project(moved(wrong, motion), points).pixels - seen


@jax.jit
def one_step(motion):
    return fit_least_squares(apart, motion, seen, method="gauss_newton", max_steps=1, tol=0.0).params


curve, motion = [], jnp.zeros(6)
for _ in range(8):
    curve.append(float(jnp.sqrt(jnp.mean(apart(motion, seen) ** 2))))
    motion = one_step(motion)
figure, axis = plt.subplots(figsize=(5, 3), dpi=80)
axis.semilogy(np.maximum(curve, 1e-14), "o-")
axis.set(xlabel="steps of Gauss-Newton", ylabel="root mean square, pixels")
axis.grid(alpha=0.3)

# %% [markdown]
# A pose that the data do not fix: all points in one direction from the camera. The Jacobian is short of rank, and a
# method that inverts its square answers NaN. Levenberg-Marquardt, solved by QR, goes where the data point and stays
# put elsewhere.

# %%
line = unproject(wrong, jnp.tile(jnp.asarray([[70.0, 40.0]]), (40, 1)), jnp.linspace(unit, 2 * unit, 40))
only_one_pixel = lambda motion: project(moved(wrong, motion), line).pixels - jnp.asarray([[72.0, 41.0]])
fit = fit_least_squares(only_one_pixel, jnp.zeros(6), method="levenberg_marquardt", max_steps=30)
print(
    "rank",
    int(jnp.linalg.matrix_rank(jax.jacobian(only_one_pixel)(jnp.zeros(6)).reshape(-1, 6), rtol=1e-6)),
    "| residual",
    f"{float(jnp.abs(only_one_pixel(fit.params)).max()):.1e}",
    "| finite",
    bool(jnp.isfinite(fit.params).all()),
)

# %% [markdown]
# ## From the picture itself
#
# Without known points: the first frame's pixels, at their depths, must have the second frame's colours where the
# camera sees them. The residual is a colour at every still pixel; its derivative goes through a bilinear look-up.
# Colours only pull from nearby, so the picture is blurred first and sharpened as the pose improves.

# %%
images = raise_(clip.images) / 255
still_pixels = pixels[still[::3]]
still_points = unproject(first, still_pixels, raise_(clip.depth[0].ravel()[still[::3]]))
colours = images[0].reshape(-1, 3)[still[::3]]


def blurred(image, radius):
    reach = np.arange(-3 * radius, 3 * radius + 1)
    kernel = np.exp(-0.5 * (reach / radius) ** 2)
    kernel = raise_(kernel / kernel.sum())
    smooth = lambda x: jnp.convolve(jnp.pad(x, 3 * radius, mode="edge"), kernel, mode="valid")
    for axis in (0, 1):
        image = jnp.apply_along_axis(smooth, axis, image)
    return image


def colours_apart(motion, image, colours):
    """(P, 3), 0 where the camera does not see the point; a difference beyond 0.2 (something hides it) pulls no more."""
    there = project(moved(start, motion), still_points)
    found, inside = bilinear(image, there.pixels)
    seen = (inside & there.in_front)[:, None]
    return jnp.where(seen, 0.2 * jnp.tanh((found - colours) / 0.2), 0)


start = moved(second, raise_(np.r_[0.01, -0.015, 0.008, 0.01 * unit, -0.008 * unit, 0.012 * unit]))
refine = jax.jit(lambda *args: fit_least_squares(colours_apart, *args, max_steps=30).params)
motion = jnp.zeros(6)
error = lambda motion: float(jnp.abs(project(moved(start, motion), points).pixels - seen).mean())
print(f"start: {error(motion):.2f} pixels")
for radius in (4, 2, 1):
    soft = blurred(images[2], radius)
    same = blurred(images[0], radius).reshape(-1, 3)[still[::3]]
    motion = refine(motion, soft, same)
    print(f"blur {radius}: {error(motion):.2f} pixels")

# %% [markdown]
# ## The answer as a function
#
# The refined pose is a function of the observed pixels, defined by "the gradient of the sum of squares is 0". Wrapped
# in `custom_root`, the solver is differentiated through that equation. Three ways to the same Jacobian (6 numbers of
# pose by 80 observed coordinates): implicitly, by moving each observation and solving again, and by the closed form
# $-(J^\top J)^{-1}J^\top$ of Gauss-Newton, which leaves out the residual's curvature and is exact when nothing is
# left over.


# %%
def slope_of_squares(motion, seen):
    return jax.grad(lambda m: 0.5 * jnp.sum(apart(m, seen) ** 2))(motion)


@custom_root(slope_of_squares)
def refined(initial, seen):
    del initial
    return jax.lax.stop_gradient(fit_least_squares(apart, jnp.zeros(6), seen, method="gauss_newton", tol=1e-10).params)


solve = jax.jit(lambda seen: refined(jnp.zeros(6), seen))
noisy = seen + raise_(draw.normal(size=seen.shape)) * 0.5
solution = solve(noisy)
implicit = jax.jit(jax.jacobian(solve))(noisy).reshape(6, -1)


def again(i, h=1e-4):
    step = jnp.zeros(noisy.size).at[i].set(h).reshape(noisy.shape)
    return (solve(noisy + step) - solve(noisy - step)) / (2 * h)


some = [0, 7, 33, 60]
numeric = jnp.stack([again(i) for i in some], axis=1)
jacobian = jax.jacobian(apart)(solution, noisy).reshape(-1, 6)
closed = jnp.linalg.pinv(jacobian)
away = lambda a, b: float(jnp.abs(a - b).max() / jnp.abs(b).max())
print(f"implicit against solving again: {away(implicit[:, some], numeric):.1e}")
print(f"implicit against Gauss-Newton's closed form: {away(implicit, closed):.1e} (what the residual's curvature adds)")

# %% [markdown]
# What this is good for: with half a pixel of noise in the observations, the uncertainty of the pose follows at once,
# with no sampling, and any loss computed *after* refinement has a gradient in what came before it.

# %%
spread = 0.5 * jnp.sqrt(jnp.sum(implicit**2, axis=1))
solved = jnp.stack([solve(seen + raise_(draw.normal(size=seen.shape)) * 0.5) for _ in range(400)])
sampled = jnp.std(solved, axis=0)
print("standard deviation  ", "  ".join(f"{n:>8}" for n in ("rot x", "rot y", "rot z", "x", "y", "z")))
print("by the Jacobian     ", "  ".join(f"{float(x):8.5f}" for x in spread))
print("by solving 400 times", "  ".join(f"{float(x):8.5f}" for x in sampled))
