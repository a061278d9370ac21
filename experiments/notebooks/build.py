"""Run the notebooks and render them for reading: `python experiments/notebooks/build.py [NAME ...]`.

A notebook is stored as a Python script whose cells begin with `# %%`: it can be compared line by line, and runs as it
is. This writes `rendered/NAME.md` with every cell's output and its figures, and fails if a cell does, or if a notebook
takes longer than it may. Needs the extra `notebooks`: `make notebooks` installs it.
"""

import argparse
import re
import sys
import time
from pathlib import Path

import jupytext
from nbclient import NotebookClient
from nbconvert import MarkdownExporter

from zestjax.io.files import write_bytes

HERE = Path(__file__).parent
LIMIT = 180  # seconds, on two cores


def rendered(path):
    """Run one notebook; its Markdown, its figures by file name, and the seconds it took."""
    notebook = jupytext.read(path)
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    start = time.perf_counter()
    folder = {"metadata": {"path": str(path.parent)}}
    # The limit is for an idle machine: a cell is stopped only where it hangs.
    NotebookClient(notebook, timeout=4 * LIMIT, coalesce_streams=True, resources=folder).execute()
    seconds = time.perf_counter() - start
    for cell in notebook.cells:
        cell["outputs"] = [o for o in cell.get("outputs", []) if for_reading(o)]
    text, resources = MarkdownExporter().from_notebook_node(notebook)
    text = re.sub(r"/\S*/ipykernel_\d+/\d+\.py:(\d+)(:\d+)?", r"line \1 of its cell", text)
    figures = {f"{path.stem}_{name}": content for name, content in resources.get("outputs", {}).items()}
    for name in resources.get("outputs", {}):
        text = text.replace(f"({name})", f"({path.stem}_{name})")
    return text, figures, seconds


def for_reading(output):
    """Not progress bars and warnings, nor where in memory a plot's legend lies."""
    shown = output.get("data", {})
    return output.get("name") != "stderr" and ("image/png" in shown or " at 0x" not in shown.get("text/plain", ""))


def main():
    """Render the notebooks named, or all."""
    parser = argparse.ArgumentParser(description="Run the notebooks and render them.")
    parser.add_argument("names", nargs="*", help="beginnings of file names (default: all)")
    names = tuple(parser.parse_args().names) or ("",)
    late = []
    for path in sorted(HERE.glob("[0-9]*.py")):
        if not path.stem.startswith(names):
            continue
        text, figures, seconds = rendered(path)
        for old in (HERE / "rendered").glob(f"{path.stem}_output_*"):
            old.unlink()
        for name, content in {f"{path.stem}.md": text.encode(), **figures}.items():
            write_bytes(HERE / "rendered" / name, content)
        late += [path.stem] if seconds > LIMIT else []
        print(f"{path.stem}: {seconds:.0f} s, {len(figures)} figures", flush=True)
    if late:
        print(f"notebooks: longer than {LIMIT} s: {', '.join(late)}", file=sys.stderr)
    return 1 if late else 0


if __name__ == "__main__":
    sys.exit(main())
