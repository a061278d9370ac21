"""The process that renders training clips ahead of a trainer, and the clips it delivers.

The trainer asks for what is missing: one line of clip indices on the producer's standard input, in the order they are
wanted; the producer answers each on its standard output once it is written. The input closes with the trainer, however
it ends, and the producer with the input. Several trainers may share a folder: each removes only what it asked for, and
asks again for what another has removed.

pending  asked for and not answered yet
"""

import contextlib
import functools
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tqdm import tqdm

from zestjax.apps.clips import clip_path, evidence_folder, origin_of, read_clip
from zestjax.io.files import make_folder

ASKED_AGAIN = 5  # times that a delivered clip may have gone before it is read: another trainer removes it but once
LEFT_SECONDS = 3600  # from which a half-written clip is of a producer that was killed: writing one takes a second


class ProducerError(RuntimeError):
    """The process that renders clips ended, twice with nothing delivered between, or its clips do not stay."""


class Producer:
    """A process that renders the clips it is asked for, started once more if it ends; a context that ends it."""

    def __init__(self, spec, folder):
        self.spec, self.folder = spec, Path(folder)
        self.folders = (self.folder, evidence_folder(folder, spec.planes)) if spec.planes else (self.folder,)
        for made in self.folders:
            make_folder(made)
            _remove_left(made)
        self.pending, self.heard, self.may_restart = {}, b"", True
        self._start()

    def _start(self):
        spec, size = self.spec, f"{self.spec.height}x{self.spec.width}"
        command = [sys.executable, "-m", "zestjax.apps.clips", "--follow", "--out", str(self.folder), "--size", size]
        command += ["--seed", str(spec.seed), "--frames", str(spec.frames), "--targets", str(spec.targets)]
        environment = os.environ | {"PJRT_NPROC": "1", "OMP_NUM_THREADS": "1", "JAX_ENABLE_X64": "0"}
        self.said = tempfile.TemporaryFile()
        self.process = subprocess.Popen(
            [*command, "--planes", str(spec.planes)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.said,
            env=environment, start_new_session=True,
        )  # fmt: skip
        assert self.process.stdin is not None and self.process.stdout is not None
        self.asked, self.answers = self.process.stdin, self.process.stdout
        os.set_blocking(self.answers.fileno(), False)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        with contextlib.suppress(OSError):
            self.asked.close()
        self.answers.close()
        self.said.close()

    def paths(self, index):
        """The files of clip `index`; the evidence, if there is any, is written last."""
        return [clip_path(folder, index) for folder in self.folders]

    def has(self, index):
        """Whether clip `index` lies there."""
        return all(path.exists() for path in self.paths(index))

    def ask(self, indices):
        """Have these clips rendered, in this order, those left out that exist or are pending."""
        missing = [index for index in indices if index not in self.pending and not self.has(index)]
        self.pending |= dict.fromkeys(missing)
        if missing:
            with contextlib.suppress(BrokenPipeError):  # `wait` finds that it ended
                self.asked.write(" ".join(map(str, missing)).encode() + b"\n")
                self.asked.flush()

    def wait(self, index):
        """The arrays of clip `index`, once it is there.

        Raises:
          ProducerError: the producer ended twice, or another process removes what it delivers.
          ValueError: its file is damaged or another clip's.
        """
        again = 0
        while True:
            with contextlib.suppress(FileNotFoundError):  # removed by another trainer meanwhile
                if self.has(index):
                    read = [read_clip(path, origin_of(self.spec, index)) for path in self.paths(index)]
                    return {name: array for arrays in read for name, array in arrays.items()}
            self._listen()
            if self.process.poll() is not None:
                self._listen()
                self._restart()
            elif index not in self.pending and not self.has(index):
                if again == ASKED_AGAIN:
                    raise ProducerError(f"{self.paths(index)[-1]}: goes as soon as it is there; choose other --clips.")
                again += 1
                self.ask([index])
            time.sleep(0.02)

    def _listen(self):
        """Take note of what was delivered."""
        with contextlib.suppress(BlockingIOError):
            self.heard += os.read(self.answers.fileno(), 1 << 16)
        *lines, self.heard = self.heard.split(b"\n")
        for line in lines:
            if line.isdigit():
                self.pending.pop(int(line), None)
                self.may_restart = True

    def _restart(self):
        """Start again, and ask again for what is pending, unless nothing was delivered since the last start."""
        self.said.seek(0)
        words = self.said.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
        text = f"the process that renders clips {_ending(self.process.returncode)}: {words[-1]}"
        if not self.may_restart:
            raise ProducerError(text)
        tqdm.write(f"warning: {text}; it is started once more.", file=sys.stderr)
        self.__exit__()
        wanted, self.pending, self.heard, self.may_restart = tuple(self.pending), {}, b"", False
        self._start()
        self.ask(wanted)


class ClipSource:
    """Clips by index, the last `alive` of them held in memory, those ahead asked for; a context.

    evict: clips that this source asked for are removed once they are older than all that may be wanted.
    """

    def __init__(self, spec, folder, *, alive, evict):
        self.evict, self.waited, self._asked, self._mine = evict, 0.0, None, set()
        self.producer = Producer(spec, folder)
        self._load = functools.lru_cache(maxsize=alive)(self._read)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.producer.__exit__()

    def _read(self, index):
        try:
            return self.producer.wait(index)
        except ValueError as error:
            tqdm.write(f"warning: {error} It is rendered again.", file=sys.stderr)
            self._remove(index)
            return self.producer.wait(index)

    def clip(self, index, ahead):
        """Arrays of clip `index`; `ahead`: the indices that may be wanted soon, soonest first."""
        ahead = tuple(ahead)
        if ahead != self._asked:
            self._asked = ahead
            wanted = dict.fromkeys((index, *ahead))
            self.producer.ask(wanted)
            if self.evict:
                self._mine.update(wanted)
                for old in [mine for mine in self._mine if mine < min(wanted)]:
                    self._remove(old)
                    self._mine.remove(old)
        start = time.perf_counter()
        arrays = self._load(index)
        self.waited += time.perf_counter() - start
        return arrays

    def _remove(self, index):
        for path in self.producer.paths(index):
            path.unlink(missing_ok=True)


def _ending(code):
    """How a process ended, in words."""
    if code >= 0:
        return f"ended with exit code {code}"
    name = signal.Signals(-code).name
    return f"was ended by {name}" + " (the system ends processes so when memory is short)" * (name == "SIGKILL")


def _remove_left(folder):
    """Remove what killed producers left: half-written clips, and the logs of earlier versions."""
    for left in (*folder.glob(".clip-*.part"), *folder.glob("producer-*.log")):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > LEFT_SECONDS:
                left.unlink()
