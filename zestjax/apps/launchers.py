"""How the folds of a cross-validation are started: here, each in a process of this machine, or as an array of SLURM.

A launcher is given the folds that have not ended, and returns when nothing that it started runs any more; what became
of them their own files tell (`fold_state`). It may be killed, run again, or run twice.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from importlib import import_module

from zestjax.apps.fold_run import run_fold, stopped_by_signals
from zestjax.apps.fold_state import Place, locked, state_of
from zestjax.apps.results import read_record
from zestjax.apps.run_folder import threads
from zestjax.io.files import resolved, write_bytes

RUN_AGAIN = 75  # EX_TEMPFAIL of sysexits.h: nothing is wrong, and a second time goes on
POLL_SECONDS = 0.2  # of processes
QUEUE_SECONDS = 3.0  # of SLURM's queue, which is asked once for all folds
SUBMIT_SECONDS = 60.0  # another launcher of the folder may be submitting
SLURM_MINUTES = 24 * 60  # of a job by default; one that runs out is requeued and goes on
SLURM_TIMEOUTS = 1000  # how often that may be: the folds' own steps end them


def inline(out, plan, folds, *, failed=False, quiet=False, **_):
    """One fold after the other, in this process."""
    with contextlib.suppress(KeyboardInterrupt), stopped_by_signals():
        for fold in folds:
            outcome = run_fold(out, plan, fold, failed=failed, quiet=quiet)
            _say(out, plan, fold, quiet)
            if outcome == "stopped":
                return


def process(out, plan, folds, *, jobs=None, failed=False, quiet=False, **_):
    """Folds in processes of their own, `jobs` at a time, by default one for two cores, which share the cores."""
    cores, waiting, running = threads() or 1, list(folds), {}
    jobs = jobs or max(1, cores // 2)
    environment = {"PJRT_NPROC": str(max(1, cores // jobs))} | os.environ
    with stopped_by_signals():
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    fold = waiting.pop(0)
                    running[fold] = _start(out, fold, failed, environment)
                for fold in [fold for fold, child in running.items() if child.poll() is not None]:
                    code = running.pop(fold).returncode
                    usual = code in (0, 1, RUN_AGAIN)
                    _say(out, plan, fold, quiet, "" if usual else f"; ended with {code}: {Place(out, fold).log}")
                time.sleep(POLL_SECONDS)
        except KeyboardInterrupt:
            for child in running.values():
                child.terminate()
        finally:
            for child in running.values():
                child.wait()


def _start(out, fold, failed, environment):
    """A fold's process, its output in its log."""
    log = Place(out, fold).log
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        return subprocess.Popen(command_of(out, fold, failed), stdout=file, stderr=file, env=environment)


def command_of(out, fold, failed=False):
    """The command that runs one fold, whoever starts it."""
    where = ["--fold", str(fold.index), "--out", str(resolved(out)), "--quiet"]
    return [sys.executable, "-m", "zestjax.apps.cli", "crossval", "run", *where, *["--failed"] * failed]


def slurm(out, plan, folds, *, jobs=None, failed=False, quiet=False, options=(), **_):
    """An array of SLURM through submitit, `jobs` of it at a time; folds that lie in the queue already are not submitted
    again. options: (name, value) of `sbatch` each. Interrupted, it leaves the jobs in the queue.

    Raises:
      ValueError: there is no submitit or no SLURM, or an option that it does not have.
    """
    folder = resolved(out) / "slurm"
    with locked(folder / "lock", patience=SUBMIT_SECONDS):
        jobs_of = _submitted(out, folder, folds, jobs=jobs, failed=failed, options=options)
    with contextlib.suppress(KeyboardInterrupt), stopped_by_signals():
        while jobs_of:
            time.sleep(QUEUE_SECONDS)
            queued = _queue(jobs_of.values())
            for index in [index for index, job in jobs_of.items() if job not in queued]:
                del jobs_of[index]
                _say(out, plan, plan.folds[int(index)], quiet)


def _submitted(out, folder, folds, *, jobs, failed, options):
    """{index of a fold: its job} of those in the queue, among them the folds given, once they are submitted."""
    submitit, queued, record = _submitit(), _queue(), folder / "jobs.json"
    jobs_of = {index: job for index, job in read_record(record).items() if job in queued}
    new = [fold for fold in folds if str(fold.index) not in jobs_of]
    wanted = {"time": SLURM_MINUTES, "array_parallelism": jobs or len(new)} | dict(options)
    if not new:
        return jobs_of
    try:
        executor = submitit.AutoExecutor(folder, cluster="slurm", slurm_max_num_timeout=SLURM_TIMEOUTS)
        executor.update_parameters(name="zestjax", **{f"slurm_{name}": value for name, value in wanted.items()})
        with executor.batch():
            started = [executor.submit(SlurmFold(command_of(out, fold, failed))) for fold in new]
    except (ValueError, NameError, RuntimeError) as error:  # submitit's; what sbatch says is a RuntimeError
        raise ValueError(f"crossval: SLURM refuses: {' '.join(str(error).split())}") from error
    jobs_of |= {str(fold.index): job.job_id for fold, job in zip(new, started, strict=True)}
    write_bytes(record, json.dumps(jobs_of).encode())
    return jobs_of


class SlurmFold:
    """What a job of SLURM runs: a fold in a process of its own. submitit's `checkpoint` asks that process to save."""

    def __init__(self, command):
        self.command = command

    def __call__(self):
        self.child = subprocess.Popen(self.command)
        threading.Thread(target=self.child.wait, daemon=True).start()
        self.wait()
        if self.child.returncode:
            raise RuntimeError(f"the fold's process ended with {self.child.returncode}")

    def wait(self):
        """Wait for the process, also within a signal's handler: no lock is held."""
        while self.child.returncode is None:
            time.sleep(POLL_SECONDS)

    def checkpoint(self):
        """Called by submitit when SLURM takes the node: what the requeued job runs."""
        self.child.send_signal(signal.SIGUSR2)
        self.wait()
        return import_module("submitit.helpers").DelayedSubmission(SlurmFold(self.command))


def _submitit():
    try:
        return import_module("submitit")
    except ModuleNotFoundError as error:
        raise ValueError("crossval: --launcher slurm needs submitit; pip install 'zestjax[slurm]'.") from error


def _queue(unknown=None):
    """Ids of this user's jobs in SLURM's queue; `unknown`, if given, where it does not answer.

    Raises:
      ValueError: there is no SLURM on this machine, or it does not answer.
    """
    try:
        told = subprocess.run(["squeue", "--me", "-h", "-r", "-o", "%i"], capture_output=True, text=True)
    except FileNotFoundError as error:
        raise ValueError("crossval: --launcher slurm: no `squeue` on this machine; run it where SLURM is.") from error
    if told.returncode and unknown is None:
        raise ValueError(f"crossval: --launcher slurm: SLURM does not answer: {' '.join(told.stderr.split())}")
    return set(unknown or ()) if told.returncode else set(told.stdout.split())


def _say(out, plan, fold, quiet, more=""):
    """A line on standard error of what became of a fold."""
    state = state_of(out, plan, fold)
    if not quiet or state.reason:
        reason = f": {state.reason}" if state.reason else ""
        print(f"crossval: fold {fold.index} {fold.label} {state.state}{reason}{more}", file=sys.stderr, flush=True)


LAUNCHERS = {"inline": inline, "process": process, "slurm": slurm}
