"""What a cross-validation consists of: its plan, which lies in its folder, and the plan's folds.

fold     one scene held out: trained on the others, scored on it
variant  what folds share but for their scene: a system, a seed, one value of each setting
"""

import dataclasses
import functools
import hashlib
import itertools
import json
import sys
from pathlib import Path
from typing import Any

from zestjax.apps.results import write_record
from zestjax.apps.scenes import place_of, same_pictures
from zestjax.apps.train import run_name
from zestjax.apps.weights import shipped_weights
from zestjax.base.checks import check_option
from zestjax.io.files import resolved
from zestjax.io.reading import read_json
from zestjax.io.scenes import PROTOCOLS, scenes_in
from zestjax.simulate.bench import BENCH
from zestjax.train.recipes import recipe_of
from zestjax.train.settings import with_settings

PLAN = "plan.json"
DYNAMIC_SCENES = (
    "kid-running", "Balloon1-2", "Balloon2-2", "DynamicFace-2", "Jumping", "Playground", "Skating-2", "Truck-2",
    "Umbrella",
)  # fmt: skip
"""The folds of the authors' code, in its order: NVIDIA's Dynamic Scenes data and NSFF's own clip."""


@dataclasses.dataclass(frozen=True)
class Fold:
    """index: in the plan, from 0. row: of the table, of its system and settings. variant, name: of its folder, which is
    of a row and a seed, and its scene's in it. settings: (name, value) each. scene, others: places of the one held out
    and of those learned from."""

    index: int
    row: str
    variant: str
    name: str
    system: str
    seed: int
    settings: tuple
    scene: str
    others: tuple

    @property
    def label(self):
        """`variant/scene`."""
        return f"{self.variant}/{self.name}"


@dataclasses.dataclass(frozen=True)
class Plan:
    """The choices of a cross-validation, see `zestjax crossval --help`; `start` and `judge` tell the files of weights
    apart. settings: (name, (value, ...)) each. finetune: (number, `s` of seconds or empty of steps), or None."""

    scenes: tuple = tuple(f"bench:{name}" for name in BENCH)
    systems: tuple = ("zest",)
    preset: str = "small"
    steps: int = 20_000
    minutes: float | None = None
    seed: int = 0
    seeds: int = 1
    settings: tuple = ()
    weights: str | None = None
    start: str | None = None
    finetune: tuple | None = None
    protocol: str = "held-out"
    size: tuple | None = None
    targets: tuple | None = None
    lpips: str | None = None
    judge: str | None = None
    checkpoint_minutes: float = 5.0

    @functools.cached_property
    def folds(self) -> tuple[Fold, ...]:
        """All of them, scene by scene within a variant."""
        names, found = _short_names(self.scenes), []
        grid = itertools.product(*(values for _, values in self.settings))
        for system, values, seed in itertools.product(self.systems, list(grid), range(self.seeds)):
            settings = tuple((name, value) for (name, _), value in zip(self.settings, values, strict=True))
            varied = [
                f"{n}={v}" for (n, v), (_, all_of_it) in zip(settings, self.settings, strict=True) if all_of_it[1:]
            ]
            row = ",".join([system, *varied]).replace("/", "_")
            variant = f"{row},seed={self.seed + seed}" if self.seeds > 1 else row
            for name, scene in zip(names, self.scenes, strict=True):
                others = tuple(other for other in self.scenes if other != scene)
                found.append(Fold(len(found), row, variant, name, system, self.seed + seed, settings, scene, others))
        return tuple(found)

    def spec(self, fold: Fold) -> dict[str, Any]:
        """All that decides a fold's numbers, as JSON has it."""
        shared = {name: value for name, value in self.stored.items() if name not in ("scenes", "systems", "seeds")}
        return _lists(shared | dataclasses.asdict(fold))

    @property
    def stored(self) -> dict[str, Any]:
        """As JSON has it."""
        return _lists(dataclasses.asdict(self))

    @property
    def digest(self) -> str:
        """Tells this plan from others, 12 digits."""
        return hashlib.sha256(json.dumps(self.stored, sort_keys=True).encode()).hexdigest()[:12]


def agreed_plan(out, given, *, resume=False):
    """The plan of a folder; stored there if it has none. Choices that are not given are the stored plan's.

    Args:
      out: folder.
      given: dict, some of `Plan`'s fields.
      resume: refuse a folder that has none.

    Raises:
      ValueError: choices that cannot be, or others than the stored plan's, by name, once a fold has begun.
    """
    out, given = Path(out), _made(given)
    stored = read_plan(out)
    if stored is None:
        if resume:
            raise ValueError(f"{out}: has no {PLAN}, so nothing was begun there; give the --out of a cross-validation.")
        return _store(out, check_plan(dataclasses.replace(Plan(), **_started(given, Plan()))))
    plan = dataclasses.replace(stored, **_started(given, stored))
    if plan.stored == stored.stored:
        return stored
    differing = [f"{n} ({v}, now {plan.stored[n]})" for n, v in stored.stored.items() if v != plan.stored[n]]
    if (out / "work").exists() or (out / "folds").exists():
        raise ValueError(
            f"{out}: holds a cross-validation with other {'; '.join(differing)}; choose another --out, or drop them."
        )
    return _store(out, check_plan(plan))


