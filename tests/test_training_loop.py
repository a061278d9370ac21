"""The loop around the steps: logs, checkpoints, and the same numbers after any kind of interruption."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from zestjax.apps import clips, producer, run_folder
from zestjax.apps.log import read_log
from zestjax.apps.loop import LoopOptions, run_loop
from zestjax.apps.scenes import digest
from zestjax.apps.train import TrainOptions, run_metadata, run_recipe, summarise
from zestjax.cameras import Camera
from zestjax.io.checkpoints import latest_checkpoint
from zestjax.io.weights import WeightsError, load_weights, save_weights
from zestjax.solve import Adam
from zestjax.train.recipes import recipe_of
from zestjax.train.training import TrainState, batch_key
from zestjax.video import Video

RUN = {"recipe": {"width": 3}, "seed": 7, "data": "toy"}


def toy_step(params, opt_state, batch):
    """Gradient descent with momentum on |params - batch|^2."""
    grads = jax.tree.map(lambda p: p - batch, params)
    opt_state = jax.tree.map(lambda m, g: 0.9 * m + g, opt_state, grads)
    return jax.tree.map(lambda p, m: p - 0.1 * m, params, opt_state), opt_state, {"total": jnp.sum(grads["w"] ** 2)}


def toy_state():
    return TrainState({"w": jnp.zeros(3, jnp.float32)}, {"w": jnp.zeros(3, jnp.float32)}, 0)


def toy_batch(step):
    return jax.random.normal(batch_key(step, seed=7), (3,))


def options(out, steps, **changes):
    return LoopOptions(out, steps, quiet=True, log_steps=2, checkpoint_seconds=0.0, **changes)


@pytest.fixture
def whole(tmp_path):
    """Ten uninterrupted steps."""
    return run_loop(toy_step, toy_state(), toy_batch, options(tmp_path / "whole", 10), metadata=RUN)


def test_a_run_leaves_weights_log_curve_and_checkpoints(tmp_path, whole):
    out = tmp_path / "whole"
    assert {path.name for path in out.iterdir()} == {"weights.safetensors", "log.jsonl", "curve.png", "checkpoints"}
    weights, metadata = load_weights(out / "weights.safetensors", like=toy_state().params)
    np.testing.assert_array_equal(weights["w"], whole.state.params["w"])
    assert metadata["seed"] == 7 and metadata["step"] == 10
    assert [line["step"] for line in read_log(out / "log.jsonl")[0]] == list(range(1, 11))
    assert len(list((out / "checkpoints").iterdir())) == 2


def test_a_run_broken_off_by_an_error_resumes_to_the_same_bits(tmp_path, whole):
    def breaking(step):
        if step == 6:
            raise RuntimeError("power cut")
        return toy_batch(step)

    out = tmp_path / "broken"
    with pytest.raises(RuntimeError, match="power cut"):
        run_loop(toy_step, toy_state(), breaking, options(out, 10), metadata=RUN)
    resumed = run_loop(toy_step, toy_state(), toy_batch, options(out, 10, resume=True), metadata=RUN)
    for name in ("params", "opt_state"):
        np.testing.assert_array_equal(getattr(resumed.state, name)["w"], getattr(whole.state, name)["w"])
    assert [line["step"] for line in read_log(out / "log.jsonl")[0]] == list(range(1, 11))


SCRIPT = """
import sys, time
sys.path.insert(0, {tests!r})
from test_training_loop import *
slow = lambda step: (time.sleep(0.05), toy_batch(step))[1]
resume = sys.argv[2] == "resume"
run_loop(toy_step, toy_state(), slow, options(sys.argv[1], 40, resume=resume), metadata=RUN)
"""


def test_a_killed_process_resumes_to_the_same_bits(tmp_path):
    out = tmp_path / "killed"
    command = [sys.executable, "-c", SCRIPT.format(tests=os.path.dirname(__file__)), str(out)]
    process = subprocess.Popen([*command, "fresh"], stderr=subprocess.DEVNULL)
    while latest_checkpoint(out / "checkpoints", (toy_state().params, toy_state().opt_state)) is None:
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    resumed = run_loop(toy_step, toy_state(), toy_batch, options(out, 40, resume=True), metadata=RUN)
    plain = run_loop(toy_step, toy_state(), toy_batch, options(tmp_path / "plain", 40), metadata=RUN)
    np.testing.assert_array_equal(resumed.state.params["w"], plain.state.params["w"])


def test_ctrl_c_ends_the_run_after_its_step_with_a_checkpoint(tmp_path):
    def interrupting(step):
        if step == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        return toy_batch(step)

    result = run_loop(toy_step, toy_state(), interrupting, options(tmp_path, 100), metadata=RUN)
    assert not result.finished and result.state.step < 10
    found = latest_checkpoint(tmp_path / "checkpoints", (toy_state().params, toy_state().opt_state))
    assert found is not None and found.step == result.state.step


def test_a_time_limit_counts_stepping_after_the_compile(tmp_path):
    def slow(step):
        time.sleep(1.0 if step == 0 else 0.05)
        return toy_batch(step)

    result = run_loop(toy_step, toy_state(), slow, options(tmp_path, 1000, seconds=0.3), metadata=RUN)
    assert result.finished and 0.3 <= result.seconds < 1.0 < result.compile_seconds


def test_a_damaged_newest_checkpoint_falls_back_to_the_one_before(tmp_path, capsys, whole):
    newest = sorted((tmp_path / "whole" / "checkpoints").iterdir())[-1]
    newest.write_bytes(newest.read_bytes()[:-7])
    resumed = run_loop(toy_step, toy_state(), toy_batch, options(tmp_path / "whole", 10, resume=True), metadata=RUN)
    np.testing.assert_array_equal(resumed.state.params["w"], whole.state.params["w"])
    assert "step 9" in capsys.readouterr().err


def test_a_folder_of_another_run_is_refused_and_kept(tmp_path, whole):
    out = tmp_path / "whole"
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(WeightsError, match="another seed"):
        run_loop(toy_step, toy_state(), toy_batch, options(out, 20, resume=True), metadata=RUN | {"seed": 8})
    with pytest.raises(WeightsError, match="--resume"):
        run_loop(toy_step, toy_state(), toy_batch, options(out, 20), metadata=RUN)
    wide = TrainState({"w": jnp.zeros(4)}, {"w": jnp.zeros(4)}, 0)
    with pytest.raises(WeightsError, match="another model or preset"):
        run_loop(toy_step, wide, toy_batch, options(out, 20, resume=True), metadata=RUN)
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


@pytest.mark.parametrize("lost", ["missing", "damaged", "of an earlier step", "of another run"])
def test_a_run_that_ended_before_its_weights_were_written_writes_them_when_resumed(tmp_path, lost, whole):
    out = tmp_path / "whole"
    weights, expected = out / "weights.safetensors", whole.state.params
    if lost == "missing":
        weights.unlink()
    elif lost == "damaged":
        weights.write_bytes(weights.read_bytes()[:-7])
    else:
        step = 9 if lost == "of an earlier step" else 10
        save_weights(weights, {"w": jnp.ones(3)}, metadata=RUN | {"step": step})
    (out / "curve.png").unlink()
    result = run_loop(toy_step, toy_state(), toy_batch, options(out, 10, resume=True), metadata=RUN)
    written, metadata = load_weights(weights, like=toy_state().params)
    np.testing.assert_array_equal(written["w"], expected["w"])
    assert metadata["step"] == 10 and (out / "curve.png").is_file()
    line = summarise(result, out, "train").line
    assert "nothing was left to do" in line and "nan" not in line and "loss" in line


def test_a_run_whose_seconds_are_used_up_takes_no_further_step(tmp_path, whole):
    given = options(tmp_path / "whole", 99, resume=True, seconds=whole.seconds)
    assert run_loop(toy_step, toy_state(), toy_batch, given, metadata=RUN).state.step == 10


def test_the_log_of_a_run_killed_before_its_first_checkpoint_begins_again(tmp_path):
    (tmp_path / "log.jsonl").write_text('{"step": 2, "total": 9}\n{"step": 4, "tot')
    (tmp_path / "faults.jsonl").write_text('{"step": 2, "fault": "x"}\n')
    run_loop(toy_step, toy_state(), toy_batch, options(tmp_path, 3, resume=True), metadata=RUN)
    lines, dropped = read_log(tmp_path / "log.jsonl")
    assert [line["step"] for line in lines] == [1, 2, 3] and not dropped and lines[1]["total"] != 9
    assert (tmp_path / "faults.jsonl").read_text() == ""


def test_lines_of_a_log_that_are_no_records_are_left_out_and_counted(tmp_path, capsys, whole):
    log = tmp_path / "whole" / "log.jsonl"
    odd = [b"5", b"[]", b'{"seconds": 1}', b'{"step": "3"}', b"\xff\xfe", b'{"st', b"[" * 100_000, b'{"step": true}']
    log.write_bytes(b"\n".join(odd) + b"\n" + log.read_bytes() + b'{"step": 11, "to')
    resumed = run_loop(toy_step, toy_state(), toy_batch, options(log.parent, 12, resume=True), metadata=RUN)
    assert [line["step"] for line in read_log(log)[0]] == list(range(1, 13)) and resumed.finished
    assert "log.jsonl: 8 lines are no record of a step and left out." in capsys.readouterr().err


def test_what_a_killed_write_left_is_removed(tmp_path, whole):
    out = tmp_path / "whole"
    left = [out / ".weights.safetensors.ab12.part", out / "checkpoints/.step_000000011.safetensors.cd34.part"]
    for path in left:
        path.write_text("half")
    run_loop(toy_step, toy_state(), toy_batch, options(out, 12, resume=True), metadata=RUN)
    assert not any(path.exists() for path in left)


def test_a_folder_serves_one_run_at_a_time(tmp_path):
    with run_folder.held(tmp_path):
        for resume in (False, True):
            with pytest.raises(ValueError, match=f"process {os.getpid()} on .* is training into it; wait"):
                run_loop(toy_step, toy_state(), toy_batch, options(tmp_path, 3, resume=resume), metadata=RUN)
    assert not list(tmp_path.iterdir())
    (tmp_path / run_folder.LOCK).write_text("process 1 on a machine that lost its power\n")
    assert run_loop(toy_step, toy_state(), toy_batch, options(tmp_path, 3), metadata=RUN).finished


def test_another_number_of_threads_is_told(tmp_path, monkeypatch, capsys, whole):
    run_loop(toy_step, toy_state(), toy_batch, options(tmp_path / "whole", 11, resume=True), metadata=RUN)
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("PJRT_NPROC", "77")
    run_loop(toy_step, toy_state(), toy_batch, options(tmp_path / "whole", 12, resume=True), metadata=RUN)
    assert "now on 77: the last bits" in capsys.readouterr().err


def test_a_newest_checkpoint_that_cannot_be_read_falls_back_to_the_one_before(tmp_path, capsys, whole):
    newest = sorted((tmp_path / "whole" / "checkpoints").iterdir())[-1]
    newest.unlink()
    (newest / "kept").mkdir(parents=True)
    resumed = run_loop(toy_step, toy_state(), toy_batch, options(tmp_path / "whole", 10, resume=True), metadata=RUN)
    np.testing.assert_array_equal(resumed.state.params["w"], whole.state.params["w"])
    assert "Going on from step 9" in capsys.readouterr().err and newest.is_file()
    assert len(list(newest.parent.glob("not_*/*/kept"))) == 1


def test_an_error_saves_the_state_that_it_met(tmp_path):
    def breaking(step):
        if step == 6:
            raise RuntimeError("the producer ended")
        return toy_batch(step)

    rare = LoopOptions(tmp_path, 10, quiet=True, log_steps=4)
    donating = jax.jit(toy_step, donate_argnums=(0, 1))
    with pytest.raises(RuntimeError, match="the producer ended"):
        run_loop(donating, toy_state(), breaking, rare, metadata=RUN)
    assert [line["step"] for line in read_log(tmp_path / "log.jsonl")[0]] == [4, 6]
    found = latest_checkpoint(tmp_path / "checkpoints", (toy_state().params, toy_state().opt_state))
    assert found is not None and found.step == 6


def recipe(**flags):
    """What a run of `zestjax train` stores of its flags."""
    frames = flags.pop("frames", ())
    options = TrainOptions(**{"out": "unused", "preset": "tiny"} | flags)
    whole = recipe_of(options.preset, system=options.system, precision=options.precision)
    return run_metadata(run_recipe(whole, options), options, frames)


def resumed(out, metadata):
    return run_loop(toy_step, toy_state(), toy_batch, options(out, 4, resume=True), metadata=metadata)


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """A run that began from a file of weights."""
    folder = tmp_path_factory.mktemp("recipe")
    for name in ("first", "second"):
        (folder / name).mkdir()
        (folder / name / "weights.safetensors").write_text(name)
    metadata = recipe(weights=folder / "first/weights.safetensors")
    run_loop(toy_step, toy_state(), toy_batch, options(folder / "run", 2), metadata=metadata)
    return folder


@pytest.mark.parametrize(
    "said, flags",
    {
        r"recipe \(rate\)": {"peak": 1e-3}, r"recipe \(weights\)": {"stage": "views"},
        "seed": {"seed": 1}, "start": {"weights": None},
        "analysis": {"analysis": "second/weights.safetensors"}, r"recipe \(system\)": {"precision": "bfloat16"},
        r"recipe \(.*height.*\)": {"preset": "small"}, r"recipe \(system.*\)": {"system": "zest-geometry"},
        r"data \(scenes\)": {"frames": (np.ones(3), np.ones(3))},
        r"data \(steps_per_clip, window\)": {"window": 8, "steps_per_clip": 2},
        r"recipe \(rate, weights\) and data \(clip_count\)": {"clip_count": 3, "stage": "views", "peak": 1e-3},
    }.items(),
)  # fmt: skip
def test_a_run_resumes_with_its_own_recipe_alone(begun, said, flags):
    given = {"weights": "first/weights.safetensors"} | flags
    paths = {name: begun / given[name] for name in ("weights", "analysis") if given.get(name)}
    with pytest.raises(WeightsError, match=f"run: its checkpoints are of a run with another {said}; resume it with"):
        resumed(begun / "run", recipe(**given | paths))


def test_a_choice_that_came_later_is_at_its_default_in_an_older_run(begun):
    metadata = recipe(weights=begun / "first/weights.safetensors")
    assert metadata["recipe"].pop("clips") == 1 and metadata["recipe"].pop("adversary") is None
    assert resumed(begun / "run", metadata).state.step == 4
    metadata["recipe"]["clips"] = 2
    with pytest.raises(WeightsError, match=r"another recipe \(clips\)"):
        resumed(begun / "run", metadata)


def test_weights_are_told_apart_by_what_they_hold(begun):
    (begun / "moved").mkdir()
    for name, content in {"same": "first", "other": "second"}.items():
        (begun / "moved" / f"{name}.safetensors").write_text(content)
    first, second = (recipe(weights=begun / name / "weights.safetensors")["start"] for name in ("first", "second"))
    assert first != second and first.split()[1] == recipe(weights=begun / "moved/same.safetensors")["start"].split()[1]
    (begun / "first/weights.safetensors").write_text("trained on")
    with pytest.raises(WeightsError, match="another start;"):
        resumed(begun / "run", recipe(weights=begun / "first/weights.safetensors"))
    (begun / "first/weights.safetensors").write_text("first")


def test_what_does_not_change_the_numbers_may_change(begun):
    free = {"steps": 9, "minutes": 3.0, "checkpoint_minutes": 1.0, "quiet": True, "clips": "there", "out": "elsewhere"}
    ended = resumed(begun / "run", recipe(weights=begun / "first/weights.safetensors", **free))
    assert ended.finished and ended.state.step == 4


def test_a_scene_is_known_by_its_frames_cameras_and_size():
    rng = np.random.default_rng(0)
    camera = Camera(np.ones((2, 3, 3), np.float32), np.ones((2, 4, 4), np.float32))
    video = Video(rng.uniform(size=(2, 4, 6, 3)).astype(np.float32), camera, np.float32(1), np.float32(9))
    moved = camera._replace(camera_from_world=2 * camera.camera_from_world)
    others = [
        video._replace(images=video.images.reshape(2, 6, 4, 3)), video._replace(images=video.images[::-1]),
        video._replace(cameras=moved), video._replace(far=np.float32(8)),
    ]  # fmt: skip
    assert digest(video) == digest(jax.tree.map(np.copy, video))
    assert len({digest(v) for v in (video, *others)}) == 5


def test_a_full_disk_costs_no_earlier_checkpoint(tmp_path, monkeypatch, whole):
    def full(content, *arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("zestjax.io.weights.write_bytes", full)
    with pytest.raises(WeightsError, match="No space left"):
        run_loop(toy_step, toy_state(), toy_batch, options(tmp_path / "whole", 20, resume=True), metadata=RUN)
    monkeypatch.undo()
    found = latest_checkpoint(tmp_path / "whole" / "checkpoints", (toy_state().params, toy_state().opt_state))
    assert found is not None and found.step == 10


def test_a_loss_that_stays_non_finite_ends_the_run(tmp_path):
    def broken(params, opt_state, batch):
        return params, opt_state, {"total": jnp.float32(jnp.nan)}

    with pytest.raises(FloatingPointError, match="not finite"):
        run_loop(broken, toy_state(), toy_batch, options(tmp_path, 1000), metadata=RUN)


def test_the_log_holds_means_and_skips_non_finite_steps(tmp_path):
    def step(params, opt_state, batch):
        return params, opt_state, {"total": batch}

    losses = [1.0, float("nan"), 3.0, 5.0]
    state = TrainState({"w": jnp.zeros(1)}, {}, 0)
    run_loop(
        step, state, lambda n: jnp.float32(losses[n]), LoopOptions(tmp_path, 4, log_steps=4, quiet=True), metadata=RUN
    )
    (line,) = [json.loads(text) for text in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert line["step"] == 4 and line["total"] == 3.0


PRODUCER = """
import sys
import time
from pathlib import Path
from typing import NamedTuple
import numpy as np
from zestjax.apps import clips, producer, run_folder

