"""How good a video's views are, told by its own frames: each predicted without itself."""

import jax
import jax.numpy as jnp
import numpy as np

from zestjax.frames.assembly import colours_of
from zestjax.metrics import psnr

FRAMES = 2  # each costs as much as three views: what other frames say of it is found anew


def own_psnr(view_of, video, *, exclude=()) -> float:
    """Mean PSNR of some of a video's own frames, each predicted without itself and without those to exclude."""
    usable = [i for i in range(len(video.images)) if i not in exclude]
    places = np.unique(np.linspace(0, len(usable) - 1, FRAMES + 2).round().astype(int)[1:-1])
    scores = []
    for i in (usable[place] for place in places):
        camera = jax.tree.map(lambda leaf, i=i: leaf[i], video.cameras)
        view, _ = view_of(camera, i, (*exclude, i))
        truth = colours_of(jnp.asarray(video.images[i]))
        scores.append(psnr(jnp.clip(jnp.asarray(view.colour, jnp.float32), 0, 1), truth))
    return float(np.mean(scores))
