"""Views of a video by a setting: rendered at its size, and brought back to the video's own."""

import jax
import numpy as np

from zestjax.apps.evaluate import Renderer
from zestjax.cameras import resized
from zestjax.io.pictures import resize_area, resize_nearest


def scaled_video(video, scale):
    """A video resized by area, its cameras with it."""
    if scale == 1:
        return video
    have = video.images.shape[1:3]
    size = tuple(max(1, round(side * scale)) for side in have)
    images = np.stack([resize_area(np.asarray(image), *size) for image in video.images])
    cameras = resized(video.cameras, size[1] / have[1], size[0] / have[0])
    return video._replace(images=images, cameras=jax.tree.map(np.asarray, cameras))


class ScaledRenderer:
    """As `evaluate.Renderer`, at a setting's size and with its system; cameras and views are of the video's own size.

    prepared_by: another of the same size, whose preparation serves this one too.
    """

    def __init__(self, model, video, setting, *, steady=False, prepared_by=None):
        self.setting, self.size = setting, video.images.shape[1:3]
        system = setting.of(model.system)
        if prepared_by is None:
            self.renderer = Renderer(model, scaled_video(video, setting.scale), steady=steady, system=system)
        else:
            self.renderer = prepared_by.renderer.running(system)
        small = self.renderer.video.images.shape[1:3]
        self.factors = tuple(new / old for new, old in zip(small[::-1], self.size[::-1], strict=True))

    @property
    def prepare_seconds(self):
        """Of preparing the video at that size, once compiled; None where that is not known."""
        return self.renderer.prepare_seconds

    def __call__(self, camera, frame_time, exclude=()):
        """(`View` of the video's size, seconds of rendering it at the setting's)."""
        view, seconds = self.renderer(resized(camera, *self.factors), frame_time, exclude)
        return view if self.factors == (1, 1) else enlarged(view, self.size, self.factors), seconds


class Renderers:
    """A `ScaledRenderer` of each setting asked for; one after another at the same size prepare the video once."""

    def __init__(self, model, video):
        self.model, self.video, self.last = model, video, None

    def __call__(self, setting):
        """The setting's."""
        same = self.last is not None and self.last.setting.scale == setting.scale
        by = self.last if same else None
        self.last = ScaledRenderer(self.model, self.video, setting, steady=True, prepared_by=by)
        return self.last


def enlarged(view, size, factors):
    """A `View` brought to a size (height, width), `factors` (across, down) of which it has; numpy float32."""

    def picture(leaf):
        return None if leaf is None else resize_area(np.clip(np.asarray(leaf, np.float32), 0, 1), *size)

    flow = None
    if view.flow is not None:
        flow = resize_nearest(np.asarray(view.flow, np.float32), *size) / np.float32(factors)
    depth = resize_nearest(np.asarray(view.depth, np.float32), *size)
    pictures = {
        name: picture(getattr(view, name)) for name in ("colour", "static", "dynamic", "opacity", "dynamicness")
    }
    return view._replace(**pictures, depth=depth, flow=flow)
