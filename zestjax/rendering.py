"""Volume rendering along a ray, of one field or of two that share it.

Names and axes, the same in every function of this file:

    S         samples on a ray, near to far
    lengths   (..., S)     length of each sample's interval, world units, >= 0 and finite
    density   (..., S)     extinction, 1 / world unit, >= 0
    alpha     (..., S)     opacity of one interval, in [0, 1]
    weights   (..., S)     share of the ray's colour owned by each sample, in [0, 1]; one field's sum to at most 1
    blend     (..., S)     which field a sample belongs to, in [0, 1]: 0 all static, 1 all dynamic
    values    (..., S, C)  any per-sample quantity: colour, feature, scene flow

Leading axes `...` are free. `lengths` and `depths` may lack them, (S,), when every ray is sampled alike.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zestjax.base.checks import check_option, check_shapes
from zestjax.base.numerics import exclusive_cumprod, exclusive_cumsum
from zestjax.base.types import Array, Tree
from zestjax.depth import expected_depth

BLEND_FORMS = ("opacity", "density")  # the released code's (and NSFF's), and the one that the paper prints


class Rendered(NamedTuple):
    """One ray's composite.

    values: same tree as the input `values`, each leaf (..., C).
    opacity: (...,) sum of the weights; 1 means nothing behind shows through.
    weights: (..., S).
    """

    values: Tree
    opacity: jax.Array
    weights: Array


class Blended(NamedTuple):
    """Weights of the two fields that share one ray, each (..., S) and each summing to at most 1.

    Together they sum to at most 1 in the density form. In the opacity form they can add up to 4/3: a sample in which
    both fields are opaque is counted once for each, because neither hides the other inside one sample.
    """

    static: jax.Array
    dynamic: jax.Array


class FieldSamples(NamedTuple):
    """What a field says along the rays. density: (..., S). colour: (..., S, 3) in [0, 1]."""

    density: Array
    colour: Array


class BlendedRender(NamedTuple):
    """Everything two fields show on a ray; leading axes (...).

    colour: (..., 3) both fields, blended. depth: (...) expected depth of the blend, world units.
    opacity: (...) of the blend. dynamicness: (...) share of the colour owned by the dynamic field, in [0, 1].
    static_colour, dynamic_colour: (..., 3) each field alone, as if it were unblended.
    static_depth, dynamic_depth: (...) likewise, world units.
    weights: `Blended`. static_weights, dynamic_weights: (..., S) of each field alone.
    """

    colour: jax.Array
    depth: jax.Array
    opacity: jax.Array
    dynamicness: jax.Array
    static_colour: jax.Array
    dynamic_colour: jax.Array
    static_depth: jax.Array
    dynamic_depth: jax.Array
    weights: Blended
    static_weights: jax.Array
    dynamic_weights: jax.Array


def alpha_from_density(density: Array, lengths: Array) -> jax.Array:
    """Opacity of an interval, 1 - exp(-density * length).

    `expm1` keeps the small opacities that `1 - exp(-x)` rounds to zero.

    Raises:
      ValueError: if the sample axes differ.
    """
    check_shapes("alpha_from_density", density=(density, "... S"), lengths=(lengths, "... S"))
    return -jnp.expm1(-jnp.multiply(*jnp.broadcast_arrays(density, lengths)))


def weights_from_density(density: Array, lengths: Array) -> jax.Array:
    """Compositing weights w_s = alpha_s * exp(-sum_{r<s} density_r length_r) of one field.

    Source: ZeST-NeRF eq. 12; NeRF (Mildenhall et al. 2020), eq. 3.
    Reference: ZeST-NeRF renderer.py `raw2outputs`.

    Args:
      density: (..., S), 1 / world unit, >= 0.
      lengths: (..., S) or (S,), world units, >= 0 and finite. Close an unbounded ray with a large last
        length, not inf (0 * inf is NaN). The reference's 1e10 makes d weight / d density as large as
        1e10 in empty space.

    Returns:
      (..., S) weights in [0, 1].

    Raises:
      ValueError: if the sample axes differ.

    Differs from the reference: transmittance is exp of a sum, not a product of (1 - alpha + 1e-10); they
    agree to 2e-7 in float32 for S <= 128. The paper's print leaves the lengths out.
    """
    check_shapes("weights_from_density", density=(density, "... S"), lengths=(lengths, "... S"))
    thickness = jnp.multiply(*jnp.broadcast_arrays(density, lengths))
    return -jnp.expm1(-thickness) * jnp.exp(-exclusive_cumsum(thickness))


def blend_weights(static_alpha: Array, dynamic_alpha: Array, blend: Array) -> Blended:
    """Weights of a static and a dynamic field mixed on one ray: `blend` scales each sample's opacity.

    Source: ZeST-NeRF eq. 7, eq. 8; NSFF (Li et al. 2021), section 3.3.
    Reference: ZeST-NeRF renderer.py `raw2outputs_blending`.

    Args:
      static_alpha: (..., S) opacity of the time-independent field, in [0, 1].
      dynamic_alpha: (..., S) opacity of the time-dependent field, in [0, 1].
      blend: (..., S) in [0, 1]; 1 is all dynamic.

    Returns:
      `Blended`.

    Raises:
      ValueError: if the sample axes differ.

    Differs from the reference: no 1e-10 in the transmittance. The product's gradient stays exact at an
    opacity of 1, where a sum of logarithms is -inf.
    """
    check_shapes(
        "blend_weights",
        static_alpha=(static_alpha, "... S"),
        dynamic_alpha=(dynamic_alpha, "... S"),
        blend=(blend, "... S"),
    )
    static = static_alpha * (1 - blend)
    dynamic = dynamic_alpha * blend
    reaching = exclusive_cumprod((1 - static) * (1 - dynamic))
    return Blended(static=reaching * static, dynamic=reaching * dynamic)


def density_blend_weights(static_density: Array, dynamic_density: Array, blend: Array, lengths: Array) -> Blended:
    """Weights of two fields on one ray as the paper prints them: `blend` scales densities in the transmittance.

    Source: ZeST-NeRF eq. 9 for the transmittance, with eq. 7 and eq. 8 for the opacities.

    Args:
      static_density: (..., S), 1 / world unit, >= 0.
      dynamic_density: (..., S), 1 / world unit, >= 0.
      blend: (..., S) in [0, 1]; 1 is all dynamic.
      lengths: (..., S) or (S,), world units, >= 0 and finite.

    Returns:
      `Blended`. A sample's opacities are mixed linearly, so they are at most what the mixed density absorbs.

    Raises:
      ValueError: if the sample axes differ.

    Differs from the paper's print: b_gamma stands inside the sum over gamma (its index has no meaning
    outside), and densities are multiplied by the interval lengths.
    """
    check_shapes(
        "density_blend_weights",
        static_density=(static_density, "... S"),
        dynamic_density=(dynamic_density, "... S"),
        blend=(blend, "... S"),
        lengths=(lengths, "... S"),
    )
    static, dynamic, blend, lengths = jnp.broadcast_arrays(static_density, dynamic_density, blend, lengths)
    static, dynamic = static * lengths, dynamic * lengths
    reaching = jnp.exp(-exclusive_cumsum(static * (1 - blend) + dynamic * blend))
    return Blended(static=reaching * (1 - blend) * -jnp.expm1(-static), dynamic=reaching * blend * -jnp.expm1(-dynamic))


def blend_weights_from_density(
    static_density: Array, dynamic_density: Array, blend: Array, lengths: Array, *, form: str = "opacity"
) -> Blended:
    """`blend_weights` or `density_blend_weights` of two fields' densities.

    Args:
      static_density: (..., S), 1 / world unit, >= 0.
      dynamic_density: (..., S), 1 / world unit, >= 0.
      blend: (..., S) in [0, 1]; 1 is all dynamic.
      lengths: (..., S) or (S,).
      form: "opacity" (NSFF's and the released code's) or "density" (the paper's print).

    Returns:
      `Blended`.

    Raises:
      ValueError: if the sample axes differ or `form` is neither.
    """
    check_option("blend_weights_from_density", form=(form, BLEND_FORMS))
    if form == "density":
        return density_blend_weights(static_density, dynamic_density, blend, lengths)
    static_alpha = alpha_from_density(static_density, lengths)
    return blend_weights(static_alpha, alpha_from_density(dynamic_density, lengths), blend)


def composite(weights: Array, values: Tree, *, background: Tree = None) -> Rendered:
    """Weighted sum of `values` along the ray, over an optional background.

    Reference: ZeST-NeRF renderer.py `raw2outputs`.
    Differs from the reference: its renders of warped samples stand on white by a slip of arguments.

    Args:
      weights: (..., S), from `weights_from_density` or a field of `Blended`.
      values: tree whose leaves are (..., S, C).
      background: tree like `values`, leaves broadcast to (..., C), seen through what opacity leaves; None: black.

    Returns:
      `Rendered`.

    Raises:
      ValueError: if a leaf's sample axis differs from the weights'.
    """

    def along_ray(value):
        check_shapes("composite", weights=(weights, "... S"), values=(value, "... S C"))
        return jnp.sum(weights[..., None] * value, axis=-2)

    opacity = jnp.sum(weights, axis=-1)
    values = jax.tree.map(along_ray, values)
    if background is not None:
        behind = (1 - opacity)[..., None]
        over = lambda value, back: value + behind * jnp.broadcast_to(back, value.shape)
        values = jax.tree.map(over, values, background)
    return Rendered(values=values, opacity=opacity, weights=weights)


def confidence_map(weights: Array, confidence: Array, *, hold_weights: bool = True) -> jax.Array:
    """Confidence seen by each ray, sum_s weights_s * confidence_s.

    Source: ZeST-NeRF eq. 13.
    Reference: ZeST-NeRF renderer.py `compute_2d_prob`, with confidence = 1 - prob.

    Args:
      weights: (..., S) of the warped dynamic field.
      confidence: (..., S) in [0, 1], w of the samples being warped.
      hold_weights: no gradient reaches the weights (the reference's choice), so that a loss the map scales
        cannot be lowered by emptying the ray.

    Returns:
      (...,) in [0, 1].

    Raises:
      ValueError: if the sample axes differ.
    """
    check_shapes("confidence_map", weights=(weights, "... S"), confidence=(confidence, "... S"))
    weights = jax.lax.stop_gradient(weights) if hold_weights else weights
    return jnp.sum(weights * confidence, axis=-1)


def render_blended(
    static: FieldSamples, dynamic: FieldSamples, blend: Array, lengths: Array, depths: Array, *, form: str = "opacity"
) -> BlendedRender:
    """Render two fields that share their rays: blended, and each alone.

    Source: ZeST-NeRF eq. 7, eq. 8.
    Reference: ZeST-NeRF renderer.py `raw2outputs_blending`.

    Args:
      static: `FieldSamples` of the time-independent field.
      dynamic: `FieldSamples` of the time-dependent field.
      blend: (..., S) in [0, 1]; 1 is all dynamic.
      lengths: (..., S) or (S,), world units.
      depths: (..., S) or (S,), of the samples, world units.
      form: see `blend_weights_from_density`.

    Returns:
      `BlendedRender`.

    Raises:
      ValueError: if axes differ or `form` is unknown.
    """
    both = blend_weights_from_density(static.density, dynamic.density, blend, lengths, form=form)
    total = both.static + both.dynamic
    static_weights = weights_from_density(static.density, lengths)
    dynamic_weights = weights_from_density(dynamic.density, lengths)
    shade = lambda weights, field: composite(weights, field.colour).values
    return BlendedRender(
        colour=shade(both.static, static) + shade(both.dynamic, dynamic),
        depth=expected_depth(total, depths),
        opacity=jnp.sum(total, axis=-1),
        dynamicness=jnp.sum(both.dynamic, axis=-1),
        static_colour=shade(static_weights, static),
        dynamic_colour=shade(dynamic_weights, dynamic),
        static_depth=expected_depth(static_weights, depths),
        dynamic_depth=expected_depth(dynamic_weights, depths),
        weights=both,
        static_weights=static_weights,
        dynamic_weights=dynamic_weights,
    )
