"""The package's source as syntax trees, for the guards; nothing is imported."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

TOP = Path(__file__).parents[1]
SOURCE = TOP / "src" / "handavatar"


@cache
def modules() -> dict[str, ast.Module]:
    """Dotted name to syntax tree of every module of the package; read only."""
    found = {}
    for path in sorted(SOURCE.rglob("*.py")):
        parts = path.relative_to(SOURCE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    return found


def imported_modules(node: ast.AST) -> Iterator[str]:
    """Dotted names that one import statement names, with ``from a import b`` as ``a.b``."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, f"line {node.lineno}: relative import"
        yield from (f"{node.module}.{alias.name}" for alias in node.names)


def find_definition(tree: ast.Module, dotted: str) -> ast.AST | None:
    """The class, function or method of a dotted name such as ``Rig.shaped``."""
    node: ast.AST = tree
    for part in dotted.split("."):
        body = getattr(node, "body", [])
        named = [item for item in body if getattr(item, "name", None) == part]
        if not named:
            return None
        node = named[-1]
    return node
