"""Nothing in the project can run code that it read from a file."""

import ast
from pathlib import Path

import pytest
from source_tree import TOP

FORBIDDEN_MODULES = {"pickle", "marshal", "shelve", "dill", "joblib", "cloudpickle", "_pickle"}
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__"}
FORBIDDEN_ATTRIBUTES = {
    ("os", "system"),
    ("os", "popen"),
    ("yaml", "load"),
    ("yaml", "unsafe_load"),
    ("torch", "save"),
}
# The published VGG weights come as a torch file; it is the user's own, read with weights_only.
MAY_LOAD_TORCH_FILES = {Path("src/handavatar/evaluate/perceptual.py")}


def _dangers(tree: ast.Module, path: Path) -> list[str]:
    found = []
    for node in ast.walk(tree):
        what = ""
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names]
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            what = ", ".join(n for n in names if n.split(".")[0] in FORBIDDEN_MODULES)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if (node.value.id, node.attr) in FORBIDDEN_ATTRIBUTES:
                what = f"{node.value.id}.{node.attr}"
        elif isinstance(node, ast.Call):
            what = _dangerous_call(node, path)
        if what:
            found.append(f"{path}, line {node.lineno}: {what}")  # type: ignore[attr-defined]
    return found


def _dangerous_call(node: ast.Call, path: Path) -> str:
    keywords = {keyword.arg: keyword.value for keyword in node.keywords}
    for argument in ("shell", "allow_pickle"):
        value = keywords.get(argument)
        if value is not None and not (isinstance(value, ast.Constant) and value.value is False):
            return f"{argument}="
    if ast.unparse(node.func).startswith("torch.hub.load"):
        return "torch.hub.load"
    if isinstance(node.func, ast.Name) and node.func.id in FORBIDDEN_CALLS:
        return node.func.id
    if ast.unparse(node.func) == "torch.load":
        only = keywords.get("weights_only")
        is_safe = isinstance(only, ast.Constant) and only.value is True
        if not is_safe or path not in MAY_LOAD_TORCH_FILES:
            return "torch.load"
    return ""


def test_no_file_of_the_project_can_execute_what_it_reads() -> None:
    found = []
    for folder in ("src", "scripts", "examples"):
        for path in sorted((TOP / folder).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found += _dangers(tree, path.relative_to(TOP))
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "import os; os.system('ls')",
        "import subprocess; subprocess.run('ls', shell=True)",
        "import numpy as np; np.load(p, allow_pickle=flag)",
        "import torch; torch.load(p)",
        "import torch; torch.load(p, weights_only=True)",
        "import torch; torch.hub.load_state_dict_from_url(u)",
        "import yaml; yaml.load(t)",
        "eval('1')",
    ],
)
def test_the_guard_catches(source: str) -> None:
    assert _dangers(ast.parse(source), Path("src/handavatar/new.py"))


def test_the_guard_lets_harmless_calls_pass() -> None:
    harmless = "model.eval(); re.compile('a'); subprocess.run(['ls'], shell=False)"
    assert not _dangers(ast.parse(harmless), Path("src/handavatar/new.py"))
    allowed = next(iter(MAY_LOAD_TORCH_FILES))
    assert not _dangers(ast.parse("torch.load(p, weights_only=True)"), allowed)
    assert _dangers(ast.parse("torch.load(p, weights_only=False)"), allowed)
