# %% [markdown]
# # What each loss term does to a scene
#
# The same small model learns the same clip five times: once with all of its losses, and once without each of four.
# What is missing afterwards is what the term was for. All runs share one compiled step, because weights may be
# arguments: a weight that is an array, even one holding 0, is computed. (A Python 0 leaves a term out of the program
# instead. That is what you want in a real run, and it costs a compile for each choice.)

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from zestjax.cameras import Camera
from zestjax.metrics import psnr
from zestjax.novel_view import prepare, render_view
from zestjax.simulate.clips import training_clip
from zestjax.solve import Adam
from zestjax.train.batches import batch_from_clip, prepare_clip
from zestjax.train.recipes import TINY
from zestjax.video import Video

system = TINY.system
clip = training_clip(jax.random.key(12), height=TINY.height, width=TINY.width, frames=8, targets=4)
prepared = prepare_clip(jax.random.key(0), clip, system)._replace(holes=())
batches = [batch_from_clip(jax.random.key(i), prepared, TINY) for i in range(40)]
figure, axes = plt.subplots(1, 4, figsize=(8, 1.6), dpi=80)
for axis, image, title in zip(
    axes,
    (clip.images[0], clip.images[-1], clip.target_images[0], clip.target_moving[0]),
    ("first frame", "last frame", "a target", "what moves in it"),
    strict=True,
):
    axis.imshow(image)
    axis.set_title(title, fontsize=9)
    axis.axis("off")

# %% [markdown]
# ## One step, weights as an argument

# %%
solver = Adam(fun=TINY.objective(), has_aux=True, learning_rate=3e-3, clip_norm=1.0)
update = jax.jit(solver.update)


def learned(without=None, steps=120):
    weights = {name: jnp.float32(0 if name == without else weight) for name, weight in TINY.weights(0).items()}
    params = system.init(jax.random.key(1))
    state = solver.init_state(params, batches[0], weights)
    for i in range(steps):
        params, state = update(params, state, batches[i % len(batches)], weights)
    return params


start = time.perf_counter()
ABOUT = {
    None: "all losses",
    "mask": "the dynamic field's share of a pixel must be the motion mask",
    "depth_ce": "the volumes' surfaces must lie at the true depths",
    "frame_ce": "each frame's own depths must be right, since they decide whom to trust",
    "flow3d": "points of the dynamic field must move as the scene does",
}
models = {without: learned(without) for without in ABOUT}
print(f"{len(models)} runs in {time.perf_counter() - start:.0f} s, the compile included")

# %% [markdown]
# ## What they render
#
# Every model renders a target of the clip. Beside its colours stand the static field alone (what the model takes the
# scene to be without what moves), the share of the dynamic field, and the depth.

# %%
video = Video(
    clip.images.astype(np.float32) / 255, Camera(clip.intrinsics, clip.camera_from_world), clip.near, clip.far
)
target = Camera(clip.target_intrinsics[0], clip.target_camera_from_world[0])
truth = jnp.asarray(clip.target_images[0], jnp.float32) / 255
still = jnp.asarray(clip.target_static_images[0], jnp.float32) / 255
moving = jnp.asarray(clip.target_moving[0], jnp.float32)
views = {w: render_view(p, prepare(p, video, system=system), target, int(clip.target_time[0]), system=system)
         for w, p in models.items()}  # fmt: skip


def row(view):
    share = lambda mask: float(jnp.sum(view.dynamicness * mask) / jnp.sum(mask))
    off = jnp.median(jnp.abs(view.depth - clip.target_depth[0]) / clip.target_depth[0])
    scores = psnr(view.colour, truth), psnr(view.colour, truth, mask=moving), psnr(view.static, still)
    return *map(float, scores), share(moving), share(1 - moving), float(off)


head = ("without", "PSNR", "moving", "static field", "dynamic where moving", "elsewhere", "depth error")
print("  ".join(f"{name:>20}" for name in head))
for without, view in views.items():
    cells = row(view)
    print("  ".join([f"{without or 'nothing':>20}", *(f"{x:20.2f}" for x in cells)]))

# %%
figure, axes = plt.subplots(len(views) + 1, 4, figsize=(7.2, 1.3 * (len(views) + 1)), dpi=80)
for axis in axes.flat:
    axis.axis("off")
depths = dict(vmin=float(clip.near), vmax=float(np.percentile(clip.target_depth[0], 95)), cmap="viridis")
for line, (name, parts) in zip(
    axes,
    [("truth", (truth, still, moving, clip.target_depth[0]))]
    + [(w or "nothing", (v.colour, v.static, v.dynamicness, v.depth)) for w, v in views.items()],
    strict=True,
):
    for axis, part, options in zip(line, parts, ({}, {}, dict(vmin=0, vmax=1, cmap="magma"), depths), strict=True):
        axis.imshow(np.asarray(part), **options)
    line[0].set_title(f"without {name}" if name != "truth" else name, fontsize=8, loc="left")
for axis, title in zip(axes[0][1:], ("static field", "dynamic share", "depth"), strict=True):
    axis.set_title(title, fontsize=8)
figure.tight_layout(pad=0.3)

# %% [markdown]
# What to look for:
#
# - without `flow3d` what moves loses most, though the dynamic field takes more of it than in any other row: the flow
#   says where a point is in the neighbouring frames, and a wrong one fetches the wrong colours, however sure the mask
#   is;
# - without `mask` nothing says which pixels move, and the dynamic field's share of them is the least of all. The static
#   field then paints the mover where it sees it, which on the clip it learned from is good enough to fool the score;
# - without `frame_ce` it is the same in part: a frame says less of what moves, the static field learns the mover by
#   heart, and the score of one clip is the better for it. The depths are the worst of all;
# - `depth_ce` changes little here, and tenths of a decibel say nothing: there was one draw of the first parameters.
#   On one clip the colours alone tell the model most of it; what these terms are for shows on scenes that it has not
#   seen.
#
# A clip of 32 x 48 pixels and 400 steps are a sketch; the ablation of the whole system is in `experiments/study.py`.
