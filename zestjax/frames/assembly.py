"""From a video on the host to the arrays of one target: frames chosen, evidence found, everything in fixed shapes.

N        frames of the video
exclude  frames that must serve nothing: not as key-frame or slot, not in another frame's evidence
"""

import functools
from collections.abc import Collection, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.base.checks import traced
from zestjax.base.types import Array, Scalar
from zestjax.cameras import Camera
from zestjax.frames.along import gaps_along
from zestjax.frames.cells import half_images
from zestjax.frames.evidence import Evidence, MatchingViews, Neighbours, frame_evidence
from zestjax.frames.optical_flow import VideoFlow, video_flow
from zestjax.frames.selection import Chosen, key_frames, neighbours

EVIDENCE_SOURCES = 8  # frames that one is compared with, as many as a target has key-frames; never varied


def positions(cameras: Camera) -> Array:
    """(N, 3) optical centres: numpy of cameras on the host, JAX's where they are traced."""
    xp = jnp if traced(cameras) else np
    pose = xp.asarray(cameras.camera_from_world)
    return -xp.einsum("nji,nj->ni", pose[:, :3, :3], pose[:, :3, 3])


def taken(cameras: Camera, frames: int | Array) -> Camera:
    """`Camera` of the chosen frames."""
    xp = jnp if traced((cameras, frames)) else np
    return jax.tree.map(lambda leaf: xp.asarray(leaf)[frames], cameras)


class Footage(NamedTuple):
    """What evidence is found from, once a video. half: (N, 2h, 2w, 3) float32, half resolution. flow: `VideoFlow`."""

    half: jax.Array
    flow: VideoFlow


def footage(images: Array) -> Footage:
    """`Footage` of (N, H, W, 3) images, uint8 or float in [0, 1]."""
    return Footage(_halved(jnp.asarray(images)), video_flow(images))


@jax.jit
def _halved(images):
    return half_images(colours_of(images))


def colours_of(images: Array) -> Array:
    """Images as they are, or of uint8 their float32 in [0, 1]."""
    return images.astype(jnp.float32) / 255 if images.dtype == jnp.uint8 else images


@functools.partial(jax.jit, static_argnames=("planes",))
def _evidence(image, camera, sources, neighbours, along, near, far, *, planes):
    found = frame_evidence(image, camera, sources, neighbours, along, near, far, planes=planes)
    return Evidence(*(jnp.round(255 * jnp.clip(x, 0, 1)).astype(jnp.uint8) for x in found))


def video_evidence(
    seen: Footage,
    cameras: Camera,
    near: Scalar,
    far: Scalar,
    *,
    planes: int,
    frames: Sequence[int] | Array | None = None,
    exclude: Collection[int] = (),
) -> Evidence:
    """`Evidence` of frames of a video, quantised to uint8 (1/255 of the truncation), on the host.

    Args:
      seen: `Footage` of N frames.
      cameras: `Camera` (N, ...) on the host, of full-size images.
      near: world units.
      far: world units.
      planes: E.
      frames: which frames, all by default.
      exclude: see the header.

    Returns:
      `Evidence` of uint8 numpy arrays, leading axis `frames`.
    """
    half, (flow, sure) = seen
    places, bounds = positions(cameras), (np.float32(near), np.float32(far))
    along = gaps_along(cameras, _beside(seen, cameras, exclude), *bounds, planes=planes)
    found = []
    for i in range(len(half)) if frames is None else frames:
        chosen, around = _compared(places, i, exclude)
        sources = MatchingViews(half[chosen.frames], taken(cameras, chosen.frames), chosen.valid)
        beside = Neighbours(flow[i], sure[i] * around.valid[:, None, None], taken(cameras, around.frames))
        path = jax.tree.map(lambda x, i=i: x[i], along)
        found.append(_evidence(half[i], taken(cameras, i), sources, beside, path, *bounds, planes=planes))
    return jax.tree.map(lambda *rows: np.stack([np.asarray(r) for r in rows]), *found)


def _beside(seen, cameras, exclude):
    """`Neighbours` of every frame (N, 2, ...); those of a frame to exclude are not trusted, nor is such a neighbour."""
    count = len(seen.half)
    wanted = np.arange(count)[:, None] + [1, -1]
    there = np.clip(wanted, 0, count - 1)
    out = np.isin(np.arange(count), list(exclude))
    sure = seen.flow.sure * ((wanted == there) & ~out[there] & ~out[:, None])[..., None, None].astype(np.float32)
    return Neighbours(seen.flow.flow, sure, taken(cameras, there))


def _compared(places, frame, exclude):
    """`Chosen` frames that one is compared with, and its two neighbours; where none is left, itself, not valid."""
    others = {frame, *exclude}
    if others.issuperset(range(len(places))):
        return tuple(Chosen(np.full(n, frame), np.zeros(n, np.float32)) for n in (EVIDENCE_SOURCES, 2))
    chosen = key_frames(places, EVIDENCE_SOURCES, target=places[frame], time=frame, exclude=others)
    return chosen, neighbours(len(places), frame, offsets=(1, -1), exclude=others)


def dequantised(evidence: Evidence) -> Evidence:
    """uint8 `Evidence` as float32 in [0, 1].

    A product: compiled, a division by a constant becomes one too, and would round otherwise than uncompiled.
    """
    return jax.tree.map(lambda x: x.astype(jnp.float32) * np.float32(1 / 255), evidence)
