"""Rigs by name, file or fingerprint: the open hand, and what the user has imported.

Imported rigs lie in ``$HANDAVATAR_HOME/rigs`` (by default ``~/.local/share/handavatar/rigs``), one
safetensors file each. Captures and avatars name a rig by its fingerprint.
"""

import json
import os
from pathlib import Path

from safetensors import SafetensorError
from safetensors import torch as safetensors_torch

from handavatar.errors import raise_if_refused
from handavatar.hand.mano import LICENCE, WHERE_TO_GET_IT, ManoModel, read_mano
from handavatar.hand.open_hand import Level, load_open_hand
from handavatar.hand.rig import RIG_ARRAYS, LicensedRigMissing, Rig, RigError
from handavatar.jobs.files import refuse_file_in_use, write_atomically

SCHEMA = 1
_MAX_BYTES = 64 * 2**20
_SET_PREFIX = "set_"
_TENSORS = (*RIG_ARRAYS, "pose_directions")


def rigs_folder() -> Path:
    """Where imported rigs lie; it need not exist."""
    home = os.environ.get("HANDAVATAR_HOME") or "~/.local/share/handavatar"
    return Path(home).expanduser() / "rigs"


def save_rig(model: ManoModel, path: Path | None = None, overwrite: bool = False) -> Path:
    """Writes an imported rig as safetensors, aside first, then renamed into place.

    Args:
        model: from :func:`~handavatar.hand.mano.read_mano`.
        path: file to write; by default one in :func:`rigs_folder`, where it is found again.
        overwrite: replace another file at ``path``.

    Returns:
        The file.

    Raises:
        FolderInUse: there is a file at ``path`` already.
    """
    rig = model.rig
    if path is None:
        path = rigs_folder() / f"{rig.name}-{rig.sha256[:12]}.safetensors"
        overwrite = True  # Its name says that it holds the same.
    refuse_file_in_use(path, overwrite)
    tensors = {name: getattr(rig, name).contiguous() for name in _TENSORS}
    tensors |= {_SET_PREFIX + name: members for name, members in rig.vertex_sets.items()}
    tensors |= {"hands_mean": model.hands_mean, "hands_components": model.hands_components}
    facts = {
        "schema": str(SCHEMA),
        "name": rig.name,
        "side": model.side,
        "sha256": rig.sha256,
        "left_shape": model.left_shape,
        "licence": LICENCE,
        "source_sha256": model.sha256,
    }
    write_atomically({path: safetensors_torch.save(tensors, facts)})
    return path


def read_rig(path: Path) -> Rig:
    """Reads an imported rig back.

    Raises:
        LicensedRigMissing: there is no such file.
        RigError: it is no imported rig, or damaged.
    """
    if not path.exists():
        raise LicensedRigMissing(f"{path}: no such file\n{WHERE_TO_GET_IT}")
    facts = _facts(path)
    try:
        arrays = safetensors_torch.load_file(path)
        rig = Rig(
            name=facts["name"],
            vertex_sets={
                name.removeprefix(_SET_PREFIX): members
                for name, members in arrays.items()
                if name.startswith(_SET_PREFIX)
            },
            is_licensed=True,
            **{name: arrays[name] for name in _TENSORS},
        )
    except (KeyError, OSError, SafetensorError, RigError, RuntimeError) as error:
        raise_if_refused(error)
        raise RigError(f"{path}: not a whole rig ({error})\nimport it again") from error
    if rig.sha256 != facts["sha256"]:
        raise RigError(
            f"{path}: its fingerprint is {rig.sha256[:12]}, expected {facts['sha256'][:12]}: it "
            "was changed\nimport it again: handavatar rig import-mano"
        )
    return rig


def load_rig(reference: str, level: Level = "full") -> Rig:
    """A rig by what a user calls it.

    Args:
        reference: ``open-hand``, ``open-hand-778``, the name of an imported rig such as
            ``mano-right``, or the path of a file that ``handavatar rig import-mano`` wrote.
        level: ``full`` is the rig as it is, ``778`` the open hand thinned to MANO's size; no
            other rig can be thinned.

    Raises:
        LicensedRigMissing: it is a MANO rig that was not imported.
        RigError: it is unknown, ambiguous or damaged, or has no such level.
    """
    if reference == "open-hand":
        return load_open_hand(level)
    if reference == "open-hand-778":
        return load_open_hand("778")
    if level != "full":
        raise RigError(
            f"rig {reference[:80]}: found level {level}, which the open hand alone has",
            "",
            "leave out `level`: other rigs are used as they are",
        )
    path = Path(reference)
    if path.suffix == ".pkl":
        raise RigError(f"{path}: not yet a rig\nimport it: handavatar rig import-mano {path}")
    if path.suffix == ".safetensors" or path.is_file():
        return read_rig(path)
    if reference.startswith("mano") or reference in _names_of_imported():
        return read_rig(_named(reference))
    known = ", ".join(["open-hand", "open-hand-778", *_names_of_imported()])
    raise RigError(
        f"rig {reference[:80]}: unknown\nname one of {known}, or a file that "
        "handavatar rig import-mano wrote"
    )


