"""LPIPS against an independent implementation in float64 NumPy, on random weights."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import assert_finite, assert_grads_match, uniform

from zestjax.apps.cli import main
from zestjax.apps.evaluate import EvaluateOptions
from zestjax.apps.scoring import score_image
from zestjax.io.lpips import import_lpips, load_lpips, read_lpips
from zestjax.io.weights import WeightsError
from zestjax.judge.lpips import alexnet_activations, lpips, lpips_like, lpips_maps


def published(seed=0):
    """Random weights as the published files name and shape them."""
    rng = np.random.default_rng(seed)
    alexnet, heads = {"classifier.1.weight": np.zeros((3, 3), np.float32)}, {}
    for i, (number, conv) in enumerate(zip((0, 3, 6, 8, 10), lpips_like().convolutions, strict=True)):
        size, _, n_in, n_out = conv.kernel.shape
        scale = (2 / (size * size * n_in)) ** 0.5
        alexnet[f"features.{number}.weight"] = (scale * rng.normal(size=(n_out, n_in, size, size))).astype(np.float32)
        alexnet[f"features.{number}.bias"] = (0.1 * rng.normal(size=n_out)).astype(np.float32)
        heads[f"lin{i}.model.1.weight"] = rng.uniform(size=(1, n_out, 1, 1)).astype(np.float32)
    return alexnet, heads


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lpips")
    alexnet, heads = published()
    np.savez(folder / "alexnet.npz", **alexnet)
    np.savez(folder / "heads.npz", **heads)
    return folder / "alexnet.npz", folder / "heads.npz"


@pytest.fixture(scope="module")
def params(files):
    return read_lpips(*files)


def oracle_convolution(x, weight, bias, stride, padding):
    """x (C, H, W) in float64, one tap of the kernel at a time."""
    x = np.pad(x, [(0, 0), (padding, padding), (padding, padding)])
    size = weight.shape[-1]
    rows, columns = ((n - size) // stride + 1 for n in x.shape[1:])
    out = np.zeros((len(weight), rows, columns)) + bias[:, None, None]
    for i in range(size):
        for j in range(size):
            taken = x[:, i : i + stride * (rows - 1) + 1 : stride, j : j + stride * (columns - 1) + 1 : stride]
            out += np.tensordot(weight[:, :, i, j], taken, 1)
    return np.maximum(out, 0)


def oracle_pool(x):
    rows, columns = ((n - 3) // 2 + 1 for n in x.shape[1:])
    windows = [x[:, i : i + 2 * rows - 1 : 2, j : j + 2 * columns - 1 : 2] for i in range(3) for j in range(3)]
    return np.max(windows, axis=0)


def oracle_activations(image, alexnet):
    alexnet = {name: array.astype(np.float64) for name, array in alexnet.items()}
    x = 2 * np.asarray(image, np.float64).transpose(2, 0, 1) - 1
    x = (x - np.array([-0.030, -0.088, -0.188])[:, None, None]) / np.array([0.458, 0.448, 0.450])[:, None, None]
    found = []
    for number, stride, padding in ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1)):
        x = oracle_pool(x) if number in (3, 6) else x
        x = oracle_convolution(
            x, alexnet[f"features.{number}.weight"], alexnet[f"features.{number}.bias"], stride, padding
        )
        found.append(x)
    return found


def oracle_maps(image, truth, arrays=None):
    alexnet, heads = published() if arrays is None else arrays
    unit = lambda x: x / (np.sqrt(np.sum(x**2, 0, keepdims=True)) + 1e-10)
    pairs = zip(oracle_activations(image, alexnet), oracle_activations(truth, alexnet), strict=True)
    return [np.tensordot(heads[f"lin{i}.model.1.weight"][0, :, 0, 0].astype(float), (unit(a) - unit(b)) ** 2, 1)
            for i, (a, b) in enumerate(pairs)]  # fmt: skip


IMAGE, TRUTH = uniform(1, 67, 90, 3), uniform(2, 67, 90, 3)


def test_activations_are_the_oracles(params):
    expected = oracle_activations(IMAGE, published()[0])
    for ours, theirs in zip(jax.jit(alexnet_activations)(params, IMAGE), expected, strict=True):
        np.testing.assert_allclose(ours.transpose(2, 0, 1), theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("height, width", [(31, 31), (67, 90), (40, 33)])
def test_distance_is_the_oracles(params, height, width):
    image, truth = IMAGE[:height, :width], TRUTH[:height, :width]
    expected = sum(m.mean() for m in oracle_maps(image, truth))
    np.testing.assert_allclose(jax.jit(lpips)(params, image, truth), expected, rtol=1e-4)


def test_equal_pictures_are_at_distance_0_and_order_does_not_matter(params):
    assert lpips(params, IMAGE, IMAGE) == 0
    np.testing.assert_allclose(lpips(params, IMAGE, TRUTH), lpips(params, TRUTH, IMAGE), rtol=1e-5)


def test_a_full_mask_counts_every_place_and_an_empty_one_nothing(params):
    flat = lambda value: jnp.full((40, 40, 3), value, jnp.float32)
    whole, masked = (lpips(params, flat(0.2), flat(0.7), mask=m) for m in (None, jnp.ones((40, 40))))
    enlarged = sum(
        np.asarray(jax.image.resize(m, (40, 40), "bilinear")).mean() for m in lpips_maps(params, flat(0.2), flat(0.7))
    )
    np.testing.assert_allclose(masked, enlarged, rtol=1e-5)
    assert 0.5 < masked / whole < 2 and np.isnan(lpips(params, flat(0.2), flat(0.7), mask=jnp.zeros((40, 40))))


def test_a_mask_leaves_out_what_differs_elsewhere(params):
    half = jnp.concatenate([IMAGE[:, :60], TRUTH[:, 60:]], axis=1)
    mask = jnp.zeros((67, 90)).at[:, :20].set(1)
    assert lpips(params, half, IMAGE, mask=mask) < 0.2 * lpips(params, half, IMAGE, mask=1 - mask)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_flat_and_saturated_pictures_are_finite_and_so_are_their_gradients(params, value):
    assert_finite(lambda x: lpips(params, x, IMAGE[:33, :33]), jnp.full((33, 33, 3), value, jnp.float32))


def test_gradient_is_the_slope_of_finite_differences(x64, params):
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), params)
    image, truth = (x[:31, :31].astype(jnp.float64) for x in (IMAGE, TRUTH))
    assert_grads_match(lambda x: lpips(params, x, truth), image)


def test_faults_are_named(params, files, tmp_path):
    with pytest.raises(ValueError, match=r"lpips: `image` is 30x40 \(HxW\), expected at least 31x31"):
        lpips(params, IMAGE[:30, :40], IMAGE[:30, :40])
    alexnet, heads = published()
    del heads["lin3.model.1.weight"]
    np.savez(tmp_path / "heads.npz", **heads)
    with pytest.raises(WeightsError, match="lin3.model.1.weight"):
        read_lpips(files[0], tmp_path / "heads.npz")
    with pytest.raises(WeightsError, match="expected"):
        alexnet["features.0.weight"] = alexnet["features.0.weight"][:, :, :7, :7]
        np.savez(tmp_path / "alexnet.npz", **alexnet)
        read_lpips(tmp_path / "alexnet.npz", files[1])
    with pytest.raises(WeightsError, match="absent.pth: could not be read"):
        read_lpips(tmp_path / "absent.pth", files[1])


def test_import_round_trip_and_scores(files, params, tmp_path):
    assert main(["import-lpips", *map(str, files), "--out", str(tmp_path / "lpips.safetensors"), "--quiet"]) == 0
    back = load_lpips(tmp_path / "lpips.safetensors")
    jax.tree.map(np.testing.assert_array_equal, back, params)
    dynamic = np.zeros((67, 90), bool)
    dynamic[10:40, 10:40] = True
    scores = score_image(IMAGE, TRUTH, dynamic, lpips=back)
    np.testing.assert_allclose(scores["full"]["lpips"], lpips(params, IMAGE, TRUTH), rtol=1e-4)
    assert all(scores[region]["lpips"] > 0 for region in ("dynamic", "static"))
    assert score_image(IMAGE, TRUTH, dynamic)["full"]["lpips"] is None


def test_other_weights_are_refused(tmp_path, files):
    import_lpips(files[0], tmp_path / "lpips.safetensors", heads=files[1])
    with pytest.raises(WeightsError, match="lpips.safetensors"):
        from zestjax.apps.weights import open_weights

        open_weights(tmp_path / "lpips.safetensors")
    assert json.dumps(EvaluateOptions("bench:walker", tmp_path).lpips) == "null"
