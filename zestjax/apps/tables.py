"""metrics.json as a line and as a table for people."""

from pathlib import Path

from zestjax.apps.results import write_record
from zestjax.apps.scoring import REGIONS, better_floor, mean_scores, share_of_the_way
from zestjax.io.files import write_bytes

SCORES = ("scene", "full PSNR / SSIM / LPIPS", "dynamic", "static")
FLOORS = {"nearest_frame": "nearest", "plane_warp": "plane warp", "flow_interpolation": "flow interpolation"}
"""Columns of floors; the last is there where the protocol has it."""
REST = ("ceiling", "above the best floor (full / dynamic / static)", "of the way", "depth", "flow px", "s / frame")


NEEDS = {
    "dynamic": ("score of dynamic and static pixels", "masks (motion_masks/, mv_masks/)"),
    "depth": ("depth error", "true depth (truth/)"),
    "flow": ("flow error", "true flow (truth/)"),
    "ceiling": ("ceiling", "the exact answers for held-out cameras that bench:NAME alone has"),
}
"""By what a scene may give: what a report has of it, and what that needs, in words."""


def lacking(name, given):
    """A sentence on what a scene's report cannot have, and why; None where it has all; `given`: names of `NEEDS`."""
    missing = [f"no {score} without {need}" for key, (score, need) in NEEDS.items() if key not in given]
    return f"{name}: {', '.join(missing)}; null in metrics.json" if missing else None


def counted(count, what):
    """A number of things: `1 frame`, `2 frames`."""
    return f"{count} {what}{'s' * (count != 1)}"


def headline(report):
    """PSNR by region against the best floor, and the seconds: one line."""
    mean = report["mean"]
    parts = []
    for region in REGIONS:
        floor = better_floor(report["floors"], region)
        if mean.get(region) and floor is not None:
            parts.append(
                f"{region} {mean[region]['psnr']:.2f} dB ({mean[region]['psnr'] - floor:+.2f} on the best floor)"
            )
    return f"{report['scene']}: {', '.join(parts)}, {mean['seconds_per_frame']:.2f} s a frame"


def write_table(out, reports):
    """Write `table.md` and `metrics.json`, the mean of the reports; returns that mean."""
    shared = {key: reports[0][key] for key in ("system", "protocol", "height", "width", "preset", "device", "weights")}
    means = {key: mean_scores([report[key] for report in reports]) for key in ("mean", "floors", "ceiling")}
    whole = {"scene": "mean", **shared, **means, "targets": [_placed(t, r) for r in reports for t in r["targets"]]}
    shown = [floor for floor in FLOORS if whole["floors"].get(floor)]
    head = (*SCORES, *(FLOORS[floor] for floor in shown), *REST)
    rows = [table_row(report, shown) for report in [*reports, whole]]
    table = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|", *rows]
    write_bytes(Path(out) / "table.md", ("\n".join(table) + "\n").encode())
    write_record(Path(out) / "metrics.json", whole)
    return whole


def _placed(target, report):
    """A target's row, with its scene and its file seen from the folder above."""
    file = None if target["file"] is None else f"{report['scene']}/{target['file']}"
    return {"scene": report["scene"], **target, "file": file}


def table_row(report, shown):
    """A scene's row, with these floors."""
    mean, floors, ceiling = report["mean"], report["floors"], report["ceiling"]
    psnrs = lambda scores: " / ".join(_shown(scores[r]["psnr"] if scores and scores.get(r) else None) for r in REGIONS)
    gains = []
    for region in REGIONS:
        floor = better_floor(floors, region)
        known = mean.get(region) and floor is not None
        gains.append(f"{mean[region]['psnr'] - floor:+.2f}" if known else "–")
    pairs = [
        f"{mean[r]['psnr']:.2f} / {_shown(mean[r]['ssim'], 3)} / {_lpips(mean[r])}" if mean.get(r) else "–"
        for r in REGIONS
    ]
    share = share_of_the_way(mean, floors, ceiling)
    cells = [
        report["scene"], *pairs, *(psnrs(floors.get(floor)) for floor in shown), psnrs(ceiling),
        " / ".join(gains), "–" if share is None else f"{100 * share:.0f} %", _shown(mean["depth_abs_rel"], 3),
        _shown(mean["flow_epe_px"]), _shown(mean["seconds_per_frame"]),
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def _lpips(scores):
    """LPIPS, which nothing else may stand for: its weights are not part of the package."""
    return "n/a" if scores.get("lpips") is None else f"{scores['lpips']:.3f}"


def _shown(value, digits=2):
    return "–" if value is None else f"{value:.{digits}f}"
