"""MVSNeRF from its published weights: every stored stage of the authors' own run is reproduced from its inputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import golden

from zestjax import mvsnerf
from zestjax.apps.weights import open_weights
from zestjax.cameras import Camera, scaled
from zestjax.cli import main
from zestjax.io.mvsnerf import mvsnerf_like, mvsnerf_params
from zestjax.io.weights import WeightsError
from zestjax.nets.conv3d import conv3d, conv3d_transpose
from zestjax.nets.feature_pyramid import feature_pyramid, imagenet_normalised
from zestjax.nets.layers import block2d, norm_act
from zestjax.nets.positional import positional_encoding
from zestjax.planesweep import carry, homographies, plane_depths, sweep_grid, warp
from zestjax.rays import rays_from_pixels
from zestjax.rendering import alpha_from_density, weights_from_density
from zestjax.video import Video

# FACTS.md, appendix B: what a float64 run of the authors' code differs by, rounded up.
TIGHT = dict(rtol=1e-4, atol=1e-4)
COST = dict(rtol=1e-4, atol=5e-4)  # a difference of squares as large as 81


@pytest.fixture(scope="module")
def record():
    return golden("mvsnerf_golden.npz")


@pytest.fixture(scope="module")
def params():
    return mvsnerf_params(golden("mvsnerf_v0_weights.npz", batch=True))


@pytest.fixture(scope="module")
def stored_params():
    return mvsnerf_params(golden("mvsnerf_v0_weights.npz", batch=True), statistics="stored")


@pytest.fixture(scope="module")
def sources(record):
    near, far = record["near_far"]
    cameras = Camera(record["intrinsics"][:3], record["w2cs"][:3])
    images = record["imgs01"][:3].transpose(0, 2, 3, 1)
    return jax.tree.map(jnp.asarray, mvsnerf.Sources(images, cameras, near, far))


def target(record):
    return Camera(jnp.asarray(record["intrinsics"][3]), jnp.asarray(record["w2cs"][3]))


def channels_first(x):
    return np.moveaxis(np.asarray(x), -1, 0)


def feature_warps(sources, planes=16):
    cameras = scaled(sources.cameras, 0.25, 0.25)
    first = jax.tree.map(lambda leaf: leaf[0], cameras)
    return homographies(first, cameras, plane_depths(sources.near, sources.far, planes))


def test_images_are_normalised_alike(record):
    ours = imagenet_normalised(jnp.asarray(record["imgs01"].transpose(0, 2, 3, 1)))
    np.testing.assert_allclose(ours.transpose(0, 3, 1, 2), record["imgs_norm"], **TIGHT)


def test_first_block_and_features_before_the_head(record, params, sources):
    x = imagenet_normalised(sources.images)
    strides = (1, 1, 2, 1, 1, 2, 1, 1)
    for i, (block, stride) in enumerate(zip(params.features.blocks, strides, strict=True)):
        x = block2d(block, x, stride=stride, legacy_abs=True)
        if i == 0:
            np.testing.assert_allclose(channels_first(x[0]), record["feat_conv0_0_train"], **TIGHT)
    np.testing.assert_allclose(x.transpose(0, 3, 1, 2), record["feat_conv2_train"], **TIGHT)


@pytest.mark.parametrize("mode", ["train", "eval"])
def test_features_in_both_modes_of_the_norms(record, params, stored_params, sources, mode):
    used = params if mode == "train" else stored_params
    ours = feature_pyramid(used.features, sources.images, legacy_abs=True)
    np.testing.assert_allclose(ours.transpose(0, 3, 1, 2), record[f"feats_{mode}"], **TIGHT)


def test_depths_and_homographies(record, sources):
    depths = plane_depths(sources.near, sources.far, 16)
    np.testing.assert_allclose(depths, record["depth_values"], rtol=1e-6)
    warps = feature_warps(sources)
    theirs = record["proj_mats"][:3]  # A | b: A u + b / d
    expected = theirs[None, :, :, :3] + 0 * np.asarray(warps)
    expected[..., 2] += theirs[None, :, :, 3] / np.asarray(depths)[:, None, None]
    np.testing.assert_allclose(warps, expected, **TIGHT)


@pytest.mark.parametrize("padding", [0, 4])
def test_warp_grids_and_masks(record, sources, padding):
    warps, grid = feature_warps(sources), sweep_grid(16, 24, padding=padding)
    for source in (1, 2):
        u, v, _, front = carry(warps[:, source], grid)
        ours = np.stack([u / (23 / 2) - 1, v / (15 / 2) - 1], -1)
        assert np.all(front)
        np.testing.assert_allclose(ours, record[f"grid{source}_pad{padding}"], **TIGHT)
        inside = np.all(np.abs(ours) < 1, -1)
        np.testing.assert_array_equal(inside, record[f"inmask_pad{padding}"][source])


def test_warped_features(record, params, sources):
    """Inside the source their values are ours; over the pixel outside it theirs fade, ours are 0."""
    features, warps = record["feats_train"][1].transpose(1, 2, 0), feature_warps(sources)
    for i, plane in enumerate(range(0, 16, 5)):
        ours = warp(jnp.asarray(features), warps[plane, 1], sweep_grid(16, 24, padding=4)).values
        inside = record["inmask_pad4"][1, plane].astype(bool)
        np.testing.assert_allclose(ours[inside], record["warp1_pad4_train"][:, i].transpose(1, 2, 0)[inside], **TIGHT)


def test_cost_volume(record, params, sources):
    ours = jax.jit(lambda: mvsnerf.cost(params, sources, planes=16, padding=4))()
    np.testing.assert_allclose(channels_first(ours), record["cost_pad4_train"], **COST)


def test_stages_of_the_regulariser(record, params):
    net = params.regulariser
    act = lambda block, x: norm_act(block.norm, x, legacy_abs=True)
    x = act(net.stem, conv3d(jnp.asarray(record["cost_pad4_train"].transpose(1, 2, 3, 0)), net.stem.conv.kernel))
    np.testing.assert_allclose(channels_first(x), record["creg_conv0"], **TIGHT)
    for (halve, follow), name in zip(net.downs, ("creg_conv2", "creg_conv4", "creg_conv6"), strict=True):
        x = act(halve, conv3d(x, halve.conv.kernel, stride=2))
        x = act(follow, conv3d(x, follow.conv.kernel))
        np.testing.assert_allclose(channels_first(x), record[name], **TIGHT)
    x = act(net.ups[2], conv3d_transpose(x, net.ups[2].conv.kernel))
    np.testing.assert_allclose(channels_first(x), record["creg_conv7"], **TIGHT)


@pytest.mark.parametrize("padding, mode", [(4, "train"), (4, "eval"), (0, "train")])
def test_volumes_from_the_images(record, params, stored_params, sources, padding, mode):
    used = params if mode == "train" else stored_params
    ours = jax.jit(lambda p: mvsnerf.volume(p, sources, planes=16, padding=padding))(used)
    np.testing.assert_allclose(channels_first(ours), record[f"vol_pad{padding}_{mode}"], **TIGHT)


def test_full_depth_volume(record, params, sources):
    ours = jax.jit(lambda: mvsnerf.volume(params, sources, planes=128, padding=4))()
    np.testing.assert_allclose(channels_first(ours)[:, ::8, ::4, ::4], record["vol128_train_strided"], **TIGHT)
    stats = [float(f(ours)) for f in (jnp.mean, lambda x: jnp.std(x, ddof=1), jnp.min, jnp.max)]
    np.testing.assert_allclose(stats, record["vol128_stats"], rtol=1e-4)


def test_rays_and_points(record):
    pixels = jnp.stack([jnp.asarray(record["ray_px"], jnp.float32), jnp.asarray(record["ray_py"], jnp.float32)], -1)
    rays = rays_from_pixels(target(record), pixels)
    np.testing.assert_allclose(rays.directions, record["rays_d"], **TIGHT)
    np.testing.assert_allclose(rays.origins[0], record["rays_o"], **TIGHT)
    near, far = record["near_far"]
    np.testing.assert_allclose(plane_depths(near, far, 24), record["z_lin"], rtol=1e-6)
    points = rays.origins[:, None] + record["z_jit"][..., None] * rays.directions[:, None]
    np.testing.assert_allclose(points, record["rays_pts"], **TIGHT)


@pytest.mark.parametrize("padding", [0, 4])
def test_coords_and_looked_up_features(record, sources, padding):
    coords = mvsnerf.volume_coords(sources, jnp.asarray(record["rays_pts"]), padding=padding)
    np.testing.assert_allclose(coords, record[f"rays_ndc_pad{padding}"], **TIGHT)
    built = jnp.asarray(record[f"vol_pad{padding}_train"].transpose(1, 2, 3, 0))
    ours = mvsnerf.look_up(built, jnp.asarray(record[f"rays_ndc_pad{padding}"]))
    np.testing.assert_allclose(ours, record[f"ray_feats_pad{padding}"], **TIGHT)


def test_view_colours(record, sources):
    ours = mvsnerf.view_colours(sources, jnp.asarray(record["rays_pts"].reshape(-1, 3)))
    np.testing.assert_allclose(ours.reshape(48, 24, 12), record["ray_colors"], **TIGHT)


def test_encoding_and_direction(record, sources):
    ours = positional_encoding(jnp.asarray(record["rays_ndc_pad4"][:2]), levels=10, order="mvsnerf")
    np.testing.assert_allclose(ours, record["pe_xyz"], **TIGHT)


def test_field_output(record, params):
    coords = jnp.asarray(record["rays_ndc_pad4"].reshape(-1, 3))
    features = jnp.asarray(np.concatenate([record["ray_feats_pad4"], record["ray_colors"]], -1).reshape(-1, 20))
    direction = jnp.repeat(jnp.asarray(record["view_dir"]), 24, axis=0)
    density, colour = mvsnerf.field(params.field, coords, features, direction)
    ours = jnp.concatenate([colour, density[:, None]], -1).reshape(48, 24, 4)
    np.testing.assert_allclose(ours, record["raw_rgbsigma"], **TIGHT)


def test_opacities_and_weights(record):
    density = jnp.asarray(record["raw_rgbsigma"][..., 3])
    ones = jnp.ones(24, jnp.float32)
    np.testing.assert_allclose(alpha_from_density(density, ones), record["alpha"], **TIGHT)
    np.testing.assert_allclose(weights_from_density(density, ones), record["weights"], **TIGHT)


def test_rendered_colours_and_depths_from_the_images(record, params, sources):
    pixels = jnp.stack([jnp.asarray(record["ray_px"], jnp.float32), jnp.asarray(record["ray_py"], jnp.float32)], -1)
    built = jnp.asarray(record["vol_pad4_train"].transpose(1, 2, 3, 0))
    draw = jax.jit(
        lambda b: mvsnerf.render(
            params, b, sources, target(record), pixels, depths=jnp.asarray(record["z_jit"]), padding=4
        )
    )
    ours = draw(built)
    np.testing.assert_allclose(ours.colour, record["rgb_map"], **TIGHT)
    np.testing.assert_allclose(ours.depth, record["depth_map"], **TIGHT)
    whole = draw(mvsnerf.volume(params, sources, planes=16, padding=4))
    np.testing.assert_allclose(whole.colour, record["rgb_map"], **TIGHT)
    np.testing.assert_allclose(whole.depth, record["depth_map"], **TIGHT)


def published_arrays(params):
    """`mvsnerf_params` undone: arrays by published name."""
    arrays = {}

    def dense(name, layer):
        arrays[f"fn/nerf.{name}.weight"], arrays[f"fn/nerf.{name}.bias"] = layer.kernel.T, layer.bias

    def block(conv, norm, block, channels=(-1, -2)):
        kernel = np.asarray(block.conv.kernel)
        axes = [kernel.ndim + c for c in channels]
        arrays[f"mvs/{conv}.weight"] = kernel.transpose(*axes, *range(kernel.ndim - 2))
        arrays[f"mvs/{norm}.weight"], arrays[f"mvs/{norm}.bias"] = block.norm[:2]
        arrays[f"mvs/{norm}.running_mean"], arrays[f"mvs/{norm}.running_var"] = block.norm.offset, block.norm.scale

    names = [f"feature.conv{i}.{j}" for i, count in enumerate((2, 3, 3)) for j in range(count)]
    for name, part in zip(names, params.features.blocks, strict=True):
        block(f"{name}.conv", f"{name}.bn", part)
    arrays["mvs/feature.toplayer.weight"] = np.asarray(params.features.head.kernel).transpose(3, 2, 0, 1)
    arrays["mvs/feature.toplayer.bias"] = params.features.head.bias
    net = params.regulariser
    for i, part in enumerate((net.stem, *(part for pair in net.downs for part in pair))):
        block(f"cost_reg_2.conv{i}.conv", f"cost_reg_2.conv{i}.bn", part)
    for i, part in zip((11, 9, 7), net.ups, strict=True):
        block(f"cost_reg_2.conv{i}.0", f"cost_reg_2.conv{i}.1", part, channels=(-2, -1))
    for i, layer in enumerate(params.field.trunk.layers):
        dense(f"pts_linears.{i}", layer)
    colour = params.field.colour
    for name, layer in {
        "pts_bias": params.field.trunk.condition, "alpha_linear": params.field.density,
        "feature_linear": colour.feature, "views_linears.0": colour.hidden, "rgb_linear": colour.colour,
    }.items():  # fmt: skip
        dense(name, layer)
    return {name: np.asarray(array) for name, array in arrays.items()}


@pytest.fixture(scope="module")
def made():
    """Parameters of the published shapes, made here."""
    rng = np.random.default_rng(0)
    like = mvsnerf_like()
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape) / 8, x.dtype), like)


def test_import_writes_what_evaluate_opens(tmp_path, made):
    arrays = published_arrays(made)
    np.savez(tmp_path / "mvsnerf.npz", **arrays)
    for statistics in ("batch", "stored"):
        out = tmp_path / f"{statistics}.safetensors"
        assert (
            main(["import-mvsnerf", str(tmp_path / "mvsnerf.npz"), "--out", str(out), "--statistics", statistics]) == 0
        )
        model = open_weights(out, published=True)
        assert model.system == "mvsnerf" and (model.params.features.blocks[0].norm.statistics is None) == (
            statistics == "batch"
        )
        np.testing.assert_array_equal(model.params.field.trunk.layers[5].kernel, made.field.trunk.layers[5].kernel)
        with pytest.raises(WeightsError, match="which only `render` and `evaluate` can use"):
            open_weights(out)


def test_import_names_what_is_wrong(tmp_path, made, capsys):
    arrays = published_arrays(made)
    arrays["fn/nerf.pts_bias.weight"] = np.zeros((128, 19), np.float32)
    np.savez(tmp_path / "a.npz", **arrays)
    del arrays["mvs/cost_reg_2.conv9.1.bias"]
    np.savez(tmp_path / "b.npz", **arrays)
    (tmp_path / "c.tar").write_bytes(b"PK no zip")
    for name, words in {
        "a.npz": "condition.kernel` is (19, 128), expected (20, 128)", "b.npz": "mvs/cost_reg_2.conv9.1.bias",
        "c.tar": "is not a PyTorch file", "absent.tar": "could not be read",
    }.items():  # fmt: skip
        assert main(["import-mvsnerf", str(tmp_path / name), "--out", str(tmp_path / "o.safetensors")]) == 2
        shown = capsys.readouterr().err
        assert words in shown and name in shown and len(shown.splitlines()) == 1
    assert not (tmp_path / "o.safetensors").exists()


def test_a_view_is_rendered_from_the_three_nearest(made):
    rng = np.random.default_rng(1)
    pose = np.tile(np.eye(4, dtype=np.float32), (5, 1, 1))
    pose[:, 0, 3] = -np.arange(5)
    k = np.tile(np.array([[30, 0, 16], [0, 30, 12], [0, 0, 1]], np.float32), (5, 1, 1))
    video = Video(rng.uniform(size=(5, 24, 32, 3)).astype(np.float32), Camera(k, pose), np.float32(2), np.float32(6))
    config = mvsnerf.MvsNerfConfig(planes=8, padding=4, samples=4)
    camera = Camera(k[0], pose[0])
    view = mvsnerf.render_view(made, video, camera, 0, config=config, exclude=(0,))
    assert (
        view.colour.shape == (24, 32, 3) and view.depth.shape == (24, 32) and bool(jnp.all(jnp.isfinite(view.colour)))
    )
    images = video.images.copy()
    images[[0, 4]] = 0  # the target itself, and the farthest
    again = mvsnerf.render_view(made, video._replace(images=images), camera, 0, config=config, exclude=(0,))
    np.testing.assert_array_equal(view.colour, again.colour)
    with pytest.raises(ValueError, match="a view needs 3 source frames, 2 are left"):
        mvsnerf.render_view(made, video, camera, 0, config=config, exclude=(0, 1, 2))
