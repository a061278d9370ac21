"""MVSNeRF from its published weights: every stored stage of the authors' own run is reproduced from its inputs.

`experiments/check_parity.py` compares them; here it must also fail where something is wrong, and fix no size.
"""

import dataclasses
import os
import subprocess
import sys

import jax.numpy as jnp
import mvsnerf_record
import numpy as np
import pytest
from oracles import GOLDEN, golden, of_experiments

from zestjax import novel_view
from zestjax.apps.cli import main
from zestjax.apps.weights import open_weights
from zestjax.cameras import Camera
from zestjax.io.mvsnerf import mvsnerf_like, mvsnerf_params
from zestjax.io.weights import WeightsError
from zestjax.systems.mvsnerf import MVSNERF, Ends, MvsNerf
from zestjax.systems.system import Params
from zestjax.video import Video

check_parity = of_experiments("check_parity")


def test_every_array_of_the_authors_run_is_reproduced():
    record = golden("mvsnerf_golden.npz", batch=True)
    golden("mvsnerf_v0_weights.npz")
    rows = check_parity.compare(record, check_parity.read_weights(GOLDEN / "mvsnerf_v0_weights.npz"))
    assert not [row for row in rows if row.verdict not in ("ok", "input")]
    assert sorted(row.name for row in rows) == sorted(record)


@pytest.fixture(scope="module")
def made():
    """Parameters of the published shapes, made here."""
    return mvsnerf_record.made_params(mvsnerf_like())


@pytest.fixture(scope="module")
def files(tmp_path_factory, made):
    """A record of another size, and the weights, as files."""
    folder, published = tmp_path_factory.mktemp("parity"), published_arrays(made)
    record = mvsnerf_record.made_record(made, mvsnerf_params(published, statistics="stored"))
    np.savez(folder / "golden.npz", **record)
    np.savez(folder / "weights.npz", **published)
    return folder, record


def parity(capsys, *paths):
    """Exit status, {name: the rest of its row}, and the last line."""
    status = check_parity.main([str(path) for path in paths])
    lines = capsys.readouterr().out.splitlines()
    return status, {line.split()[0]: line.split(maxsplit=3)[3] for line in lines[1:-1]}, lines[-1]


def test_sizes_are_the_files_own(files, capsys):
    folder, record = files
    status, rows, last = parity(capsys, folder / "golden.npz", folder / "weights.npz")
    said = lambda verdict: {name for name, row in rows.items() if row == verdict}
    assert status == 0, {name: row for name, row in rows.items() if row.startswith("FAIL")}
    assert said("missing") == mvsnerf_record.LEFT_OUT and said("input") == set(check_parity.INPUTS)
    assert said("ok") == set(record) - set(check_parity.INPUTS) and f"{len(said('ok'))} arrays hold" in last


def test_an_array_that_differs_in_value_or_shape_is_a_failed_row(files):
    """Each array in turn: by a thousandth of its greatest value, and without its last entries."""
    folder, record = files
    rows, fit = check_parity.prepared(record, check_parity.read_weights(folder / "weights.npz"))
    assert {row.name for row in rows} == set(check_parity.INPUTS)
    for name in set(record) - set(check_parity.INPUTS):
        off = np.float32(1 if name.startswith("inmask") else 1e-3 * max(1, np.abs(record[name]).max()))
        for changed in (record[name] + off, record[name][..., :-1], record[name] * np.float32(np.nan)):
            row = check_parity.row_of(name, changed, fit)
            assert row.name == name and row.verdict == "FAIL", row
            assert (row.error is None) == (changed.shape != record[name].shape), row


def test_what_is_wrong_with_a_file_is_said_in_its_rows(files, capsys):
    folder, record = files
    changed = record | {
        "depth_map": record["depth_map"] + 1, "rays_d": record["rays_d"].T, "alpha": np.array(["no", "numbers"]),
        "colour_map": np.zeros(3), "u_jitter": record["u_jitter"][:, 1:],
    }  # fmt: skip
    del changed["rays_o"]
    np.savez(folder / "changed.npz", **changed)
    status, rows, _ = parity(capsys, folder / "changed.npz", folder / "weights.npz")
    failed = {name for name, row in rows.items() if row.startswith("FAIL")}
    assert status == 1 and failed == {"depth_map", "rays_d", "alpha", "z_jit"}
    assert rows["colour_map"] == "unknown: not compared" and rows["rays_o"] == "missing"
    assert "has shape (3, 5), expected (5, 3)" in rows["rays_d"] and "expected numbers" in rows["alpha"]


