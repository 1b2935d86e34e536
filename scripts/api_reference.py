#!/usr/bin/env python3
"""Writes docs/api.md and docs/api/: what users' programs may rely on, as the docstrings say it.

    python scripts/api_reference.py

Which names these are, tests/test_public_names.py says. Everything is read from the source, nothing
is imported, so the file is the same whichever Python runs this. Needs nothing but Python.
"""

import ast
import inspect
import re
import sys
from dataclasses import dataclass
from pathlib import Path

TOP = Path(__file__).resolve().parents[1]
SOURCE = TOP / "src" / "handavatar"
PROMISES = TOP / "tests" / "test_public_names.py"
DOCS = TOP / "docs"

HEADER = """\
# The Python interface

Made by `python scripts/api_reference.py` from the docstrings of the names that
`tests/test_public_names.py` promises; change those, not these pages. A test compares both. Units,
axes and frames are those of [conventions.md](conventions.md); [examples/](../examples) shows the
names at work.

| module | names |
|---|---|
"""
_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Source|Departs):[ \n]", re.M)
_ITEM = re.compile(r"^ {4}(?! )([\w.*]+): ", re.M)
_ROLE = re.compile(r":(?:func|class|meth|attr|mod):`~?([^`]+)`")
_LONGEST_VALUE = 60
_WIDTH = 96
Definition = ast.ClassDef | ast.FunctionDef


@dataclass(frozen=True)
class Module:
    """One module's source.

    Attributes:
        name: dotted, without the package's.
        text: its source.
        tree: its syntax tree.
    """

    name: str
    text: str
    tree: ast.Module

    def annotation(self, node: ast.expr) -> str:
        """A type; one that is quoted because its class comes later, without the quotes."""
        return self.source(node).strip("\"'")

    def source(self, node: ast.AST) -> str:
        """An expression as it is written, on one line."""
        return " ".join((ast.get_source_segment(self.text, node) or "").split())


