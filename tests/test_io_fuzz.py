"""Damaged files of every format load, or are refused by one line that names them; `make fuzz` tries many more."""

import pytest
from oracles import of_experiments

fuzz = of_experiments("fuzz")


@pytest.mark.parametrize("name", fuzz.FORMATS)
def test_a_damaged_file_loads_or_is_refused_by_name(name):
    row = fuzz.fuzz(name, count=60, seed=1)
    assert row.faults == () and row.tried == row.loaded + row.refused
    assert row.loaded and row.refused
