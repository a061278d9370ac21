"""Public functions under fuzzing: sizes, dtypes and extremes as hypothesis draws them, within what is documented.

A row of `FUNCTIONS` is a function and its arrays: name -> (axes, kind). A kind is the documented range, by its corners.
"""

import functools

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from zestjax import cost_volume, depth, flow, frustum, metrics, planesweep, rays, rendering, resample
from zestjax.base import numerics
from zestjax.cameras import Camera, look_at, project, unproject
from zestjax.fields import conditioning
from zestjax.frames import trust
from zestjax.losses import adversarial, photometric, priors, regularisers, scene_flow, supervision
from zestjax.nets.layers import Conv, Dense, Norm, conv2d, dense, norm_act
from zestjax.nets.positional import positional_encoding
from zestjax.simulate.motion import rotation_from_vector

KINDS = {
    "real": (0.0, -0.0, 1e-30, -1e-30, 0.3, -0.7, 1.0, -1.0, 1e6, -1e6),
    "divisor": (0.0, 1e-10, 1e-3, 1.0, -2.0),
    "unit": (0.0, 1e-30, 1e-7, 0.5, 0.999999, 1.0),
    "mask": (0.0, 1.0),
    "density": (0.0, 1e-30, 1e-9, 0.2, 3.0, 1e4, 1e20),
    "length": (1e-10, 1e-3, 1.0, 7.0, 1e10),
    "depth": (1e-3, 0.5, 2.0, 2.0000002, 1e6),
    "logit": (-200.0, -1.0, -1e-8, 0.0, 1e-8, 3.0, 200.0),
    "pixel": (-1e9, -0.5, 0.0, 1.0, 1.5, 3.0, 1e9),
    "point": (0.0, 1e-6, -1e-6, 0.4, -0.4, 2.0, -2.0, 1e6, -1e6),
    "share": (-0.5, 0.0, 1e-6, 0.5, 0.999999, 1.0, 1.5),
    "vector": (0.0, 1e-20, 1e-5, -1e-5, 1.0, 3.1415927, -3.1415927, 6.2831855),
}
K = [[40.0, 0, 8], [0, 40, 6], [0, 0, 1]]
like = lambda x, values: jnp.asarray(values, x.dtype)
camera = lambda x: Camera(like(x, K), like(x, np.eye(4)))
place = lambda x: frustum.Frustum(camera(x), like(x, 1.0), like(x, 9.0), 12, 16)
cameras = lambda x: jax.tree.map(lambda leaf: leaf[None], camera(x))
seen = lambda points, table: conditioning.sample_views(
    conditioning.SourceViews(table[None], cameras(points), like(points, [1.0]), like(points, [0.0])), points[None]
)
RAY = {"weights": ("R S", "unit"), "values": ("R S 3", "real")}
FLOWS = {"flow": ("R S 3", "real"), "points": ("R S 3", "point")}
IMAGES = {"image": ("H W 3", "unit"), "truth": ("H W 3", "unit")}
FUNCTIONS = {
    "exclusive_cumsum": (numerics.exclusive_cumsum, {"x": ("R S", "real")}),
    "exclusive_cumprod": (numerics.exclusive_cumprod, {"x": ("R S", "unit")}),
    "safe_norm": (numerics.safe_norm, {"x": ("R 3", "real")}),
    "safe_divide": (numerics.safe_divide, {"numerator": ("R", "real"), "denominator": ("R", "divisor")}),
    "masked_mean": (numerics.masked_mean, {"x": ("R S", "real"), "mask": ("R S", "mask")}),
    "alpha_from_density": (rendering.alpha_from_density, {"density": ("R S", "density"), "lengths": ("R S", "length")}),
    "weights_from_density": (
        rendering.weights_from_density, {"density": ("R S", "density"), "lengths": ("R S", "length")}),
    "blend_weights": (rendering.blend_weights, {
        "static_alpha": ("R S", "unit"), "dynamic_alpha": ("R S", "unit"), "blend": ("R S", "unit")}),
    "density_blend_weights": (rendering.density_blend_weights, {
        "static_density": ("R S", "density"), "dynamic_density": ("R S", "density"), "blend": ("R S", "unit"),
        "lengths": ("R S", "length")}),
    "composite": (rendering.composite, RAY),
    "confidence_map": (rendering.confidence_map, {"weights": ("R S", "unit"), "confidence": ("R S", "unit")}),
    "expected_depth": (depth.expected_depth, {"weights": ("R S", "unit"), "depths": ("R S", "depth")}),
    "median_depth": (depth.median_depth, {"weights": ("R S", "unit"), "depths": ("R S", "depth")}),
    "disparity_from_depth": (depth.disparity_from_depth, {"depth": ("R", "depth")}),
    "masked_median": (depth.masked_median, {"values": ("R P", "real"), "mask": ("R P", "mask")}),
    "whitened": (depth.whitened, {"values": ("R P", "unit"), "mask": ("R P", "mask")}),
    "align_least_squares": (depth.align_least_squares, {
        "values": ("P", "unit"), "target": ("P", "unit"), "mask": ("P", "mask")}),
    "align_robust": (depth.align_robust, {"values": ("P", "unit"), "target": ("P", "unit"), "mask": ("P", "mask")}),
    "expected": (flow.expected, RAY),
    "induced_flow": (lambda weights, points, flow_: flow.induced_flow(
        weights, points, flow_, camera(points), jnp.zeros((*weights.shape[:-1], 2), points.dtype)),
        {"weights": ("R S", "unit"), "points": ("R S 3", "point"), "flow": ("R S 3", "real")}),
    "project": (lambda points: project(camera(points), points), {"points": ("R 3", "point")}),
    "unproject": (lambda pixels, depth: unproject(camera(pixels), pixels, depth),
                  {"pixels": ("R 2", "real"), "depth": ("R", "depth")}),
    "rotation_from_vector": (rotation_from_vector, {"vector": ("R 3", "vector")}),
    "rays_from_pixels": (lambda pixels: rays.rays_from_pixels(camera(pixels), pixels), {"pixels": ("R 2", "real")}),
    "depths_from_fractions": (lambda fractions: rays.depths_from_fractions(fractions, 1.0, 9.0, spacing="inverse"),
                              {"fractions": ("R S", "unit")}),
    "frustum_from_world": (lambda points: frustum.frustum_from_world(place(points), points, spacing="inverse"),
                           {"points": ("R 3", "point")}),
    "world_from_frustum": (lambda coords: frustum.world_from_frustum(place(coords), coords, spacing="inverse"),
                           {"coords": ("R 3", "share")}),
    "bilinear": (resample.bilinear, {"image": ("H W C", "real"), "pixels": ("R 2", "pixel")}),
    "trilinear": (resample.trilinear, {"volume": ("D H W C", "real"), "cells": ("R 3", "pixel")}),
    "homographies": (lambda depths: planesweep.homographies(camera(depths), cameras(depths), depths),
                     {"depths": ("D", "depth")}),
    "warp": (planesweep.warp, {"image": ("H W C", "unit"), "homography": ("3 3", "real"), "grid": ("h w 3", "unit")}),
    "cost_volume": (lambda tables, homographies, grid: cost_volume.cost_volume(tables, homographies, grid), {
        "tables": ("V H W C", "unit"), "homographies": ("D V 3 3", "real"), "grid": ("h w 3", "unit")}),
    "trusted": (trust.trusted, {
        "static": ("R", "unit"), "inverse_depth": ("R", "unit"), "tolerance": ("R", "depth"), "point": ("R", "unit")}),
    "sample_views": (seen, {"points": ("P 3", "point"), "table": ("H W 6", "unit")}),
    "over_views": (conditioning.over_views, {"weights": ("V P", "unit"), "values": ("V C P", "real")}),
    "reconstruction_loss": (photometric.reconstruction_loss, {"colour": ("R 3", "unit"), "target": ("R 3", "unit")}),
    "photometric_loss": (photometric.photometric_loss, {
        "warped": ("R 3", "unit"), "target": ("R 3", "unit"), "confidence": ("R", "unit")}),
    "geometric_loss": (priors.geometric_loss, {"pixels": ("R 2", "real"), "target_pixels": ("R 2", "real")}),
    "depth_loss": (priors.depth_loss, {"depth": ("R P", "unit"), "target": ("R P", "unit")}),
    "blend_entropy_loss": (regularisers.blend_entropy_loss, {"blend": ("R S", "unit")}),
    "blend_entropy_loss of logits": (
        functools.partial(regularisers.blend_entropy_loss, given="logit", symmetric=True), {"blend": ("R S", "logit")}),
    "disocclusion_loss": (regularisers.disocclusion_loss, {"confidence": ("R S", "unit")}),
    "edge_aware_depth_loss": (regularisers.edge_aware_depth_loss, {
        "disparity": ("H W", "unit"), "image": ("H W 3", "unit")}),
    "cycle_loss": (scene_flow.cycle_loss, {
        "there": ("R S 3", "real"), "back": ("R S 3", "real"), "confidence": ("R S", "unit")}),
    "minimum_flow_loss": (scene_flow.minimum_flow_loss, {"flow": ("R S 3", "real")}),
    "spatial_smoothness_loss": (scene_flow.spatial_smoothness_loss, FLOWS),
    "temporal_loss": (scene_flow.temporal_loss, {"forward": ("R S 3", "real"), "backward": ("R S 3", "real")}),
    "depth_cross_entropy_loss": (lambda logits, plane: supervision.depth_cross_entropy_loss(
        jax.nn.log_softmax(logits, -1), plane), {"logits": ("R D", "logit"), "plane": ("R", "pixel")}),
    "motion_mask_loss": (supervision.motion_mask_loss, {"dynamicness": ("R", "unit"), "moving": ("R", "mask")}),
    "generator_loss": (adversarial.generator_loss, {"rendered": ("R", "logit")}),
    "discriminator_loss": (adversarial.discriminator_loss, {"real": ("R", "logit"), "rendered": ("R", "logit")}),
    "psnr": (metrics.psnr, IMAGES),
    "endpoint_error": (lambda flow, truth: metrics.endpoint_error(flow, truth, None), {
        "flow": ("H W 2", "real"), "truth": ("H W 2", "real")}),
    "dense": (lambda kernel, bias, x: dense(Dense(kernel, bias), x), {
        "kernel": ("C O", "unit"), "bias": ("O", "real"), "x": ("R C", "real")}),
    "conv2d": (lambda kernel, x: conv2d(Conv(kernel, None), x), {
        "kernel": ("3 3 C O", "unit"), "x": ("B H W C", "real")}),
    "norm_act": (lambda scale, offset, x: norm_act(Norm(scale, offset), x), {
        "scale": ("C", "real"), "offset": ("C", "real"), "x": ("B H W C", "unit")}),
    "positional_encoding": (functools.partial(positional_encoding, levels=4), {"x": ("R 3", "unit")}),
    "look_at": (lambda position, target: look_at(position, target, up=like(
        position, [0.0, -1, 0])), {"position": ("R 3", "real"), "target": ("R 3", "real")}),
}  # fmt: skip
PRIMITIVES = {"safe_divide", "masked_mean"}  # they broadcast as JAX does, and JAX says so where they do not
WITHOUT_GRADIENT = {"look_at", "psnr"}  # a direction between two equal points has none; PSNR is capped where it is flat
EVERY = pytest.mark.parametrize("name", FUNCTIONS)
QUICK = settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
SIZES = dict(R=3, S=4, P=5, H=3, W=4, h=2, w=3, C=2, D=3, V=2, B=2, O=3)


