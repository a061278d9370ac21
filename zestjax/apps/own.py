"""How good a video's views are, told by its own frames: each predicted without itself."""

import jax
import numpy as np

FRAMES = 2  # each costs as much as three views: what other frames say of it is found anew


def own_psnr(view_of, video, *, exclude=()) -> float:
    """Mean PSNR of some of a video's own frames, each predicted without itself and without those to exclude."""
    usable = [i for i in range(len(video.images)) if i not in exclude]
    places = np.unique(np.linspace(0, len(usable) - 1, FRAMES + 2).round().astype(int)[1:-1])
    scores = []
    for i in (usable[place] for place in places):
        camera = jax.tree.map(lambda leaf, i=i: leaf[i], video.cameras)
        view, _ = view_of(camera, i, (*exclude, i))
        truth = np.asarray(video.images[i], np.float32)
        truth = truth / 255 if np.asarray(video.images).dtype == np.uint8 else truth
        error = np.mean((np.clip(np.asarray(view.colour, np.float32), 0, 1) - truth) ** 2)
        scores.append(-10 * np.log10(max(error, 1e-10)))
    return float(np.mean(scores))
