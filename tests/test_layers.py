"""Imports point down, and one module knows jaxopt."""

import ast
from pathlib import Path

import zestjax

PACKAGE = Path(zestjax.__file__).parent
LAYERS = [
    "base",
    "cameras video rays resample frustum",
    "nets planesweep",
    "frames",
    "sfm cost_volume encoding",
    "fields rendering depth flow",
    "systems",
    "losses effects model novel_view adam",
    "solve metrics judge testing simulate",
    "train",
    "io",
    "apps",
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names.split()}
FILES = sorted(PACKAGE.rglob("*.py"))


def stage(path):
    """The top-level module or subpackage a file belongs to."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported(tree):
    """Top-level zestjax modules a file imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            parts = node.module.split(".")
            if parts[0] == "zestjax":
                yield from parts[1:2] or (alias.name for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if a.name.startswith("zestjax."))


def test_imports_point_down():
    wrong = []
    for path in FILES:
        here, names = stage(path), {name for name in imported(ast.parse(path.read_text())) if name != "__version__"}
        if here == "__init__":
            continue
        if unknown := {here, *names} - LEVEL.keys():
            wrong.append(f"{path.name}: {sorted(unknown)} are in no layer: add them to LAYERS")
        elif above := {name for name in names if LEVEL[name] > LEVEL[here]}:
            wrong.append(f"{path.name} (layer {LEVEL[here]}) imports from above: {sorted(above)}")
    assert not wrong


def test_one_module_knows_jaxopt():
    knows = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            modules += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if any(module.split(".")[0] == "jaxopt" for module in modules):
                knows.append(path.name)
    assert set(knows) <= {"solve.py"}


def test_no_circle_and_few_rooms():
    """Modules and packages at the top: thirty at most, and none is reached from itself."""
    arrows = {stage(path): set() for path in FILES}
    for path in FILES:
        arrows[stage(path)] |= {name for name in imported(ast.parse(path.read_text())) if name in arrows}
    rooms = arrows.keys() - {"__init__"}
    assert len(rooms) <= 30
    left = {room: arrows[room] & rooms - {room} for room in rooms}
    while ready := {room for room, needs in left.items() if not needs & left.keys()}:
        left = {room: needs for room, needs in left.items() if room not in ready}
    assert not left, f"circle among {sorted(left)}"
