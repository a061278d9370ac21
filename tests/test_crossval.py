"""Cross-validation: what runs, what is not run twice, what a kill, a full disk or another launcher leaves."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import crossval_stub
import numpy as np
import pytest
from scipy import stats

from zestjax.apps import crossval_table, evaluate, fold_state, launchers, train
from zestjax.apps.cli import main
from zestjax.apps.crossval import crossval
from zestjax.apps.fold_state import Place, State, locked, seconds_left, state_of, worked_on
from zestjax.apps.folds import DYNAMIC_SCENES, _short_names, agreed_plan, read_plan
from zestjax.io.pictures import write_image

SCENES = ("bench:walker", "bench:blobs", "bench:marbles")
GIVEN = ("--scenes", *SCENES, "--preset", "tiny", "--steps", "5", "--quiet")


@pytest.fixture(autouse=True)
def stubs(monkeypatch):
    """Trainings and scores of no cost; the user's cache is not the tests' to fill."""
    monkeypatch.setenv("STUB_SCENES", " ".join(SCENES))
    monkeypatch.setattr(train, "train", crossval_stub.stub_train)
    monkeypatch.setattr(evaluate, "evaluate", crossval_stub.stub_evaluate)
    monkeypatch.setattr("zestjax.apps.cli._prepare_jax", lambda: None)
    monkeypatch.setattr("zestjax.apps.crossval.keep_compiled", lambda: None)


def run(out, *arguments):
    return main(["crossval", *arguments, "--out", str(out)])


def told(out, capsys, *arguments):
    """What a step says as JSON."""
    capsys.readouterr()
    assert run(out, *arguments, "--json") == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys, code, *words):
    said = capsys.readouterr()
    assert code == 2 and said.out == "" and said.err.startswith("error: ") and said.err.count("\n") == 1, said.err
    assert all(word in said.err for word in words), said.err


def start(out, *arguments, **environment):
    """A process that runs a command with the stubs."""
    command = [sys.executable, crossval_stub.__file__, "crossval", *arguments, "--out", str(out)]
    return subprocess.Popen(command, env=os.environ | environment, stderr=subprocess.PIPE, text=True)


def ended(process):
    """The exit code of a process, and what it said."""
    said = process.communicate(timeout=120)[1]
    return process.returncode, said


def starts(out, fold):
    """The steps at which the trainings of a fold began."""
    place = Place(out, agreed_plan(out, {}).folds[fold])
    folder = place.result if place.result.exists() else place.fold
    return (folder / "train/starts").read_text().split()


def fold_files(out):
    """Content of the finished folds' scores."""
    return {path.relative_to(out): path.read_text() for path in sorted(Path(out).glob("folds/*/*/metrics.json"))}


