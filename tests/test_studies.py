"""The studies and notebooks of `experiments/` run to their end, and find what they claim."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
NOTEBOOKS = sorted((EXPERIMENTS / "notebooks").glob("[0-9]*.py"))
pytestmark = pytest.mark.slow


def run(*command, limit):
    environment = os.environ | {"MPLBACKEND": "Agg", "XLA_FLAGS": "--xla_backend_optimization_level=1"}
    command = [sys.executable, *map(str, command)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_as_a_script(path):
    assert run(path, limit=300)  # each prints what it finds


@pytest.mark.parametrize("losses", ["simulated", "paper"])
def test_two_thousand_steps_over_nasty_scenes_stay_finite(losses, tmp_path):
    run(EXPERIMENTS / "stability.py", "--out", tmp_path, "--losses", losses, "--quiet", limit=1200)
    report = json.loads((tmp_path / "stability.json").read_text())
    assert report["finite"] and report["steps"] == 2000 and report["skipped"] == 0


def test_there_is_a_notebook_for_every_topic():
    assert len(NOTEBOOKS) == 8
