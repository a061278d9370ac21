"""The frontier: settings of systems, the search for the best of them, intervals, the page seen in a browser."""

import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from zestjax.apps import energy, frontier_page, memory, scaled, search, settings, trials
from zestjax.apps.scoring import REGIONS
from zestjax.apps.settings import TRAINED, Setting
from zestjax.io.pictures import encoded_png
from zestjax.novel_view import View
from zestjax.systems.mvsnerf import MVSNERF
from zestjax.systems.presets import NSFF, PAPER, STILL, ZEST
from zestjax.systems.sampling import Even

BROWSER = next((found for name in ("chromium", "google-chrome", "chrome") if (found := shutil.which(name))), None)


def static_of(system: Any, frames):
    """A system's static field, served by other frames."""
    return replace(system.static, frames=frames)


@pytest.mark.parametrize(
    "system", [ZEST, STILL, PAPER, NSFF, MVSNERF], ids=["zest", "still", "paper", "nsff", "mvsnerf"]
)
def test_every_system_runs_by_every_setting_with_its_own_parameters(system):
    assert TRAINED.of(system) == system and TRAINED.named(system) == "as trained"
    for setting in settings.distinct([*settings.drawn(30, 0), *settings.neighbours(TRAINED)], system):
        changed, frames = setting.of(system), system.static.frames
        assert changed.dynamic == system.dynamic and changed.frames == system.frames
        assert setting.named(system).count("\n") == 0 and static_of(changed, frames) == system.static
        assert changed.space.planes >= 2 and changed.static.frames.count >= 1


def test_a_setting_says_what_it_changes():
    setting = Setting(planes=0.75, views=0.5, samples=1.0, precision="bfloat16", scale=0.5)
    assert setting.named(ZEST) == "24 planes, 4 views, 32 even samples, bfloat16, 0.5 of the size"
    assert setting.of(ZEST).sampler == Even(32, "plane") and setting.of(PAPER).sampler == Even(128)
    assert setting.family == Setting(planes=0.75, views=0.5, samples=1.0, precision="bfloat16")


def landscape(setting, targets):
    """(seconds, decibels) of a made-up machine, where half the views are better and planes do not matter."""
    seconds = setting.scale**2 * (0.3 + 0.4 * setting.views + 0.3 * setting.planes) * (3 if setting.samples else 1)
    decibels = 30 + 4 * np.log2(min(setting.scale, 1)) - abs(np.log2(setting.views / 0.5)) - 6 * (setting.samples > 0)
    return seconds, decibels + 0.01 * np.sin(targets + 10 * setting.planes)


def test_the_search_finds_what_changing_one_axis_at_a_time_would_not():
    first = [*settings.scales(), *settings.begun_with(12, 0)]
    found = search.search(first, settings.scales(), ZEST, rungs=(2, 4, 8), measured=landscape, tries=12)
    points = [landscape(setting, 8) for setting in found]
    best = [found[i] for i in search.front(points)]
    assert all(setting.samples == 0 for setting in best) and set(settings.scales()) <= set(found)
    assert any(setting.views != 1 and setting.planes != 1 for setting in best)
    cheap = min(seconds for seconds, decibels in points if decibels >= 29.5)
    assert cheap <= 0.8 * landscape(TRAINED, 8)[0]


def test_half_of_a_rung_goes_on_and_what_always_does():
    asked = []
    measured = lambda setting, targets: (asked.append((setting, targets)), landscape(setting, targets))[1]
    tried = settings.distinct(settings.drawn(16, 1), ZEST)
    left = search.halving([TRAINED, *tried], [TRAINED], (1, 2, 4), measured)
    counts = [len({setting for setting, count in asked if count == rung}) for rung in (1, 2, 4)]
    assert counts[0] == len(tried) + 1 and counts[0] > counts[1] > counts[2]
    assert TRAINED in left and len(left) == counts[2]


def test_a_setting_is_worth_what_it_is_better_than_all_that_are_no_slower():
    points = [(1, 20), (2, 25), (3, 24), (2, 24), (0.5, 10)]
    assert search.front(points) == [0, 1, 4] and search.margins(points) == [10, 1, -1, -1, np.inf]


def test_an_interval_holds_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    ends = np.array([trials.interval(rng.normal(1.0, 2.0, 6)) for _ in range(2000)])
    assert 0.93 < np.mean((ends[:, 0] < 1) & (ends[:, 1] > 1)) < 0.97
    assert trials.interval([3.0]) == (3.0, 3.0)


def test_a_setting_that_was_dropped_early_is_compared_on_its_own_targets():
    """Two easy targets are no reason to look better than as trained."""
    scores = lambda psnr: {"psnr": psnr, "ssim": 0.9, "lpips": None}
    trial = lambda psnr: {
        "full": scores(psnr), "dynamic": None, "static": scores(psnr), "depth_abs_rel": None, "seconds": 1.0,
        "cpu_seconds": 0.9, "prepare_seconds": 2.0, "peak_mb": 1.0, "working_mb": 1.0, "joules": None,
    }  # fmt: skip
    model: Any = SimpleNamespace(system=ZEST)
    scene: Any = SimpleNamespace(targets=[None] * 4)
    kept = trials.Trials(model, [scene], "unused")
    for i, psnr in enumerate((40.0, 40.0, 20.0, 20.0)):
        kept.done[TRAINED, i] = trial(psnr)
    for i in range(2):
        kept.done[Setting(views=0.5), i] = trial(39.0 + i)
    row = kept.row(Setting(views=0.5))
    assert row["psnr_full"] == 29.5 and row["gain"] == -0.5 and row["targets"] == 2 and row["psnr_dynamic"] is None
    assert row["psnr_low"] < 29.5 < row["psnr_high"] and kept.row(TRAINED)["psnr_full"] == 30.0


