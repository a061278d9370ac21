"""The frontier as a picture, `frontier.png`."""

from zestjax.io.figures import png_of
from zestjax.io.files import write_bytes


def draw(path, rows, title):
    """Write the plot: seconds against PSNR, the frontier joined and its settings named, with their intervals."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    best = sorted((row for row in rows if row["pareto"]), key=lambda row: row["seconds_per_frame"])
    rest = [row for row in rows if not row["pareto"]]
    places = lambda some: ([row["seconds_per_frame"] for row in some], [row["psnr_full"] for row in some])
    axes.plot(*places(rest), "o", color="0.75", label="other settings", zorder=0)
    reach = [
        [row["psnr_full"] - row["psnr_low"] for row in best],
        [row["psnr_high"] - row["psnr_full"] for row in best],
    ]
    axes.errorbar(*places(best), yerr=reach, fmt="o-", color="C0", ecolor="0.6", elinewidth=1, label="frontier")
    for i, row in enumerate(best):  # to the left above and to the right below in turns: neighbours' names do not meet
        place, left = (row["seconds_per_frame"], row["psnr_full"]), i % 2 == 0
        offset, ha, va = ((-5, 4), "right", "bottom") if left else ((5, -4), "left", "top")
        axes.annotate(row["setting"], place, offset, textcoords="offset points", fontsize=7, ha=ha, va=va)
    axes.set(xlabel="seconds per frame", ylabel="PSNR, full image (dB)", title=title, xscale="log")
    axes.legend(loc="lower right")
    write_bytes(path, png_of(figure))
