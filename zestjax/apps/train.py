"""`zestjax train`: one set of weights from many scenes, simulated as they are needed or read from folders."""

import contextlib
import dataclasses
import hashlib
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

import zestjax
from zestjax.apps.cache import STALE_DAYS, held_clips, remove_stale_clips
from zestjax.apps.clips import EVIDENCE, EXPOSURE, STAND_IN, ClipSpec, clip_folder, hole_key
from zestjax.apps.effects import check_choice, over_scenes
from zestjax.apps.hosts import is_first, join, run_mesh, run_place
from zestjax.apps.loop import LoopOptions, LoopResult, run_loop
from zestjax.apps.own_frames import known_of, own_frame_batches
from zestjax.apps.producer import ClipSource
from zestjax.apps.scenes import digest, open_scene, place_of
from zestjax.apps.tables import counted
from zestjax.apps.weights import arithmetic, load_params
from zestjax.base.checks import check_option
from zestjax.base.parts import to_stored
from zestjax.effects import params_for, priors_for, system_for
from zestjax.frames.evidence import Evidence
from zestjax.frames.exposure import Exposure
from zestjax.frames.known import answers_of, shared
from zestjax.io.weights import WeightsError
from zestjax.systems.presets import ZEST
from zestjax.train.batches import (
    PreparedClip,
    batch_from_clip,
    clip_from_arrays,
    frame_batch,
    prepare_clip,
    step_batches,
)
from zestjax.train.learn import STAGES, find_fault, stage_weights
from zestjax.train.mesh import mesh_trainer
from zestjax.train.recipes import RECIPES, SYSTEMS, recipe_of
from zestjax.train.settings import with_settings
from zestjax.train.stand_ins import StandIns
from zestjax.train.terms import measurable, unmeasured
from zestjax.train.training import TrainState, batch_key, clip_index, clip_window

SCENES_PER_STEP = 4  # of the stage `frames`
AHEAD = 8  # clips that the producer keeps rendered beyond the newest one in use
KEPT = 128  # clips held in memory, about 20 MB each at 144x256


@dataclasses.dataclass(frozen=True)
class TrainOptions:
    """The flags of `zestjax train`.

    out, preset, steps, minutes, resume, seed, quiet: as the command's.
    weights: start from these. analysis: take the part that analyses single frames from these instead.
    clips: folder of rendered clips, kept; None: the cache, where used ones are removed, and when a run starts those of
    others that ended long ago (`cache.STALE_DAYS`). clip_count: reuse that many
    clips; None: new ones for ever. window: clips alive at a time. steps_per_clip: steps between one new clip and the
    next. scenes: folders (or `bench:NAME`) whose own frames are predicted from one another; no simulated clips.
    checkpoint_minutes: between two checkpoints. system: one of `recipes.SYSTEMS`. stage: one of `learn.STAGES`.
    peak: highest learning rate, by default the recipe's. settings: (name, value) of `settings.with_setting` each.
    hosts: see `hosts.join`; the devices of all processes share every step. effects: of `effects.over_scenes`.
    """

    out: Path
    preset: str = "small"
    steps: int = 20_000
    minutes: float | None = None
    resume: bool = False
    seed: int = 0
    weights: Path | None = None
    analysis: Path | None = None
    clips: Path | None = None
    clip_count: int | None = None
    scenes: tuple = ()
    window: int = 16
    steps_per_clip: int = 4
    checkpoint_minutes: float = 5.0
    quiet: bool = False
    system: str = "zest"
    stage: str = "all"
    peak: float | None = None
    precision: str = "float32"
    settings: tuple = ()
    hosts: str | None = None
    effects: str = "all"


class Summary(NamedTuple):
    """line: what the command prints. weights: file. result: `LoopResult`."""

    line: str
    weights: Path
    result: LoopResult


