"""The pictures of a command's last run and of no earlier one.

A record is the JSON file beside the pictures that names them: it is written before the first one, so that the next run
knows what an interrupted one left. What no record names is not touched.
"""

import json
import re

from zestjax.io.files import write_bytes
from zestjax.io.reading import read_json

OURS = re.compile(r"((frames|pictures)/[^/]+\.png|video\.(webm|webp))")


def begin(record, names, told):
    """Remove what an earlier run of a command recorded, and record what is to come.

    Args:
      record: path of the JSON file; the names are relative to its folder.
      names: dict of an earlier record -> its files' names.
      told: dict to record.

    Raises:
      OSError: the place is not writable.
    """
    for name in names(read_record(record)):
        if isinstance(name, str) and OURS.fullmatch(name):
            (record.parent / name).unlink(missing_ok=True)
    write_record(record, told)


def write_record(record, told):
    """Write a record."""
    write_bytes(record, (json.dumps(told, indent=1) + "\n").encode())


def read_record(record):
    """The dict of a record; empty where there is none that can be read."""
    try:
        told = read_json(record)
    except (OSError, ValueError):
        return {}
    return told if isinstance(told, dict) else {}
