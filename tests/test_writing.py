"""Files are written by one mechanism: aside, and renamed when they are whole."""

import ast
import re

from source_tree import modules

ALLOWED = {
    "handavatar.jobs.files": "the mechanism",
    "handavatar.capture.synthetic": "into a capture's folder, which is filled aside",
    "handavatar.capture.degraded": "into a capture's folder, which is filled aside",
    "handavatar.capture.video": "into a capture's folder, which is filled aside",
    "handavatar.train.runs": "a checkpoint's folder is filled aside; a log grows by lines; a lock",
    "handavatar.jobs.locks": "who holds a lock, told by whoever holds it",
    "handavatar.jobs.video_writer": "a film is encoded aside",
    "handavatar.view.recording": "grows by pieces, and takes its place when it is whole",
}
WRITES = {"write_text", "write_bytes", "save_file", "fsync"}
RENAMES = {("os", "rename"), ("os", "replace"), ("shutil", "move"), ("torch", "save")}
COPIES = {"copyfile", "copy2", "copytree"}
MODE = re.compile("[wax]b?[+]?b?|rb?[+]b?")


def _writes_by_hand(call: ast.Call) -> bool:
    if isinstance(call.func, ast.Name):
        name, owner = call.func.id, ""
    elif isinstance(call.func, ast.Attribute):
        value = call.func.value
        name, owner = call.func.attr, value.id if isinstance(value, ast.Name) else ""
    else:
        return False
    if name == "open":
        words = [*call.args, *(keyword.value for keyword in call.keywords)]
        modes = [word.value for word in words if isinstance(word, ast.Constant)]
        return any(isinstance(mode, str) and MODE.fullmatch(mode) for mode in modes)
    return name in WRITES | COPIES or (owner, name) in RENAMES


def test_nothing_writes_files_by_hand() -> None:
    """A kill at any moment leaves what was there, or what is new: ``jobs.files`` sees to it."""
    found = {
        module: [
            node.lineno
            for node in ast.walk(tree)
            if isinstance(node, ast.Call) and _writes_by_hand(node)
        ]
        for module, tree in modules().items()
    }
    wrong = {module: lines for module, lines in found.items() if lines and module not in ALLOWED}
    assert not wrong, f"write with jobs.files.write_atomically, or write_aside: {wrong}"
    assert {module for module in ALLOWED if not found[module]} == set(), "no longer needed"
