"""Every benchmark, one after the other, in one file and one table.

    python experiments/bench.py [--out runs/bench] [--only model growth --with "--preset tiny"]

Each of `experiments/benchmarks` is a process of its own, and prints a JSON line for each thing that it times; its
lines are shown as they come. `bench.json` has the machine, the versions and flags, and all lines; `table.md` is for
reading. Both are written anew after each benchmark, so that what was measured before a kill is kept; a benchmark that
fails is told of at the end, and the others go on.
"""

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

import jax

import zestjax
from zestjax.apps.doctor import versions
from zestjax.io.files import write_bytes

HERE = Path(__file__).parent / "benchmarks"
COLUMNS = {
    "compile s": ("compile", "compile_s"),
    "run s": ("best", "seconds", "once_s"),
    "temporaries MB": ("temp_mb",),
    "peak MB": ("peak_mb",),
    "GFLOP": ("flops",),
    "of matmul peak": ("share_of_matmul_peak",),
}
"""What a reader looks for, under the names that the benchmarks give it."""
LOOPS = "XLA counts the operations of a loop's body once: of blocks of rays and of views GFLOP and shares are too low."
SAID_ELSEWHERE = ("load", "device", "matmul_gflops")


def machine():
    """{what: text} of what the seconds belong to."""
    found = {finding.name: finding.found for finding in versions()}
    devices = ", ".join(sorted({device.device_kind for device in jax.devices()}))
    return {
        "device": f"{jax.default_backend()}: {devices}",
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "processor": platform.processor() or platform.machine(),
        "flags": os.environ.get("XLA_FLAGS", ""),
        "compiler": zestjax.BACKEND.state,
        **found,
    }


def lines_of(script, more):
    """(JSON lines that a benchmark printed, its exit code); everything is shown as it comes."""
    command, found = [sys.executable, str(script), *more], []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=script.parent) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            if line.startswith("{"):
                found.append(json.loads(line))
    return found, process.returncode


def cells(row):
    """A row's cells: what it is, the columns, and everything else as `name value`."""
    names = {name for given in COLUMNS.values() for name in given}
    first = lambda given: next((row[name] for name in given if row.get(name) is not None), None)
    scaled = {"GFLOP": 1e-9}
    shown = []
    for title, given in COLUMNS.items():
        value = first(given)
        shown.append("" if value is None else f"{value * scaled.get(title, 1):.4g}")
    rest = {k: v for k, v in row.items() if k not in names and k not in SAID_ELSEWHERE and not isinstance(v, str)}
    what = " ".join(str(v) for k, v in row.items() if isinstance(v, str) and k not in SAID_ELSEWHERE)
    return [what, *shown, ", ".join(f"{k} {json.dumps(v)}" for k, v in rest.items())]


def table(about, found):
    """The Markdown table of all lines."""
    head = ["benchmark", "what", *COLUMNS, "also"]
    rows = [[name, *cells(row)] for name, lines in found.items() for row in lines]
    line = lambda row: "| " + " | ".join(row) + " |"
    machine_is = "\n".join(f"- {name}: {text}" for name, text in about.items())
    return "\n".join(
        [machine_is, "", LOOPS, "", line(head), "|" + "---|" * len(head), *(line(row) for row in rows), ""]
    )


def main():
    """Run, collect, write."""
    scripts = {path.stem: path for path in sorted(HERE.glob("*.py"))}
    parser = argparse.ArgumentParser(description="Runs every benchmark into one file and one table.")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"))
    parser.add_argument("--only", nargs="+", default=list(scripts), choices=list(scripts))
    parser.add_argument("--with", dest="more", default="", help="more options, that each of them must know")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    about, found, failed = machine(), {}, []
    for name in options.only:
        plot = ["--plot", str((options.out / "growth.png").resolve())] if name == "growth" else []
        found[name], code = lines_of(scripts[name], [*shlex.split(options.more), *plot])
        failed += [name] * (code != 0)
        whole = json.dumps({"machine": about, "benchmarks": found}, indent=1) + "\n"
        write_bytes(options.out / "bench.json", whole.encode())
        write_bytes(options.out / "table.md", table(about, found).encode())
    print(f"bench: {options.out / 'table.md'}")
    if failed:
        raise SystemExit(f"bench: {', '.join(failed)} failed; the last lines above say why.")


if __name__ == "__main__":
    main()
