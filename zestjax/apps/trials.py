"""What settings cost and give on targets: measured once each, kept in a file, summed up in rows.

trial    one setting on one target: scores by region, seconds, memory; a line of `trials.jsonl`
row      one setting: the mean of its trials, beside the same targets as trained
"""

import dataclasses
import json
import time
from pathlib import Path

import jax
import numpy as np

from zestjax.apps.energy import joules, joules_since
from zestjax.apps.memory import held_megabytes, peak_megabytes, reset_peak
from zestjax.apps.own import own_psnr
from zestjax.apps.scaled import ScaledRenderer
from zestjax.apps.scoring import REGIONS, half_width, mean_scores, number, score_depth, score_image
from zestjax.apps.settings import TRAINED, Setting
from zestjax.io.files import append_bytes, write_bytes
from zestjax.io.reading import parse_json, read_regular

MOST_TRIALS = 2**26  # bytes of a file of trials: a hundred thousand lines


class Trials:
    """Settings of a model on targets of scenes.

    model: `weights.Model`. scenes: `io.scenes.Scene`s. repeats: renderings of each target, of which the middle seconds
    count. lpips: `LpipsParams` or None. file: of the trials; what it has is not measured again. targets: (scene's
    number, target) of all, a round of the scenes at a time, so that the first few are of many scenes.
    """

    def __init__(self, model, scenes, file, *, repeats=1, lpips=None, tick=lambda: None):
        self.model, self.scenes, self.file, self.lpips, self.repeats = model, scenes, Path(file), lpips, repeats
        rounds = max(len(scene.targets) for scene in scenes)
        pairs = [
            (i, scene.targets[r]) for r in range(rounds) for i, scene in enumerate(scenes) if r < len(scene.targets)
        ]
        self.targets, self.done, self.together, self.tick = pairs, {}, {}, tick
        self._renderers, self._warm = {}, set()

    def begin(self, header, *, resume):
        """Take up the trials of a file whose first line is the same header, or begin a new one.

        Raises:
          ValueError: the file holds the trials of something else.
        """
        if not resume or not self.file.exists():
            write_bytes(self.file, (json.dumps(header) + "\n").encode())
            return
        first, *lines = [parse_json(line) for line in read_regular(self.file, most=MOST_TRIALS).splitlines()]
        if first != header:
            raise ValueError(f"{self.file}: has trials of something else; drop --resume, or give another folder.")
        for line in lines:
            setting = Setting(**line["setting"])
            if "together" in line:
                self.together[setting] = line["together"]
            else:
                self.done[setting, line["target"]] = line["trial"]

    def measured(self, setting, count):
        """(seconds, decibels) of a setting on the first so many targets; see `row`."""
        if (setting, 0) not in self.done:
            self.tick()
        for index in range(count):
            if (setting, index) not in self.done:
                self._keep(setting, index, self._trial(setting, index))
        row = self.row(setting)
        return row["seconds_per_frame"], row["psnr_full"]

    def time_together(self, settings, rounds):
        """Seconds of one target by each setting, all in turn, so that what else the machine does slows all alike."""
        untimed = [setting for setting in settings if setting not in self.together]
        target, found = self.targets[0][1], {setting: [] for setting in untimed}
        views = {setting: self._renderer(setting, 0)[0] for setting in untimed}
        for turn in range(rounds + 1):
            for setting, view_of in views.items():
                start = time.process_time()
                _, spent = view_of(target.camera, target.time, target.exclude)
                if turn:  # the first one may compile
                    found[setting].append(number(own_seconds(spent, time.process_time() - start)))
        for setting in untimed:
            self.together[setting] = found[setting]
            self._write({"setting": dataclasses.asdict(setting), "together": found[setting]})

    def _write(self, line):
        append_bytes(self.file, (json.dumps(line) + "\n").encode())

    def _keep(self, setting, index, trial):
        self.done[setting, index] = trial
        self._write({"setting": dataclasses.asdict(setting), "target": index, "trial": trial})

    def _trial(self, setting, index):
        number_of_scene, target = self.targets[index]
        view_of, prepared = self._renderer(setting, number_of_scene)
        show = lambda: view_of(target.camera, target.time, target.exclude)
        if setting not in self._warm:
            show()  # compiles
            self._warm.add(setting)
        reset_peak()
        held, energy = held_megabytes() or 0.0, joules()
        start = time.process_time()
        shown = [show() for _ in range(self.repeats)]
        processor = (time.process_time() - start) / self.repeats
        view, seconds = shown[-1][0], [spent for _, spent in shown]
        peak, used = peak_megabytes(), joules_since(energy)
        working = None if peak is None else max(peak - held, prepared["mb"] or 0.0)
        return {
            **score_image(view.colour, target.image, target.dynamic, lpips=self.lpips),
            "depth_abs_rel": score_depth(view.depth, target.depth),
            "seconds": number(np.median(seconds)), "cpu_seconds": number(processor),
            "prepare_seconds": prepared["seconds"], "peak_mb": peak, "working_mb": working,
            "joules": None if used is None else used / self.repeats,
        }  # fmt: skip

    def _renderer(self, setting, index):
        """A renderer of a scene, and what preparing it took; prepared once for all settings of a size."""
        have = self._renderers.get((index, setting.scale))
        if have is None:
            if len(self._renderers) >= 2 * len(self.scenes):
                self._renderers = {key: kept for key, kept in self._renderers.items() if key[1] == setting.scale}
            reset_peak()
            held = held_megabytes()
            known = any(scale == setting.scale for _, scale in self._renderers)  # then its seconds are, too
            first = ScaledRenderer(self.model, self.scenes[index].video, setting, steady=not known)
            peak = peak_megabytes()
            mb = None if peak is None or held is None else peak - held
            have = first, {"seconds": first.prepare_seconds, "mb": mb}
            self._renderers[index, setting.scale] = have
        return ScaledRenderer(self.model, self.scenes[index].video, setting, prepared_by=have[0]), have[1]

    def shown(self, setting, index):
        """(`View` of a target by a setting, the truth)."""
        place, target = self.targets[index]
        view, _ = self._renderer(setting, place)[0](target.camera, target.time, target.exclude)
        return view, target.image

    def own_psnr(self):
        """Mean over the scenes of `own.own_psnr` as trained."""
        return float(np.mean([own_psnr(self._renderer(TRAINED, i)[0], s.video) for i, s in enumerate(self.scenes)]))

    def row(self, setting):
        """A setting's means. Decibels are those as trained on all targets that it was measured on, plus the mean
        difference on the setting's own: settings that were dropped early can be compared with the others."""
        own = {i: trial for (tried, i), trial in self.done.items() if tried == setting}
        base = {i: trial for (tried, i), trial in self.done.items() if tried == TRAINED}
        shared = sorted(own.keys() & base.keys())
        mean, trained = mean_scores(list(own.values())), mean_scores(list(base.values()))
        rest = mean_scores([base[i] for i in shared])
        assert isinstance(mean, dict) and isinstance(trained, dict) and isinstance(rest, dict)
        gains = np.array([own[i]["full"]["psnr"] - base[i]["full"]["psnr"] for i in shared])
        each = [own_seconds(trial["seconds"], trial["cpu_seconds"]) for trial in own.values()]
        seconds = np.array(self.together.get(setting, each))
        found: dict = {"targets": len(own)}
        for region in REGIONS:
            for name in ("psnr", "ssim", "lpips"):
                found[f"{name}_{region}"] = _moved(mean, trained, rest, region, name)
        low, high = interval(gains)
        known = [trial["prepare_seconds"] for trial in own.values() if trial["prepare_seconds"] is not None]
        full = found["psnr_full"]
        return found | {
            "psnr_low": full + low - gains.mean(), "psnr_high": full + high - gains.mean(), "gain": float(gains.mean()),
            "gain_low": low, "gain_high": high, "depth_abs_rel": mean["depth_abs_rel"],
            "seconds_per_frame": float(np.median(seconds)), "seconds_low": float(np.quantile(seconds, 0.1)),
            "seconds_high": float(np.quantile(seconds, 0.9)),
            "cpu_seconds": float(np.median([trial["cpu_seconds"] for trial in own.values()])),
            "clock_seconds": float(np.median([trial["seconds"] for trial in own.values()])),
            "prepare_seconds": min(known, default=None), "peak_mb": mean["peak_mb"], "working_mb": mean["working_mb"],
            "joules_per_frame": mean["joules"],
        }  # fmt: skip


def own_seconds(clock, processor):
    """Seconds of a frame apart from what else a machine does, as far as it tells: on one core of a CPU the processor's
    own are the fewer; on more cores, and beside an accelerator, those on the clock count."""
    return min(clock, processor) if jax.default_backend() == "cpu" else clock


def interval(values):
    """(low, high) that holds the mean of all such values, see `scoring.half_width`; both the mean of a single one."""
    mean, half = float(np.mean(values)), half_width(values) or 0.0
    return mean - half, mean + half


def _moved(mean, trained, rest, region, name):
    """A score of a setting's own targets, moved to what it would be on all of them; None where it is not known."""
    parts = [scores[region] and scores[region][name] for scores in (mean, trained, rest)]
    return None if None in parts else parts[0] + parts[1] - parts[2]