def test_a_plan_says_what_will_run_and_the_folder_keeps_it(tmp_path, capsys):
    assert (
        run(tmp_path, "plan", *GIVEN[:-1], "--system", "zest", "zest-none", "--seeds", "2", "--set", "blocks=1,2") == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 25 and lines[0] == "  0 zest,blocks=1,seed=0/walker: seed 0, learns from 2 scenes"
    assert "24 folds (3 scenes x 2 systems x 2 seeds x 2 blocks values), array 0-23; each about" in lines[-1]
    plan = told(tmp_path, capsys, "plan")
    assert plan["array"] == "0-23" and plan["seconds_each"] > 0 and plan["gigabytes_each"] > 0
    held = [(fold["scene"], set(fold["others"])) for fold in plan["folds"]]
    assert all(scene not in others and {scene} | others == set(SCENES) for scene, others in held)
    assert run(tmp_path, "plan", "--steps", "6") == 0  # no fold has begun
    assert read_plan(tmp_path).steps == 6


def test_by_default_the_scenes_are_zest_benchs(tmp_path):
    plan = agreed_plan(tmp_path, {})
    assert len(plan.folds) == 9 and plan.folds[0].others[0].startswith("bench:")


def a_scene(folder):
    """A folder that is taken for a scene, with a picture of its own."""
    painted = np.random.default_rng(list(str(folder).encode())).random((16, 16, 3))
    write_image(folder / "images/00000.png", painted.astype(np.float32))
    np.save(folder / "poses_bounds.npy", np.zeros((1, 17)))


def test_the_published_data_is_the_authors_nine_folds_in_their_order(tmp_path, capsys):
    for name in (*DYNAMIC_SCENES, "broom", "curls"):
        a_scene(tmp_path / "data" / name / "dense")
    plan = agreed_plan(tmp_path / "out", {"scenes": [tmp_path / "data"]})
    assert [fold.name for fold in plan.folds] == list(DYNAMIC_SCENES)
    assert "left out, as in the authors' folds: broom, curls" in capsys.readouterr().err


def test_folds_of_scenes_with_one_name_have_two(tmp_path):
    for name in ("a/dense", "b/dense"):
        a_scene(tmp_path / name)
    plan = agreed_plan(tmp_path / "out", {"scenes": [tmp_path / "a/dense", tmp_path / "b/dense"]})
    assert [fold.name for fold in plan.folds] == ["a-dense", "b-dense"]
    assert _short_names(("bench:walker", "/data/walker", "/b/data/walker")) == [
        "walker",
        "data-walker",
        "b-data-walker",
    ]


def test_a_link_to_a_scene_is_that_scene(tmp_path, capsys):
    a_scene(tmp_path / "scene")
    (tmp_path / "link").symlink_to(tmp_path / "scene")
    given = [str(tmp_path / name) for name in ("scene", "link")]
    refused(capsys, run(tmp_path / "out", "--scenes", *given), f"{tmp_path}/scene is given twice")


def test_a_copy_of_a_scene_is_that_scene(tmp_path, capsys):
    for name in ("first", "other"):
        a_scene(tmp_path / name)
    shutil.copytree(tmp_path / "first", tmp_path / "copy")
    (tmp_path / "copy/images/00000.png").rename(tmp_path / "copy/images/img_a.png")
    given = [str(tmp_path / name) for name in ("other", "first", "copy")]
    refused(capsys, run(tmp_path / "out", "--scenes", *given), f"{tmp_path}/copy has the pictures of {tmp_path}/first")


@pytest.mark.parametrize(
    "flags, words",
    [
        (["--scenes", "bench:walker", "bench:blobs", "bench:walker"], ["bench:walker", "given twice"]),
        (["--scenes", "bench:walker"], ["two at least"]),
        (["--scenes", "nowhere", "bench:walker"], ["nowhere", "is not a folder"]),
        (["--scenes", "bench:street", "bench:walker"], ["street", "walker"]),
        (["--system", "nerf"], ["nerf", "zest-geometry"]),
        (["--system", "zest", "zest"], ["zest", "given twice"]),
        (["--preset", "huge"], ["huge", "small"]),
        (["--protocol", "lenient"], ["lenient", "strict"]),
        (["--launcher", "cloud"], ["cloud", "slurm"]),
        (["--set", "rate.pek=1"], ["rate.pek", "peak, floor, warmup"]),
        (["--set", "rays.count=8,0"], ["rays.count=0"]),
        (["--set", "blocks=1", "blocks=2"], ["blocks", "given twice"]),
        (["--finetune", "40", "--protocol", "strict"], ["--finetune", "strict"]),
        (["--weights", "nowhere.safetensors"], ["nowhere.safetensors"]),
        (["--resume"], ["nothing was begun"]),
        (["status"], ["nothing was begun"]),
    ],
)
def test_bad_choices_are_one_line_and_nothing_is_begun(tmp_path, capsys, flags, words):
    refused(capsys, run(tmp_path / "out", *flags), *words)
    assert not (tmp_path / "out/work").exists()


def test_a_whole_run_writes_what_is_promised_and_a_second_one_does_nothing(tmp_path, capsys):
    assert run(tmp_path, *GIVEN[:-1]) == 0
    said = capsys.readouterr().out
    assert said.startswith("crossval: 3 of 3 folds done: zest 33.00 dB") and said.count("\n") == 1
    for name in ("walker", "blobs", "marbles"):
        fold = tmp_path / "folds/zest" / name
        about, metrics = (json.loads((fold / file).read_text()) for file in ("fold.json", "metrics.json"))
        assert about["recipe"]["part"] == "Recipe" and about["seed"] == 0 and about["code"] and about["zestjax"]
        assert {"jax", "jaxlib", "numpy"} <= about["libraries"].keys() and about["peak_megabytes"] > 0
        assert metrics["weights"] == str(fold / "train/weights.safetensors") and Path(metrics["weights"]).exists()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("folds/**/*")}
    assert (
        run(tmp_path, *GIVEN)
        == run(tmp_path, "--resume", "--quiet")
        == run(tmp_path, "run", "--fold", "1", "--quiet")
        == 0
    )
    assert before == {path: path.stat().st_mtime_ns for path in tmp_path.glob("folds/**/*")}
    refused(capsys, run(tmp_path, *GIVEN, "--steps", "6"), "steps (5, now 6)", "another --out")
    refused(capsys, run(tmp_path, "run", "--fold", "3"), "no fold 3", "0 to 2")


