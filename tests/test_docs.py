"""The documents say what the code says."""

import ast
import importlib.util
import json
import re
import sys
from types import ModuleType

import pytest
from source_tree import SOURCE, TOP, find_definition

METHOD = TOP / "docs" / "method.md"


def _script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, TOP / "scripts" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Dataclasses look their module up.
    spec.loader.exec_module(module)
    return module


def test_departures_are_collected() -> None:
    script = _script("departures")
    text = script.TARGET.read_text(encoding="utf-8")
    assert text == script.document(), "run: python scripts/departures.py"


def test_the_collector_reads_every_kind_of_docstring() -> None:
    source = '''
"""Module.

Departs: one, over
    two lines.
Source: elsewhere.
"""
LIMIT = 1
"""A limit. Departs here is no section."""
class A:
    """A.

    Departs: of the class.
    """
    size: int = 2
    """Size.

    Departs: of the field.
    """
    def f(self):
        """F.

        Departs: first.

        Departs: second | with a bar.
        """
'''
    assert _script("departures").departures(ast.parse(source)) == [
        ("", "one, over two lines."),
        ("A", "of the class."),
        ("A.size", "of the field."),
        ("A.f", "first."),
        ("A.f", "second | with a bar."),
    ]


def test_the_reference_says_what_the_docstrings_say() -> None:
    wanted = _script("api_reference").documents()
    pages = {TOP / "docs" / "api.md", *(TOP / "docs" / "api").iterdir()}
    assert pages == set(wanted), "run: python scripts/api_reference.py"
    for path, text in wanted.items():
        assert path.read_text(encoding="utf-8") == text, "run: python scripts/api_reference.py"


API_SOURCE = '''
"""Module."""
LIMIT = 3
"""A limit.

Departs: from the paper's.
"""
LONG = "a value that is far too long to be worth a line of its own in a reference"
def first(a, b: "Later" = None, *, c: Float[Tensor, "rays 3"]) -> "Later":
    """Does it; see :func:`second`.

    Args:
        a: one,
            over two lines.
        c: three.

    Raises:
        ValueError: never.

    After the section.

    Source: paper Eq. 1.
    """
def _hidden(): ...
def second(): """Not promised."""
@dataclass(frozen=True)
class Later(Base):
    """Later.

    Attributes:
        size: metres.
    """
    size: int = 2
    _inner: int = 3
    @property
    def twice(self) -> int:
        """Twice."""
    @staticmethod
    def made(count: int) -> "Later":
        """Made."""
    def _quiet(self): ...
'''
API_TEXT = """\
# handavatar.some.module

Module.

## LIMIT

```python
LIMIT = 3
```

A limit.

*Departs:* from the paper's.

## LONG

```python
LONG = ...
```

## first

```python
first(a, b: Later = None, *, c: Float[Tensor, "rays 3"]) -> Later
```

Does it; see `second`.

*Args*

- `a`: one, over two lines.
- `c`: three.

*Raises*

- `ValueError`: never.

After the section.

*Source:* paper Eq. 1.

## Later

```python
class Later(Base):
    size: int = 2
```

Later.

*Attributes*

- `size`: metres.

### Later.twice

```python
Later.twice: int
```

Twice.

### Later.made

```python
Later.made(count: int) -> Later
```

Made.
"""


def test_the_reference_reads_every_kind_of_definition() -> None:
    script = _script("api_reference")
    module = script.Module("some.module", API_SOURCE, ast.parse(API_SOURCE))
    assert script.module_section(module, ["LIMIT", "LONG", "first", "Later"]) == API_TEXT


def test_the_notebook_is_made_from_the_examples() -> None:
    script = _script("notebook")
    text = script.TARGET.read_text(encoding="utf-8")
    assert text == script.document(), "run: python scripts/notebook.py"
    notebook = json.loads(text)
    assert notebook["nbformat"] == 4
    assert not any(cell.get("outputs") for cell in notebook["cells"])
    with pytest.raises(ValueError, match="docstring"):
        script.cells("print('no options')\n")


def _rows() -> list[list[str]]:
    """Cells of the method table, without head and ruler."""
    lines = [line for line in METHOD.read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in rows if not set(row[0]) <= set("-: ") and row[0] != "paper"]


def _named(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


@pytest.mark.parametrize("row", _rows(), ids=lambda row: row[0])
def test_each_equation_has_a_function_a_law_and_a_reference(row: list[str]) -> None:
    equation, _, functions, law, reference = row
    for name in _named(functions):
        module, _, dotted = name.partition(":")
        path = SOURCE / f"{module}.py"
        assert path.is_file(), f"{equation}: no module {module}"
        definition = find_definition(ast.parse(path.read_text(encoding="utf-8")), dotted)
        assert definition is not None, f"{equation}: {module} has no {dotted}"
        text = ast.get_docstring(definition) or ""  # type: ignore[arg-type]
        assert "Source:" in text, f"{equation}: {name} does not say where it comes from"
    assert _named(functions), equation
    for kind, cell in (("law", law), ("reference", reference)):
        assert _named(cell), f"{equation}: no {kind} test"
        for name in _named(cell):
            file, _, test = name.partition("::")
            path = TOP / "tests" / file
            assert path.is_file(), f"{equation}: no {path}"
            tree = ast.parse(path.read_text(encoding="utf-8"))
            assert find_definition(tree, test) is not None, f"{equation}: {file} has no {test}"


def test_every_numbered_equation_of_the_paper_has_a_row() -> None:
    labels = " ".join(row[0] for row in _rows())
    for number in range(1, 5):
        assert f"Eq. {number}" in labels
    for label in ("skin", "trans", "L_shape"):
        assert label in labels


def test_the_readme_shows_the_two_commands() -> None:
    readme = (TOP / "README.md").read_text(encoding="utf-8")
    assert "scripts/demo" in readme and "scripts/test" in readme


def test_links_between_the_documents_lead_somewhere() -> None:
    for page in [TOP / "README.md", *sorted((TOP / "docs").rglob("*.md"))]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"
