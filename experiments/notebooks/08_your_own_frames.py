# %% [markdown]
# # Your own frames, camera and loss
#
# You have frames and cameras as arrays, and want a view from somewhere else, many of them, or a gradient through one.
# Here both are made by a loop of NumPy: a wall with a pattern, and a disc in front of it that slides to the right.
# Nothing is trained; the weights are those that come with the library.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from zestjax import metrics, novel_view
from zestjax.apps.weights import open_weights
from zestjax.cameras import Camera, look_at
from zestjax.video import Video

# %% [markdown]
# ## Frames and cameras
#
# A camera is a matrix of intrinsics in pixels and a pose, `camera_from_world`: x right, y down, z forward (OpenCV's),
# and the first pixel's centre is (0, 0), so that the middle of an image 128 wide is at 63.5. Poses that say where a
# camera is in the world are inverted first; `look_at` makes poses of places. A video's cameras are one `Camera` with a
# leading axis, and a frame's time is its index.

# %%
K = np.array([[128, 0, 63.5], [0, 128, 35.5], [0, 0, 1]], np.float32)
RAYS = np.stack([*np.meshgrid(np.arange(128), np.arange(72)), np.ones((72, 128))], -1) @ np.linalg.inv(K).T


def cameras_at(places):
    poses = look_at(jnp.asarray(places), jnp.array([0, 0, 4.0]), up=jnp.array([0, -1.0, 0]))
    return Camera(jnp.broadcast_to(K, (*poses.shape[:-2], 3, 3)), poses)


def photograph(pose, t):
    rays, here = RAYS @ pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    at = lambda z: (here + rays * (z - here[2]) / rays[..., 2:])[..., :2]  # where rays meet a plane
    paint = lambda p: 0.5 + 0.3 * np.sin(p @ np.array([[3, -2, 1], [1, 3, -4]]) + np.sin(p @ np.array([[9], [7]])))
    disc = at(3.0) - np.array([0.08 * t - 0.3, 0])
    return np.where(np.sum(disc**2, -1, keepdims=True) < 0.16, 1 - paint(disc), paint(at(5.0))).astype(np.float32)


cameras = cameras_at([[0.4 * np.sin(0.8 * t), 0.1 * np.cos(t), 0] for t in range(8)])
frames = np.stack([photograph(pose, t) for t, pose in enumerate(np.asarray(cameras.camera_from_world))])
video = Video(frames, cameras, near=2.0, far=8.0)

# %% [markdown]
# ## A view
#
# `prepare` asks each frame for its own depth and moving pixels, once; `render_view` then gives any camera at any of the
# frames' times. This camera took none of the frames, and at time 4 another one looked on.

# %%
model = open_weights()
scene = novel_view.prepare(model.params, video, system=model.system)
render = lambda camera: novel_view.render_view(model.params, scene, camera, 4, system=model.system)
mine = cameras_at([0.2, 0.1, 0.0])
view, truth = render(mine), photograph(np.asarray(mine.camera_from_world), 4)
print(f"{metrics.psnr(view.colour, truth):.1f} dB; the frame of that time {metrics.psnr(frames[4], truth):.1f} dB")
plt.imshow(np.concatenate([frames[4], view.colour, truth], 1))

# %% [markdown]
# From the left: the frame of that time, our camera's view, and what it should be.
#
# ## Three cameras at once
#
# A view is a pure function of its camera and its time: `jax.vmap` maps it, here over three places.

# %%
views = jax.jit(jax.vmap(render))(cameras_at([[-0.3, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]))
print(views.colour.shape, "colours, of which move", np.mean(views.dynamicness, (1, 2)).round(2))

# %% [markdown]
# ## A loss of our own, and its gradient in the camera's pose
#
# Any function of a view is a loss. This one compares it with a photograph. The pose's last column moves the camera in
# its own axes: it begins 6 cm beside the place that the photograph was taken from, and descends towards it.


# %%
def loss(shift):
    pose = mine.camera_from_world.at[:3, 3].add(shift)
    return jnp.mean(jnp.abs(render(mine._replace(camera_from_world=pose)).colour - truth))


slope, shift = jax.jit(jax.value_and_grad(loss)), jnp.array([0.06, 0.0, 0.0])
for _ in range(8):
    value, grad = slope(shift)
    print(f"loss {value:.4f} at {np.asarray(shift).round(3)}, gradient {np.asarray(grad).round(2)}")
    shift = shift - 0.015 * grad
