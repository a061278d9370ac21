"""MVSNeRF's recorded arrays against what this library computes from its published weights: a row an array.

    python experiments/check_parity.py GOLDEN.npz WEIGHTS.npz

GOLDEN holds what a run of the authors' code computed, under the names of `INPUTS` and `FAMILIES`; every size is read
off its names and shapes. WEIGHTS is MVSNeRF's checkpoint or an npz of its arrays. The last column says `ok` or `FAIL`,
or why nothing was compared: `input` (others are computed from it), `unknown` or `missing`; these are no failures.

Exits with 0 if all that was compared holds, with 1 if something does not, with 2 on files of another kind.
"""

import argparse
import contextlib
import re
import sys
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import parity_arrays as arrays

from zestjax.base.checks import check_shapes
from zestjax.cameras import rigid_inverse
from zestjax.io.mvsnerf import read_mvsnerf
from zestjax.io.reading import read_arrays
from zestjax.io.weights import WeightsError
from zestjax.nets.feature_pyramid import imagenet_normalised
from zestjax.rendering import alpha_from_density, weights_from_density
from zestjax.systems import mvsnerf

INPUTS = {
    "imgs01": "views 3 H W", "w2cs": "views 4 4", "intrinsics": "views 3 3", "near_far": "2",
    "ray_px": "R", "ray_py": "R", "u_jitter": "R S",
}  # fmt: skip
NEEDED = ("imgs01", "w2cs", "intrinsics", "near_far")
UNFIT = (ValueError, TypeError, IndexError, ZeroDivisionError)  # what arrays raise that do not fit one another


FAMILIES = {
    r"imgs_norm": lambda golden: jnp.moveaxis(imagenet_normalised(golden.images), -1, 1),
    r"c2ws": lambda golden: rigid_inverse(golden.cameras.camera_from_world),
    r"proj_mats": arrays.projections,
    r"depth_values": lambda golden: golden.depths(golden.planes),
    r"feat_conv0_0_(train|eval)": arrays.first_block,
    r"feat_conv2_(train|eval)": lambda golden, mode: golden.features(mode)[1],
    r"feats_(train|eval)": lambda golden, mode: golden.features(mode)[2],
    r"grid(\d+)_pad(\d+)": arrays.normalised_pixels,
    r"inmask_pad(\d+)": arrays.inside_masks,
    r"warp(\d+)_pad(\d+)_(train|eval)": arrays.warped_features,
    r"cost_pad(\d+)_(train|eval)": lambda golden, padding, mode: golden.volumes(padding, mode)[0],
    r"creg_conv([02467])": lambda golden, number: golden.regularised()[number],
    r"vol_pad(\d+)_(train|eval)": lambda golden, padding, mode: golden.volumes(padding, mode)[1],
    r"vol(\d+)_(train|eval)_strided": arrays.kept_cells,
    r"vol(\d+)_stats": arrays.statistics,
    r"z_lin": lambda golden: golden.depths(golden.record.get("z_lin", golden.record["u_jitter"]).shape[-1]),
    r"z_jit": arrays.jittered_depths,
    r"rays_o": lambda golden: golden.rays()[1].origins[0],
    r"rays_d": lambda golden: golden.rays()[1].directions,
    r"rays_pts": arrays.ray_points,
    r"rays_ndc_pad(\d+)": lambda golden, padding: mvsnerf.volume_coords(
        golden.sources, golden.stored("rays_pts"), padding=padding
    ),
    r"ray_feats_pad(\d+)": arrays.ray_features,
    r"ray_colors": arrays.view_colours,
    r"pe_xyz": arrays.encoded_points,
    r"view_dir": arrays.view_directions,
    r"raw_rgbsigma": arrays.field_outputs,
    r"alpha": lambda golden: arrays.absorbed(golden, alpha_from_density),
    r"weights": lambda golden: arrays.absorbed(golden, weights_from_density),
    r"rgb_map": lambda golden: golden.rendered()[0],
    r"depth_map": lambda golden: golden.rendered()[1],
}
"""What computes the arrays whose names match: a function of `Golden` and of what the name says."""
NAMES = """imgs_norm c2ws proj_mats depth_values feat_conv0_0_train feat_conv2_train feats_train feats_eval creg_conv0
creg_conv2 creg_conv4 creg_conv6 creg_conv7 z_lin z_jit rays_o rays_d rays_pts ray_colors pe_xyz view_dir raw_rgbsigma
alpha weights rgb_map depth_map""".split()
PADDED = ("inmask_pad{}", "vol_pad{}_train", "rays_ndc_pad{}", "ray_feats_pad{}")  # of every padding, beside the grids
BUILT = ("warp1_pad{}_train", "cost_pad{}_train", "vol_pad{}_eval")  # of the main one


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message):
        print(f"error: {message} (see `{self.prog} --help`)", file=sys.stderr)
        sys.exit(2)


