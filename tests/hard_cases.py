"""Named inputs on which naive forms of the same functions break, each with its cause; `test_hard_cases` runs them.

A case is a function of floating-point arrays, the arrays, and what it gives there, found another way. It must also be
finite, in value and gradient, agree with float64, and not depend on how it is run: eagerly, compiled, or mapped.
"""

from typing import Any, NamedTuple

import hard_oracles as oracle
import jax.numpy as jnp
import numpy as np
from oracles import blend_by_loop, density_blend_by_loop, weights_by_loop

from zestjax import cost_volume, depth, flow, frustum, metrics, planesweep, rays, rendering, resample
from zestjax.base import numerics
from zestjax.cameras import Camera, project, unproject
from zestjax.fields.conditioning import SourceViews, hidden, over_views, sample_views
from zestjax.frames import trust
from zestjax.losses import adversarial, means, photometric, priors, regularisers, scene_flow, supervision
from zestjax.nets.layers import Norm, norm_act
from zestjax.nets.positional import positional_encoding
from zestjax.simulate.motion import rotation_from_vector


class Case(NamedTuple):
    """name. cause: what breaks a naive form. fn: of the arrays. args: float arrays. expected: the value, in closed form
    or by a loop. tolerance: of values and gradients, relative to the greatest. unit: what counts as large."""

    name: str
    cause: str
    fn: Any
    args: tuple
    expected: Any
    tolerance: float = 2e-4
    unit: float = 1e-6


def array(*values):
    return np.array(values, np.float32)