def load_mano(reference: str) -> ManoModel:
    """A MANO file of the user's with its mean pose and components.

    Args:
        reference: ``MANO_RIGHT.pkl`` or ``MANO_LEFT.pkl`` itself, the name of an imported rig such
            as ``mano-right``, or the path of an imported one.

    Raises:
        LicensedRigMissing: it is not there.
        RigError: it is no MANO file and no imported rig, or damaged.
    """
    path = Path(reference)
    if path.suffix == ".pkl":
        return read_mano(path)
    if path.suffix != ".safetensors" and not path.is_file():
        path = _named(reference)
    rig, facts = read_rig(path), _facts(path)
    arrays = safetensors_torch.load_file(path)
    try:
        return ManoModel(
            rig=rig,
            side=facts["side"],  # type: ignore[arg-type]
            hands_mean=arrays["hands_mean"],
            hands_components=arrays["hands_components"],
            left_shape=facts["left_shape"],  # type: ignore[arg-type]
            sha256=facts["source_sha256"],
        )
    except KeyError as error:
        raise RigError(f"{path}: not a whole rig ({error})\nimport it again") from error


def _named(reference: str) -> Path:
    """The file of an imported MANO rig of this name."""
    named = [path for path, facts in _imported().items() if facts["name"] == reference]
    if len(named) > 1:
        raise RigError(
            f"{len(named)} imported rigs are named {reference}\nname one by its file: "
            + ", ".join(str(path) for path in named)
        )
    if not named:
        raise LicensedRigMissing(
            f"rig {reference[:80]}: not imported; {rigs_folder()} does not hold it",
            "",
            f"{WHERE_TO_GET_IT}",
        )
    return named[0]


def find_rig(sha256: str, name: str) -> Rig:
    """The rig that a capture or an avatar was made with.

    Args:
        sha256: its fingerprint.
        name: what it was called, for the message.

    Raises:
        LicensedRigMissing: it is a MANO rig that was not imported here.
        RigError: it is another version of the open hand.
    """
    for rig in (load_open_hand(), load_open_hand("778")):
        if rig.sha256 == sha256:
            return rig
    for path, facts in _imported().items():
        if facts["sha256"] == sha256:
            return read_rig(path)
    if name.startswith("mano"):
        raise LicensedRigMissing(
            f"rig {name} ({sha256[:12]}): not imported; {rigs_folder()} does not hold it",
            "",
            f"{WHERE_TO_GET_IT}",
        )
    raise RigError(
        f"rig {name} ({sha256[:12]}): unknown; the open hand of this version is "
        f"{load_open_hand().sha256[:12]}\nmake the capture again with this version"
    )


def _names_of_imported() -> list[str]:
    return sorted({facts["name"] for facts in _imported().values()})


def _imported() -> dict[Path, dict[str, str]]:
    """Files of the user's folder and what each says of itself; what is no rig is left out."""
    found = {}
    for path in sorted(rigs_folder().glob("*.safetensors")):
        try:
            found[path] = _facts(path)
        except (OSError, RigError):
            continue
    return found


def _facts(path: Path) -> dict[str, str]:
    """What an imported rig's header says of it; the arrays are not read."""
    if not path.is_file() or path.stat().st_size > _MAX_BYTES:
        raise RigError(f"{path}: no file, or larger than {_MAX_BYTES // 2**20} MB\nimport it again")
    with path.open("rb") as file:
        header_size = int.from_bytes(file.read(8), "little")
        header = file.read(header_size) if header_size < path.stat().st_size else b""
    try:
        facts = json.loads(header)["__metadata__"]
        is_ours = facts["schema"] == str(SCHEMA) and {"name", "sha256"} <= set(facts)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise RigError(f"{path}: not a rig that handavatar imported ({error})") from error
    if not is_ours:
        raise RigError(f"{path}: not an imported rig of schema {SCHEMA}\nimport it again")
    return facts
