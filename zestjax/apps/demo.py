"""`zestjax demo`: scenes that the shipped weights have never seen, from new cameras, beside the truth and the clock."""

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from zestjax import metrics
from zestjax.apps.evaluate import EvaluateOptions, Renderer, floor_images, score_scene, timed
from zestjax.apps.paths import camera_path
from zestjax.apps.progress import progress
from zestjax.apps.report import write_report
from zestjax.apps.results import write_record
from zestjax.apps.scenes import BENCH_SIZE, open_scene
from zestjax.apps.scoring import number, score_depth
from zestjax.apps.stereo import stereo_scene
from zestjax.apps.weights import arithmetic, open_weights
from zestjax.io.figures import depth_picture, error_picture, share_picture, side_by_side
from zestjax.io.pictures import write_image
from zestjax.io.scenes import Target
from zestjax.io.video import write_video

SCENE, TIMES, FILM = "walker", (2, 8, 13, 19), 20


@arithmetic()
def demo(out, *, quiet=False, weights=None):
    """Run `zestjax demo`.

    Args:
      out: folder; gets `metrics.json`, `side_by_side.png`, `video.*` and `report.html` with what it shows.
      quiet: no progress.
      weights: None for the shipped ones.

    Returns:
      str, the summary line.

    Raises:
      WeightsError: the weights cannot be used.
    """
    out, model = Path(out), open_weights(weights)
    options = EvaluateOptions(scene=f"bench:{SCENE}", out=out, targets=TIMES, quiet=quiet)
    (report, film), seconds = timed(lambda: _bench(model, options, out, quiet))
    report["stereo"], report["stereo"]["total_seconds"] = timed(lambda: _stereo(model, out))
    report["total_seconds"] = number(seconds + report["stereo"]["total_seconds"])
    write_record(out / "metrics.json", report)
    page = write_report(out, report, film)
    mean = report["mean"]
    return (
        f"demo: {SCENE}, never seen in training: {mean['full']['psnr']:.2f} dB, "
        f"{mean['seconds_per_frame']:.2f} s a frame, {report['total_seconds']:.0f} s in all: {page}"
    )


def _bench(model, options, out, quiet):
    """Scores, pictures and film of the zest-bench scene: (dict for metrics.json, film's path)."""
    opened = open_scene(options.scene, model.recipe, targets=options.targets)
    view_of, frames = Renderer(model, opened.scene.video, steady=True), []
    report = score_scene(view_of, opened, options, out)
    shutil.copyfile(out / report["targets"][0]["file"], out / "side_by_side.png")
    path = camera_path("orbit", opened.scene.video, count=FILM)
    for i in progress(range(FILM), "film", quiet=quiet):
        view, _ = view_of(jax.tree.map(lambda leaf, i=i: leaf[i], path.cameras), int(path.times[i]))
        frames.append(np.clip(np.asarray(view.colour, np.float32), 0, 1))
    return report, write_video(out / "video", np.stack(frames), fps=12)


def _stereo(model, out):
    """The real stereo pair: its true depth, and the view half-way against both pictures carried there by it."""
    stereo = stereo_scene(*BENCH_SIZE)  # the size of the other scene: nothing new is compiled
    video, view_of = stereo.video, Renderer(model, stereo.video)
    left = jax.tree.map(lambda leaf: leaf[0], video.cameras)
    at_left, _ = view_of(left, 1)
    middle, seconds = view_of(stereo.middle, 0)
    target = Target(time=0, camera_name="middle", camera=stereo.middle, image=stereo.middle_image)
    nearest, warped = floor_images(view_of.video, target)
    psnr = lambda image: number(
        metrics.psnr(
            jnp.clip(jnp.asarray(image, jnp.float32), 0, 1),
            jnp.asarray(stereo.middle_image, jnp.float32),
            mask=jnp.asarray(stereo.middle_known, jnp.float32),
        )  # fmt: skip
    )
    bounds = dict(near=float(video.near), far=float(video.far))
    image = np.clip(np.asarray(middle.colour, np.float32), 0, 1)
    known = stereo.middle_known[..., None]
    pictures = {
        "left input": np.asarray(video.images[0]), "view half-way": image,
        "carried by the true disparity": stereo.middle_image,
        "error": error_picture(np.where(known, image, 0), stereo.middle_image * known),
        "depth at the left": depth_picture(np.asarray(at_left.depth), **bounds),
        "true depth": depth_picture(stereo.depth, **bounds),
        "dynamicness": share_picture(np.asarray(middle.dynamicness)),
    }  # fmt: skip
    write_image(out / "stereo.png", side_by_side(list(pictures.values()), labels=list(pictures), columns=4))
    return {
        "depth_abs_rel": score_depth(at_left.depth, stereo.depth), "middle_psnr": psnr(middle.colour),
        "floors": {"nearest_frame": psnr(nearest), "plane_warp": psnr(warped)},
        "known_share": number(stereo.middle_known.mean()), "seconds_per_frame": number(seconds),
        "height": int(video.images.shape[1]), "width": int(video.images.shape[2]), "picture": "stereo.png",
    }  # fmt: skip