@arithmetic()
def train(options):
    """Run `zestjax train`.

    Returns:
      `Summary`.

    Raises:
      ValueError, WeightsError: bad options; the folder holds another run; a damaged checkpoint.
    """
    join(options.hosts)
    check_option("train", system=(options.system, SYSTEMS), stage=(options.stage, STAGES))
    check_option("train", precision=(options.precision, ("float32", "bfloat16")))
    if options.scenes and options.stage == "frames":
        raise ValueError("train: --stage frames learns from exact answers, which --scenes lack; drop one of them.")
    check_option("train", preset=(options.preset, tuple(RECIPES)))
    whole = recipe_of(options.preset, system=options.system, precision=options.precision)
    whole = with_settings(whole, options.settings)
    scenes = [open_scene(name, whole, protocol=None).scene for name in options.scenes]
    each = over_scenes(check_choice(options.effects), scenes, quiet=options.quiet)
    frames = shared([priors_for(known_of(scene), on) for scene, on in zip(scenes, each, strict=bool(scenes))])
    fitted = replace(whole, system=system_for(whole.system, each[0]))
    recipe = run_recipe(fitted, options, known=answers_of(frames[0]) if frames else None)
    metadata = run_metadata(recipe, options, frames)
    state, step_fn = fresh(recipe, options, whole=whole)
    limit, quiet = None if options.minutes is None else 60 * options.minutes, options.quiet or not is_first()
    objective = recipe.objective()
    explain = lambda params, batch: find_fault(objective, jax.device_get(params), batch)
    with run_place(options.out) as out, batches(recipe, options, frames) as batch_at:
        loop = LoopOptions(out, options.steps, limit, options.resume, 60 * options.checkpoint_minutes, quiet=quiet)
        result = run_loop(step_fn, state, batch_at, loop, metadata=metadata, explain=explain)
    return summarise(result, options.out, "train")


def run_recipe(recipe, options, *, known=None):
    """The `Recipe` of a run: with its stage and its peak, on scenes of which `known` is known (None: on simulated
    clips). It says on standard error which of the usual terms are left out, and why.

    Raises:
      ValueError: a system without maps of its frames has no stages; or no term is left.
    """
    if options.stage != "all" and recipe.system.frames is None:
        raise ValueError(f"train: --stage {options.stage} needs a system whose frames are analysed; drop --stage.")
    wanted = stage_weights(options.stage, weights=dict(recipe.weights.terms))
    if (lost := unmeasured(recipe.system, wanted, own=recipe.terms, known=known)) and not options.quiet:
        listed = "; ".join(f"{name} (needs {need})" for name, need in lost.items())
        print(f"train: this run learns without {listed}", file=sys.stderr)
    recipe = recipe.weighted(measurable(recipe.system, wanted, own=recipe.terms, known=known))
    if options.peak is None:
        return recipe
    rate = recipe.rate
    return replace(recipe, rate=replace(rate, peak=options.peak, floor=options.peak * rate.floor / rate.peak))


def fresh(recipe, options, whole=None):
    """A run's first `TrainState`, from the seed or from given weights, and its compiled step. whole: the `Recipe` with
    every effect, whose weights may be given."""
    with jax.threefry_partitionable(False):  # the other form of the same generator compiles ten times longer here
        params: Any = recipe.init(jax.random.key(options.seed))
    if options.weights is not None:
        params = started(options.weights, params, recipe, recipe if whole is None else whole)
    if options.analysis is not None:
        if recipe.system.frames is None:
            raise ValueError(f"train: --analysis is of maps that `{options.system}` does not ask for; drop it.")
        other: Any = load_params(options.analysis, like=params)
        params = params._replace(analysis=other.analysis)
    if mesh := run_mesh(recipe, quiet=options.quiet):
        init, step_fn = mesh_trainer(recipe, mesh, steps=options.steps)
    else:
        init, step_fn = recipe.trainer(steps=options.steps)
        step_fn = jax.jit(step_fn, donate_argnums=(0, 1))
    return TrainState(params, init(params), 0), step_fn


def started(path, params, recipe, whole):
    """Given weights like `params` of a recipe, or of them what the recipe with every effect has more."""
    if recipe.system.dynamic is whole.system.dynamic:
        return load_params(path, like=params)
    try:
        every = jax.eval_shape(whole.init, jax.random.key(0))
        return params_for(recipe.system, load_params(path, like=every))
    except WeightsError:  # it was trained without that effect, too
        return load_params(path, like=params)


def say_removed(folders, options):
    """Name on standard error the clips of other runs that were removed from the cache."""
    if folders and not options.quiet:
        listed = "; ".join(map(str, folders))
        print(f"train: removed clips that no run has used for {STALE_DAYS} days: {listed}", file=sys.stderr)


def run_metadata(recipe, options, frames=()):
    """Everything that makes one run's numbers differ from another's, as JSON can hold it; `frames`: of its scenes."""
    data: dict = {"scenes": [digest(known) for known in frames] or "simulated", "clip_count": options.clip_count}
    data |= {"window": options.window, "steps_per_clip": options.steps_per_clip}
    return {
        "preset": options.preset, "system": options.system, "recipe": to_stored(recipe), "seed": options.seed,
        "scenes": [place_of(name) for name in options.scenes], "steps": options.steps,
        "stage": options.stage, "data": data,
        "start": run_name(options.weights),
        "analysis": run_name(options.analysis), "zestjax": zestjax.__version__,
        "jax": jax.__version__, "written": time.strftime("%Y-%m-%dT%H:%M:%S"),
    }  # fmt: skip


