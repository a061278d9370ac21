"""One-page reports: what every HTML page that a command writes has in common. Cells and parts are trusted markup."""

import base64
from collections.abc import Collection, Sequence
from pathlib import Path

from zestjax.io.files import write_bytes

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; padding: 0 1rem; color: #222 }
h1, h2 { line-height: 1.2 } p.small { color: #666; font-size: .9rem } table { border-collapse: collapse }
th, td { text-align: right; border-bottom: 1px solid #ddd } td:first-child { text-align: left }
"""


def write_page(path: Path, title: str, parts: Sequence[str], *, style: str = "") -> Path:
    """Write a page that asks no other host for anything.

    Args:
      path: of the file.
      title: of the window.
      parts: of the body.
      style: beyond `STYLE`.

    Returns:
      path.
    """
    head = f'<meta charset="utf-8"><title>{title}</title><style>{STYLE}{style}</style>'
    page = f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(parts)}</body></html>\n'
    write_bytes(path, page.encode())
    return path


def table(head: Sequence[str], lines: Sequence[Sequence[str]], *, marked: Collection[int] = (), mark: str = "") -> str:
    """A table; the lines of the numbers `marked` have the class `mark`."""
    row = lambda cells, tag, kind="": f"<tr{kind}>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"
    body = [row(line, "td", f' class="{mark}"' if i in marked else "") for i, line in enumerate(lines)]
    return f"<table>{row(head, 'th')}{''.join(body)}</table>"


def embedded(png: bytes) -> str:
    """A picture as the address of an `img`."""
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"
