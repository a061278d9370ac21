"""Mixes: how two fields share the samples of a ray.

S        samples on a ray
blend    (..., S) which field a sample belongs to: 0 all static, 1 all dynamic
"""

from typing import Protocol

import jax

from zestjax.base.parts import part
from zestjax.rendering import BlendedRender, FieldSamples, render_blended


class Mix(Protocol):
    """Both fields' samples, their blend, lengths and depths (..., S) to what the ray shows."""

    def __call__(
        self, static: FieldSamples, dynamic: FieldSamples, blend: jax.Array, lengths: jax.Array, depths: jax.Array
    ) -> BlendedRender: ...


@part
class Opacity:
    """Each field owns its share of a sample's opacity. Source: ZeST-NeRF eq. 8."""

    def __call__(self, static, dynamic, blend, lengths, depths):
        """See `rendering.render_blended`."""
        return render_blended(static, dynamic, blend, lengths, depths, form="opacity")


@part
class Density:
    """Each field's density is scaled by its share; weights sum to at most 1."""

    def __call__(self, static, dynamic, blend, lengths, depths):
        """See `rendering.render_blended`."""
        return render_blended(static, dynamic, blend, lengths, depths, form="density")
