"""The frontier as one page, `report.html`: a plot that answers to the mouse, pictures at three budgets, the figures.

The page needs nothing but itself: pictures and script are in it, and it asks no other host for anything.

row      dict of a setting, as `frontier.rows_of` has it
"""

import html
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from zestjax.apps import pages
from zestjax.apps.pages import embedded, table
from zestjax.apps.scoring import REGIONS

WIDTH, HEIGHT, LEFT, BELOW = 860, 420, 60, 45  # of the plot and its margins, pixels
ROUND = (1, 2, 5)  # what the ticks of seconds begin with
STYLE = """
body { max-width: 62rem } table { font-size: .85rem } th, td { padding: .2rem .5rem }
td:first-child { white-space: nowrap }
tr.front { font-weight: 600 } svg { max-width: 100%; font: 12px system-ui, sans-serif } svg .grid { stroke: #eee }
svg .front { fill: #1769aa } svg .other { fill: #aaa } svg .bar { stroke: #9bb; } svg circle:hover { stroke: #000 }
svg .line { fill: none; stroke: #1769aa; stroke-width: 2 } .scroll { overflow-x: auto }
#tip { position: absolute; display: none; background: #fff; border: 1px solid #888; padding: .3rem .6rem;
  font-size: .85rem; white-space: pre; pointer-events: none }
.row { display: flex; gap: .5rem } figure { margin: 0; flex: 1 }
.pair { position: relative } .pair img { width: 100%; display: block; image-rendering: pixelated }
.pair .truth { position: absolute; inset: 0; clip-path: inset(0 0 0 var(--cut, 50%)) } input[type=range] { width: 100% }
"""
SCRIPT = """
const tip = document.getElementById('tip');
for (const dot of document.querySelectorAll('circle[data-tip]')) {
  dot.addEventListener('mousemove', e => {
    tip.textContent = dot.dataset.tip; tip.style.display = 'block';
    tip.style.left = (e.pageX + 14) + 'px'; tip.style.top = (e.pageY + 10) + 'px';
  });
  dot.addEventListener('mouseleave', () => { tip.style.display = 'none'; });
}
const slider = document.getElementById('cut');
if (slider) {
  const cut = () => document.getElementById('budgets').style.setProperty('--cut', slider.value + '%');
  slider.addEventListener('input', cut); cut();
}
document.body.dataset.ready = document.querySelectorAll('circle[data-tip]').length;
"""


class Shown(NamedTuple):
    """A picture at a budget. caption: what it cost and gave. png: bytes."""

    caption: str
    png: bytes


def write_page(out: Path, rows, *, title: str, told: str, shown=(), truth: bytes | None = None) -> Path:
    """Write `report.html`.

    Args:
      out: folder.
      rows: of all settings.
      title: what they were measured on.
      told: a sentence on what was found.
      shown: `Shown` at budgets, cheap to dear.
      truth: PNG of what they should show.

    Returns:
      path of the page.
    """
    about = (
        "Each dot is a way to run the same weights; none needs training. Seconds are of one frame, its volumes too; "
        "the bars hold the mean over all such targets with 95 % probability, beside the weights as trained. Settings "
        "dropped after a few targets are grey, and placed by their difference on those."
    )
    parts = [
        f"<h1>What accuracy costs: {html.escape(title)}</h1>", f"<p>{quoted(told)}.</p>", _plot(rows),
        f'<p class="small">{about}</p>', _budgets(shown, truth), "<h2>One change at a time</h2>", _changes(rows),
        "<h2>All settings</h2>", _table(rows), f'<div id="tip"></div><script>{SCRIPT}</script>',
    ]  # fmt: skip
    return pages.write_page(Path(out) / "report.html", "zestjax frontier", parts, style=STYLE)


def quoted(text: str) -> str:
    """A sentence as HTML, what stands between `backticks` as code."""
    return re.sub("`([^`]*)`", r"<code>\1</code>", html.escape(text))


def _plot(rows):
    """The plot as SVG: seconds, logarithmic, against decibels."""
    seconds = np.log([row["seconds_per_frame"] for row in rows])
    decibels = np.array([row["psnr_full"] for row in rows])
    left, right = seconds.min() - 0.15, seconds.max() + 0.15
    low, high = np.floor(decibels.min() - 0.2), np.ceil(decibels.max() + 0.2)
    across = lambda s: LEFT + (np.log(s) - left) / (right - left) * (WIDTH - LEFT - 10)
    down = lambda d: (high - d) / (high - low) * (HEIGHT - BELOW - 10) + 10
    marks = []
    for value in (n * 10.0**k for k in range(-4, 4) for n in ROUND):
        if left <= np.log(value) <= right:
            x = across(value)
            marks.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="10" y2="{HEIGHT - BELOW}"/>')
            marks.append(f'<text x="{x:.1f}" y="{HEIGHT - 25}" text-anchor="middle">{value:g} s</text>')
    for value in np.arange(low, high + 1, max(1, round((high - low) / 8))):
        y = down(value)
        marks.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - 10}" y1="{y:.1f}" y2="{y:.1f}"/>')
        marks.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    best = sorted((r for r in rows if r["pareto"]), key=lambda r: r["seconds_per_frame"])
    line = " ".join(f"{across(r['seconds_per_frame']):.1f},{down(r['psnr_full']):.1f}" for r in best)
    marks.append(f'<polyline class="line" points="{line}"/>')
    marks += [_dot(r, across, down) for r in sorted(rows, key=lambda r: r["pareto"])]
    marks.append(f'<text x="{WIDTH / 2}" y="{HEIGHT - 6}" text-anchor="middle">seconds a frame</text>')
    marks.append(f'<text x="14" y="{HEIGHT / 2}" text-anchor="middle" '
                 f'transform="rotate(-90 14 {HEIGHT / 2})">PSNR, full image (dB)</text>')  # fmt: skip
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="frontier">{"".join(marks)}</svg>'


