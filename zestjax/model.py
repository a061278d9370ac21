"""The forward model in one call: what a notebook needs, and where to look for its parts.

frames to volumes to fields to pixels: `systems.system.System.encode`, then `System.render`; a whole view of a video:
`novel_view`.
"""

import jax

from zestjax.frames.analysis import FrameMaps
from zestjax.systems.system import Params, Prediction, System
from zestjax.video import Inputs


def predict(
    params: Params,
    inputs: Inputs,
    maps: FrameMaps | None,
    pixels: jax.Array,
    *,
    system: System,
    jitter: jax.Array | None = None,
) -> Prediction:
    """Render pixels of a target from its inputs; pure, of one scene and one target, compiled and mapped as you like.

    Args:
      params: of the system.
      inputs: `Inputs`.
      maps: `analysis.FrameMaps` of the inputs' frames, or None in a system without `frames`.
      pixels: (R, 2) column and row in the target image.
      system: `System`.
      jitter: (R, S) in [0, 1), places of even samples in their strata, or None for the middles.

    Returns:
      `Prediction`.

    Source: ZeST-NeRF sections 3.1 to 3.4.
    """
    return system.render(params, system.encode(params, inputs, maps), inputs, pixels, jitter=jitter)
