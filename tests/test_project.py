"""What must hold of the project as a whole: its dependencies, its size, its promises about numbers."""

import ast
import importlib.util
import re
import tokenize
import tomllib
from pathlib import Path

from oracles import of_experiments

ROOT = Path(__file__).parents[1]
FILES = sorted((ROOT / "zestjax").rglob("*.py"))
DEFINITIONS = ast.FunctionDef | ast.AsyncFunctionDef
TREES = {str(path.relative_to(ROOT)): ast.parse(path.read_text()) for path in FILES}
TOP_LEVEL = {"zestjax", "experiments", "tests", "pyproject.toml", "LICENSE", "README.md", "CHANGELOG.md", "Makefile"}


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


def code_lines(path, tree):
    """Numbers of the lines of a file that hold code: no blank lines, no comments, no docstrings."""
    silent = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    with path.open() as file:
        tokens = [token for token in tokenize.generate_tokens(file.readline) if token.type not in silent]
    code = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    documented = [n for n in ast.walk(tree) if isinstance(n, ast.Module | ast.ClassDef | DEFINITIONS)]
    docs = [n.body[0] for n in documented if ast.get_docstring(n, clean=False) is not None]
    return code - {line for doc in docs for line in range(doc.lineno, (doc.end_lineno or doc.lineno) + 1)}


def test_modules_and_functions_stay_small():
    """Fewer than 300 lines of code a module, at most 40 a function; what explains them is not counted."""
    large = []
    for path, tree in TREES.items():
        code = code_lines(ROOT / path, tree)
        large += [f"{path}, {len(code)} lines"] if len(code) >= 300 else []
        for node in (n for n in ast.walk(tree) if isinstance(n, DEFINITIONS)):
            lines = len(code & {*range(node.lineno, (node.end_lineno or 0) + 1)})
            large += [f"{path}: {node.name}, {lines} lines"] if lines > 40 else []
    assert not large


def test_only_the_edge_prints_or_reads_arguments():
    found = []
    for path, tree in TREES.items():
        if Path(path).parts[1] in ("apps", "cli.py"):
            continue
        for node in ast.walk(tree):
            prints = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
            names = {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
            found += [path] if prints or names & {"argparse", "logging", "tqdm"} else []
    assert not found


def test_every_guard_that_the_mutation_check_undoes_is_still_there():
    source = lambda module: (ROOT / "zestjax" / f"{module}.py").read_text()
    listed = of_experiments("mutations").MUTATIONS
    assert not [guard for name, pairs in listed.items() for guard, _ in pairs if guard not in source(name)]
