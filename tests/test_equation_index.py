"""zestjax/EQUATIONS.md and the docstrings' `Source:` lines say the same thing."""

import functools
import importlib
import inspect
import re
from pathlib import Path

import zestjax

INDEX = Path(zestjax.__file__).parent / "EQUATIONS.md"
EQUATIONS, DIFFERENCES = (
    [tuple(cell.strip() for cell in line.strip("| ").split("|")) for line in part.splitlines() if line[:1] == "|"][2:]
    for part in INDEX.read_text().split("\n## ")
)
ROWS = [row[:3] for row in EQUATIONS]


def source(function):
    """The docstring's `Source:` paragraph up to the next heading, on one line; empty if it has none."""
    _, found, rest = (inspect.getdoc(function) or "").partition("Source:")
    return " ".join(re.split(r"\n\s*\n|\n(?:Reference|Differs|Args|Returns)", rest)[0].split()) if found else ""


def cites(text, label):
    return re.search(re.escape(label) + r"(?!\d)", text) is not None


def named(function):
    """A function of a module, or of a class of it."""
    module, *names = _split(function)
    return functools.reduce(getattr, names, importlib.import_module(module))


def _split(function):
    """[module, name] or [module, class, name]: a class begins with a capital."""
    parts = function.split(".")
    names = 2 if parts[-2][0].isupper() else 1
    return [".".join(parts[:-names]), *parts[-names:]]


def test_a_row_names_a_function_that_cites_it():
    wrong = []
    for paper, label, function in ROWS:
        text = source(named(function))
        if paper.split()[0] not in text or not cites(text, label):
            wrong.append(f"{function} should cite {paper} {label}, cites: {text!r}")
    assert not wrong


def test_a_listed_module_has_a_row_for_every_equation_of_the_paper_it_cites():
    cited = set()
    for module in sorted({_split(function)[0] for _, _, function in ROWS}):
        for name, function in vars(importlib.import_module(module)).items():
            if inspect.isfunction(function) and function.__module__ == module and "ZeST-NeRF eq." in source(function):
                ours = source(function).split(";")[0] if "NeRF (Mildenhall" in source(function) else source(function)
                cited |= {("ZeST-NeRF", label, f"{module}.{name}") for label in re.findall(r"eq\. \d+", ours)}
    assert not cited - set(ROWS)


def test_rows_are_not_repeated():
    assert len(set(ROWS)) == len(ROWS)


def test_every_numbered_equation_of_the_paper_has_a_row():
    cited = {label for paper, label, _ in ROWS if paper == "ZeST-NeRF"}
    assert cited == {f"eq. {i}" for i in range(1, 26)}


def test_a_difference_is_told_where_it_is_made():
    silent = []
    for row in DIFFERENCES:
        told = re.search(r"Source:|Reference:|Differs from", inspect.getdoc(named(row[5])) or "")
        silent += [row] if len(row) != 6 or not all(row) or not told else []
    assert not silent