def test_a_view_comes_back_to_its_videos_size():
    small = np.full((8, 12), 2.0, np.float32)
    colour = np.full((8, 12, 3), 0.25, np.float32)
    leaves: Any = (colour, colour, None, small, small / 2, small / 2, np.ones((8, 12, 2), np.float32))
    view = scaled.enlarged(View(*leaves), (16, 24), (0.5, 0.5))
    assert view.colour.shape == (16, 24, 3) and view.depth.shape == view.opacity.shape == (16, 24)
    assert view.dynamic is None and np.all(np.asarray(view.flow) == 2.0) and np.all(np.asarray(view.colour) == 0.25)


def test_energy_and_memory_are_told_where_the_machine_tells(tmp_path, monkeypatch):
    monkeypatch.setattr(energy, "COUNTERS", str(tmp_path))
    assert energy.joules() is None and energy.joules_since(None) is None
    for socket, used in (("intel-rapl:0", 2_000_000), ("intel-rapl:1", 500_000), ("intel-rapl:0:0", 1)):
        (tmp_path / socket).mkdir()
        (tmp_path / socket / "energy_uj").write_text(f"{used}\n")
    assert energy.joules() == 2.5 and energy.joules_since(1.0) == 1.5 and energy.joules_since(9.0) is None
    memory.reset_peak()
    held, peak = memory.held_megabytes(), memory.peak_megabytes()
    assert held is None or peak is None or 0 < held <= peak + 1


def row(name, seconds, psnr, *, pareto):
    """A row of a frontier."""
    found: dict[str, Any] = {"setting": name, "pareto": pareto, "targets": 4, "gain": psnr - 28, "depth_abs_rel": 0.05}
    found |= {f"{score}_{region}": None for score in ("psnr", "ssim", "lpips") for region in REGIONS}
    found |= {"psnr_full": psnr, "psnr_static": psnr + 2, "ssim_full": 0.9, "working_mb": 200.0}
    found |= {"psnr_low": psnr - 0.5, "psnr_high": psnr + 0.5, "gain_low": -0.5, "gain_high": 0.5}
    return found | {
        "seconds_per_frame": seconds, "seconds_low": 0.9 * seconds, "seconds_high": 1.1 * seconds,
        "joules_per_frame": None,
    }  # fmt: skip


@pytest.fixture
def page(tmp_path):
    """A page of four settings; its pictures are noise of three strengths."""
    rng = np.random.default_rng(0)
    truth = np.repeat(np.repeat(rng.random((9, 16, 3)), 16, 0), 16, 1).astype(np.float32)
    picture = lambda noise: encoded_png(np.clip(truth + noise * rng.normal(size=truth.shape), 0, 1).astype(np.float32))
    shown = [frontier_page.Shown(f"noise {noise}", picture(noise)) for noise in (0.3, 0.1, 0.02)]
    rows = [row("0.5 of the size", 0.3, 26.0, pareto=1), row("16 planes", 0.8, 27.9, pareto=1)]
    rows += [row("as trained", 1.1, 28.0, pareto=1), row("<b>48 planes</b>", 1.5, 27.5, pareto=0)]
    return frontier_page.write_page(
        tmp_path, rows, title="a & b", told="two settings", shown=shown, truth=encoded_png(truth)
    )


def test_the_page_asks_no_other_host_and_trusts_no_name(page):
    text = page.read_text()
    assert "http" not in text.replace("http-equiv", "") and "//" not in text.split("<script>")[0].split("base64")[0]
    assert "<b>48 planes" not in text and "a &amp; b" in text
    assert text.count("data:image/png;base64,") == 6 and text.count("<circle") == 4 and text.count("n/a") > 4


@pytest.mark.skipif(BROWSER is None, reason="no Chromium or Chrome is installed")
def test_the_page_is_drawn_and_its_script_runs_in_a_browser(page, tmp_path):
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        f"--user-data-dir={tmp_path}/user",
    ]
    browse = lambda *more: subprocess.run(
        [str(BROWSER), *flags, *more, page.as_uri()], capture_output=True, timeout=120, check=True, cwd=tmp_path
    )
    assert b'data-ready="4"' in browse("--dump-dom").stdout
    browse(f"--screenshot={tmp_path / 'page.png'}", "--window-size=1000,1500", "--hide-scrollbars")
    drawn = cv2.imread(str(tmp_path / "page.png"))
    assert drawn is not None and drawn.shape[:2] == (1500, 1000)
    blue = np.all(np.abs(drawn.astype(int) - (0xAA, 0x69, 0x17)) < 12, -1)
    assert blue[:700].sum() > 300, "the frontier is drawn in blue above"
    colours = np.unique(drawn[700:].reshape(-1, 3), axis=0)
    assert len(colours) > 2000, "the pictures are below it"
