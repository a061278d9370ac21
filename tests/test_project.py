"""What must hold of the project as a whole: its dependencies, its size, its promises about numbers."""

import ast
import importlib.util
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "zestjax").rglob("*.py"))
TOP_LEVEL = {"zestjax", "experiments", "tests", "pyproject.toml", "LICENSE", "README.md", "CHANGELOG.md", "Makefile"}


def of_experiments(name):
    """A script of `experiments/` as a module."""
    sys.path.insert(0, str(ROOT / "experiments"))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.pop(0)


def test_optax_is_not_in_the_environment():
    assert importlib.util.find_spec("optax") is None


def test_every_dependency_states_its_lower_bound():
    lower_bounds = of_experiments("lower_bounds").lower_bounds
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert any(line.startswith("jaxopt==0.8.5") for line in lower_bounds(project))


def test_the_top_level_holds_only_what_the_layout_names():
    visible = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")}
    assert visible - {"runs", "build", "dist"} <= TOP_LEVEL


def test_numbers_are_made_finite_by_construction_not_afterwards():
    assert not [path.name for path in FILES if "nan_to_num" in path.read_text()]


def test_nothing_is_pickled():
    """Two modules read others' pickles, and run nothing that is in them (`test_torch_files`, `test_lpips_archive`)."""
    pattern = re.compile(r"\bimport pickle|allow_pickle=True")
    assert [path.name for path in FILES if pattern.search(path.read_text())] == ["array_pickles.py", "torch_files.py"]
    assert not [path.name for path in FILES if re.search(r"pickle\.(load|dump)", path.read_text())]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_modules_and_functions_stay_small(path):
    text = path.read_text()
    assert text.count("\n") < 300
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            doc = ast.get_docstring(node)
            lines = (node.end_lineno or 0) - node.lineno + 1 - (len(doc.splitlines()) + 2 if doc else 0)
            assert lines <= 40, f"{node.name} has {lines} lines of code"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_only_the_edge_prints_or_reads_arguments(path):
    if path.relative_to(ROOT / "zestjax").with_suffix("").parts[0] in ("apps", "cli"):
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id != "print"
        if isinstance(node, ast.Import):
            assert not {"argparse", "logging", "tqdm"} & {alias.name for alias in node.names}


def test_every_guard_that_the_mutation_check_undoes_is_still_there():
    source = lambda module: (ROOT / "zestjax" / f"{module}.py").read_text()
    listed = of_experiments("mutations").MUTATIONS
    assert not [guard for name, pairs in listed.items() for guard, _ in pairs if guard not in source(name)]
