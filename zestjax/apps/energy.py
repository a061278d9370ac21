"""Energy of a stretch of work, where the machine counts it (Linux's RAPL); most containers do not tell."""

import contextlib
from pathlib import Path

COUNTERS = "/sys/class/powercap"
PACKAGES = "intel-rapl:[0-9]"  # one a socket, of AMD's processors too; what lies below them is counted in them


def joules() -> float | None:
    """What all sockets have used since some moment, in joules; None where the system does not tell."""
    found = []
    with contextlib.suppress(OSError, ValueError):
        found = [int((p / "energy_uj").read_text()) / 1e6 for p in Path(COUNTERS).glob(PACKAGES)]
    return sum(found) if found else None


def joules_since(start: float | None) -> float | None:
    """Joules since a count of `joules`; None where it is not told, or the counter began anew meanwhile."""
    now = joules()
    return None if start is None or now is None or now < start else now - start