class ParityError(ValueError):
    """A file that cannot be compared."""


class Weights(NamedTuple):
    """`mvsnerf.MvsNerfParams`. train: norms by the images at hand, as published. eval: by the stored statistics."""

    train: mvsnerf.MvsNerfParams
    eval: mvsnerf.MvsNerfParams


class Row(NamedTuple):
    """Of one array. error: the greatest absolute one. tolerance: what that may be. Both are None where nothing was
    compared. verdict: see the module. note: why."""

    name: str
    error: float | None
    tolerance: float | None
    verdict: str
    note: str = ""


def tolerance_of(name, theirs):
    """Greatest absolute error of an array: 5e-5 of its greatest value, or of 1 if that is more.

    Float32 rounds sums in proportion to their greatest parts, so the scale is the array's and not each value's: a cost
    is a difference of squares. Ours are within 5e-6 of theirs so scaled, theirs within 3e-6 of a float64 run of their
    code (FACTS.md, appendix B, in absolute numbers): ten times that leaves room for other sizes, and any fault shows.
    A mask is 0 or 1, and exact.
    """
    if re.match("inmask", name):
        return 0.0
    return 5e-5 * max(1.0, float(np.max(np.abs(theirs), initial=0)))


def compare(record, weights):
    """`Row`s of every array of a record, then of those that it lacks.

    Args:
      record: arrays by name, as the file holds them.
      weights: `Weights`.

    Raises:
      ParityError: without the images and cameras from which all else is computed.
    """
    rows, golden = prepared(record, weights)
    rows += [row_of(name, array, golden) for name, array in record.items() if name not in INPUTS]
    return rows + [Row(name, None, None, "missing") for name in expected(record) if name not in record]


def prepared(record, weights):
    """`Row`s of the inputs, and `parity_arrays.Golden` of what fits; None where images or cameras do not."""
    if lacking := [name for name in NEEDED if name not in record]:
        raise ParityError(f"holds no {', '.join(lacking)}; give a file of MVSNeRF's recorded arrays.")
    inputs, rows = {}, []
    for name in (n for n in INPUTS if n in record):
        try:
            given = {name: (numbers(name, record[name]), INPUTS[name])}
            check_shapes("check_parity", **inputs | given)
            inputs |= given
            rows.append(Row(name, None, None, "input"))
        except UNFIT as error:
            rows.append(Row(name, None, None, "FAIL", said(error)))
    fit = {name: array for name, (array, _) in inputs.items()}
    for name in (n for n in record if is_known(n)):
        with contextlib.suppress(ValueError):  # its row says so
            fit[name] = numbers(name, record[name])
    return rows, arrays.Golden(fit, weights, FAMILIES) if set(NEEDED) <= set(inputs) else None


