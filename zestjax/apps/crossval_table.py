"""The table of a cross-validation: means over scenes, and differences between systems, with 95 % intervals.

row       a system with one value of each setting; its seeds are averaged, target by target
interval  Student's t over scenes, which are independent; the targets of one scene are not, and only their mean counts.
          Within a scene it is over the scene's targets, and says how even the difference is there
paired    a row's scores minus the first row's, target by target, over the targets that both have
"""

import csv
import io
from pathlib import Path

import numpy as np

from zestjax.apps.fold_state import Place, finished
from zestjax.apps.results import read_record, write_record
from zestjax.apps.scoring import REGIONS, half_width, number
from zestjax.apps.tables import counted
from zestjax.io.files import write_bytes

METRICS = ("psnr", "ssim", "lpips")
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3, "seconds": 2}
SHOWN = (("full", "psnr"), ("full", "ssim"), ("full", "lpips"), ("dynamic", "psnr"), ("static", "psnr"))


def interval(values):
    """Mean and confidence interval of numbers: {"mean", "low", "high", "n"}; of one number no bounds; of none None."""
    values = np.asarray([value for value in values if value is not None], np.float64)
    if not len(values):
        return None
    half = half_width(values)
    low, high = (None, None) if half is None else (number(values.mean() - half), number(values.mean() + half))
    return {"mean": number(values.mean()), "low": low, "high": high, "n": len(values)}


def write_tables(out, plan):
    """Merge what is finished: writes table.md, table.csv, table.tex and table.json, and returns what the last holds.

    Returns:
      dict: folds, finished (counts), missing (labels), codes (of the folds' code), rows and paired (see above), and by
      row and scene `scenes` (metrics.json's means) and `images` (its targets).

    Raises:
      ValueError: a folder holds another fold's result.
    """
    out, rows = Path(out), {fold.row: {} for fold in plan.folds}
    missing, codes = [], set()
    for fold in plan.folds:
        told = finished(out, plan, fold)
        metrics = read_record(Place(out, fold).result / "metrics.json")
        if told is None or "targets" not in metrics:
            missing.append(fold.label)
            continue
        codes.add(told.get("code"))
        rows[fold.row].setdefault(fold.name, []).append((fold, metrics))
    first = next(iter(rows))
    table = {
        "folds": len(plan.folds), "finished": len(plan.folds) - len(missing), "missing": missing,
        "codes": sorted(map(str, codes)), "rows": [_row(row, found, plan) for row, found in rows.items()],
        "paired": [_paired(row, found, first, rows[first]) for row, found in rows.items() if row != first],
        "scenes": {row: {name: [metrics["mean"] for _, metrics in folds] for name, folds in found.items()}
                   for row, found in rows.items()},
        "images": {row: {name: [_image(fold, t) for fold, metrics in folds for t in metrics["targets"]]
                         for name, folds in found.items()} for row, found in rows.items()},
    }  # fmt: skip
    write_record(out / "table.json", table)
    for suffix, written in (("md", markdown), ("csv", comma_separated), ("tex", latex)):
        write_bytes(out / f"table.{suffix}", written(table).encode())
    return table


def _image(fold, target):
    """A target's row, its picture seen from the cross-validation's folder."""
    file = None if target["file"] is None else f"folds/{fold.variant}/{fold.name}/{target['file']}"
    return {"seed": fold.seed, **target, "file": file}


def _score(scores, region, metric):
    return (scores.get(region) or {}).get(metric)


def _row(row, found, plan):
    """A row's intervals over scenes, `found`: {scene: [(fold, metrics)]}."""
    over = lambda read: interval([_mean([read(metrics["mean"]) for _, metrics in folds]) for folds in found.values()])
    count, of = sum(map(len, found.values())), sum(fold.row == row for fold in plan.folds)
    scores = {r: {m: over(lambda mean, r=r, m=m: _score(mean, r, m)) for m in METRICS} for r in REGIONS}
    return {"row": row, "folds": count, "of": of, **scores, "seconds": over(lambda mean: mean["seconds_per_frame"])}


def _paired(row, found, first, against):
    """A row's differences from the first: by scene over its targets, and over scenes."""
    scenes = {name: _differences(found[name], against[name]) for name in found if name in against}
    over = lambda r, m: interval([d[r][m] and d[r][m]["mean"] for d in scenes.values()])
    return {"row": row, "against": first, **{r: {m: over(r, m) for m in METRICS} for r in REGIONS}, "scenes": scenes}


