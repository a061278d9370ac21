"""zestjax/EQUATIONS.md and the docstrings' `Source:` lines say the same thing."""

import importlib
import inspect
import re
from pathlib import Path

import pytest

import zestjax

INDEX = Path(zestjax.__file__).parent / "EQUATIONS.md"
EQUATIONS, DIFFERENCES = (
    [tuple(cell.strip() for cell in line.strip("| ").split("|")) for line in part.splitlines() if line[:1] == "|"][2:]
    for part in INDEX.read_text().split("\n## ")
)
ROWS = [row[:3] for row in EQUATIONS]
LISTED = sorted({function.rsplit(".", 1)[0] for _, _, function in ROWS})


def source(function):
    """The docstring's `Source:` paragraph up to the next heading, on one line; empty if it has none."""
    _, found, rest = (inspect.getdoc(function) or "").partition("Source:")
    return " ".join(re.split(r"\n\s*\n|\n(?:Reference|Differs|Args|Returns)", rest)[0].split()) if found else ""


def cites(text, label):
    return re.search(re.escape(label) + r"(?!\d)", text) is not None


@pytest.mark.parametrize("paper, label, function", ROWS, ids=[f"{row[2]}-{row[1]}" for row in ROWS])
def test_a_row_names_a_function_that_cites_it(paper, label, function):
    module, name = function.rsplit(".", 1)
    text = source(getattr(importlib.import_module(module), name))
    assert paper.split()[0] in text and cites(text, label), f"{function} cites: {text!r}"


@pytest.mark.parametrize("module", LISTED)
def test_a_listed_module_has_a_row_for_every_equation_of_the_paper_it_cites(module):
    members = vars(importlib.import_module(module)).items()
    for name, function in members:
        if inspect.isfunction(function) and function.__module__ == module and "ZeST-NeRF eq." in source(function):
            ours = source(function).split(";")[0] if "NeRF (Mildenhall" in source(function) else source(function)
            for label in re.findall(r"eq\. \d+", ours):
                assert ("ZeST-NeRF", label, f"{module}.{name}") in ROWS, f"{module}.{name} cites {label}"


def test_rows_are_not_repeated():
    assert len(set(ROWS)) == len(ROWS)


def test_every_numbered_equation_of_the_paper_has_a_row():
    cited = {label for paper, label, _ in ROWS if paper == "ZeST-NeRF"}
    assert cited == {f"eq. {i}" for i in range(1, 26)}


@pytest.mark.parametrize("row", DIFFERENCES, ids=lambda row: row[0])
def test_a_difference_is_told_where_it_is_made(row):
    assert len(row) == 6 and all(row), row
    module, name = row[5].rsplit(".", 1)
    text = inspect.getdoc(getattr(importlib.import_module(module), name)) or ""
    assert re.search(r"Source:|Reference:|Differs from", text), f"{row[5]} does not say what it is compared with"