def run_name(weights):
    """The run that a file of weights comes from, without the machine's folders, and the file's digest; None of None."""
    if weights is None:
        return None
    path = Path(weights)
    name = path.resolve().parent.name if path.stem == "weights" else path.stem
    return f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}"


def summarise(result, out, verb):
    """The one line on stdout."""
    state, weights = result.state, Path(out) / "weights.safetensors"
    loss = result.report.get("total")
    said = "" if loss is None else f", loss {loss:.4f}"
    rate = result.report.get("seconds_per_step", float("nan"))
    spent = f"{rate:.2f} s a step, compile {result.compile_seconds:.0f} s" if result.steps else "nothing was left to do"
    ended = "" if result.finished else " (interrupted)"
    return Summary(
        f"{verb}: {counted(state.step, 'step')} in {result.seconds:.0f} s ({spent}){said}: {weights}{ended}",
        weights,
        result,
    )


def batches(recipe, options, frames=()):
    """Context: step -> batch, from the `KnownFrames` of the scenes named, or from simulated clips."""
    if frames:
        return contextlib.nullcontext(_scene_batches(recipe, options, frames))
    return _SimulatedBatches(recipe, options)


def _scene_batches(recipe, options, frames):
    """step -> batch of one of the scenes in turn."""
    each = [own_frame_batches(known, recipe, seed=options.seed) for known in frames]
    in_turn = lambda target: each[target % len(each)](target // len(each))
    return step_batches(lambda step, clip: in_turn(step * recipe.clips + clip), recipe.clips)


class _SimulatedBatches:
    """Batches of the sliding window of simulated clips; a context that ends their producer."""

    def __init__(self, recipe, options):
        planes = 0 if recipe.system.frames is None else recipe.system.frames.planes
        spec = ClipSpec(options.seed, recipe.height, recipe.width, planes=planes)
        folder = clip_folder(spec, root=options.clips)
        self.recipe, self.seed, self.count = recipe, options.seed, options.clip_count
        self.stage = options.stage
        self.window = {"window": options.window, "steps_per_clip": options.steps_per_clip, "count": self.count}
        self.ahead = AHEAD * options.steps_per_clip
        evict = options.clips is None and self.count is None
        self.ends = contextlib.ExitStack()
        if options.clips is None:
            self.ends.enter_context(held_clips(folder))
            say_removed(remove_stale_clips(folder), options)
        self.source = self.ends.enter_context(
            ClipSource(spec, folder, alive=min(options.window, KEPT) + 1, evict=evict)
        )

    def __enter__(self):
        return step_batches(self.batch, self.recipe.clips)

    def __exit__(self, *_):
        self.ends.close()

    def batch(self, step, clip):
        key = batch_key(step, seed=self.seed, draw=clip)
        if self.stage == "frames":
            draws = range(clip * SCENES_PER_STEP, (clip + 1) * SCENES_PER_STEP)
            return frame_batch(key, [self.prepared(step, draw) for draw in draws], self.recipe.system)
        return batch_from_clip(key, self.prepared(step, clip), self.recipe, step=step)

    def prepared(self, step, draw):
        """`PreparedClip` of one of the clips that a step sees."""
        live, soon = clip_window(step, **self.window), clip_window(step + self.ahead, **self.window)
        wanted = range(live.start, soon.stop)
        wrapped = [index if self.count is None else index % self.count for index in wanted]
        index = clip_index(step, seed=self.seed, draw=draw, **self.window)
        return prepared_from_arrays(hole_key(self.seed, index), self.source.clip(index, wrapped), self.recipe.system)


def prepared_from_arrays(key, arrays, system):
    """`PreparedClip` of a stored clip, with its evidence if that was stored too, and of frames evened as the system has
    them; `key` draws the holes if not."""
    clip = clip_from_arrays(arrays)
    links, gains = (arrays.get(EXPOSURE + name) for name in Exposure._fields)
    as_stored = system.exposure == ZEST.exposure or (system.exposure is None and gains is None)
    if "holes" not in arrays or not as_stored:
        return prepare_clip(key, clip, system)
    evidence = lambda before: Evidence(**{name: arrays[before + name] for name in Evidence._fields})
    stand_ins = None
    if f"{STAND_IN}times" in arrays:
        plain = {name: arrays[STAND_IN + name] for name in StandIns._fields[:-1]}
        stand_ins = StandIns(evidence=evidence(STAND_IN + EVIDENCE), **plain)
    holes = tuple(int(i) for i in arrays["holes"])
    exposure = None if links is None else Exposure(links, gains)
    return PreparedClip(clip, evidence(EVIDENCE), holes, stand_ins=stand_ins, exposure=exposure)
