"""Peak memory of a stretch of work: the device's own count on an accelerator, the process's resident size on a CPU."""

import contextlib
from pathlib import Path

import jax

PROCESS = Path("/proc/self")


def reset_peak():
    """Start a new peak of the process's resident size, where the system can (Linux)."""
    with contextlib.suppress(OSError):
        (PROCESS / "clear_refs").write_text("5")


def peak_megabytes():
    """The peak since `reset_peak` (of a device: since its start) in MB, or None where the system does not tell."""
    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return stats["peak_bytes_in_use"] / 1e6
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = (PROCESS / "status").read_text().splitlines()
        return float(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024 / 1e6
    return None
