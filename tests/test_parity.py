"""zestjax/PARITY.md: ZeST-NeRF's and NSFF's own functions against ours, and by how much ours differ on purpose."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import golden

import zestjax
from zestjax import cost_volume, depth, flow, rendering
from zestjax.cameras import Camera
from zestjax.fields.trunk import ColourHead, Trunk, direct_colour, trunk
from zestjax.losses import photometric, priors, regularisers, scene_flow
from zestjax.nets.layers import Dense, dense
from zestjax.nets.positional import positional_encoding
from zestjax.planesweep import sweep_grid

TABLE = [
    [cell.strip() for cell in line.strip("|\n ").split("|")]
    for line in (Path(zestjax.__file__).parent / "PARITY.md").read_text().splitlines()
    if line.startswith("| `")
]
ROWS = {array.strip("`"): row for row in TABLE for array in row[1].split(", ")}


def euclidean(ndc, hwf):
    """NSFF's inverse of OpenGL's normalised coordinates, clamped as the released ZeST-NeRF does."""
    height, width, focal = hwf
    z = 2 / (jnp.clip(ndc[..., 2], -1, 0.99) - 1)
    return jnp.stack([-ndc[..., 0] * z * width / 2 / focal, -ndc[..., 1] * z * height / 2 / focal, z], -1)


def single_field(take, name):
    """The authors' `raw2outputs` in our functions: {array: (as published, as we do it)}."""
    raw, z, dists = take[f"raw_{name}"], take["z_vals"], take["dists"]
    density, colour = jax.nn.relu(raw[..., 3]), jax.nn.sigmoid(raw[..., :3])
    weights = rendering.weights_from_density(density, dists)
    shown = rendering.composite(weights, colour)
    ours = depth.expected_depth(weights, z)
    published = depth.expected_depth(weights, z, background=0.0)
    disparity = depth.disparity_from_depth(published / shown.opacity, nearest=1e-10)
    return {
        f"r2o_{name}_rgb": (shown.values, shown.values),
        f"r2o_{name}_acc": (shown.opacity, shown.opacity),
        f"r2o_{name}_weights": (weights, weights),
        f"r2o_{name}_alpha": (rendering.alpha_from_density(density, dists),) * 2,
        f"r2o_{name}_depth": (published, ours),
        f"r2o_{name}_disp": (disparity, depth.disparity_from_depth(ours)),
        f"r2o_{name}_rgb_whitebug": (rendering.composite(weights, colour, background=1.0).values, shown.values),
    }


def blended(take):
    field = lambda name: rendering.FieldSamples(
        jax.nn.relu(take[f"raw_{name}"][..., 3]), jax.nn.sigmoid(take[f"raw_{name}"][..., :3])
    )
    static, dynamic, b, z = field("static"), field("dynamic"), take["blend_w"], take["z_vals"]
    ours = rendering.render_blended(static, dynamic, b, take["dists"], z)
    print_form = rendering.render_blended(static, dynamic, b, take["dists"], z, form="density")
    seen = rendering.confidence_map(ours.dynamic_weights, 1 - take["prob"])
    return {
        "blend_rgb": (ours.colour, print_form.colour),
        "blend_depth": (ours.depth * ours.opacity, ours.depth),
        "blend_rgb_dy": (ours.dynamic_colour,) * 2,
        "blend_depth_dy": (ours.dynamic_depth * jnp.sum(ours.dynamic_weights, -1), ours.dynamic_depth),
        "blend_weights_dy_only": (ours.dynamic_weights,) * 2,
        "blend_weights_dd": (ours.weights.dynamic, print_form.weights.dynamic),
        "prob_map": (seen, seen),
    }


def projected(take):
    """The moved point in the neighbour's image; theirs: a mean in normalised coordinates, OpenGL's signs."""
    height, width, focal = take["HWf"]
    points = euclidean(take["ndc"], take["HWf"])
    moved = euclidean(take["ndc"] + take["sf_post"], take["HWf"])
    weights = take["blend_weights_dy_only"]
    k = jnp.zeros((3, 3)).at[jnp.arange(2), jnp.arange(2)].set(focal).at[2, 2].set(1)
    k = k.at[0, 2].set(width / 2).at[1, 2].set(height / 2)
    camera = Camera(k, take["w2c"])
    mean = flow.expected(weights, take["ndc"] + take["sf_post"], normalise=False)
    there = euclidean(mean, take["HWf"])
    seen = there @ take["w2c"][:3, :3].T + take["w2c"][None, :3, 3]
    opengl = jnp.stack([-focal * seen[:, 0] / seen[:, 2] + width / 2, focal * seen[:, 1] / seen[:, 2] + height / 2], -1)
    ours = flow.induced_flow(weights, points, moved - points, camera, jnp.zeros((10, 2)))
    return {"ndc2euc": (points, None), "proj_from_ndc": (opengl, ours.pixels)}


