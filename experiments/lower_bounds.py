"""Prints the declared lower bounds of a pyproject.toml as a pip constraints file: `name==bound` a line.

python experiments/lower_bounds.py pyproject.toml > lowest.txt
"""

import re
import sys
import tomllib
from pathlib import Path


def lower_bounds(project):
    """Constraint lines of a parsed pyproject's dependencies and `dev` extra; every entry must state a `>=`."""
    entries = project["dependencies"] + project["optional-dependencies"]["dev"]
    lines = []
    for entry in entries:
        match = re.match(r"([A-Za-z0-9_.-]+)>=([0-9.]+)", entry)
        if match is None:
            raise ValueError(f"{entry!r} in pyproject.toml states no lower bound (`name>=version`).")
        lines.append("{}=={}".format(*match.groups()))
    return lines


if __name__ == "__main__":
    print("\n".join(lower_bounds(tomllib.loads(Path(sys.argv[1]).read_text())["project"])))
