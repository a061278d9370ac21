"""`zestjax doctor`: is this machine fit for zestjax, and does its compiler compute what it should?

finding   one line of the report: ok, a name, what was found; one that is not ok says what to do
"""

import dataclasses
import importlib.metadata
import json
import os
import platform
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement

import zestjax
from zestjax.apps.cache import cache_folder
from zestjax.testing.backend import backend_checks

LEAST_MEMORY = 2.0  # GB: a frame of `small` at 144x256 takes 1.1, training it 2
LEAST_DISK = 1.0  # GB: compiled programs and simulated clips of one training
GB = 1e9


@dataclasses.dataclass(frozen=True)
class DoctorOptions:
    """The flags of `zestjax doctor`. seed: of the numbers that the compiler is tried with."""

    json: bool = False
    seed: int = 0
    quiet: bool = False


class Finding(NamedTuple):
    """ok: False is a fault; None is worth knowing and no fault. name, found: words."""

    ok: bool | None
    name: str
    found: str


class Report(NamedTuple):
    """text: what to print, the summary last. ok: all is well."""

    text: str
    ok: bool


def doctor(options: DoctorOptions) -> Report:
    """Look at versions, devices, flags, memory, the cache folder and extras, and try the known miscompilations."""
    sections = {
        "versions": versions(),
        "devices": devices(),
        "flags": flags(),
        "miscompilations": [Finding(c.ok, c.name, c.detail) for c in backend_checks(seed=options.seed)],
        "resources": [memory(), cache(cache_folder())],
        "extras": extras(),
    }
    faults = [f"{f.name}: {f.found}" for found in sections.values() for f in found if f.ok is False]
    if options.json:
        report = {name: [f._asdict() for f in found] for name, found in sections.items()}
        return Report(json.dumps({"ok": not faults, "faults": faults, **report}, indent=1), not faults)
    mark = {True: "ok  ", False: "FAULT", None: "-   "}
    lines = []
    for name, found in sections.items():
        lines += [name, *(f"  {mark[f.ok]:5} {f.name}: {f.found}" for f in found)]
    last = (
        f"doctor: {len(faults)} fault{'s' * (len(faults) > 1)}: {'; '.join(faults)}" if faults else "doctor: all well"
    )
    return Report("\n".join([*lines, last]), not faults)


def versions() -> list[Finding]:
    """Python, zestjax and what it needs, each against its bound."""
    found = [Finding(True, "python", f"{platform.python_version()} on {platform.machine()} {platform.system()}"),
             Finding(True, "zestjax", zestjax.__version__)]  # fmt: skip
    needed, _ = _requirements()
    if not needed:
        found.append(Finding(None, "requirements", "unknown: zestjax runs from a folder and is not installed"))
    return found + [_version(need) for need in needed]


def _version(need):
    try:
        version = importlib.metadata.version(need.name)
    except importlib.metadata.PackageNotFoundError:
        return Finding(False, need.name, f"is missing; pip install '{need}'")
    ok = need.specifier.contains(version, prereleases=True)
    return Finding(ok, need.name, version if ok else f"{version} is not {need.specifier}; pip install '{need}'")


def _requirements():
    """(what is always needed, {extra: what it needs})."""
    try:
        listed = importlib.metadata.requires("zestjax") or []
    except importlib.metadata.PackageNotFoundError:
        return [], {}
    always, by_extra = [], {}
    for requirement in map(Requirement, listed):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            always.append(requirement)
        else:
            wanted = str(requirement.marker).partition('extra == "')[2].partition('"')[0]
            by_extra.setdefault(wanted, []).append(requirement)
    return always, by_extra


def devices() -> list[Finding]:
    """What JAX computes on."""
    import jax

    listed = ", ".join(f"{d.platform} ({d.device_kind})" for d in jax.devices())
    return [Finding(True, "devices", listed), Finding(True, "cores", str(os.cpu_count()))]


def flags() -> list[Finding]:
    """`XLA_FLAGS` and what became of it at `import zestjax`, see `zestjax.base.backend`."""
    state, found = zestjax.BACKEND
    said = {
        "off": "fused sums are switched off by zestjax",
        "user": "set before zestjax was imported, left as it is",
        "running": "JAX ran before zestjax was imported, nothing was changed",
        "file": "XLA_FLAGS names a file, which is left alone",
        "unknown": "this jaxlib is none of those the flag was tried on, nothing was changed",
    }[state]
    kept = [name for name in ("JAX_PLATFORMS", "JAX_ENABLE_X64") if os.environ.get(name)]
    ours = True if state in ("off", "unknown") else None
    return [Finding(ours, "XLA_FLAGS", f"{found or '(empty)'}: {said}"),
            *(Finding(None, name, os.environ[name]) for name in kept)]  # fmt: skip


def memory() -> Finding:
    """Memory that is free."""
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        free = int(lines["MemAvailable"].split()[0]) * 1024 / GB
    except (OSError, KeyError, ValueError):
        return Finding(None, "free memory", "not known on this system")
    ok = free >= LEAST_MEMORY
    return Finding(
        ok, "free memory", f"{free:.1f} GB" + ("" if ok else f"; free some, {LEAST_MEMORY:.0f} GB are needed")
    )


def cache(folder: Path) -> Finding:
    """The cache folder: can it be written, how much is in it, how much room is left?"""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            room = shutil.disk_usage(folder).free / GB
    except OSError as error:
        remedy = "set XDG_CACHE_HOME to a folder that can be written"
        return Finding(False, "cache folder", f"{folder}: {error.strerror or error}; {remedy}")
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / GB
    said = f"{folder}: {size:.2f} GB used, {room:.1f} GB free"
    return Finding(room >= LEAST_DISK, "cache folder", said + ("" if room >= LEAST_DISK else "; free some space"))


def extras() -> list[Finding]:
    """Optional parts, and what each lacks."""
    found = []
    for name, needs in _requirements()[1].items():
        lacking = [need.name for need in needs if not _version(need).ok]
        said = f"lacks {', '.join(lacking)}; pip install 'zestjax[{name}]'" if lacking else "complete"
        found.append(Finding(None if lacking else True, name, said))
    return found
