"""The flags of `zestjax crossval`. Choices of the plan that are not given are left out: they are then those of the plan
that the folder has, else `folds.Plan`'s defaults."""

import argparse
import re
from pathlib import Path

from zestjax.apps.commands import natural, numbers, positive, positive_float, setting, size

ACTIONS = ("plan", "run", "status", "table")


def grid(text):
    """A setting's name and its values; commas within brackets part none."""
    name, values = setting(text)
    return name, tuple(re.split(r",(?![^\[]*\])", values))


def slurm_option(text):
    """An option of sbatch; whole numbers are numbers."""
    name, value = setting(text)
    return name, int(value) if value.isdigit() else value


def amount(text):
    """Steps, or seconds: (number, `s` or nothing)."""
    if not (match := re.fullmatch(r"(\d+)(s?)", text)) or not int(match[1]):
        raise argparse.ArgumentTypeError(f"{text!r} is neither steps, as 400, nor seconds, as 60s")
    return int(match[1]), match[2]


CHOICES = {
    "scenes": ("--scenes", str, "+", "PATH", "scenes, or a folder of them (default: zest-bench, bench:all)"),
    "systems": ("--system", str, "+", "NAME", "as of train (default zest)"),
    "preset": ("--preset", str, None, "NAME", "tiny, small or paper (default small)"),
    "steps": ("--steps", natural, None, "N", "of each training (default 20000); 0: score --weights as they are"),
    "minutes": ("--minutes", positive_float, None, "M", "stop each training after so much stepping"),
    "seeds": ("--seeds", positive, None, "N", "so many, from --seed on (default 1)"),
    "settings": ("--set", grid, "+", "NAME=V,V", "parts of the recipe, rate.peak=1e-3 or weights.TERM=0; "
                 "several values make a grid"),
    "weights": ("--weights", Path, None, "W", "start from these"),
    "finetune": ("--finetune", amount, None, "N|Ns", "then adapt to the scene held out: steps, or seconds"),
    "protocol": ("--protocol", str, None, "NAME", "held-out, strict, paper or fixed-view (default held-out)"),
    "size": ("--size", size, None, "HxW", "of what is scored (default: the preset's height)"),
    "targets": ("--targets", numbers, None, "i,j,...", "times to predict (default: all)"),
    "lpips": ("--lpips", Path, None, "FILE", "LPIPS's weights, from import-lpips (default: n/a)"),
    "checkpoint_minutes": ("--checkpoint-minutes", positive_float, None, "M", "between checkpoints (default 5)"),
}  # fmt: skip
"""Of the plan, by name: flag, type, how many, what its value is called, help. `--seed` is one too."""


def add_flags(command):
    """Give the command its flags."""
    command.add_argument("action", nargs="?", choices=ACTIONS, help="one step only; without it all, or what is left")
    add = command.add_argument_group("what is run, kept in --out").add_argument
    for name, (flag, kind, count, called, about) in CHOICES.items():
        add(flag, dest=name, type=kind, nargs=count, default=argparse.SUPPRESS, metavar=called, help=about)
    add = command.add_argument_group("how it is run").add_argument
    add("--fold", type=natural, metavar="K", help="of `run`: this one")
    add("--launcher", default="inline", help="inline, process or slurm (default inline)")
    add("--jobs", type=positive, metavar="N", help="folds at a time (default: process, half the cores; slurm, all)")
    add(
        "--slurm",
        type=slurm_option,
        nargs="+",
        default=(),
        metavar="NAME=VALUE",
        help="of sbatch: partition=gpu time=600",
    )
    add("--resume", action="store_true", help="refuse an --out that has no plan yet")
    add("--failed", action="store_true", help="run those that failed again")
    add("--json", action="store_true", help="of `plan`, `status` and `table`")
