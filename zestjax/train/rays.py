"""Which pixels of a target a step of training looks at.

draw     which pixels: drawn on the host from a generator, a function of the step
mined    pixels that are looked at more often than others, because they move
patch    pixels that lie in a square, evenly spaced: what a term may see as a picture
"""

from typing import ClassVar, Protocol

import numpy as np

from zestjax.base.checks import check_counts
from zestjax.base.parts import part

MOST_RAYS = 2**16  # of a step: a file may not ask for more
MOST_SIDE = 2**8  # of a patch, for the same reason


class Rays(Protocol):
    """Which pixels of a target a step looks at."""

    def draw(self, rng: np.random.Generator, moving: np.ndarray, step: int) -> np.ndarray:
        """(R,) flat indices into a target whose moving pixels (H, W) are known."""
        ...


@part
class Rows:
    """`count` whole rows, neighbours."""

    count: int = 16

    jittered: ClassVar[bool] = False

    def __post_init__(self):
        check_counts("Rows", count=(self.count, 1, MOST_RAYS))

    def draw(self, rng: np.random.Generator, moving: np.ndarray, step: int) -> np.ndarray:
        """See `Rays`."""
        height, width = moving.shape
        if self.count > height:
            raise ValueError(f"Rows: `count` is {self.count}, the target has {height} rows; take fewer.")
        first = rng.integers(0, height - self.count + 1)
        return np.arange(first * width, (first + self.count) * width)


@part
class Pixels:
    """`count` pixels anywhere, and `mined` more of those that move, up to step `mined_until` (0: always); samples are
    jittered in their strata. Source: ZeST-NeRF section 4 (1024 rays and 512 more while the priors are on)."""

    count: int = 1024
    mined: int = 512
    mined_until: int = 0

    jittered: ClassVar[bool] = True

    def __post_init__(self):
        check_counts("Pixels", count=(self.count, 1, MOST_RAYS), mined=(self.mined, 0, MOST_RAYS))

    def draw(self, rng: np.random.Generator, moving: np.ndarray, step: int) -> np.ndarray:
        """See `Rays`."""
        if self.count > moving.size:
            raise ValueError(f"Pixels: `count` is {self.count}, the target has {moving.size} pixels; take fewer.")
        anywhere = rng.choice(moving.size, self.count, replace=False)
        if self.mined_until and step >= self.mined_until:
            return anywhere
        mined = np.flatnonzero(moving) if moving.any() else np.arange(moving.size)
        return np.concatenate([anywhere, rng.choice(mined, self.mined)])


@part
class Patch:
    """`side` x `side` pixels, evenly spaced, anywhere. The square spans a random share of the picture's shorter side,
    at most `most` and at least `least`, or at first exp(-decay step) where that is more.

    Reference: ZeST-NeRF utils.py, the patches of GRAF (Schwarz et al. 2020).
    Differs from the reference: the spacing is the same along both sides, and the least share falls every step.
    """

    side: int = 32
    least: float = 0.25
    most: float = 0.9
    decay: float = 7.5e-6  # the reference's 0.0075 every 1000 steps

    jittered: ClassVar[bool] = True

    def __post_init__(self):
        check_counts("Patch", side=(self.side, 2, MOST_SIDE))
        if not 0 < self.least <= self.most <= 1:
            raise ValueError(f"Patch: `least` is {self.least} and `most` {self.most}, expected 0 < least <= most <= 1.")
        if self.decay < 0:
            raise ValueError(f"Patch: `decay` is {self.decay}, expected at least 0.")

    def draw(self, rng: np.random.Generator, moving: np.ndarray, step: int) -> np.ndarray:
        """See `Rays`."""
        height, width = moving.shape
        reach = min(height, width) - 1
        if self.side - 1 > reach:
            raise ValueError(f"Patch: `side` is {self.side}, the target has {height} x {width} pixels; take fewer.")
        least = min(self.most, max(self.least, float(np.exp(-self.decay * step))))
        spacing = max(rng.uniform(least, self.most) * reach / (self.side - 1), 1.0)
        places = [rng.uniform(0, size - 1 - spacing * (self.side - 1)) for size in (height, width)]
        rows, columns = (np.floor(place + spacing * np.arange(self.side)).astype(int) for place in places)
        return (rows[:, None] * width + columns[None]).reshape(-1)
