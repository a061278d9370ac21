"""What a scene calls for, as a value: of every effect whether it is on, and the evidence.

told     "yes": it is there. "no": it is not. "cannot tell": the frames do not say, and the effect stays on
switch   an effect that a system, or the data it learns from, can do without
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

YES, NO, UNKNOWN = "yes", "no", "cannot tell"
SWITCHES = ("motion", "disocclusion", "exposure", "flow_prior", "depth_prior")
"""What is off is not in the program: see `effects.systems`."""
REPORTED = ("view_dependence", "noise", "thin_structures", "revisits", "forward_facing")
"""What is told and changes nothing in the program."""
EFFECTS = SWITCHES + REPORTED


class Evidence(NamedTuple):
    """Of one effect. told: see the header. numbers: measured, by name. thresholds: that they were compared with, by the
    same names or by what they bound. reason: a sentence. picture: (h, w, 3) in [0, 1] of where it was found, or
    None."""

    told: str
    numbers: Mapping[str, float]
    thresholds: Mapping[str, float]
    reason: str
    picture: np.ndarray | None = None

    @property
    def on(self) -> bool:
        """Whether the effect is computed where the user leaves it open: unless it surely is not there."""
        return self.told != NO


Found = dict[str, Evidence]
"""`Evidence` by effect."""


def unknown(reason: str, *, numbers: Mapping[str, float] | None = None) -> Evidence:
    """`Evidence` of what the frames do not tell."""
    return Evidence(UNKNOWN, numbers or {}, {}, reason)


def judged(value: float, *, least: float, most: float, name: str, what: str) -> tuple[str, str]:
    """(told, reason) of a number: no below `least`, yes from `most` on, and between them the frames cannot tell."""
    told = UNKNOWN if not np.isfinite(value) else NO if value < least else YES if value >= most else UNKNOWN
    bound = (
        f"below {least:g}" if told == NO else f"{most:g} or more" if told == YES else f"between {least:g} and {most:g}"
    )
    return told, f"{what}: {name} is {value:.4g}, {bound}"


def chosen(found: Found, choice: str | Iterable[str]) -> frozenset[str]:
    """Which effects are on.

    Args:
      found: `Found`; may be empty unless the choice is `auto`.
      choice: `auto`, as found; `all`; `none`; or names, separated by commas or given one by one.

    Raises:
      ValueError: an unknown name, listing the known ones.
    """
    if choice == "auto":
        return frozenset(name for name, evidence in found.items() if evidence.on)
    if choice in ("all", "none"):
        return frozenset(EFFECTS if choice == "all" else ())
    names = frozenset(choice.split(",") if isinstance(choice, str) else choice)
    if wrong := sorted(names - set(EFFECTS)):
        listed = ", ".join(("auto", "all", "none", *EFFECTS))
        raise ValueError(f"effects: {wrong[0]!r} is none; expected one of {listed}, or several names with commas.")
    return names


def as_told(found: Found) -> dict:
    """`Found` as JSON holds it: {name: {"on", "use", "evidence"}}."""
    number = lambda x: float(f"{float(x):.6g}") if np.isfinite(x) else None
    numbers = lambda values: {name: number(value) for name, value in values.items()}
    each = lambda e: {"told": e.told, "reason": e.reason, **numbers(e.numbers), "thresholds": numbers(e.thresholds)}
    use = lambda name: "a switch" if name in SWITCHES else "told only: it changes nothing in the program"
    return {name: {"on": e.on, "use": use(name), "evidence": each(e)} for name, e in found.items()}