def promised() -> dict[str, list[str]]:
    """Dotted module to its promised top-level names; methods come with their class."""
    tables = {}
    for node in ast.parse(PROMISES.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and _assigned(node) in ("EXACTLY", "AT_LEAST"):
            tables[_assigned(node)] = ast.literal_eval(node.value)
    names: dict[str, list[str]] = {}
    for table in (tables["EXACTLY"], tables["AT_LEAST"]):
        for module, words in table.items():
            known = names.setdefault(module, [])
            for word in (word.partition(".")[0] for word in words.split()):
                if word not in known:
                    known.append(word)
    return names


def module_section(module: Module, names: list[str]) -> str:
    """One module: its docstring, then its names in the order of the source."""
    parts = [f"# handavatar.{module.name}\n", docstring(ast.get_docstring(module.tree))]
    for position, node in enumerate(module.tree.body):
        if isinstance(node, ast.ClassDef) and node.name in names:
            parts.append(class_section(module, node))
        elif isinstance(node, ast.FunctionDef) and node.name in names:
            parts.append(f"## {node.name}\n")
            parts.append(signature(module, node))
            parts.append(docstring(ast.get_docstring(node)))
        elif (target := _assigned(node)) in names:
            parts.append(value_section(module, node, target, module.tree.body[position + 1 :]))
    return "\n".join(part for part in parts if part)


def class_section(module: Module, node: ast.ClassDef) -> str:
    """A class: what makes one, its docstring, its public methods and properties."""
    fields = [
        item
        for item in node.body
        if isinstance(item, ast.AnnAssign) and not _assigned(item).startswith("_")
    ]
    is_dataclass = any("dataclass" in module.source(item) for item in node.decorator_list)
    bases = ", ".join(module.source(base) for base in node.bases)
    head = f"class {node.name}({bases})" if bases else f"class {node.name}"
    parts = [f"## {node.name}\n", "```python", head + (":" if is_dataclass and fields else "")]
    if is_dataclass:
        for item in fields:
            value = "" if item.value is None else f" = {_short(module.source(item.value))}"
            parts.append(
                f"    {module.source(item.target)}: {module.annotation(item.annotation)}{value}"
            )
    parts += ["```\n", docstring(ast.get_docstring(node))]
    for item in node.body:
        if not isinstance(item, ast.FunctionDef):
            continue
        if item.name == "__init__" or not item.name.startswith("_"):
            if item.name != "__init__":
                parts.append(f"### {node.name}.{item.name}\n")
            parts.append(signature(module, item, node.name))
            parts.append(docstring(ast.get_docstring(item)))
    return "\n".join(part for part in parts if part)


def value_section(module: Module, node: ast.stmt, name: str, following: list[ast.stmt]) -> str:
    """A constant: its value where that is short, and the string below it."""
    assert isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None
    kind = f": {module.annotation(node.annotation)}" if isinstance(node, ast.AnnAssign) else ""
    parts = [f"## {name}\n", "```python", f"{name}{kind} = {_short(module.source(node.value))}"]
    parts.append("```\n")
    after = following[0].value if following and isinstance(following[0], ast.Expr) else None
    if isinstance(after, ast.Constant) and isinstance(after.value, str):
        parts.append(docstring(after.value))
    return "\n".join(parts)


def signature(module: Module, node: ast.FunctionDef, owner: str = "") -> str:
    """What to write to call it, as a block of code; one argument a line where it is long."""
    marks = [module.source(item) for item in node.decorator_list]
    is_bound = owner and "staticmethod" not in marks
    name = node.name
    if owner:
        name = owner if name == "__init__" else f"{owner}.{name}"
    returned = "" if node.returns is None else module.annotation(node.returns)
    if "property" in marks or "cached_property" in marks:
        return f"```python\n{name}: {returned}\n```\n"
    arguments = _arguments(module, node.args)[1 if is_bound else 0 :]
    arrow = "" if returned in ("", "None") else f" -> {returned}"
    line = f"{name}({', '.join(arguments)}){arrow}"
    if len(line) > _WIDTH:
        listed = "".join(f"    {argument},\n" for argument in arguments)
        line = f"{name}(\n{listed}){arrow}"
    return f"```python\n{line}\n```\n"


def _arguments(module: Module, given: ast.arguments) -> list[str]:
    plain = [*given.posonlyargs, *given.args]
    values = [None] * (len(plain) - len(given.defaults)) + list(given.defaults)
    found = [_argument(module, *pair) for pair in zip(plain, values, strict=True)]
    if given.vararg is not None:
        found.append("*" + _argument(module, given.vararg, None))
    elif given.kwonlyargs:
        found.append("*")
    named = zip(given.kwonlyargs, given.kw_defaults, strict=True)
    found += [_argument(module, *pair) for pair in named]
    if given.kwarg is not None:
        found.append("**" + _argument(module, given.kwarg, None))
    return found


def _argument(module: Module, argument: ast.arg, value: ast.expr | None) -> str:
    if argument.annotation is None:
        return argument.arg if value is None else f"{argument.arg}={module.source(value)}"
    text = f"{argument.arg}: {module.annotation(argument.annotation)}"
    return text if value is None else f"{text} = {module.source(value)}"


def docstring(text: str | None) -> str:
    """A Google docstring as Markdown: prose as it is, sections as lists."""
    text = _ROLE.sub(r"`\1`", inspect.cleandoc(text or ""))
    pieces = _SECTION.split(text)
    parts = [pieces[0].strip()] if pieces[0].strip() else []
    for name, body in zip(pieces[1::2], pieces[2::2], strict=True):
        # What follows a section without indent is prose again.
        inside, prose = _indented(body)
        is_list = name in ("Args", "Attributes", "Raises")
        parts.append(f"*{name}*\n\n{_items(inside)}" if is_list else f"*{name}:* {_joined(inside)}")
        parts += [prose] if prose else []
    return "\n\n".join(parts) + "\n" if parts else ""


def _indented(body: str) -> tuple[str, str]:
    """The part of a section's text that belongs to it, and what comes after."""
    lines = body.splitlines()
    for number, line in enumerate(lines):
        if number and line and not line.startswith(" "):
            return "\n".join(lines[:number]).rstrip(), "\n".join(lines[number:]).strip()
    return body.rstrip(), ""


def _items(body: str) -> str:
    pieces = _ITEM.split("\n" + body.strip("\n") + "\n")
    pairs = zip(pieces[1::2], pieces[2::2], strict=True)
    return "\n".join(f"- `{name}`: {_joined(text)}" for name, text in pairs)


def _joined(text: str) -> str:
    return " ".join(text.split())


def _short(value: str) -> str:
    return "..." if len(value) > _LONGEST_VALUE or value.startswith("field(") else value


def _assigned(node: ast.stmt) -> str:
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        return node.targets[0].id
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
        return node.target.id
    return ""


def documents() -> dict[Path, str]:
    """The index and a page for each package.

    Raises:
        FileNotFoundError: if a promised module does not exist.
    """
    rows = []
    pages: dict[Path, list[str]] = {}
    for name, names in sorted(promised().items()):
        path = SOURCE / f"{name.replace('.', '/')}.py"
        path = path if path.is_file() else SOURCE / name.replace(".", "/") / "__init__.py"
        text = path.read_text(encoding="utf-8")
        page = f"{name.partition('.')[0]}.md"
        section = module_section(Module(name, text, ast.parse(text)), names)
        pages.setdefault(DOCS / "api" / page, []).append(section)
        link = f"[`{name}`](api/{page}#handavatar{name.replace('.', '')})"
        rows.append(f"| {link} | {' '.join(f'`{each}`' for each in names)} |\n")
    found = {DOCS / "api.md": HEADER + "".join(rows)}
    for path, sections in pages.items():
        found[path] = "[All modules](../api.md)\n\n" + "\n".join(sections)
    return found


def main() -> int:
    """Rewrites the reference; pages of what is promised no longer go."""
    wanted = documents()
    (DOCS / "api").mkdir(exist_ok=True)
    for path in set((DOCS / "api").glob("*.md")) - set(wanted):
        path.unlink()
    for path, text in wanted.items():
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
