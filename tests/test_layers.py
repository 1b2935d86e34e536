"""Who may import whom, without cycles; imports inside functions only where they are meant."""

import ast

import pytest
from source_tree import imported_modules, modules

# Left: a folder or top module. Right: what it may import besides itself.
EVERYTHING_BELOW = (
    "geometry jobs hand fit capture field render edit replay avatar plain retouch processes "
    "alignment animate evaluate train peers export view webcam demo doctor synthetic bench tracker"
)
MAY_IMPORT = {
    name: {"errors", *allowed.split()}
    for name, allowed in {
        # What users can cause, and how it is said.
        "errors": "",
        "geometry": "",
        # Files and folders of a long command; knows no hand.
        "jobs": "",
        "hand": "geometry jobs",
        # A texture's chart is that of a rig.
        "render": "geometry hand",
        # A hand laid onto pictures.
        "fit": "geometry jobs hand render",
        # The network that sees hands; knows pictures, not videos.
        "tracker": "geometry jobs hand processes",
        "capture": "geometry jobs hand render fit tracker",
        # A hand before a camera, followed live; knows neither avatars nor pages.
        "webcam": "geometry jobs hand render fit capture tracker",
        "field": "geometry jobs hand",
        "edit": "geometry hand field",
        # A function's work on a GPU, recorded.
        "replay": "",
        "avatar": "geometry jobs hand field render edit replay",
        # Fits a pose to a mask with any shaped hand.
        "alignment": "geometry hand render",
        # The slow renderer that the fast one is measured against.
        "plain": "geometry field render avatar",
        # Registers poses, fits the textured mesh that it compares with, and films what it judged.
        "evaluate": (
            "geometry jobs hand fit capture field render edit avatar alignment plain animate "
            "retouch"
        ),
        # An edit says in which clip's light a frame is seen.
        "train": (
            "geometry jobs hand fit capture field render edit avatar plain alignment evaluate "
            "processes"
        ),
        # Made videos with truth: a subject of the made captures before a background.
        "synthetic": "geometry jobs hand capture render tracker processes",
        # Registration against truth; it runs what training begins with, on captures and films.
        "bench": "geometry jobs hand fit capture render evaluate train synthetic",
        # Prior art, for a table alone.
        "peers": "geometry jobs hand fit capture field render avatar evaluate train",
        # Words of an edit mean what they mean elsewhere.
        "export": "geometry hand capture field render edit avatar retouch jobs",
        # Its fluid pictures bake the fields on the mesh; its others are what `animate` makes. What
        # a trainer leaves for others to see is read where it is written.
        "view": "geometry jobs hand capture field render edit avatar retouch animate train webcam "
        "tracker",
        # What words and pictures mean to an avatar.
        "retouch": "jobs hand capture edit avatar",
        "processes": "",
        # Motions to pictures: what a viewer may see, the rasteriser's neighbours, and the kernels'
        # names.
        "animate": "geometry hand capture field render edit avatar retouch processes jobs",
        # The whole road in one call, just under the command line.
        "demo": "geometry jobs hand fit capture field render edit avatar animate evaluate train",
        "doctor": "hand capture field evaluate train",
        "cli": EVERYTHING_BELOW,
        "__main__": "cli",
    }.items()
}
# Heavy or optional packages that a function may import when it needs them.
OPTIONAL_EXTRAS = {"mediapipe", "cv2", "mitsuba", "drjit", "h5py", "pillow_heif"}
# Modules that import such a package (triton) at their top.
OPTIONAL_MODULES = {
    "handavatar.field.fused",
    "handavatar.field.fused_anchors",
    "handavatar.render.fused_coverage",
    "handavatar.render.fused_rays",
}
FORBIDDEN_NAMES = {"utils", "util", "misc", "helpers", "common", "base", "manager"}


def _layer(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def _own_imports(module: str, tree: ast.Module, known: set[str]) -> set[str]:
    """Modules of this package that a module imports, wherever it does so."""
    found = set()
    for node in ast.walk(tree):
        for name in imported_modules(node):
            if name.split(".")[0] == "handavatar":
                found.add(name if name in known else name.rpartition(".")[0])
    return found - {module}


TREES = modules()


def test_every_import_points_down_the_table() -> None:
    wrong = []
    for module, tree in TREES.items():
        layer = _layer(module)
        if not layer:
            continue
        assert layer in MAY_IMPORT, f"{module}: give {layer} a row in this table and in house.md"
        for target in _own_imports(module, tree, set(TREES)):
            if _layer(target) not in MAY_IMPORT[layer] | {layer, ""}:
                wrong.append(f"{module} imports {target}")
    assert not wrong, "\n".join(wrong)


def test_the_package_itself_imports_nothing() -> None:
    imports = [name for node in ast.walk(TREES["handavatar"]) for name in imported_modules(node)]
    assert not [name for name in imports if name.split(".")[0] not in ("importlib", "typing")]


def test_there_are_no_import_cycles() -> None:
    graph = {module: _own_imports(module, tree, set(TREES)) for module, tree in TREES.items()}
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            for target in sorted(graph.get(module, ())):
                visit(target, (*path, module))
            done.add(module)

    for module in graph:
        visit(module, ())


def test_imports_inside_functions_are_the_clis_or_of_optional_extras() -> None:
    wrong = []
    for module, tree in TREES.items():
        if _layer(module) == "cli":
            continue
        for function in ast.walk(tree):
            if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                continue
            for node in ast.walk(function):
                for name in imported_modules(node):
                    is_own = name.rpartition(".")[0] in OPTIONAL_MODULES
                    if name.split(".")[0] not in OPTIONAL_EXTRAS and not is_own:
                        wrong.append(f"{module}, line {node.lineno}: {name}")  # type: ignore[attr-defined]
    assert not wrong, "\n".join(wrong)


def test_no_annotations_are_postponed_and_names_are_nouns() -> None:
    for module, tree in TREES.items():
        names = {name for node in ast.walk(tree) for name in imported_modules(node)}
        # Strings instead of annotations would switch the shape checks off.
        assert "__future__.annotations" not in names, module
        assert not FORBIDDEN_NAMES & set(module.split(".")), module


@pytest.mark.parametrize(
    ("source", "is_caught"),
    [
        ("from handavatar.hand.rig import Rig", True),
        ("def f():\n    import handavatar.hand.rig", True),
        ("from handavatar.geometry.rotations import skew", False),
        ("from handavatar import __version__", False),
    ],
)
def test_the_guard_sees_what_it_should(source: str, is_caught: bool) -> None:
    targets = _own_imports("handavatar.geometry.new", ast.parse(source), set(TREES))
    allowed = MAY_IMPORT["geometry"] | {"geometry", ""}
    assert any(_layer(target) not in allowed for target in targets) == is_caught