class Toy(NamedTuple):
    images: np.ndarray
    extra: np.ndarray | None = None

def render(spec, index):
    if index == 13:
        raise ValueError("clip 13 is unlucky")
    time.sleep(0.3 if index == 40 else 0)
    return Toy(np.full((2, spec.height, spec.width, 3), index, np.uint8))

clips.render_clip = render
sys.exit(clips.main(sys.argv[1:]))
"""


@pytest.fixture
def toy_producer(tmp_path, monkeypatch):
    """Clips from a real producer process whose renderer is a toy."""
    popen = subprocess.Popen
    run = lambda command, **kw: popen([sys.executable, "-c", PRODUCER, *command[3:]], **kw)
    monkeypatch.setattr(producer.subprocess, "Popen", run)
    return lambda: producer.ClipSource(clips.ClipSpec(0, 4, 6), tmp_path, alive=3, evict=True)


@pytest.fixture
def source(toy_producer):
    with toy_producer() as source:
        yield source


def test_clips_are_rendered_ahead_by_a_process_of_their_own(source, tmp_path):
    assert (source.clip(0, range(0, 3))["images"] == 0).all()
    deadline = time.time() + 20
    while not clips.clip_path(tmp_path, 2).exists() and time.time() < deadline:
        time.sleep(0.02)
    assert (source.clip(2, range(2, 4))["images"] == 2).all()
    assert not clips.clip_path(tmp_path, 0).exists(), "a clip that left the window is removed"


def test_a_damaged_clip_is_rendered_again(source, tmp_path):
    clips.clip_path(tmp_path, 5).write_bytes(b"not a clip")
    assert (source.clip(5, [5])["images"] == 5).all()


@pytest.mark.parametrize("change", [{"index": 4}, {"seed": 1}, {"frames": 3}, {"code": "of an upgrade"}])
def test_a_clip_of_another_origin_is_rendered_again(source, tmp_path, capfd, change, monkeypatch):
    spec = clips.ClipSpec(0, 4, 6)._replace(**{k: v for k, v in change.items() if k in ("seed", "frames")})
    with monkeypatch.context() as patch:
        if "code" in change:
            patch.setattr(clips, "code_digest", lambda *_: change["code"])
        origin = clips.origin_of(spec, change.get("index", 5))
    clips.write_clip(clips.clip_path(tmp_path, 5), {"images": np.zeros(3)}, origin)
    assert (source.clip(5, [5])["images"] == 5).all()
    said = capfd.readouterr().err
    assert "clip-000005.npz: holds clip" in said and "expected clip 5 of seed 0, 4x6, 16+8 frames" in said


def test_a_missing_module_is_not_taken_for_an_empty_one():
    with pytest.raises(ValueError, match="has no moved.py"):
        clips.code_digest("simulate/*.py", "moved.py")


def test_a_producer_that_fails_says_why(source, capfd):
    with pytest.raises(producer.ProducerError, match="ended with exit code 1: ValueError: clip 13 is unlucky"):
        source.clip(13, [13])
    assert capfd.readouterr().err.count("it is started once more") == 1


def test_a_producer_that_is_killed_is_started_again(source, tmp_path, capfd):
    for index in (40, 41):
        source.producer.ask([index, index + 100])
        os.kill(source.producer.process.pid, signal.SIGKILL)
        source.producer.process.wait()
        assert (source.clip(index, [index])["images"] == index).all()
    assert capfd.readouterr().err.count("was ended by SIGKILL") == 2


def test_two_trainers_may_share_a_folder_of_clips(toy_producer, tmp_path):
    with toy_producer() as first, toy_producer() as second:
        second.clip(0, range(0, 3))
        for index in range(0, 9, 2):
            assert (first.clip(index, range(index, index + 3))["images"] == index).all()
        for index in range(1, 5):
            assert (second.clip(index, range(index, index + 3))["images"] == index).all()
    assert clips.clip_path(tmp_path, 9).exists() and not clips.clip_path(tmp_path, 0).exists()


def test_clips_that_vanish_are_asked_for_again(source, tmp_path):
    source.clip(0, range(0, 3))
    while source.producer.pending:
        source.producer._listen()
    for path in tmp_path.iterdir():
        path.unlink()
    tmp_path.rmdir()
    assert (source.clip(2, range(0, 3))["images"] == 2).all()


def test_the_producer_ends_with_its_trainer(source):
    process = source.producer.process
    process.stdin.close()
    assert process.wait(timeout=20) == 0


def test_a_step_that_is_skipped_is_explained_and_the_run_goes_on(tmp_path, capsys):
    solver = Adam(learning_rate=0.1)

    def step(params, opt_state, batch):
        params, opt_state = solver.apply(params, opt_state, {"w": params["w"] - batch}, jnp.float32(1))
        return params, opt_state, {"total": jnp.float32(1)}

    state = TrainState({"w": jnp.zeros(2)}, solver.init_state({"w": jnp.zeros(2)}), 0)
    batch_at = lambda n: jnp.full(2, jnp.nan if n == 2 else 1.0, jnp.float32)
    explain = lambda params, batch: f"not finite: batch {batch[0]}"
    ended = run_loop(jax.jit(step), state, batch_at, options(tmp_path, 6), metadata=RUN, explain=explain)
    assert int(ended.state.opt_state.skipped) == 1 and np.isfinite(ended.state.params["w"]).all()
    assert json.loads((tmp_path / "faults.jsonl").read_text()) == {"step": 3, "fault": "not finite: batch nan"}
    assert "warning: step 3 was skipped; not finite: batch nan" in capsys.readouterr().err


def test_a_full_disk_names_the_log_and_saves_the_state(tmp_path, monkeypatch):
    opened = Path.open

    def full(path, mode="r", *arguments):
        if mode == "ab":
            raise OSError(28, "No space left on device")
        return opened(path, mode, *arguments)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(OSError, match="No space left on device; free some space") as caught:
        run_loop(toy_step, toy_state(), toy_batch, options(tmp_path, 9), metadata=RUN)
    assert caught.value.filename == str(tmp_path / "log.jsonl")
    monkeypatch.undo()
    resumed = run_loop(toy_step, toy_state(), toy_batch, options(tmp_path, 9, resume=True), metadata=RUN)
    plain = run_loop(toy_step, toy_state(), toy_batch, options(tmp_path / "plain", 9), metadata=RUN)
    np.testing.assert_array_equal(resumed.state.params["w"], plain.state.params["w"])
    assert len(list((tmp_path / "checkpoints").glob("step_*"))) == 2
