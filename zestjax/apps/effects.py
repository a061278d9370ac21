"""`--effects` of the commands: which effects of a scene a model is run with."""

import sys
import time
from typing import NamedTuple

from zestjax.apps.own_frames import known_of
from zestjax.apps.scoring import number
from zestjax.effects import chosen, inspect, params_for, system_for
from zestjax.effects.found import SWITCHES
from zestjax.effects.systems import kept

AUTO, ALL = "auto", "all"
LEAST_SHARE = 0.5  # of the frames that must be left, where some are held back, for effects to be found by


class Chosen(NamedTuple):
    """on: effects that are on. told: of `metrics.json`."""

    on: tuple[str, ...]
    told: dict


def choose(choice, scene, *, exclude=(), still=False, quiet=False):
    """The effects of a scene that are on.

    Args:
      choice: of `--effects`.
      scene: `io.scenes.Scene`.
      exclude: frames that are not read.
      still: nothing moves, whatever is found.
      quiet: nothing is said on standard error.

    Returns:
      `Chosen`.

    Raises:
      ValueError: an unknown name.
    """
    found, seconds, without = {}, None, ("motion",) if still else ()
    if choice == AUTO and len(set(exclude)) > (1 - LEAST_SHARE) * len(scene.video.images):
        choice = ALL
        if not quiet:
            said = "too many frames are held back for the others to tell; all are on"
            print(f"effects: {scene.name}: {said}", file=sys.stderr)
    if choice == AUTO:
        start = time.perf_counter()
        found = inspect(scene.video, given=known_of(scene), exclude=exclude)
        seconds = time.perf_counter() - start
    on = kept(chosen(found, choice), without=without)
    off = [name for name in SWITCHES if name not in on]
    if choice == AUTO and not quiet:
        said = "; ".join(f"no {name.replace('_', ' ')} ({found[name].reason})" for name in off if name in found)
        print(f"effects: {scene.name}: {said or 'all are on'}", file=sys.stderr)
    spent = None if seconds is None else number(seconds)
    return Chosen(on, {"choice": choice, "on": list(on), "off": off, "seconds": spent})


def hidden_frames(scene):
    """The frames that may not be read for some target, sorted; of pictures by other cameras, which are read only when
    they are asked for, there are none."""
    if not len(scene.targets) or not scene.targets[0].exclude:
        return ()
    return tuple(sorted({i for target in scene.targets for i in target.exclude}))


def with_effects(model, on):
    """The `Model` run with the effects that are on; the same where all are."""
    system = system_for(model.system, on)
    return model if system == model.system else model.running(system, params_for(system, model.params))


def over_scenes(choice, scenes, *, quiet=False):
    """[(effects on)] of scenes that one system learns from: what a system is made of is on where any scene calls for
    it, priors each by its own; without scenes what is simulated has every effect.

    Raises:
      ValueError: an unknown name.
    """
    if not scenes:
        return [kept(chosen({}, ALL if choice == AUTO else choice))]
    each = [choose(choice, scene, quiet=quiet).on for scene in scenes]
    shared = {name for on in each for name in on if name not in ("flow_prior", "depth_prior")}
    return [kept({*shared, *on}) for on in each]


def check_choice(choice):
    """A choice of `--effects`, refused before any scene is read.

    Raises:
      ValueError: an unknown name.
    """
    chosen({}, ALL if choice == AUTO else choice)
    return choice
