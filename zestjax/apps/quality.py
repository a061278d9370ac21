"""What `prepare` found, and what of it is in doubt: `quality.json` for programs, `quality.html` for people."""

import html
import json

import numpy as np

from zestjax.apps.pages import embedded, write_page
from zestjax.apps.report import STYLE
from zestjax.io.figures import png_of, side_by_side
from zestjax.io.files import write_bytes
from zestjax.io.pictures import encoded_png

MOST_ERROR = 1.0  # pixels, median of a frame: sound frames stay below half of one
LEAST_ANGLE = 2.0  # degrees between a point's rays: below, depths are off by a tenth and more
LEAST_FEATURES = 100  # a frame, of which a tenth may serve its camera
LEAST_SERVING = 30  # observations of a frame: six unknowns, and as many again that are noise
MOST_DRIFT = 1.5  # pixels between far frames, and twice what near ones have
MOST_FOCAL_ERROR = 0.1  # as a share: depths are off by as much
MOST_MOVING = 0.5  # share of a frame: then what stands still no longer outnumbers what moves
LEAST_SURE = 0.5  # share of a frame whose flow is consistent there and back
BLURRED = 0.3  # of the frames' median sharpness
SHOWN = 8  # frames on the page


def quality_of(source, told, cameras, flows, maps, *, given):
    """The report.

    Args:
      source: as the user named it.
      told: dict of the frames, from `prepare`'s first stage.
      cameras: `Estimated`.
      flows: list of `FlowPair` between its registered frames.
      maps: `Maps` of them.
      given: the focal length was not estimated.

    Returns:
      dict, `quality.json`.
    """
    index, width = np.flatnonzero(cameras.registered), told["size"][1]
    share = lambda values: [round(float(value), 4) for value in values]
    place = lambda i: told["names"][i] if told["names"] else told["chosen"][i]
    report = {
        "source": source, "camera": cameras.kind, "height": told["size"][0], "width": width,
        "frames": {
            "found": told["found"], "repeated": told["repeated"], "chosen": len(told["chosen"]),
            "registered": len(index), "sources": [place(i) for i in index],
            "unregistered": [place(i) for i in np.flatnonzero(~cameras.registered)],
        },
        "focal": {
            "pixels": round(cameras.focal, 3), "given": given, "relative_error": _number(cameras.focal_error),
            "degrees_across": round(float(np.degrees(2 * np.arctan(width / 2 / cameras.focal))), 2),
        },
        "near": round(cameras.near, 5), "far": round(cameras.far, 5), "points": cameras.points,
        "median_angle_degrees": round(cameras.angle, 3),
        "reprojection_px": {
            "median": _number(_median(cameras.errors)), "by_frame": [_number(x) for x in cameras.errors[index]],
        },
        "drift_px": {"near": round(cameras.near_gap, 3), "far": round(cameras.far_gap, 3)},
        "features": cameras.features[index].tolist(), "observations": cameras.observations[index].tolist(),
        "sharpness": share(np.array(told["sharpness"])[index]), "moving_share": share(maps.moving.mean((1, 2))),
        "flow_sure_share": share([(pair.sure_there > 0.3).mean() for pair in flows]),
        "disparity": maps.disparity is not None,
    }  # fmt: skip
    return report | {"doubts": doubts_of(report)}


def doubts_of(report):
    """What of a report without them is in doubt: [{"what", "says", "advice"}]."""
    found = [*_of_camera(report), *_of_frames(report), *_of_geometry(report)]
    return [{"what": what, "says": says, "advice": advice} for what, says, advice in found]


def _of_camera(report):
    cannot = "its depths are unknown and no disparity is written; frames between its own can be rendered, views from "
    cannot += "elsewhere cannot: for those move the camera sideways"
    if report["camera"] == "still":
        yield "still camera", "the camera stands still", cannot
    if report["camera"] == "turning":
        yield "no parallax", "the camera only turns, or all it sees is one plane", cannot
    if report["camera"] != "moving" and not report["focal"]["given"]:
        yield "focal length", "the focal length is a guess, as nothing shows it", "give --fov or --focal if it is known"


def _of_frames(report):
    frames = report["frames"]
    if lost := frames["unregistered"]:
        listed = ", ".join(map(str, lost[:5])) + (", ..." if len(lost) > 5 else "")
        yield (
            "unregistered",
            f"{len(lost)} of {frames['chosen']} frames have no camera ({listed}) and are left out",
            ("look whether they are blurred, or of another scene"),
        )
    few = _where(report, "features", lambda x: x < LEAST_FEATURES)
    if few:
        yield (
            "few features",
            f"{len(few)} frames have under {LEAST_FEATURES} features ({_some(few)})",
            ("a larger --height, more light or more texture help"),
        )
    middle = float(np.median(report["sharpness"]))
    if blurred := _where(report, "sharpness", lambda x: x < BLURRED * middle):
        yield (
            "blurred",
            f"{len(blurred)} frames are far less sharp than the others ({_some(blurred)})",
            ("fewer --frames choose among more"),
        )
    if moving := _where(report, "moving_share", lambda x: x > MOST_MOVING):
        yield (
            "much motion",
            f"more than half of {len(moving)} frames moves ({_some(moving)})",
            ("cameras may follow what moves instead of what stands: look at the masks"),
        )
    if unsure := _where(report, "flow_sure_share", lambda x: x < LEAST_SURE):
        yield (
            "unsure flow",
            f"the flow after {len(unsure)} frames is sure of less than half of them ({_some(unsure)})",
            ("more --frames make steps smaller"),
        )


