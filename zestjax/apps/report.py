"""The demo's page: one HTML file that shows the pictures and the film beside it."""

import html
from pathlib import Path

from zestjax.apps.pages import table, write_page
from zestjax.apps.scoring import REGIONS, better_floor, share_of_the_way

STYLE = """
body { max-width: 60rem } img, video { max-width: 100%; image-rendering: pixelated } video { width: 32rem }
th, td { padding: .25rem .7rem } th:first-child { text-align: left } .ours { font-weight: 600 }
"""


def write_report(out, report, film):
    """Write `report.html`; links are relative, so the folder can be moved or served.

    Args:
      out: the demo's folder.
      report: dict of its metrics.json.
      film: path of the video in it.

    Returns:
      path of the page.
    """
    stereo = report["stereo"]
    parts = [
        f"<h1>New views of a scene never seen: {html.escape(report['scene'])}</h1>",
        f"<p>A video of {report['height']}x{report['width']} pixels, one camera at a time; every view below is of "
        "another camera at that time, which no input contained. Nothing was trained on this scene.</p>",
        "<h2>A moving camera while time runs</h2>", _film(film), "<h2>Beside the truth</h2>",
        '<img src="side_by_side.png" alt="input, novel view, truth, error, depth, dynamicness">',
        "<h2>Figures</h2>", _scores(report), _clock(report), "<h2>Every target</h2>", _targets(report),
        "<h2>A real stereo pair with true disparity</h2>", f'<img src="{stereo["picture"]}" alt="stereo pair">',
        _stereo(stereo),
    ]  # fmt: skip
    return write_page(Path(out) / "report.html", "zestjax demo", parts, style=STYLE)


def _film(film):
    name = html.escape(film.name)
    if film.suffix == ".webm":
        return f'<video src="{name}" controls autoplay loop muted playsinline></video>'
    return f'<img src="{name}" alt="the film">'


def _scores(report):
    """PSNR and SSIM by region: the model between floors and ceiling."""
    rows = [
        ("nearest frame, copied", report["floors"]["nearest_frame"]),
        ("neighbours, warped by the best plane", report["floors"]["plane_warp"]),
        ("zestjax, zero-shot", report["mean"]),
        ("inputs carried by the true depth and motion (ceiling)", report["ceiling"]),
    ]
    cells = lambda scores: [
        f"{scores[r]['psnr']:.2f} / {scores[r]['ssim']:.3f}" if scores and scores.get(r) else "–" for r in REGIONS
    ]
    return table(
        ["PSNR (dB) / SSIM", *(f"{region} pixels" for region in REGIONS)],
        [[name, *cells(scores)] for name, scores in rows], marked=[2], mark="ours",
    )  # fmt: skip


def _clock(report):
    mean, floor = report["mean"], better_floor(report["floors"])
    share = share_of_the_way(mean, report["floors"], report["ceiling"])
    said = f"{mean['full']['psnr'] - floor:+.2f} dB on the best floor" + (
        "" if share is None else f", {100 * share:.0f} % of the way to the ceiling"
    )
    return (
        f"<p>{said}. {mean['seconds_per_frame']:.2f} s a frame, {report['prepare_seconds']:.1f} s once for the video, "
        f"{report['compile_seconds']:.0f} s to compile, {report['total_seconds']:.0f} s for this whole page, on "
        f"{html.escape(report['device'])}.</p>"
    )


def _targets(report):
    rows = []
    for target in report["targets"]:
        link = f'<a href="{html.escape(target["file"])}">time {target["time"]}, {html.escape(target["camera"])}</a>'
        psnrs = [f"{target[r]['psnr']:.2f}" if target.get(r) else "–" for r in REGIONS]
        rows.append([link, *psnrs, f"{target['seconds']:.2f}"])
    return table(["target", *(f"{region} dB" for region in REGIONS), "seconds"], rows)


def _stereo(stereo):
    floors = stereo["floors"]
    return (
        "<p>Two photographs (Middlebury 2014, as they ship with scikit-image), the camera half-way between them. Mean "
        f"relative depth error {stereo['depth_abs_rel']:.3f} against the true disparity. Half-way, against both "
        f"pictures carried there by the true disparity ({100 * stereo['known_share']:.0f} % of the pixels): "
        f"{stereo['middle_psnr']:.2f} dB; nearest frame {floors['nearest_frame']:.2f}, plane warp "
        f"{floors['plane_warp']:.2f}. {stereo['seconds_per_frame']:.2f} s a frame.</p>"
    )
