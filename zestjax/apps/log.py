"""What a training run leaves to read: a JSON line per few steps, and the curves drawn from them.

A line holds step, seconds (of stepping so far), seconds_per_step, and the mean of every scalar the steps reported.
"""

import json
import math
import time
from pathlib import Path

import numpy as np

from zestjax.io.figures import png_of
from zestjax.io.files import append_bytes, write_bytes
from zestjax.io.reading import parse_json, read_regular

PATIENCE = 50  # steps in a row whose loss may be non-finite before the run gives up
CLOCK = ("step", "seconds", "seconds_per_step")


class Recorder:
    """Means of the steps' scalars, a JSON line every `every` steps; a non-finite loss counts in no mean."""

    def __init__(self, path, every):
        self.path, self.every, self.last, self.kept, self.broken = Path(path), every, {}, [], 0
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.mark, self.drawn = None, time.monotonic()

    def add(self, step, info, clock):
        finite = all(math.isfinite(value) for value in info.values())
        self.broken = 0 if finite else self.broken + 1
        if self.broken >= PATIENCE:
            raise FloatingPointError(
                f"the loss was not finite in {PATIENCE} steps in a row, up to step {step}; lower the learning rate."
            )
        self.kept.append((step, info if finite else {}, clock.seconds))
        if step % self.every == 0:
            self.flush()

    def flush(self):
        if not self.kept:
            return
        step, _, seconds = self.kept[-1]
        names = list(dict.fromkeys(name for _, info, _ in self.kept for name in info))
        means = {name: float(np.mean([info[name] for _, info, _ in self.kept if name in info])) for name in names}
        spent = seconds - (self.kept[0][2] if self.mark is None else self.mark)
        self.last = {
            "step": step,
            "seconds": round(seconds, 2),
            "seconds_per_step": round(spent / len(self.kept), 4),
        } | means
        append_bytes(self.path, (json.dumps(self.last) + "\n").encode())
        self.mark, self.kept = seconds, []

    def draw(self, path, *, least_seconds=60.0):
        """Draw the curves so far, unless they were less than `least_seconds` ago."""
        now = time.monotonic()
        if now - self.drawn >= least_seconds:
            self.drawn = now
            draw_curve(self.path, path)


def read_log(path):
    """The lines of a log that are records of a step, and how many are not.

    Args:
      path: the log; none is an empty one. A last line that a crash cut short is neither kept nor counted.

    Returns:
      (list of dict, int).
    """
    if not Path(path).exists():
        return [], 0
    whole = read_regular(path).split(b"\n")[:-1]
    lines = [line for text in whole if (line := _record(text)) is not None]
    return lines, len(whole) - len(lines)


def _record(text):
    """A line's dict, or None if it is no record of a step."""
    try:
        line = parse_json(text)
    except ValueError:
        return None
    return line if isinstance(line, dict) and type(line.get("step")) is int else None


def cut_log(path, step):
    """Forget what was logged after the checkpoint that a run resumes from, and what is no record.

    Returns:
      int, how many lines were no record.
    """
    lines, dropped = read_log(path)
    kept = [line for line in lines if line["step"] <= step]
    write_bytes(path, "".join(json.dumps(line) + "\n" for line in kept).encode())
    return dropped


def draw_curve(log, path):
    """The logged scalars against the step, smoothed, one small plot each, as a PNG."""
    from matplotlib.figure import Figure

    lines = [_numbers(line) for line in read_log(log)[0]]
    names = [n for n in dict.fromkeys(n for line in lines for n in line) if n not in CLOCK]
    if not names:
        return
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(3.6 * columns, 2.4 * rows), layout="constrained")
    for axes, name in zip(figure.subplots(rows, columns, squeeze=False).flat, names, strict=False):
        steps, values = np.array([(line["step"], line[name]) for line in lines if name in line]).T
        width = max(1, len(values) // 40)
        smooth = np.convolve(np.pad(values, (width - 1, 0), mode="edge"), np.ones(width) / width, mode="valid")
        axes.plot(steps, values, color="0.8", linewidth=0.8)
        axes.plot(steps, smooth, color="C0", linewidth=1.4)
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
    write_bytes(path, png_of(figure))


def _numbers(line):
    """A record without what cannot be drawn."""
    return {name: value for name, value in line.items() if type(value) in (int, float)}