def _differences(folds, others):
    """{region: {metric: interval over targets}} of one scene."""
    ours, theirs = _by_target(folds), _by_target(others)
    shared = [target for target in ours if target in theirs]
    found = {}
    for region in REGIONS:
        for metric in METRICS:
            pairs = [(_of(ours[t], region, metric), _of(theirs[t], region, metric)) for t in shared]
            differences = [a - b for a, b in pairs if a is not None and b is not None]
            found.setdefault(region, {})[metric] = interval(differences)
    return found


def _by_target(folds):
    """{(time, camera): its rows, one a seed}."""
    found = {}
    for _, metrics in folds:
        for target in metrics["targets"]:
            found.setdefault((target["time"], target["camera"]), []).append(target)
    return found


def _of(targets, region, metric):
    return _mean([_score(target, region, metric) for target in targets])


def _mean(values):
    values = [value for value in values if value is not None]
    return sum(values) / len(values) if values else None


def _text(found, digits, sign=""):
    """`26.30 ± 1.20`, half of the interval; a number that is not known is a dash."""
    if found is None or found["mean"] is None:
        return "–"
    half = "" if found["low"] is None else f" ± {(found['high'] - found['low']) / 2:.{digits}f}"
    return f"{found['mean']:{sign}.{digits}f}{half}"


def _cells(table):
    """The rows' table and the paired one, each a list of lists of texts, the head first."""
    head = ["system", "folds", *(f"{region} {metric.upper()}" for region, metric in SHOWN), "s / frame"]
    rows = [[row["row"], f"{row['folds']} of {row['of']}", *(_text(row[r][m], DIGITS[m]) for r, m in SHOWN),
             _text(row["seconds"], DIGITS["seconds"])] for row in table["rows"]]  # fmt: skip
    paired = [[f"{row['row']} - {row['against']}", str(len(row["scenes"])),
               *(_text(row[r][m], DIGITS[m], "+") for r, m in SHOWN)] for row in table["paired"]]  # fmt: skip
    return [head, *rows], [["difference", "scenes", *head[2:-1]], *paired] if paired else []


def _note(table):
    """What a table is of, in a sentence."""
    said = f"{table['finished']} of {counted(table['folds'], 'fold')} finished; mean over scenes ± 95 % interval"
    if len(table["codes"]) > 1:
        said += f"; the folds are of {len(table['codes'])} versions of the code ({', '.join(table['codes'])})"
    return said + (f"; not finished: {', '.join(table['missing'])}" if table["missing"] else "") + "."


def markdown(table):
    """The table as Markdown."""
    line = lambda cells: "| " + " | ".join(cells) + " |"
    parts = [[line(cells[0]), "|---" * len(cells[0]) + "|", *map(line, cells[1:])] for cells in _cells(table) if cells]
    return "\n\n".join([_note(table), *("\n".join(part) for part in parts)]) + "\n"


def latex(table):
    """The table as LaTeX, of no packages."""
    escaped = lambda text: (
        "".join(f"\\{c}" if c in "_&%#$" else c for c in text).replace("±", r"$\pm$").replace("–", "--")
    )
    parts = [f"% {_note(table)}".replace("±", "+-")]
    for cells in filter(None, _cells(table)):
        lines = [" & ".join(map(escaped, row)) + r" \\" for row in cells]
        parts += [f"\\begin{{tabular}}{{l{'r' * (len(cells[0]) - 1)}}}", r"\hline", lines[0], r"\hline", *lines[1:],
                  r"\hline", r"\end{tabular}"]  # fmt: skip
    return "\n".join(parts) + "\n"


def comma_separated(table):
    """Every interval of the rows as CSV: mean, low and high."""
    names = [(region, metric) for region in REGIONS for metric in METRICS]
    head = [f"{r}_{m}{end}" for r, m in [*names, ("seconds", "frame")] for end in ("", "_low", "_high")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["system", "folds", "of", *head])
    for row in table["rows"]:
        found = [*(row[r][m] for r, m in names), row["seconds"]]
        values = [one and one[key] for one in found for key in ("mean", "low", "high")]
        writer.writerow([row["row"], row["folds"], row["of"], *values])
    return text.getvalue()