@pytest.mark.parametrize("change", [lambda x: x[:, 0], lambda x: x[:-1], lambda x: 1 - x])
def test_images_that_do_not_fit_fail_what_is_computed_from_them(files, capsys, change):
    folder, record = files
    np.savez(folder / "images.npz", **record | {"imgs01": change(record["imgs01"])})
    status, rows, _ = parity(capsys, folder / "images.npz", folder / "weights.npz")
    assert status == 1 and rows["feats_train"].startswith("FAIL") and rows["rgb_map"].startswith("FAIL")


def test_files_of_another_kind_are_refused_in_one_line(files, tmp_path, capsys):
    folder, record = files
    (tmp_path / "text.npz").write_text("no arrays")
    os.mkfifo(tmp_path / "fifo.npz")
    np.save(tmp_path / "one.npy", record["z_lin"])
    np.savez(tmp_path / "part.npz", imgs01=record["imgs01"])
    np.savez(tmp_path / "few.npz", **{"fn/nerf.pts_bias.weight": np.zeros((128, 20))})
    golden, weights = folder / "golden.npz", folder / "weights.npz"
    for paths, words in {
        (tmp_path / "text.npz", weights): "text.npz: is not a numpy file that can be read",
        (tmp_path / "one.npy", weights): "one.npy: holds one array (.npy), expected arrays by name",
        (tmp_path / "part.npz", weights): "part.npz: holds no w2cs, intrinsics, near_far;",
        (tmp_path / "fifo.npz", weights): "fifo.npz: is a fifo", (golden, tmp_path / "fifo.npz"): "fifo.npz: is a fifo",
        (weights, weights): "weights.npz: holds no imgs01", (golden, golden): "golden.npz: lacks or misshapes",
        (golden, tmp_path / "few.npz"): "few.npz: lacks or misshapes",
    }.items():  # fmt: skip
        assert check_parity.main([str(path) for path in paths]) == 2
        shown = capsys.readouterr()
        assert not shown.out and shown.err.startswith("error: ") and words in shown.err and shown.err.count("\n") == 1
    command = [sys.executable, check_parity.__file__, str(tmp_path / "absent.npz"), str(weights)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and not done.stdout
    assert (
        done.stderr == f"error: {tmp_path / 'absent.npz'}: could not be read (No such file or directory); "
        "check the path.\n"
    )


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


def test_import_writes_what_evaluate_opens(tmp_path, made):
    arrays = published_arrays(made)
    np.savez(tmp_path / "mvsnerf.npz", **arrays)
    for statistics in ("batch", "stored"):
        out = tmp_path / f"{statistics}.safetensors"
        assert (
            main(["import-mvsnerf", str(tmp_path / "mvsnerf.npz"), "--out", str(out), "--statistics", statistics]) == 0
        )
        model = open_weights(out)
        field = model.params.static
        assert model.name == "mvsnerf" and model.system.static == MvsNerf(statistics=statistics)
        assert (field.features.blocks[0].norm.statistics is None) == (statistics == "batch")
        np.testing.assert_array_equal(field.field.trunk.layers[5].kernel, made.field.trunk.layers[5].kernel)
        with pytest.raises(WeightsError, match="holds weights of `mvsnerf`, not `zest`"):
            open_weights(out, system="zest")


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
    space = dataclasses.replace(MVSNERF.space, planes=8)
    system = dataclasses.replace(MVSNERF, space=space, static=MvsNerf(padding=4), sampler=Ends(4))
    camera, params = Camera(k[0], pose[0]), Params(None, made, None)
    shown = lambda video, exclude: novel_view.render_view(
        params, novel_view.prepare(params, video, system=system), camera, 0, system=system, exclude=exclude
    )
    view = shown(video, (0,))
    assert (
        view.colour.shape == (24, 32, 3) and view.depth.shape == (24, 32) and bool(jnp.all(jnp.isfinite(view.colour)))
    )
    images = video.images.copy()
    images[[0, 4]] = 0  # the target itself, and the farthest
    again = shown(video._replace(images=images), (0,))
    np.testing.assert_array_equal(view.colour, again.colour)
    with pytest.raises(ValueError, match="a view needs 3 source frames, 2 are left"):
        shown(video, (0, 1, 2))
