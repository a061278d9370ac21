"""Weights together with the recipe they belong to: the file carries both."""

import contextlib
import dataclasses
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax

from zestjax.apps.earlier import recipe_from_config, renamed, with_paths
from zestjax.base.checks import check_option
from zestjax.base.parts import from_stored, to_stored
from zestjax.io.mvsnerf import read_mvsnerf
from zestjax.io.weights import WeightsError, load_weights, read_metadata, save_weights
from zestjax.losses.adversarial import DiscriminatorParams
from zestjax.systems.mvsnerf import MVSNERF, STATISTICS, MvsNerf
from zestjax.systems.system import Params, System
from zestjax.train.adversary import Opponents
from zestjax.train.recipes import PARTS, Fixed, Recipe, pairs

PUBLISHED = "mvsnerf"


class Model(NamedTuple):
    """params: learned arrays. recipe: `Recipe` of the run; of it, system: what `params` belong to. name: the system's,
    for people. path: the file. metadata: dict of the run. opponent: the discriminator that they were trained against,
    or None."""

    params: Params
    recipe: Recipe
    name: str
    path: Path
    metadata: dict
    opponent: DiscriminatorParams | None = None

    @property
    def system(self) -> System:
        """What the parameters belong to."""
        return self.recipe.system

    @property
    def preset(self) -> str:
        """Name of the preset that the run started from."""
        return str(self.metadata.get("preset", self.name))

    @property
    def trained(self) -> Params | Opponents:
        """All that the run trained, as of `Recipe.init`."""
        return self.params if self.opponent is None else Opponents(self.params, self.opponent)

    def running(self, system: System, params: Params | None = None) -> "Model":
        """The same weights, or some of them, run as another system."""
        recipe = dataclasses.replace(self.recipe, system=system)
        return self._replace(recipe=recipe, params=self.params if params is None else params)


def shipped_weights():
    """The file of the weights that come with the package."""
    return Path(str(resources.files("zestjax") / "weights" / "small.safetensors"))


def recipe_from_metadata(metadata, known=PARTS):
    """The `Recipe` of a file's metadata, of this version or of 0.1.

    Args:
      metadata: dict of JSON; it may come from anybody.
      known: the parts that it may name.

    Raises:
      WeightsError: there is none that this version can use.
    """
    try:
        if "recipe" in metadata:
            found = from_stored(metadata["recipe"], known)
        elif metadata.get("system") == PUBLISHED:
            found = published_recipe(metadata["statistics"])
        else:
            found = recipe_from_config(metadata["config"])
        if not isinstance(found, Recipe):
            raise ValueError(f"it is a {type(found).__name__}, expected a Recipe")
        return found
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError) as error:
        raise WeightsError(f"has no recipe this version can use ({error})") from error


def published_recipe(statistics):
    """The `Recipe` of MVSNeRF's published weights."""
    system = dataclasses.replace(MVSNERF, static=MvsNerf(statistics=statistics))
    return Recipe(system, Fixed(pairs(dict(rec=1.0))), height=256, width=320)


@contextlib.contextmanager
def arithmetic(precision=None):
    """Context: JAX computes in 64 bits for `float64`, else in 32, whatever the process was started with.

    Weights and templates for them are made inside it: they are float32 by definition.
    """
    with jax.enable_x64(precision == "float64"):
        yield


@arithmetic()
def open_weights(path=None, *, system=None, parts=()):
    """Load weights and their recipe.

    Args:
      path: file; None: the shipped ones.
      system: refuse weights of another system.
      parts: classes of your own that its system is made of.

    Returns:
      `Model`.

    Raises:
      WeightsError: no such file, damaged, of another system or of a newer version.
    """
    path = Path(path) if path is not None else shipped_weights()
    metadata = read_metadata(path)
    name = metadata.get("system")
    if name == PUBLISHED and "recipe" not in metadata and metadata.get("statistics") not in STATISTICS:
        raise WeightsError(f"{path}: does not say whose statistics its norms have; import the published file again.")
    try:
        recipe = recipe_from_metadata(metadata, (*PARTS, *parts))
        name = name if isinstance(name, str) else ablated_name(recipe.system)
        like = jax.eval_shape(recipe.init, jax.random.key(0))
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError) as error:
        raise WeightsError(f"{path}: {error}; use its version.") from error
    if system is not None and system != name:
        raise WeightsError(f"{path}: holds weights of `{name}`, not `{system}`; train them with --system {system}.")
    params: Any = load_weights(path, like=like, renewed=renewing(metadata))[0]
    model, opponent = params if isinstance(params, Opponents) else (params, None)
    return Model(model, recipe, name, path, metadata, opponent)


def ablated_name(system):
    """Which of `presets.ABLATED` a system is, by the volumes that it has."""
    fields = (system.static, system.dynamic)
    volumes = tuple(getattr(field, "volume", None) is not None for field in fields)
    names: dict[tuple, str] = {
        (True, False): "zest-geometry",
        (False, True): "zest-motion",
        (False, False): "zest-none",
    }
    return "zest" if system.dynamic is None else names.get(volumes, "zest")


def load_params(path, *, like):
    """Parameters of a file, like those given; of this version or of 0.1. Of opponents, a file of a renderer alone gives
    the renderer.

    Raises:
      WeightsError: see `io.weights.load_weights`.
    """
    if isinstance(like, Opponents) and not any(".discriminator" in name for name in load_weights(path)[0]):
        return like._replace(model=load_params(path, like=like.model))
    return load_weights(path, like=like, renewed=renewing(read_metadata(path)))[0]


def renewing(metadata):
    """Function from the arrays of a file to today's, by its metadata; see `earlier`."""
    if "recipe" in metadata:
        return with_paths
    name_now = (lambda name: f".static{name}") if metadata.get("system") == PUBLISHED else renamed
    return lambda arrays: with_paths({name_now(name): array for name, array in arrays.items()})


def at_precision(model, precision):
    """The `Model` run at a precision of `precision.PRECISIONS`, or, of None, as it is.

    It must run within `arithmetic(precision)`.

    Raises:
      ValueError: an unknown precision, or another than float32 for MVSNeRF's weights.
    """
    if precision is None:
        return model
    if model.name == PUBLISHED:
        check_option("--precision, of MVSNeRF's weights,", precision=(precision, ("float32",)))
    return model.running(dataclasses.replace(model.system, precision=precision))


def import_mvsnerf(path, out, *, statistics="batch"):
    """Write MVSNeRF's published weights as a file that `render` and `evaluate` take.

    Returns:
      str, the summary line.

    Raises:
      WeightsError: see `io.mvsnerf.read_mvsnerf`; or the file could not be written.
    """
    params = Params(None, read_mvsnerf(path, statistics=statistics), None)
    recipe = published_recipe(statistics)
    metadata = {"system": PUBLISHED, "statistics": statistics, "start": Path(path).name, "recipe": to_stored(recipe)}
    save_weights(out, params, metadata=metadata)
    count = sum(leaf.size for leaf in jax.tree.leaves(params))
    return f"import-mvsnerf: {count:,} values, statistics of the {statistics}: {out}"