def shape_of(axes, sizes):
    return tuple(int(a) if a.isdigit() else sizes[a] for a in axes.split())


@functools.cache
def compiled(name):
    """Values, and gradients of a sum of them with unequal weights."""
    fn, spec = FUNCTIONS[name]

    def total(*args):
        leaves = [x for x in jax.tree.leaves(fn(*args)) if jnp.issubdtype(x.dtype, jnp.floating)]
        mixed = lambda x: jnp.sum(x.ravel() * like(x, 1 + np.arange(x.size) / 7 % 1))
        return functools.reduce(jnp.add, map(mixed, leaves))

    places = tuple(range(len(spec)))
    slopes = () if name in WITHOUT_GRADIENT else places
    return jax.jit(lambda *args: (fn(*args), jax.grad(total, argnums=slopes)(*args) if slopes else ()))


@EVERY
@given(data=st.data())
@QUICK
def test_values_and_gradients_are_finite_at_every_corner_of_the_documented_range(name, data):
    _, spec = FUNCTIONS[name]
    args = []
    for axes, kind in spec.values():
        shape = shape_of(axes, SIZES)
        corners = st.sampled_from(KINDS[kind])
        drawn = data.draw(st.lists(corners, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
        args.append(jnp.asarray(np.array(drawn, np.float32).reshape(shape)))
    values, slopes = compiled(name)(*args)
    for leaf in jax.tree.leaves((values, slopes)):
        assert not jnp.issubdtype(leaf.dtype, jnp.floating) or np.isfinite(leaf).all(), (name, values, slopes)


@EVERY
@given(data=st.data())
@QUICK
def test_any_size_is_taken_and_every_dtype_kept(name, data):
    """Sizes from 1 on; half precision may be raised to float32, float64 may not be lowered."""
    fn, spec = FUNCTIONS[name]
    least = {"spatial_smoothness_loss": 2}.get(name, 1)
    sizes = {axis: data.draw(st.integers(least, 5), label=axis) for axis in SIZES}
    dtype = data.draw(st.sampled_from(["float32", "float64", "bfloat16"]))
    with jax.enable_x64(True):
        args = [jax.ShapeDtypeStruct(shape_of(axes, sizes), dtype) for axes, _ in spec.values()]
        out = jax.eval_shape(fn, *args)
    for leaf in jax.tree.leaves(out):
        allowed = (dtype, "float32") if dtype == "bfloat16" else (dtype,)
        assert not jnp.issubdtype(leaf.dtype, jnp.floating) or leaf.dtype in map(jnp.dtype, allowed), leaf.dtype


@EVERY
@given(data=st.data())
@QUICK
def test_a_wrong_size_is_taken_or_refused_by_name(name, data):
    """One axis of one array is another size: it broadcasts, or the error is ours, in words of the caller's."""
    fn, spec = FUNCTIONS[name]
    args = [list(shape_of(axes, SIZES)) for axes, _ in spec.values()]
    wrong = data.draw(st.sampled_from([(i, j) for i, shape in enumerate(args) for j in range(len(shape))]))
    args[wrong[0]][wrong[1]] += data.draw(st.sampled_from([1, 2, 7]))
    if data.draw(st.booleans()):
        args[wrong[0]] = args[wrong[0]][1:]  # and an axis is missing
    try:
        with jax.numpy_rank_promotion("allow"):  # as users have it
            jax.eval_shape(fn, *(jax.ShapeDtypeStruct(tuple(shape), jnp.float32) for shape in args))
    except (ValueError, TypeError) as error:
        assert name in PRIMITIVES or str(error).split(":")[0].replace(".", "_").isidentifier(), (args, str(error)[:200])
