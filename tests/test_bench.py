"""The collector of benchmarks, and the exponents that one of them fits."""

import json
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


@pytest.fixture
def modules(monkeypatch):
    """(experiments/bench.py, experiments/benchmarks/growth.py)"""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    monkeypatch.syspath_prepend(str(EXPERIMENTS / "benchmarks"))
    import bench
    import growth

    yield bench, growth
    for name in ("bench", "growth", "model"):
        sys.modules.pop(name, None)


def test_lines_of_all_benchmarks_are_kept_in_one_file_and_a_failure_is_told(modules, monkeypatch, tmp_path, capfd):
    bench, _ = modules
    line = {"preset": "tiny", "what": "view", "compile": 2.0, "best": 0.25, "flops": 3e9, "load": 0.5, "more": [1, 2]}
    (tmp_path / "good.py").write_text(f"print('starting'); print('''{json.dumps(line)}''')")
    (tmp_path / "bad.py").write_text("print('{\"what\": \"half\"}'); raise SystemExit('no device')")
    monkeypatch.setattr(bench, "HERE", tmp_path)
    monkeypatch.setattr(sys, "argv", ["bench.py", "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit, match="bench: bad failed"):
        bench.main()
    found = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert found["benchmarks"] == {"bad": [{"what": "half"}], "good": [line]} and "jax" in found["machine"]
    rows = (tmp_path / "out" / "table.md").read_text().splitlines()
    assert rows[-1] == "| good | tiny view | 2 | 0.25 |  |  | 3 |  | more [1, 2] |"
    assert "starting" in capfd.readouterr().out


def test_exponents_are_those_of_a_power(modules):
    _, growth = modules
    rows = [(x, {"seconds": 3 * x**1.5, "temp_mb": 7.0, "compile": -1.0}) for x in (2, 4, 8)]
    found = growth.exponents(rows)
    assert found == pytest.approx({"seconds": 1.5, "temp_mb": 0.0}, abs=1e-9)


@pytest.mark.parametrize("factor", [0.5, 1, 2])
def test_a_size_is_changed_and_no_other(modules, factor):
    _, growth = modules
    recipe = growth.RECIPES["small"]
    for size, change in growth.OF_A_VIEW.items():
        value, changed = change(recipe, factor)
        assert value > 0 and (changed == recipe) == (factor == 1 and size != "samples"), size