def _dot(row, across, down):
    x, y = across(row["seconds_per_frame"]), down(row["psnr_full"])
    kind, size = ("front", 6) if row["pareto"] else ("other", 4)
    tip = html.escape("\n".join(_said(row)), quote=True)
    bar = ""
    if row["pareto"]:
        ends = (min(max(down(row[end]), 10), HEIGHT - BELOW) for end in ("psnr_low", "psnr_high"))
        bar = f'<line class="bar" x1="{x:.1f}" x2="{x:.1f}" y1="{next(ends):.1f}" y2="{next(ends):.1f}"/>'
    dot = f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="{size}" data-tip="{tip}"><title>{tip}</title></circle>'
    return bar + dot


def _said(row):
    """The lines of a row's hover text."""
    number = lambda value, form: "n/a" if value is None else format(value, form)
    three = lambda name, form: " / ".join(number(row[f"{name}_{region}"], form) for region in REGIONS)
    lines = [row["setting"], f"PSNR {three('psnr', '.2f')} dB", f"SSIM {three('ssim', '.3f')}"]
    lines.append(f"LPIPS {three('lpips', '.3f')}")
    lines.append(f"{row['seconds_per_frame']:.3f} s ({row['seconds_low']:.3f} to {row['seconds_high']:.3f})")
    lines.append(f"memory of a frame {number(row['working_mb'], '.0f')} MB")
    lines.append(f"depth error {number(row['depth_abs_rel'], '.4f')}, {row['targets']} targets")
    return lines


def _budgets(shown, truth):
    """Pictures side by side, each covered by the truth from where the slider stands."""
    if not shown or truth is None:
        return ""
    figure = lambda s: (
        f'<figure><div class="pair"><img src="{embedded(s.png)}" alt="{html.escape(s.caption, quote=True)}">'
        f'<img class="truth" src="{embedded(truth)}" alt="truth"></div>'
        f"<figcaption>{html.escape(s.caption)}</figcaption></figure>"
    )
    return (
        "<h2>The same view at three budgets</h2><p>Left of the slider what was rendered, right of it the truth.</p>"
        '<input id="cut" type="range" min="0" max="100" value="70" aria-label="where the truth begins">'
        f'<div class="row" id="budgets">{"".join(figure(s) for s in shown)}</div>'
    )


def _changes(rows):
    """Settings that differ from as trained in one axis: what it brings in decibels, and costs in seconds."""
    own = next(row for row in rows if row["setting"] == "as trained")
    single = [row for row in rows if row is not own and "," not in row["setting"]]
    head = ["change", "dB (95 %)", "dynamic dB", "static dB", "times the seconds", "targets"]
    lines = []
    for row in sorted(single, key=lambda r: (r["setting"].split(" ", 1)[-1], r["seconds_per_frame"])):
        gain = lambda name, row=row: None if row[name] is None or own[name] is None else row[name] - own[name]
        shown = lambda value: "n/a" if value is None else f"{value:+.2f}"
        lines.append([
            html.escape(row["setting"]), f"{row['gain']:+.2f} ({row['gain_low']:+.2f} to {row['gain_high']:+.2f})",
            shown(gain("psnr_dynamic")), shown(gain("psnr_static")),
            f"{row['seconds_per_frame'] / own['seconds_per_frame']:.2f}", str(row["targets"]),
        ])  # fmt: skip
    return _scrolled(table(head, lines))


def _table(rows):
    scores = [f"{name} {region}" for name in ("PSNR", "SSIM", "LPIPS") for region in REGIONS]
    head = ["setting", *scores, "depth", "s", "MB", "J", "targets"]
    names = [f"{name}_{r}" for name in ("psnr", "ssim", "lpips") for r in REGIONS]
    forms = dict(zip(names, [".2f"] * 3 + [".3f"] * 6, strict=True))
    forms |= {"depth_abs_rel": ".4f", "seconds_per_frame": ".3f", "working_mb": ".0f", "joules_per_frame": ".1f"}
    cell = lambda row, name: "n/a" if row[name] is None else format(row[name], forms[name])
    lines = [[html.escape(row["setting"]), *(cell(row, name) for name in forms), str(row["targets"])] for row in rows]
    best = [i for i, row in enumerate(rows) if row["pareto"]]
    return _scrolled(table(head, lines, marked=best, mark="front"))


def _scrolled(shown):
    """A table that may be wider than the page."""
    return f'<div class="scroll">{shown}</div>'