def test_a_fold_that_fails_is_alone_in_it_and_runs_again_when_asked(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("STUB_FAILS", "bench:blobs")
    assert run(tmp_path, *GIVEN) == 1
    assert "fold 1 zest/blobs failed: ValueError: the loss was not finite" in capsys.readouterr().err
    status = told(tmp_path, capsys, "status")
    assert (status["done"], status["failed"]) == (2, 1) and [one["state"] for one in status["each"]][1] == "failed"
    assert (
        "not finite" in status["each"][1]["reason"]
        and "Traceback" in Place(tmp_path, read_plan(tmp_path).folds[1]).failed.read_text()
    )
    assert run(tmp_path, "run", "--fold", "1", "--quiet") == 1
    assert "--failed" in capsys.readouterr().err
    table = (tmp_path / "table.md").read_text()
    assert table.startswith("2 of 3 folds finished") and "not finished: zest/blobs" in table and "| 2 of 3 |" in table
    monkeypatch.delenv("STUB_FAILS")
    assert run(tmp_path, "--quiet") == 1  # not without being asked
    assert run(tmp_path, "--failed", "--quiet") == 0 and starts(tmp_path, 0) == ["0"]


def test_a_result_of_another_recipe_is_refused_and_left(tmp_path, capsys):
    assert run(tmp_path, *GIVEN) == 0
    file = tmp_path / "folds/zest/blobs/fold.json"
    other = json.loads(file.read_text())
    other["spec"]["steps"] = 7
    file.write_text(json.dumps(other))
    for action in ([], ["status"], ["table"], ["run", "--fold", "1"]):
        refused(capsys, run(tmp_path, *action), "folds/zest/blobs", "other steps", "move it away")
    assert json.loads(file.read_text()) == other
    (tmp_path / "plan.json").write_text('{"digest": "0", "plan": {"steps": "many"}}')
    refused(capsys, run(tmp_path, "status"), "plan.json", "no plan")


def test_a_full_disk_is_one_line_and_with_room_it_goes_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("STUB_FULL", "bench:blobs")
    refused(capsys, run(tmp_path, *GIVEN), "No space left", "free some space")
    assert [told(tmp_path, capsys, "status")[name] for name in ("done", "failed", "running")] == [1, 0, 0]
    monkeypatch.delenv("STUB_FULL")
    assert run(tmp_path, "--quiet") == 0 and starts(tmp_path, 0) == ["0"]


def test_a_scene_that_vanishes_fails_by_its_name_and_nothing_is_lost(tmp_path, capsys, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr("zestjax.apps.cli._prepare_jax", lambda: None)
    for name in ("a", "b"):
        a_scene(tmp_path / name)
    scenes = [str(tmp_path / name) for name in ("a", "b")]
    assert run(tmp_path / "out", "plan", "--scenes", *scenes, "--preset", "tiny", "--quiet") == 0
    (tmp_path / "b").rename(tmp_path / "c")
    assert run(tmp_path / "out", "run", "--fold", "1", "--quiet") == 1
    assert f"{tmp_path / 'b'}: is not a folder" in capsys.readouterr().err
    refused(capsys, run(tmp_path / "out", "--scenes", *scenes), "b: is not a folder")
    assert read_plan(tmp_path / "out").scenes == tuple(scenes)


@pytest.mark.parametrize("number", [signal.SIGUSR2, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_saves_and_says_run_me_again(tmp_path, number):
    process = start(tmp_path, "run", "--fold", "0", *GIVEN, STUB_SECONDS="0.2")
    while not list(tmp_path.glob("work/000/fold/train/step")):
        time.sleep(0.02)
    process.send_signal(number)
    assert ended(process)[0] == 75
    plan = read_plan(tmp_path)
    assert state_of(tmp_path, plan, plan.folds[0]).state == "stopped" and not list(tmp_path.glob("folds/*/*"))
    assert run(tmp_path, "run", "--fold", "0", "--quiet") == 0
    first, second = starts(tmp_path, 0)
    assert first == "0" and 0 < int(second) < 5


@pytest.mark.slow
def test_a_kill_loses_nothing_and_the_others_go_on(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert run(whole, *GIVEN) == 0
    process = start(killed, *GIVEN[:-1], "--launcher", "process", "--jobs", "2", STUB_KILLS="bench:blobs")
    code, said = ended(process)
    assert code == 75 and "fold 1 zest/blobs stopped; ended with -9" in said
    assert len(fold_files(killed)) == 2
    assert run(killed, "--quiet") == 0 and starts(killed, 1) == ["0", "3"] and starts(killed, 0) == ["0"]
    placed = lambda out: {path: text.replace(str(out), "") for path, text in fold_files(out).items()}
    assert placed(whole) == placed(killed)


@pytest.mark.slow
def test_two_launchers_at_once_run_each_fold_once(tmp_path, capsys):
    both = [start(tmp_path, *GIVEN, STUB_SECONDS="0.3") for _ in range(2)]
    while not list(tmp_path.glob("work/*/fold/train/log.jsonl")):
        time.sleep(0.02)
    status = told(tmp_path, capsys, "status")
    assert status["running"] >= 1 and not status["failed"] and status["seconds_left"] > 0
    codes = [ended(process)[0] for process in both]
    assert set(codes) <= {0, 75} and 0 in codes
    assert [starts(tmp_path, fold) for fold in range(3)] == [["0"]] * 3


def test_a_fold_that_another_process_holds_is_left_to_it(tmp_path, capsys):
    plan = agreed_plan(tmp_path, {"scenes": SCENES, "preset": "tiny", "steps": 5})
    place = Place(tmp_path, plan.folds[1])
    place.fold.mkdir(parents=True)
    with locked(place.lock) as held:
        assert held and told(tmp_path, capsys, "status")["running"] == 1
        assert run(tmp_path, "run", "--fold", "1") == 75
        assert capsys.readouterr().out == "crossval: fold 1 zest/blobs running in another process\n"
        assert run(tmp_path) == 75
        assert "2 of 3 folds done (1 running)" in capsys.readouterr().out
    assert run(tmp_path, "--quiet") == 0 and starts(tmp_path, 1) == ["0"]


@pytest.mark.slow
def test_a_launcher_that_is_stopped_stops_its_folds_which_go_on_later(tmp_path):
    process = start(tmp_path, *GIVEN, "--launcher", "process", "--jobs", "3", STUB_SECONDS="0.4")
    while len(list(tmp_path.glob("work/*/fold/train/step"))) < 3:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    assert ended(process)[0] == 75 and not list(tmp_path.glob("folds/*/*"))
    assert run(tmp_path, "--quiet") == 0 and all(len(starts(tmp_path, fold)) == 2 for fold in range(3))


@pytest.mark.slow
def test_a_clock_that_jumps_confuses_nobody(tmp_path, capsys, monkeypatch):
    process = start(tmp_path, "run", "--fold", "0", *GIVEN, STUB_SECONDS="0.5")
    while not list(tmp_path.glob("work/000/fold/train/step")):
        time.sleep(0.02)
    for jump in (-1e9, 1e9):
        now = time.time() + jump
        monkeypatch.setattr(time, "time", lambda now=now: now)
        for path in tmp_path.glob("work/000/*"):
            os.utime(path, (now, now))
        assert told(tmp_path, capsys, "status")["each"][0]["state"] == "running"
        assert run(tmp_path, "run", "--fold", "0", "--quiet") == 75  # runs elsewhere, and is not run twice
    assert ended(process)[0] == 0 and told(tmp_path, capsys, "status")["each"][0]["state"] == "done"


def test_another_hosts_fold_is_alive_while_its_counter_moves(tmp_path, monkeypatch):
    plan = agreed_plan(tmp_path, {})
    place, beat = Place(tmp_path, plan.folds[0]), {"count": 4, "host": "elsewhere", "ended": False}
    place.work.mkdir(parents=True)
    place.beat.write_text(json.dumps(beat))
    monkeypatch.setattr(fold_state.time, "sleep", lambda _: None)
    assert not worked_on(place, True)
    monkeypatch.setattr(fold_state.time, "sleep", lambda _: place.beat.write_text(json.dumps(beat | {"count": 5})))
    assert worked_on(place, True)
    place.beat.write_text(json.dumps(beat | {"ended": True}))
    assert not worked_on(place, True) and worked_on(place, False)


class Scheduler:
    """What `launchers.slurm` uses of submitit and of SLURM: jobs run when the queue is next asked. `waits`: asks until
    then."""

    def __init__(self, waits=0):
        self.jobs, self.waits, self.wanted, self.submitted = {}, waits, {}, 0

    def AutoExecutor(self, folder, *, cluster, slurm_max_num_timeout):
        assert cluster == "slurm" and slurm_max_num_timeout > 100
        return self

    def update_parameters(self, **wanted):
        if unknown := wanted.keys() - {"name", "slurm_time", "slurm_array_parallelism", "slurm_partition"}:
            raise ValueError(f"Unavailable parameter(s): {sorted(unknown)}\nValid parameters are:\n  - time")
        self.wanted = wanted

    def batch(self):
        return contextlib.nullcontext()

    def submit(self, fold):
        self.submitted += 1
        self.jobs[name := f"7_{self.submitted}"] = fold
        return SimpleNamespace(job_id=name)

    def queue(self, unknown=()):
        known, self.waits = set(self.jobs), self.waits - 1
        if self.waits < 0:
            for name in list(self.jobs):
                main(self.jobs.pop(name).command[3:])
        return known


def test_slurm_gets_an_array_of_what_is_left_and_finds_its_jobs_again(tmp_path, monkeypatch, capsys):
    scheduler = Scheduler()
    monkeypatch.setattr(launchers, "_submitit", lambda: scheduler)
    monkeypatch.setattr(launchers, "_queue", scheduler.queue)
    monkeypatch.setattr(launchers, "QUEUE_SECONDS", 0.0)
    monkeypatch.setenv("STUB_FAILS", "bench:blobs")
    given = ("--launcher", "slurm", "--jobs", "2", "--slurm", "partition=gpu", "time=60")
    assert run(tmp_path, *GIVEN, *given) == 1
    assert scheduler.wanted == {
        "name": "zestjax",
        "slurm_time": 60,
        "slurm_array_parallelism": 2,
        "slurm_partition": "gpu",
    }
    assert scheduler.submitted == 3 and run(tmp_path, *given, "--quiet") == 1 and scheduler.submitted == 3
    scheduler.jobs["8_0"] = launchers.SlurmFold(["", "", "", "crossval", "table", "--out", str(tmp_path), "--quiet"])
    scheduler.waits = 1
    (tmp_path / "slurm/jobs.json").write_text('{"1": "8_0"}')
    assert run(tmp_path, *given, "--failed", "--quiet") == 1 and scheduler.submitted == 3  # it is in the queue already
    capsys.readouterr()
    refused(capsys, run(tmp_path, *given, "--failed", "--slurm", "colour=red", "--quiet"), "SLURM refuses", "colour")


def test_what_slurm_says_is_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/squeue").write_text("#!/bin/sh\necho 'Unable to contact\nslurm controller' >&2; exit 1\n")
    (tmp_path / "bin/squeue").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setattr(launchers, "_submitit", Scheduler)
    refused(capsys, run(tmp_path / "out", *GIVEN, "--launcher", "slurm"), "does not answer: Unable to contact slurm")
    monkeypatch.setattr(launchers, "_queue", lambda *_: set())

    def fail(*_):
        raise RuntimeError("invalid\npartition")

    monkeypatch.setattr(Scheduler, "submit", fail)
    refused(capsys, run(tmp_path / "out", *GIVEN, "--launcher", "slurm"), "SLURM refuses: invalid partition")


def test_slurm_that_is_not_there_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(launchers, "_submitit", lambda: None)
    refused(capsys, run(tmp_path, *GIVEN, "--launcher", "slurm"), "no `squeue`")
    monkeypatch.undo()
    monkeypatch.setattr(launchers, "import_module", lambda _: (_ for _ in ()).throw(ModuleNotFoundError()))
    monkeypatch.setattr("zestjax.apps.cli._prepare_jax", lambda: None)
    refused(capsys, run(tmp_path, *GIVEN, "--launcher", "slurm"), "zestjax[slurm]")


def test_a_job_that_slurm_takes_asks_its_fold_to_save(monkeypatch):
    saves = "import signal, sys, time; signal.signal(signal.SIGUSR2, lambda *_: sys.exit(75)); time.sleep(60)"
    job, again = launchers.SlurmFold([sys.executable, "-c", saves]), []
    monkeypatch.setattr(launchers, "import_module", lambda _: SimpleNamespace(DelayedSubmission=again.append))
    thread = threading.Thread(target=lambda: pytest.raises(RuntimeError, job))
    thread.start()
    time.sleep(1.0)
    job.checkpoint()
    thread.join(10)
    assert job.child.returncode == 75 and again[0].command == job.command


def test_the_time_left_is_of_what_has_not_ended():
    states = [
        State("done", seconds=100.0),
        State("failed"),
        State("running", "train", 50, 100, 90.0, 1.0),
        State("waiting"),
    ]
    assert seconds_left(states, None) == pytest.approx(50 + 14 + 100)  # what compiling took is no pace
    assert seconds_left([State("running", "train", 1, 100, 90.0, 0.0)], 200.0) == 110.0
    assert seconds_left([State("waiting")] * 3, 10.0) == 30.0 and seconds_left([State("waiting")], None) is None
    assert seconds_left([State("running", "evaluate", 5, 5, 90.0)] * 2 + [State("waiting")] * 2, 100.0) == 110.0


def test_choices_may_be_given_as_python_has_them(tmp_path):
    plan = agreed_plan(tmp_path, {"systems": "zest-none", "settings": {"rate.peak": (1e-3, 5e-4), "blocks": 1}})
    assert plan.settings == (("rate.peak", ("0.001", "0.0005")), ("blocks", ("1",)))
    assert {fold.row for fold in plan.folds} == {"zest-none,rate.peak=0.001", "zest-none,rate.peak=0.0005"}


def test_intervals_are_students():
    values = [20.0, 23.0, 21.5, 26.0]
    found = crossval_table.interval(values)
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    assert found["n"] == 4 and (found["low"], found["high"]) == pytest.approx((low, high), abs=1e-5)
    assert crossval_table.interval([3.0]) == {"mean": 3.0, "low": None, "high": None, "n": 1}
    assert crossval_table.interval([None]) is None


def test_the_function_returns_the_table_with_paired_differences(tmp_path):
    table = crossval(tmp_path, scenes=SCENES, preset="tiny", steps=2, systems=("zest", "zest-geometry"), seeds=2)
    assert (table["folds"], table["finished"]) == (12, 12)
    assert [(row["row"], row["folds"], row["full"]["psnr"]["n"]) for row in table["rows"]] == [
        ("zest", 6, 3),
        ("zest-geometry", 6, 3),
    ]
    (paired,) = table["paired"]
    assert paired["against"] == "zest" and paired["full"]["psnr"]["n"] == 3 and paired["dynamic"]["psnr"] is None
    assert paired["scenes"]["walker"]["full"]["psnr"]["n"] == 3  # targets, their seeds averaged
    assert len(table["images"]["zest"]["walker"]) == 6 and len(table["scenes"]["zest"]["walker"]) == 2
    assert table == json.loads((tmp_path / "table.json").read_text())
    rows = (tmp_path / "table.csv").read_text().splitlines()
    assert rows[0].startswith("system,folds,of,full_psnr,full_psnr_low,full_psnr_high") and len(rows) == 3
    assert (tmp_path / "table.tex").read_text().count(r"\end{tabular}") == 2