def losses(take):
    points = euclidean(take["ndc"], take["HWf"])
    there, back = (euclidean(take["ndc"] + take[name], take["HWf"]) - points for name in ("sf_post", "sf_prev"))
    weights, edges = take["blend_weights_dy_only"], jnp.linspace(0, 1, 16)
    masked = lambda norm: photometric.reconstruction_loss(take["A"], take["B"], valid=take["mask"], norm=norm)
    short = weights[..., :-1]
    distortion = regularisers.distortion_loss(short, edges)
    published = 0.5 * (distortion * len(short) + jnp.sum(short**2) / 15 / 3)
    disparity, image = take["disp_patch"][..., 0], take["img_patch"]
    smooth = lambda picture, **options: regularisers.edge_aware_depth_loss(disparity, picture, **options)
    entropy = regularisers.blend_entropy_loss(take["blend_w"])
    ones = jnp.ones(10)
    prior = lambda **options: priors.depth_loss(take["blend_depth_dy"], -take["gt_disp"], **options)
    return {
        "loss_sf_smooth": (
            scene_flow.spatial_smoothness_loss(there, points, weighting="uniform", drop_far=0.05),
            scene_flow.spatial_smoothness_loss(there, points),
        ),
        "loss_lke": (
            0.5 * scene_flow.temporal_loss(there, back, drop_far=0.1), scene_flow.temporal_loss(there, back),
        ),
        "loss_depth": (prior(norm="squared", floor=0.0), prior()),
        "median_dep": (depth.masked_median(take["blend_depth_dy"], ones),) * 2,
        "median_gt_neg": (depth.masked_median(-take["gt_disp"], ones),) * 2,
        "mse_masked": (masked("squared"),) * 2,
        "mae_masked": (masked("absolute"),) * 2,
        "loss_distortion": (published, regularisers.distortion_loss(weights, jnp.linspace(0, 1, 17))),
        "loss_disp_smooth": (smooth(image, relative=False), smooth(image)),
        "loss_tv": (smooth(jnp.zeros_like(image), relative=False), None),
        "entropy": (entropy, entropy),
    }  # fmt: skip


def encodings(take):
    sets = {"pe3_10": ("x3", 10), "pe4_10": ("x4", 10), "pe3_4": ("x3", 4)}
    return {name: (positional_encoding(take[x], levels=n),) * 2 for name, (x, n) in sets.items()}


def tiny_field(take, kind):
    """The released network of eight layers in our trunk and heads; raw outputs, as the golden arrays hold them."""
    layer = lambda name: Dense(take[f"w_{kind}_nerf.{name}.weight"].T, take[f"w_{kind}_nerf.{name}.bias"])
    x = take[f"mlp_in_{kind}"].reshape(24, -1)
    n_point = 63 if kind == "st" else 84
    point, features, direction = x[:, :n_point], x[:, n_point:-27], x[:, -27:]
    state = trunk(Trunk(tuple(layer(f"pts_linears.{i}") for i in range(8)), layer("pts_bias")), point, features)
    head = ColourHead(layer("feature_linear"), layer("views_linears.0"), layer("rgb_linear"))
    raw = jax.scipy.special.logit(direct_colour(head, state, direction))
    density = dense(layer("alpha_linear"), state)
    if kind == "st":
        rest = [jax.nn.sigmoid(dense(layer("w_linear"), state))]
    else:
        rest = [jnp.tanh(dense(layer("sf_linear"), state)), jax.nn.sigmoid(dense(layer("prob_linear"), state))]
    out = jnp.concatenate([raw, density, *rest], -1).reshape(take[f"mlp_out_{kind}"].shape)
    return {f"mlp_out_{kind}": (out, None)}


def volumes(take):
    matrices, depths = take["cv_proj"], take["cv_depth"]
    warps = matrices[None, ..., :3] * jnp.ones((8, 1, 1, 1))
    warps = warps.at[..., 2].add(matrices[None, ..., 3] / depths[:, None, None])
    features, images = (jnp.moveaxis(take[name], 1, -1) for name in ("cv_feats", "cv_imgs"))
    ours = cost_volume.mvsnerf_cost_volume(
        features, cost_volume.quarter_colours(images), warps, padding=4, colour_views=3
    )
    sound = cost_volume.cost_volume(features, warps, sweep_grid(8, 8, padding=4)).variance
    mixed = jnp.concatenate([ours[..., :9], sound], -1)
    return {"cv_cost": (jnp.moveaxis(ours, -1, 0), jnp.moveaxis(mixed, -1, 0))}


@pytest.fixture(scope="module")
def record():
    return {name: jnp.asarray(array) for name, array in golden("zest_funcs_golden.npz").items()}


@pytest.fixture(scope="module")
def computed(record):
    weights = {name: array for name, array in golden("zest_funcs_golden.npz", batch=True).items() if name[:2] == "w_"}
    take = record | {name: jnp.asarray(array) for name, array in weights.items()}

    @jax.jit
    def everything(take):
        return (
            single_field(take, "static") | single_field(take, "dynamic") | blended(take) | projected(take)
            | losses(take) | encodings(take) | tiny_field(take, "st") | tiny_field(take, "dy") | volumes(take)
        )  # fmt: skip

    return everything(take)


@pytest.mark.parametrize("name", ROWS)
def test_theirs_is_reproduced_and_our_difference_has_the_stated_size(record, computed, name):
    _, _, _, tolerance, _, size = ROWS[name]
    published, ours = computed[name]
    theirs = np.asarray(record[name])
    np.testing.assert_allclose(published, theirs, rtol=float(tolerance), atol=float(tolerance))
    if size == "–":
        assert ours is None
    elif size == "0":
        np.testing.assert_allclose(ours, theirs, rtol=float(tolerance), atol=float(tolerance))
    else:
        np.testing.assert_allclose(np.max(np.abs(ours - theirs)), float(size), rtol=0.02)


def test_every_recorded_output_is_in_the_table(record):
    inputs = "z_vals rays_d raw_static raw_dynamic blend_w prob ndc sf_post sf_prev w2c HWf gt_disp mask A B x3 x4"
    inputs += " disp_patch img_patch mlp_in_st mlp_in_dy cv_feats cv_imgs cv_proj cv_depth cv_mask dists"
    outputs = {name for name in record if name[:2] != "w_"} - set(inputs.split())
    assert outputs == {name for name in ROWS if name in record}
