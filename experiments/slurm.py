"""A cross-validation on a real SLURM of one node: a fold that fails, one that is killed, and two that are requeued.

    python experiments/slurm.py --out runs/slurm [--steps 200]

As root of a Debian it installs slurmctld, slurmd, slurm-client and munge where they are missing, starts them with a
configuration of its own (no accounting database), and ends them. Five folds of `tiny` run as an array, two at a time:

fails      its scene has no held-out pictures: the others end, and `--failed` runs it once it has
killed     by SIGKILL: the same command goes on
preempted  by a job of a partition with more priority: SLURM requeues it
signalled  SIGUSR2, as before a time limit: the fold saves, and submitit requeues it

Every fold is compared with a run that nothing disturbed, bit by bit. Prints what was found; the exit code is 1 if
anything is not as it should be.
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from zestjax.apps.simulate import SimulateOptions, simulate
from zestjax.io.weights import load_weights

PACKAGES = ("slurmctld", "slurmd", "slurm-client", "munge")
SCENES = ("blobs", "crowd", "dusk", "marbles", "walker")
FAILS, KILLED, PREEMPTED, SIGNALLED = 0, 1, 2, 3
CAP = 2
CONFIGURATION = """
ClusterName=zestjax
SlurmctldHost={host}
SlurmUser=root
AuthType=auth/munge
AuthInfo=cred_expire=10
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
SlurmdParameters=config_overrides
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ReturnToService=2
KillWait=30
NodeName={host} CPUs={cap} RealMemory=4000 State=UNKNOWN
PartitionName=low Nodes={host} Default=YES MaxTime=INFINITE State=UP PriorityTier=1
PartitionName=high Nodes={host} MaxTime=INFINITE State=UP PriorityTier=10
"""
"""`cred_expire` is also how long a requeued job waits; the default is two minutes."""


@contextlib.contextmanager
def slurm(folder):
    """Context: a SLURM of this node runs; its daemons are ours and end with it."""
    if missing := [
        name for name in PACKAGES if not shutil.which({"slurm-client": "sbatch", "munge": "munged"}.get(name, name))
    ]:
        subprocess.run(["apt-get", "install", "-y", "-q", "--no-install-recommends", *missing], check=True,
                       env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"}, stdout=sys.stderr)  # fmt: skip
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    conf = folder / "slurm.conf"
    conf.write_text(CONFIGURATION.format(host=socket.gethostname(), folder=folder, cap=CAP))
    os.environ["SLURM_CONF"] = str(conf)
    subprocess.run(["install", "-d", "-o", "munge", "-g", "munge", "/run/munge"], check=True)
    commands = (["runuser", "-u", "munge", "--", "munged", "-F"], ["slurmctld", "-D", "-f", str(conf)],
                ["slurmd", "-D", "-f", str(conf)])  # fmt: skip
    if subprocess.run(["munge", "-n"], capture_output=True).returncode == 0:
        commands = commands[1:]  # one runs already
    daemons = []
    try:
        for command in commands:
            daemons.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
            time.sleep(1)
        wait("the node to be idle", lambda: "idle" in said("sinfo", "-h", "-o", "%T"), 60)
        yield
    finally:
        subprocess.run(["scancel", "--me"], capture_output=True)
        for daemon in reversed(daemons):
            daemon.terminate()
            daemon.wait()


def said(*command):
    """What a command prints."""
    return subprocess.run(command, capture_output=True, text=True).stdout


def wait(what, ready, seconds):
    """Wait until something is so.

    Raises:
      TimeoutError: it never was.
    """
    last = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > last:
            raise TimeoutError(f"waited {seconds} s for {what}")
        time.sleep(0.2)


class Study:
    """The folds, what happens to them, and what was not as it should be."""

    def __init__(self, root, steps):
        self.root, self.out, self.steps, self.wrong, self.most = root, root / "slurm", steps, [], 0
        self.notes = {}
        for name in SCENES:
            simulate(SimulateOptions(root / "data" / name, scene=name, size=(32, 48), frames=6, quiet=True))

    def given(self, out, *flags):
        scenes = [str(self.root / "data" / name) for name in SCENES]
        choices = ["--scenes", *scenes, "--preset", "tiny", "--steps", str(self.steps), "--targets", "2"]
        where = ["--checkpoint-minutes", "0.05", "--out", str(out)]
        return [sys.executable, "-m", "zestjax.apps.cli", "crossval", *choices, *where, *flags]

    def reference(self):
        """The run that nothing disturbs."""
        start = time.monotonic()
        subprocess.run(self.given(self.root / "inline", "--quiet"), check=True)
        self.notes["inline_seconds"] = round(time.monotonic() - start)

    def submit(self, *flags):
        """Start the launcher."""
        return subprocess.Popen(self.given(self.out, "--launcher", "slurm", "--jobs", str(CAP), *flags))

    def status(self):
        text = said(sys.executable, "-m", "zestjax.apps.cli", "crossval", "status", "--json", "--out", str(self.out))
        return json.loads(text)["each"] if text else []

    def training(self, fold):
        """Whether a fold has a checkpoint to go on from, and trains."""
        self.most = max(self.most, len(said("squeue", "--me", "-h", "-r", "-t", "R", "-o", "%i").split()))
        return any((self.out / f"work/{fold:03d}/fold/train/checkpoints").glob("step_*.safetensors"))

    def job(self, fold):
        return json.loads((self.out / "slurm/jobs.json").read_text())[str(fold)]

    def check(self, holds, what):
        print(f"{'ok   ' if holds else 'WRONG'} {what}", file=sys.stderr, flush=True)
        self.wrong += [] if holds else [what]

    def disturb(self, launcher):
        """Do to three folds what may happen to them, each while it trains."""
        for fold, event in ((KILLED, self.kill), (PREEMPTED, self.preempt), (SIGNALLED, self.signal)):
            wait(f"fold {fold} to train", lambda fold=fold: self.training(fold) or launcher.poll() is not None, 600)
            event(fold)
        while launcher.poll() is None:
            self.training(0)
            time.sleep(0.5)
        return launcher.returncode

    def kill(self, fold):
        process = json.loads((self.out / f"work/{fold:03d}/beat.json").read_text())["process"]
        os.kill(process, signal.SIGKILL)

    def preempt(self, fold):
        """Ask for the whole node: SLURM takes it from the folds that run."""
        subprocess.run(["sbatch", "-p", "high", "-n", str(CAP), "-o", "/dev/null", "--wrap", "sleep 3"], check=True,
                       stdout=subprocess.DEVNULL)  # fmt: skip

    def signal(self, fold):
        subprocess.run(["scancel", "--signal=USR2", self.job(fold)], check=True)

    def restarts(self, fold):
        """How often SLURM started a fold's job again."""
        told = said("scontrol", "show", "job", self.job(fold))
        return int(told.partition("Restarts=")[2].split()[0]) if "Restarts=" in told else -1

    def same(self, fold):
        """Whether a fold's weights are those of the run that nothing disturbed."""
        name = f"folds/zest/{SCENES[fold]}/train/weights.safetensors"
        (one, _), (other, _) = load_weights(self.out / name), load_weights(self.root / "inline" / name)
        return all(np.array_equal(one[leaf], other[leaf]) for leaf in other)


