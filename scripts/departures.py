#!/usr/bin/env python3
"""Collects the ``Departs:`` paragraphs of all docstrings into docs/departures.md.

    python scripts/departures.py          rewrites the file
    python scripts/departures.py --check  says whether it is up to date

Needs nothing but Python.
"""

import ast
import re
import sys
from pathlib import Path

TOP = Path(__file__).resolve().parents[1]
SOURCE = TOP / "src" / "handavatar"
TARGET = TOP / "docs" / "departures.md"

HEADER = """\
# Where the code differs from the paper on purpose

Made by `python scripts/departures.py` from the `Departs:` lines of the docstrings; change those,
not this file. A test compares both.

| where | departure |
|---|---|
"""
# A paragraph ends at an empty line or at the next section of the docstring.
_DEPARTURE = re.compile(r"^ *Departs:(.*?)(?=^\s*$|^ *[A-Z][a-z]+:(?:\s|$)|\Z)", re.S | re.M)


def departures(tree: ast.Module) -> list[tuple[str, str]]:
    """Pairs of a dotted name within the module and one departure, in the order of the file."""
    found: list[tuple[str, str]] = []

    def visit(node: ast.AST, name: str) -> None:
        before = ""
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                visit(child, f"{name}.{child.name}" if name else child.name)
            elif text := _string(child):
                owner = ".".join(part for part in (name, before) if part)
                for match in _DEPARTURE.finditer(text):
                    found.append((owner, " ".join(match[1].split())))
            before = _assigned(child)

    visit(tree, "")
    return found


def _string(node: ast.AST) -> str:
    """The text of a statement that is only a string: a docstring, or one of an attribute."""
    is_string = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return node.value.value if is_string and isinstance(node.value.value, str) else ""


def _assigned(node: ast.AST) -> str:
    """The name that an assignment sets: the string after it documents that name."""
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        return node.target.id
    return ""


def document() -> str:
    """The text of docs/departures.md."""
    rows = []
    for path in sorted(SOURCE.rglob("*.py")):
        module = path.relative_to(SOURCE).as_posix()
        for name, text in departures(ast.parse(path.read_text(encoding="utf-8"))):
            where = f"`{module}`" + (f" `{name}`" if name else "")
            escaped = text.replace("|", r"\|")
            rows.append(f"| {where} | {escaped} |\n")
    return HEADER + "".join(rows)


def main() -> int:
    """Rewrites or checks the document."""
    text = document()
    if "--check" in sys.argv[1:]:
        return 0 if TARGET.exists() and TARGET.read_text(encoding="utf-8") == text else 1
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