def draw(seed, *shape, low=0.0, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


K = np.array([[40, 0, 8], [0, 40, 6], [0, 0, 1]], np.float32)
POSE = np.eye(4, dtype=np.float32)


def moved(x=0.0, y=0.0, z=0.0):
    pose = POSE.copy()
    pose[:3, 3] = [x, y, z]
    return pose


def camera(intrinsics=K, pose=POSE):
    return lambda like: Camera(jnp.asarray(intrinsics, like.dtype), jnp.asarray(pose, like.dtype))


def like(x, constant):
    return jnp.asarray(constant, x.dtype)


def opacities(density):
    return weights(density, jnp.ones_like(density))


def depth_of(density):
    return depth.expected_depth(opacities(density), like(density, RAY))


def projected(points):
    seen = project(camera()(points), points)
    return jnp.where(seen.in_front[..., None], seen.pixels, 0)


def swept(pose, depth_of_plane, intrinsics=K):
    """A 6 x 8 image carried onto a plane of a reference camera at the origin."""

    def fn(image):
        like = lambda c: camera(*c)(image)
        homography = planesweep.plane_homography(
            like((K, POSE)), like((intrinsics, pose)), jnp.asarray(depth_of_plane, image.dtype)
        )
        return planesweep.warp(image, homography, planesweep.sweep_grid(6, 8, dtype=image.dtype)).values

    return fn


def volume_of(poses, planes=(1.0, 4.0)):
    def fn(tables):
        first = camera()(tables)
        sources = Camera(*(jnp.stack(x) for x in zip(*(camera(K, p)(tables) for p in poses), strict=True)))
        warps = planesweep.homographies(first, sources, jnp.asarray(planes, tables.dtype))
        out = cost_volume.cost_volume(tables, warps, planesweep.sweep_grid(4, 5, dtype=tables.dtype))
        return jnp.concatenate([out.mean, out.variance], -1)

    return fn


def fitted(homography):
    """A trusted sweep as the camera behind it is fitted: the mean of what is seen."""
    surface = like(homography, np.full((1, 6, 8), 0.5))
    maps = trust.Trust(surface, surface, 0.1 * surface)
    out = cost_volume.cost_volume(
        like(homography, IMAGE)[None], homography[None, None], planesweep.sweep_grid(4, 5, dtype=homography.dtype),
        trust=maps, depths=like(homography, [2.0]),
    )  # fmt: skip
    return out.mean


def shown(points):
    """What one view that knows its own depth shows of points: colours, and whether they are hidden."""
    one = lambda x: like(points, x)[None]
    table = np.concatenate([draw(10, 6, 8, 3), np.full((6, 8, 2), 0.5), np.full((6, 8, 1), 1e-3)], -1)
    at = sample_views(SourceViews(one(table), Camera(one(K), one(POSE)), one(1.0), one(0.0)), points[None])
    return jnp.concatenate([at.colour[0].T, hidden(at.gap).T], -1)


def confident(confidence):
    """A mean by confidence in which only the first of two is valid."""
    residual = jnp.stack([jnp.ones_like(confidence), jnp.full_like(confidence, jnp.nan)])
    both = jnp.stack([confidence, jnp.full_like(confidence, jnp.nan)])
    return means.mean_over_valid(
        "case", residual, valid=like(confidence, [1, 0]), confidence=both, normalise="confidence"
    )


def blended(static, dynamic, b):
    return jnp.stack(rendering.blend_weights(static, dynamic, b))


def blended_density(static, dynamic, b):
    lengths = jnp.ones(static.shape, static.dtype)
    return jnp.stack(rendering.density_blend_weights(static, dynamic, b, lengths))


def weights(density, lengths):
    return rendering.weights_from_density(density, lengths)


def whitened(values):
    return depth.whitened(values, jnp.ones_like(values)).values


def projected_flow(points, moves):
    shares = jnp.full(points.shape[:1], 0.25, points.dtype)
    return flow.induced_flow(shares, points, moves, camera()(points), jnp.zeros(2, points.dtype)).flow


def masked(mask):
    return lambda x: metrics.mean_where(x, jnp.asarray(mask, x.dtype), where="case")


def psnr_of(truth):
    return lambda x: metrics.psnr(x, jnp.asarray(truth, x.dtype))


def place(x):
    return frustum.Frustum(camera()(x), like(x, 1.0), like(x, 9.0), 12, 16)


def cubed(spacing):
    return lambda points: frustum.frustum_from_world(place(points), points, spacing=spacing)


def uncubed(points, moves):
    return frustum.world_from_frustum(place(points), points + moves, spacing="inverse")


def agreed(image):
    """Mean and variance of both planes of `volume_of` where the views that see show one and the same image."""
    return np.stack([np.concatenate([image[:4, :5], 0 * image[:4, :5]], -1)] * 2)


def normed(x):
    ones = jnp.ones(x.shape[-1], x.dtype)
    return norm_act(Norm(ones, 0 * ones), x)


IMAGE = draw(0, 6, 8, 2)
RAY = array(0.5, 2.0, 0.1, 3.0)
EMPTY, WALL, ONES = np.zeros(4, np.float32), np.full(4, 1e20, np.float32), np.ones(4, np.float32)
LAST, AIR = array(1, 1, 1, 1e10), np.full(4, 1e-3, np.float32)
BESIDE, CUBE = array([3, 1, -2], [0, 0, 0], [0, 0, 1e-9]), (1.0, 9.0, 12, 16)
FLOW = draw(3, 4, 3, low=-0.1, high=0.1)

CASES = [
    # rendering
    Case("empty ray", "depth / opacity is 0 / 0", depth_of, (EMPTY,), 3.0),
    Case("empty ray's disparity", "max(1e-10, NaN) is NaN",
         lambda s: depth.disparity_from_depth(depth_of(s)), (EMPTY,), 1 / 3),
    Case("wall", "products of 1 - alpha are 0, their logarithm is -inf", opacities, (WALL,),
         array(1, 0, 0, 0)),
    Case("a wall behind air", "0 times inf", opacities, (array(0, 0, 1e20, 1),), array(0, 0, 1, 0)),
    Case("a last interval of 1e10", "d weight / d density is 1e10 in empty space, but finite", weights, (RAY, LAST),
         weights_by_loop(RAY, LAST)),
    Case("air before a last interval of 1e10", "the sum absorbs all before it", weights, (AIR, LAST),
         weights_by_loop(AIR, LAST)),
    Case("thin air", "1 - exp(-x) rounds to 0", opacities, (np.full(4, 1e-9, np.float32),),
         np.full(4, 1e-9), 1e-3, unit=1e-12),
    Case("b at 0", "the logarithm of b", blended, (draw(1, 4), draw(2, 4), EMPTY),
         blend_by_loop(draw(1, 4), draw(2, 4), EMPTY)),
    Case("b at 1", "the logarithm of 1 - b", blended, (draw(1, 4), draw(2, 4), ONES),
         blend_by_loop(draw(1, 4), draw(2, 4), ONES)),
    Case("opaque in both fields", "a product of zeros has no gradient by division", blended, (ONES, ONES, 0.5 * ONES),
         blend_by_loop(ONES, ONES, 0.5 * ONES)),
    Case("b at 0 and 1 between walls", "0 times inf", blended_density, (WALL, WALL, array(0, 1, 0, 1)),
         density_blend_by_loop(WALL, WALL, array(0, 1, 0, 1), ONES)),
    Case("a distortion of one spike", "pairs cancel", lambda w: regularisers.distortion_loss(
        w, like(w, np.linspace(0, 1, 5))), (array(0, 1, 0, 0),), 1 / 12),
    # cameras
    Case("a point behind the camera", "it mirrors into the image", projected,
         (array([0.1, 0.2, -3.0]),), array([0, 0])),
    Case("a point on the camera's plane", "a division by 0", projected, (array([1.0, 2.0, 0.0]),), array([0, 0])),
    Case("a point at the camera's centre", "0 / 0", projected, (array([0.0, 0.0, 0.0]),), array([0, 0])),
    Case("a point at 1e6", "its square overflows in half precision", projected,
         (array([1e6, 2e6, 1e6]),), array([48, 86])),
    Case("a depth of 1e8", "inverse depths vanish", lambda d: unproject(camera()(d), jnp.ones((1, 2), d.dtype), d),
         (array(1e8),), array([-1.75e7, -1.25e7, 1e8])),
    Case("near-singular intrinsics", "an inverse by elimination", lambda p: unproject(
        camera(np.diag([1e-3, 1e-3, 1]))(p), p[None], jnp.ones(1, p.dtype)),
         (array(0.5, 0.25),), array([500, 250, 1])),
    Case("beside and behind a frustum", "z from an infinite inverse depth", cubed("inverse"),
         (BESIDE,), oracle.cube_from_world(BESIDE, K, *CUBE), 1e-6),
    Case("far beyond a frustum", "inverse depths of 0", cubed("inverse"), (array([1e4, 0, 1e9]),),
         oracle.cube_from_world([[1e4, 0, 1e9]], K, *CUBE), 1e-3),
    Case("depths at infinity", "1 / 0", lambda f: rays.depths_from_fractions(f, 1.0, 1e30, spacing="inverse"),
         (array(0.0, 0.5),), array(1, 2)),
    # plane sweeps
    Case("a grazing plane", "the third coordinate passes 0", swept(moved(z=-2.0), 2.0), (IMAGE,), np.zeros((6, 8, 2))),
    Case("a plane behind the source", "a mirrored image", swept(moved(z=-5.0), 2.0), (IMAGE,), np.zeros((6, 8, 2))),
    Case("a plane at 1e12", "t / d vanishes", swept(moved(x=1.0), 1e12), (IMAGE,), IMAGE),
    Case("identical views", "E[f^2] - E[f]^2 cancels", volume_of([POSE] * 3), (np.stack([100 + IMAGE] * 3),),
         agreed(100 + IMAGE), 1e-6),
    Case("one visible view", "a variance of one", volume_of([POSE, moved(x=1e4)]), (draw(4, 2, 6, 8, 2),),
         agreed(draw(4, 2, 6, 8, 2)[0])),
    Case("no visible view", "0 / 0", volume_of([moved(x=1e4), moved(x=-1e4)]),
         (draw(5, 2, 6, 8, 2),), np.zeros((2, 4, 5, 4))),
    Case("constant images", "a variance of 0", volume_of([POSE, moved(x=0.1)]),
         (np.full((2, 6, 8, 2), 0.5, np.float32),), agreed(np.full((6, 8, 2), 0.5))),
    Case("a 1-pixel image", "sides of length 0", lambda i: resample.bilinear(i, jnp.zeros((3, 2), i.dtype)).values,
         (draw(6, 1, 1, 2),), draw(6, 1, 1, 2)[0].repeat(3, 0)),
    Case("pixels that are not numbers", "an address from a NaN", lambda i: resample.bilinear(
        i, jnp.full((2, 2), np.nan, i.dtype)).values, (IMAGE,), np.zeros((2, 2))),
    Case("a volume's very edge", "a neighbour outside", lambda c: resample.trilinear(
        jnp.asarray(draw(7, 2, 3, 4, 1), c.dtype), c), (array([0, 0, 0], [0.5, 1.25, 0.75]),),
         oracle.volume_at(draw(7, 2, 3, 4, 1), [[0, 0, 0], [0.5, 1.25, 0.75]])),
    Case("a sweep through the source's own plane, its camera being fitted", "1 / 0 in the inverse depth", fitted,
         (array([1, 0, 0], [0, 1, 0], [0.5, 0, -1]),),
         oracle.carried(IMAGE, [[1, 0, 0], [0, 1, 0], [0.5, 0, -1]], 4, 5)[None]),
    Case("1-pixel tables", "a side of length 0", lambda t: cost_volume.cost_volume(
        t, like(t, np.eye(3))[None, None], planesweep.sweep_grid(1, 1, dtype=t.dtype)).mean, (draw(12, 1, 1, 1, 2),),
         draw(12, 1, 1, 1, 2)),
    Case("a rotation by 0", "the angle's norm at 0", rotation_from_vector, (np.zeros(3, np.float32),), np.eye(3)),
    Case("a rotation by pi", "the sine of pi", rotation_from_vector, (array(np.pi, 0, 0),), np.diag([1, -1, -1]), 1e-5),
    # flow
    Case("zero flow", "|f| at 0", lambda f: scene_flow.minimum_flow_loss(f), (np.zeros((4, 3), np.float32),), 0.0),
    Case("zero flow's smoothness", "the norm of 0", scene_flow.spatial_smoothness_loss,
         (np.zeros((4, 3), np.float32), np.zeros((4, 3), np.float32)), 0.0),
    Case("points that coincide", "the norm of 0 in a weight", scene_flow.spatial_smoothness_loss,
         (FLOW, np.ones((4, 3), np.float32)), np.mean(np.abs(np.diff(FLOW.astype(np.float64), axis=0)))),
    Case("confidence 0", "a division by the confidences' sum",
         lambda a, b, w: scene_flow.cycle_loss(a, b, w, normalise="confidence"), (FLOW, FLOW, EMPTY), 0.0),
    Case("flow out of the frustum", "z passes 1", uncubed,
         (np.full((1, 3), 0.9, np.float32), np.full((1, 3), 0.5, np.float32)),
         oracle.world_from_cube([[1.4, 1.4, 1.4]], K, *CUBE), 2e-3),
    Case("flow to behind the camera", "a mirrored pixel", projected_flow,
         (draw(8, 4, 3, low=1, high=2), np.full((4, 3), -9, np.float32)), array(0, 0)),
    Case("a neighbour that is missing", "NaN times 0", lambda x: means.mean_over_valid(
        "case", jnp.stack([x, jnp.full_like(x, jnp.nan)]), valid=jnp.asarray([1.0, 0.0], x.dtype)), (RAY,), 1.4),
    Case("no neighbour at all", "0 / 0", lambda x: means.mean_over_valid(
        "case", x[None], valid=jnp.zeros(1, x.dtype)), (RAY,), 0.0),
    # views
    Case("points that a view does not see", "its maps read 0: a division by the tolerance", shown,
         (array([0.3, 0.1, -3], [0, 0, 0], [90, 0, 2]),), np.zeros((3, 4))),
    Case("a point far behind a view's surface", "the gap overflows", shown, (array([-1e3, -500, 1e4]),),
         [[*draw(10, 6, 8, 3)[4, 4], 1 - np.exp(-9)]]),
    Case("no view is trusted", "a weighted mean of weights 0", over_views,
         (np.zeros((2, 3), np.float32), draw(11, 2, 4, 3)), np.zeros((4, 3))),
    # losses
    Case("a confidence that is missing", "NaN in the sum of confidences", confident, (array(0.5, 0.25),), 1.0),
    Case("a depth that the planes exclude", "0 times the logarithm of 0", lambda p: (
        supervision.depth_cross_entropy_loss(jnp.stack([p, p, like(p, -np.inf), like(p, -np.inf)]), like(p, 0.5))),
        (np.float32(-0.6931472),), 0.6931472),
    Case("certain and wrong of what moves", "the logarithm of 0", lambda d: supervision.motion_mask_loss(
        d, 1 - like(d, [0, 1])), (array(0, 1),), np.log(1e3)),
    Case("a discriminator that is certain", "exp overflows", adversarial.generator_loss, (array(200, -200),), 40001.0),
    Case("a kernel of zeros", "its greatest singular value is 0", lambda k: adversarial.spectral_norm(
        k.reshape(1, 1, 3, 3)), (np.zeros(9, np.float32),), 0.0, 1e-3, unit=1e-3),
    Case("a depth whose truth is unknown", "NaN in the residual", lambda d: metrics.depth_abs_rel(
        d, like(d, [[2.0, np.nan, 0.0]]), None), (array([3.0, 1.0, 1.0]),), 0.5),
    Case("a flow whose truth is unknown", "NaN in the norm", lambda f: metrics.endpoint_error(
        f, like(f, [[[0, 0], [np.nan, 1]]]), None), (array([[3.0, 4.0], [1.0, 1.0]]),), 5.0),
    Case("a flow equal to the truth", "the norm of 0", lambda f: metrics.endpoint_error(f, 0 * f, None),
         (np.zeros((2, 3, 2), np.float32),), 0.0),
    Case("entropy at 0 and 1", "0 log 0", regularisers.blend_entropy_loss, (array(0, 1),), 0.0),
    Case("entropy of logits at 200", "exp overflows", lambda z: regularisers.blend_entropy_loss(
        z, given="logit", symmetric=True), (array(-200, 200),), 0.0),
    Case("a flat depth map", "a deviation of 0", whitened, (np.full(5, 2.5, np.float32),), np.zeros(5)),
    Case("a flat prior", "it counts in nothing", lambda d: priors.depth_loss(d, jnp.ones_like(d)), (draw(9, 5),), 0.0),
    Case("one pixel of a depth map", "its own median", whitened, (array(3.0),), array(0.0)),
    Case("an empty mask's mean", "0 / 0", lambda x: numerics.masked_mean(x, jnp.zeros_like(x)), (RAY,), 0.0),
    Case("pixels equal to the truth", "PSNR is infinite", psnr_of(IMAGE), (IMAGE,), 100.0),
    Case("saturated images", "|x| at equal values", lambda x: photometric.reconstruction_loss(
        x, jnp.ones_like(x), norm="absolute"), (np.ones((3, 3), np.float32),), 0.0),
    Case("SSIM of flat images", "variances by cancellation", lambda a, b: metrics.ssim(a, b),
         (np.full((12, 12, 1), 0.5, np.float32), np.full((12, 12, 1), 0.5, np.float32)), 1.0, unit=1e-4),
    Case("aligning a constant", "a variance of 0", lambda v: depth.aligned(
        depth.align_least_squares(v, like(v, RAY), jnp.ones_like(v)), v), (ONES,), np.full(4, 1.4)),
    Case("the norm of 0", "a square root at 0", numerics.safe_norm, (np.zeros(3, np.float32),), 0.0),
    Case("a quotient of small numbers", "the square of the denominator is 0", numerics.safe_divide,
         (array(1e-25, 3e-25), array(2e-25, 1e-25)), array(0.5, 3)),
    Case("dividing by 0", "inf", numerics.safe_divide, (RAY, EMPTY), np.zeros(4)),
    # networks
    Case("a batch of constants", "a deviation of 0", normed, (np.full((5, 2), 3.0, np.float32),), np.zeros((5, 2))),
    Case("a batch of one", "a deviation of 0", normed, (array([1.0, 2.0]),), np.zeros((1, 2))),
    Case("ten octaves", "2^9 x in half precision", lambda x: positional_encoding(x, levels=10),
         (array(0.3, -0.9),), oracle.encoded(array(0.3, -0.9), 10), 2e-3),
    # trust
    Case("a surface of no tolerance", "a division by 0", lambda z: trust.agreement(z, 0 * z, 1e-12 + 0 * z),
         (array(0.5, 0.0),), array(0, np.exp(-1))),
]  # fmt: skip