def _of_geometry(report):
    if report["camera"] != "moving":
        return
    errors, drift, focal = report["reprojection_px"]["by_frame"], report["drift_px"], report["focal"]
    if bad := [i for i, error in enumerate(errors) if error is None or error > MOST_ERROR]:
        yield (
            "reprojection error",
            f"{len(bad)} frames are off by over {MOST_ERROR:g} pixel ({_some(bad)})",
            ("a lens with distortion does that, or a rolling shutter: undistort the video"),
        )
    if weak := _where(report, "observations", lambda x: x < LEAST_SERVING):
        yield (
            "weak frames",
            f"{len(weak)} cameras rest on under {LEAST_SERVING} points ({_some(weak)})",
            ("a larger --height or more --frames help"),
        )
    if report["median_angle_degrees"] < LEAST_ANGLE:
        yield (
            "little parallax",
            f"points are seen from within {report['median_angle_degrees']:.1f} degrees",
            ("depths are weak: a longer path sideways helps"),
        )
    if drift["far"] > MOST_DRIFT and drift["far"] > 2 * drift["near"]:
        yield (
            "drift",
            f"frames far apart disagree by {drift['far']:.1f} pixels, near ones by {drift['near']:.1f}",
            ("a shorter part of the video, or more --frames, help"),
        )
    if not focal["given"] and focal["relative_error"] is None:
        yield (
            "focal length",
            "the focal length is a guess, as too little stands still to tell",
            ("give --fov or --focal if it is known"),
        )
    elif not focal["given"] and focal["relative_error"] > MOST_FOCAL_ERROR:
        yield (
            "focal length",
            f"the focal length is known to {100 * focal['relative_error']:.0f} % only",
            ("give --fov or --focal if it is known"),
        )


def _where(report, name, doubtful):
    return [i for i, value in enumerate(report[name]) if doubtful(value)]


def _some(frames):
    return "frame " + ", ".join(map(str, frames[:5])) + (", ..." if len(frames) > 5 else "")


def _number(value):
    return None if value is None or not np.isfinite(value) else round(float(value), 4)


def _median(values):
    known = values[np.isfinite(values)]
    return np.median(known) if len(known) else None


def write_quality(folder, report, images, moving, cameras):
    """Write `quality.json` and `quality.html`, which needs no other file.

    Args:
      folder: the scene's.
      report: dict of `quality_of`.
      images: (N, H, W, 3) uint8, registered frames.
      moving: (N, H, W) bool.
      cameras: `Estimated`.
    """
    write_bytes(folder / "quality.json", (json.dumps(report, indent=1) + "\n").encode())
    frames, focal = report["frames"], report["focal"]
    doubts = "".join(
        f"<li><b>{html.escape(d['what'])}</b>: {html.escape(d['says'])}; {html.escape(d['advice'])}.</li>"
        for d in report["doubts"]
    )
    known = "given" if focal["given"] else f"estimated, to {100 * (focal['relative_error'] or 0):.1f} %"
    error = report["reprojection_px"]["median"]
    parts = [
        f"<h1>{html.escape(report['source'])}</h1>",
        f"<p>{frames['registered']} frames of {report['height']}x{report['width']}, out of {frames['found']}; the "
        f"camera: {report['camera']}; focal length {focal['pixels']:.1f} pixels, {focal['degrees_across']:.0f} degrees "
        f"across ({known}).</p>",
        f"<h2>In doubt</h2><ul>{doubts}</ul>" if doubts else "<p>Nothing is in doubt.</p>",
        f"<p>{report['points']} points, median error {'unknown' if error is None else f'{error:.2f} pixels'}, seen "
        f"from {report['median_angle_degrees']:.1f} degrees apart; near {report['near']:.2f}, far {report['far']:.2f}."
        "</p>",
        _picture(png_of(_plots(report, cameras)), "path, errors and moving share by frame"),
        "<h2>What moves, in red</h2>", _picture(encoded_png(_sheet(images, moving)), "frames with masks"),
    ]  # fmt: skip
    write_page(folder / "quality.html", "zestjax prepare", parts, style=STYLE)


def _picture(png, alt):
    return f'<img src="{embedded(png)}" alt="{alt}">'


def _sheet(images, moving):
    """Frames with what moves in red."""
    chosen = np.unique(np.linspace(0, len(images) - 1, SHOWN).astype(int))
    red = np.array([255, 0, 0], np.float32)
    mixed = [np.where(moving[i][..., None], (images[i] + red) / 2, images[i]).astype(np.uint8) for i in chosen]
    return side_by_side(mixed, labels=[f"frame {i}" for i in chosen], columns=4)


def _plots(report, cameras):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.6), layout="constrained")
    path, errors, moving = figure.subplots(1, 3)
    places = cameras.poses[cameras.registered][:, :3, 3]
    path.plot(places[:, 0], places[:, 2], "o-", markersize=3, linewidth=0.8)
    path.set_title("cameras from above", fontsize=9)
    errors.plot([np.nan if error is None else error for error in report["reprojection_px"]["by_frame"]])
    errors.set_title("reprojection error, pixels", fontsize=9)
    moving.plot(report["moving_share"])
    moving.set_title("share that moves", fontsize=9)
    for axes in (path, errors, moving):
        axes.tick_params(labelsize=7)
    return figure
