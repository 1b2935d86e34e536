#!/usr/bin/env python3
"""Makes examples/hand_avatar.ipynb from the examples, so that both tell the same story.

    python scripts/notebook.py

A line ``# %% Title`` in an example begins a cell; its docstring becomes the text above. Options
take their defaults, and pictures that are saved are shown. Needs nothing but Python.
"""

import ast
import json
import re
import sys
from pathlib import Path

TOP = Path(__file__).resolve().parents[1]
EXAMPLES = TOP / "examples"
TARGET = EXAMPLES / "hand_avatar.ipynb"

TITLE = """\
# A hand avatar, from a capture to an engine

Made by `python scripts/notebook.py` from the examples in this folder; change those, not this file.
A test compares both. The first part trains for some minutes."""
_ASKS = "options = tyro.cli(Options)"
_TAKES = "options = Options()"
_SAVED = re.compile(r"^(Image\.fromarray\(\w+\))\.save\(", re.M)


def cells(example: str) -> list[tuple[str, str]]:
    """Kind (``markdown`` or ``code``) and text of each cell of one example.

    Raises:
        ValueError: if it has no docstring, or does not read its options in the one known line.
    """
    tree = ast.parse(example)
    told = ast.get_docstring(tree)
    if told is None or example.count(f"\n{_ASKS}\n") != 1:
        raise ValueError(f"an example needs a docstring and the line `{_ASKS}`")
    first, _, rest = told.partition("\n")
    found = [("markdown", f"## {first.rstrip('.')}\n{rest}".rstrip())]
    begin, *parts = example.split("\n# %% ")
    imports = "\n".join(begin.splitlines()[tree.body[0].end_lineno :]).replace("import tyro\n", "")
    found.append(("code", imports.strip()))
    for part in parts:
        title, _, code = part.partition("\n")
        code = code.strip().replace(_ASKS, _TAKES)
        shown = _SAVED.findall(code)
        found.append(("markdown", f"### {title}"))
        found.append(("code", "\n".join([code, *shown[-1:]])))
    return found


def document() -> str:
    """The text of the notebook: nbformat 4, nothing executed."""
    told = [("markdown", TITLE)]
    for path in sorted(EXAMPLES.glob("[0-9]*.py")):
        told += cells(path.read_text(encoding="utf-8"))
    content = []
    for number, (kind, text) in enumerate(told):
        cell = {"cell_type": kind, "id": f"cell-{number:02d}", "metadata": {}}
        if kind == "code":
            cell |= {"execution_count": None, "outputs": []}
        content.append(cell | {"source": text.splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook = {
        "cells": content,
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


def main() -> int:
    """Rewrites the notebook."""
    TARGET.write_text(document(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
