"""Peak memory of a stretch of work: the device's own count on an accelerator, the process's resident size on a CPU."""

import contextlib
import ctypes
import sys
from pathlib import Path

import jax

PROCESS = Path("/proc/self")


def reset_peak():
    """Start a new peak of the process's resident size, where the system can (Linux); what was freed goes back first."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's
        if trim is not None:
            trim(0)
    with contextlib.suppress(OSError):
        (PROCESS / "clear_refs").write_text("5")


def peak_megabytes():
    """The peak since `reset_peak` (of a device: since its start) in MB, or None where the system does not tell."""
    stats = jax.devices()[0].memory_stats() or {}
    return stats["peak_bytes_in_use"] / 1e6 if "peak_bytes_in_use" in stats else _resident("VmHWM")


def held_megabytes():
    """What is held now, in MB, or None where the system does not tell."""
    stats = jax.devices()[0].memory_stats() or {}
    return stats["bytes_in_use"] / 1e6 if "bytes_in_use" in stats else _resident("VmRSS")


def _resident(name):
    """One line of the process's status, in MB."""
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = (PROCESS / "status").read_text().splitlines()
        return float(next(line for line in lines if line.startswith(name)).split()[1]) * 1024 / 1e6
    return None