def row_of(name, theirs, golden):
    """`Row` of one array that is no input; `golden` is None where the inputs do not fit."""
    if not is_known(name):
        return Row(name, None, None, "unknown", "not compared")
    if golden is None:
        return Row(name, None, None, "FAIL", "cannot be computed from these inputs")
    try:
        theirs = np.asarray(numbers(name, theirs), np.float64)
        ours, counts = golden(name)
    except KeyError as error:
        return Row(name, None, None, "FAIL", f"cannot be computed without {error}")
    except UNFIT as error:
        return Row(name, None, None, "FAIL", said(error))
    if bare(ours.shape) != bare(theirs.shape):
        return Row(name, None, None, "FAIL", f"has shape {theirs.shape}, expected {ours.shape}")
    error = np.abs(np.asarray(ours, np.float64).reshape(theirs.shape) - theirs)
    error = error if counts is None else np.where(np.asarray(counts).reshape(theirs.shape), error, 0)
    worst, tolerance = float(np.max(error, initial=0)), tolerance_of(name, theirs)
    return Row(name, worst, tolerance, "ok" if worst <= tolerance else "FAIL")


def is_known(name):
    """Whether an array of this name can be computed."""
    return any(re.fullmatch(pattern, name) for pattern in FAMILIES)


def expected(record):
    """Names of all arrays that a record of these paddings may be expected to have."""
    grids = [f"grid{v}_pad{{}}" for v in range(1, len(record["w2cs"]) - 1)] if np.ndim(record["w2cs"]) else []
    names = [*INPUTS, *NAMES, *(name.format(arrays.main_padding(record)) for name in BUILT)]
    names += [name.format(padding) for name in (*grids, *PADDED) for padding in arrays.paddings_of(record)]
    full = {m[1] for m in (re.fullmatch(r"vol(\d+)_(train_strided|stats)", name) for name in record) if m} or {"*"}
    return names + [f"vol{planes}_{kind}" for planes in sorted(full) for kind in ("train_strided", "stats")]


def numbers(name, array):
    """An array as float32."""
    if array.dtype.kind not in "buif":
        raise ValueError(f"`{name}` holds {array.dtype}, expected numbers")
    return jnp.asarray(array, jnp.float32)


def bare(shape):
    """A shape without leading axes of one, which are batches'."""
    return bare(shape[1:]) if shape and shape[0] == 1 else tuple(shape)


def said(error):
    """The first line of an error, or what is legible of it."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def read_record(path):
    """The arrays of an npz by name.

    Raises:
      ParityError: the file cannot be read, or is none.
    """
    try:
        return read_arrays(path)
    except ValueError as error:
        raise ParityError(str(error)) from error


def read_weights(path):
    """`Weights`.

    Raises:
      ParityError, WeightsError: the file cannot be read, or holds other weights.
    """
    if Path(path).suffix == ".npz":
        read_record(path)
    return Weights(*(read_mvsnerf(path, statistics=kind) for kind in ("batch", "stored")))


def table(rows):
    """Lines of text."""
    width = max(len(row.name) for row in rows)
    number = lambda x: "-" if x is None else f"{x:.2e}"
    yield f"{'name':{width}}  max abs error  tolerance  ok"
    for row in rows:
        line = f"{row.name:{width}}  {number(row.error):>13}  {number(row.tolerance):>9}  {row.verdict}"
        yield line + (f": {row.note}" if row.note else "")


def main(arguments=None):
    """Compare two files; returns the exit status."""
    parser = Parser(description="MVSNeRF's recorded arrays against this library's, a row an array.")
    parser.add_argument("golden", type=Path, help="npz of what the authors' code computed")
    parser.add_argument("weights", type=Path, help="MVSNeRF's checkpoint, or an npz of its arrays")
    options = parser.parse_args(arguments)
    path = options.golden
    try:
        record, path = read_record(path), options.weights
        weights, path = read_weights(path), options.golden
        rows = compare(record, weights)
    except (ParityError, WeightsError) as error:
        print(f"error: {path}: {str(error).removeprefix(f'{path}: ')}", file=sys.stderr)
        return 2
    count = lambda *verdicts: sum(row.verdict in verdicts for row in rows)
    print(*table(rows), sep="\n")
    print(
        f"check_parity: {count('ok')} of {count('ok', 'FAIL')} arrays hold; {count('unknown')} unknown, "
        f"{count('missing')} missing"
    )
    return 0 if count("ok") and not count("FAIL") else 1


if __name__ == "__main__":
    sys.exit(main())