def study(root, steps):
    """Run it all; the `Study`."""
    done = Study(root, steps)
    done.reference()
    scene, aside = root / "data" / SCENES[FAILS] / "mv_images", root / "aside"
    scene.rename(aside)
    with slurm(root / "etc"):
        done.check("accounting_storage/none" in said("scontrol", "show", "config"), "no accounting database")
        start = time.monotonic()
        code = done.disturb(done.submit())
        done.notes["array_seconds"] = round(time.monotonic() - start)
        states = [fold["state"] for fold in done.status()]
        expected = ["done"] * len(SCENES)
        expected[FAILS], expected[KILLED] = "failed", "stopped"
        done.check(states == expected and code == 75, f"states {states}, exit code {code}: run me again")
        done.check("no pictures of other cameras" in str(done.status()[FAILS]["reason"]), "the failure has its reason")
        done.check(done.most == CAP, f"{done.most} jobs ran at a time, of {CAP} allowed")
        for fold in (PREEMPTED, SIGNALLED):
            done.check(done.restarts(fold) >= 1, f"fold {fold} was requeued {done.restarts(fold)} times")
        code = done.submit().wait()
        states = [fold["state"] for fold in done.status()]
        done.check(states.count("done") == 4 and code == 1, f"again: {states}, exit code {code}: one failed")
        aside.rename(scene)
        code = done.submit("--failed").wait()
        done.check(code == 0, f"--failed, with its pictures: exit code {code}")
    for fold in range(len(SCENES)):
        done.check(done.same(fold), f"fold {fold}: the bits of the run that nothing disturbed")
    return done


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=200)
    options = parser.parse_args()
    if os.geteuid():
        print("error: SLURM's daemons are started as root; run it as root, in a container", file=sys.stderr)
        return 2
    root = options.out.resolve()
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    os.environ["PJRT_NPROC"] = "1"  # bits are those of one number of threads
    done = study(root, options.steps)
    print(json.dumps({"wrong": done.wrong, **done.notes}))
    return 1 if done.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
