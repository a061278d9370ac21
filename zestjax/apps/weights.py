"""Weights together with the configuration they belong to: the file carries both."""

import contextlib
import dataclasses
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax

from zestjax.checks import check_option
from zestjax.io.mvsnerf import STATISTICS, mvsnerf_like, read_mvsnerf
from zestjax.io.weights import WeightsError, load_weights, read_metadata, save_weights
from zestjax.model import init_params
from zestjax.mvsnerf import MvsNerfConfig
from zestjax.presets import Config

SYSTEMS = {
    "zest": {},
    "zest-geometry": {"motion": False},
    "zest-motion": {"geometry": False},
    "zest-none": {"geometry": False, "motion": False},
}
"""What each system changes in a preset."""


PUBLISHED = "mvsnerf"
MOST_SIZE = 2**16  # of a number in a configuration: planes, channels or pixels; a larger one is damage
MOST_LAYERS = 64  # and of what is a layer or a level each: a file may not keep us busy for hours
COUNTED = ("field_depth", "point_levels", "view_levels", "key_frames")


class Model(NamedTuple):
    """params: learned arrays. config: `presets.Config` or `mvsnerf.MvsNerfConfig`. system: str. path: the file.
    metadata: dict of the run."""

    params: Any
    config: Any
    system: str
    path: Path
    metadata: dict


def shipped_weights():
    """The file of the weights that come with the package."""
    return Path(str(resources.files("zestjax") / "weights" / "small.safetensors"))


def config_from_json(fields):
    """A `Config` from its dict in a file.

    Raises:
      WeightsError: no dict, fields that this version does not know or that are missing, other types, or sizes that no
        model has.
    """
    if not isinstance(fields, dict):
        raise WeightsError(f"the configuration is a {type(fields).__name__}, expected an object")
    known = {field.name: field.type for field in dataclasses.fields(Config)}
    if unknown := sorted(fields.keys() - known.keys()):
        raise WeightsError(f"the configuration has fields that this version does not know: {', '.join(unknown)[:200]}")
    values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in fields.items()}
    if wrong := [name for name, value in values.items() if not _of_type(value, known[name])]:
        raise WeightsError(f"the configuration has `{wrong[0]}` {str(values[wrong[0]])[:80]}, which cannot be")
    if too_many := [name for name in COUNTED if values.get(name, 0) > MOST_LAYERS]:
        raise WeightsError(f"the configuration has `{too_many[0]}` {values[too_many[0]]}, more than {MOST_LAYERS}")
    try:
        return Config(**values)
    except (TypeError, ValueError) as error:
        raise WeightsError(f"the configuration cannot be: {error}") from error


def _of_type(value, kind):
    """Whether a value of JSON is of a field's type, and its numbers of a size that a model can have."""
    if kind is int:
        return type(value) is int and 0 <= value <= MOST_SIZE
    if kind is tuple:
        sizes = isinstance(value, tuple) and 0 < len(value) <= MOST_LAYERS
        return sizes and all(type(size) is int and abs(size) <= MOST_SIZE for size in value)
    return type(value) is kind


def system_of(config):
    """The name of the system that a configuration is."""
    volumes = (config.geometry, config.motion)
    return next(name for name, c in SYSTEMS.items() if (c.get("geometry", True), c.get("motion", True)) == volumes)


@contextlib.contextmanager
def arithmetic(precision=None):
    """Context: JAX computes in 64 bits for `float64`, else in 32, whatever the process was started with.

    Weights and templates for them are made inside it: they are float32 by definition.
    """
    with jax.enable_x64(precision == "float64"):
        yield


@arithmetic()
def open_weights(path=None, *, system=None, published=False):
    """Load weights and their configuration.

    Args:
      path: file; None: the shipped ones.
      system: refuse weights of another system.
      published: MVSNeRF's weights, as `import-mvsnerf` writes them, will do as well.

    Returns:
      `Model`.

    Raises:
      WeightsError: no such file, damaged, of another system or of a newer version.
    """
    path = Path(path) if path is not None else shipped_weights()
    metadata = read_metadata(path)
    if metadata.get("system") == PUBLISHED:
        if not published or system not in (None, PUBLISHED):
            raise WeightsError(f"{path}: holds MVSNeRF's weights, which only `render` and `evaluate` can use.")
        if metadata.get("statistics") not in STATISTICS:
            raise WeightsError(
                f"{path}: does not say whose statistics its norms have; import the published file again."
            )
        params, _ = load_weights(path, like=mvsnerf_like(statistics=metadata["statistics"]))
        return Model(params, MvsNerfConfig(), PUBLISHED, path, metadata)
    try:
        config = config_from_json(metadata["config"])
        like = jax.eval_shape(lambda: init_params(jax.random.key(0), config))
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError) as error:
        raise WeightsError(f"{path}: has no configuration this version can use ({error}); use its version.") from error
    found = system_of(config)
    if system is not None and system != found:
        raise WeightsError(f"{path}: holds weights of `{found}`, not `{system}`; train them with --system {system}.")
    params, _ = load_weights(path, like=like)
    return Model(params, config, found, path, metadata)


def standing_still(model):
    """The `Model` for a scene in which nothing moves: neither the motion volume nor the dynamic field is compiled."""
    if model.system == PUBLISHED:
        return model
    params = model.params._replace(motion=None, dynamic=None)
    return model._replace(params=params, config=dataclasses.replace(model.config, dynamic=False, motion=False))


def at_precision(model, precision):
    """The `Model` run at a precision of `precision.PRECISIONS`, or, of None, as it is.

    It must run within `arithmetic(precision)`.

    Raises:
      ValueError: an unknown precision, or another than float32 for MVSNeRF's weights.
    """
    if precision is None:
        return model
    if model.system == PUBLISHED:
        check_option("--precision, of MVSNeRF's weights,", precision=(precision, ("float32",)))
        return model
    return model._replace(config=dataclasses.replace(model.config, precision=precision))


def import_mvsnerf(path, out, *, statistics="batch"):
    """Write MVSNeRF's published weights as a file that `render` and `evaluate` take.

    Returns:
      str, the summary line.

    Raises:
      WeightsError: see `io.mvsnerf.read_mvsnerf`; or the file could not be written.
    """
    params = read_mvsnerf(path, statistics=statistics)
    save_weights(out, params, metadata={"system": PUBLISHED, "statistics": statistics, "start": Path(path).name})
    count = sum(leaf.size for leaf in jax.tree.leaves(params))
    return f"import-mvsnerf: {count:,} values, statistics of the {statistics}: {out}"