def read_plan(out):
    """The plan stored in a folder, or None.

    Raises:
      ValueError: it is damaged, or of another version.
    """
    path = Path(out) / PLAN
    if not path.exists():
        return None
    told = read_json(path)
    try:
        choices: dict[str, Any] = {name: _tuples(value) for name, value in told["plan"].items()}
        plan = check_plan(Plan(**choices))
        if plan.digest != told["digest"]:
            raise ValueError("its digest is of another")
        return plan
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path}: is no plan that this version can use ({error}); choose another --out.") from error


def check_plan(plan):
    """The plan, if it can be carried out.

    Raises:
      ValueError: a name, a setting, a scene or a number of scenes that cannot be.
    """
    check_option("crossval", protocol=(plan.protocol, PROTOCOLS))
    for fold in plan.folds[:: len(plan.scenes)]:
        with_settings(recipe_of(plan.preset, system=fold.system), fold.settings)
    for kind, given in (("system", plan.systems), ("setting", [name for name, _ in plan.settings])):
        if twice := _twice(given):
            raise ValueError(f"crossval: the {kind} {twice} is given twice; give it once.")
    if len(plan.scenes) < 2 and plan.steps:
        raise ValueError("crossval: a scene held out needs another to learn from; give two at least, or --steps 0.")
    if plan.finetune and plan.protocol == "strict":
        raise ValueError("crossval: --finetune reads the frames that --protocol strict predicts; drop one of them.")
    return plan


def scenes_of(names):
    """Places of the scenes that names stand for: a scene, `bench:NAME`, `bench:all`, or a folder that holds several; of
    the Dynamic Scenes data these are the authors' nine, or those of them that are there.

    Raises:
      ValueError: no such scene, or one twice, also under another name.
    """
    found = [place for name in names for place in _scenes_of(str(name))]
    if twice := _twice(found):
        raise ValueError(f"crossval: the scene {twice} is given twice: it would be learned from and held out at once.")
    if copies := same_pictures([place for place in found if not place.startswith("bench:")]):
        first, second = copies
        raise ValueError(
            f"crossval: {second} has the pictures of {first}: they would be learned from and held out at once; "
            "give one of them."
        )
    return tuple(found)


def _scenes_of(name):
    if name == "bench:all":
        return [f"bench:{scene}" for scene in BENCH]
    if name.startswith("bench:"):
        check_option("crossval", scene=(name.removeprefix("bench:"), BENCH))
        return [name]
    inside = list(dict.fromkeys(folder for folder, _ in scenes_in(name)))
    if not inside:
        raise ValueError(f"{name}: is not a folder that is or holds a scene in a supported layout, nor bench:NAME.")
    if len(inside) == 1:
        return [place_of(name)]
    called = {_scene_name(folder): folder for folder in inside}
    authors = [scene for scene in DYNAMIC_SCENES if scene in called]
    if authors and (left := sorted(called.keys() - set(authors))):
        print(f"crossval: {name}: left out, as in the authors' folds: {', '.join(left)}", file=sys.stderr)
    return [place_of(called[scene]) for scene in authors] if authors else [place_of(folder) for folder in inside]


def _scene_name(folder):
    folder = Path(folder)
    return folder.parent.name if folder.name == "dense" else folder.name


def _short_names(places):
    """A name for each place that no other has: as much of its end as that takes."""
    parts = [
        (place.removeprefix("bench:"),) if place.startswith("bench:") else Path(place).parts[1:] for place in places
    ]
    for depth in range(1, max(map(len, parts), default=1) + 1):
        names = ["-".join(part[-depth:]) for part in parts]
        if not _twice(names) and "dense" not in names:
            return names
    return [f"scene{i}" for i in range(len(places))]


def _made(given):
    """Given choices in the form that a plan has."""
    given = dict(given)
    for name in ("scenes", "systems"):
        if isinstance(given.get(name), str):
            given[name] = (given[name],)
    if "scenes" in given:
        given["scenes"] = scenes_of(given["scenes"])
    if "settings" in given:
        texts = lambda values: tuple(map(str, values)) if isinstance(values, list | tuple) else (str(values),)
        each = given["settings"].items() if isinstance(given["settings"], dict) else given["settings"]
        given["settings"] = tuple((name, texts(values)) for name, values in each)
    for name in ("weights", "lpips"):
        if given.get(name) is not None:
            given[name] = str(resolved(given[name]))
    return {name: _tuples(value) for name, value in given.items()}


def _started(given, plan):
    """Given choices with what tells their files apart; zero-shot scores without weights are of the shipped ones."""
    weights, steps = given.get("weights", plan.weights), given.get("steps", plan.steps)
    weights = str(shipped_weights()) if weights is None and not steps else weights
    lpips = given.get("lpips", plan.lpips)
    return given | {"start": run_name(weights), "judge": run_name(lpips)}


def _store(out, plan):
    write_record(out / PLAN, {"digest": plan.digest, "plan": plan.stored})
    return plan


def _lists(value: Any) -> Any:
    """A tree as JSON has it: tuples are lists."""
    if isinstance(value, dict):
        return {name: _lists(entry) for name, entry in value.items()}
    return [_lists(entry) for entry in value] if isinstance(value, list | tuple) else value


def _tuples(value):
    return tuple(map(_tuples, value)) if isinstance(value, list | tuple) else value


def _twice(given):
    """One of those that are there more than once, or None."""
    given = list(given)
    return next((one for one in given if given.count(one) > 1), None)
