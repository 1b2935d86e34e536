"""Files and folders that are put in place whole; what is somebody else's stays."""

import json
import os
import socket
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from handavatar import __version__
from handavatar.jobs import files
from handavatar.jobs.files import (
    MARKER,
    FolderInUse,
    FolderKind,
    UnfinishedFolder,
    claim_folder,
    fill_folder,
    make_folder,
    mark_folder,
    name_files,
    read_marker,
    refuse_file_in_use,
    refuse_folder_in_use,
    remove_folder,
    restore_folder,
    strangers_in,
    swap_folder,
    write_aside,
    write_atomically,
)

HOST = socket.gethostname()
DEAD = 2**22 + 1  # above any process number of Linux

SONGS = FolderKind("songs", ("*.mp3", "sheets/*.pdf"), lambda folder: (folder / "a.mp3").is_file())
FILMS = FolderKind("films", ("*.mp4",))


def _made(folder: Path, text: str = "old", kind: FolderKind = SONGS) -> Path:
    folder.mkdir()
    mark_folder(folder, kind)
    (folder / "a.mp3").write_text(text)
    name_files(folder)
    return folder


def _texts(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != MARKER)
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def test_the_marker_says_what_a_folder_is(tmp_path: Path) -> None:
    make_folder(tmp_path / "deep" / "new", SONGS)
    marker = read_marker(tmp_path / "deep" / "new")
    assert marker is not None and marker.keys() == {"program", "version", "kind", "time"}
    assert (marker["kind"], marker["version"]) == ("songs", __version__)
    assert not (tmp_path / "deep" / MARKER).exists()
    # What holds something is nobody's but its owner's.
    make_folder(tmp_path, SONGS)
    assert read_marker(tmp_path) is None


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"program": "git", "kind": "songs"}', '{"program": "handavatar"}']
)
def test_another_ones_marker_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / MARKER).write_text(text)
    assert read_marker(tmp_path) is None
    with pytest.raises(FolderInUse):
        remove_folder(tmp_path)
    assert (tmp_path / MARKER).read_text() == text


def test_files_are_written_all_or_none(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with pytest.raises(IsADirectoryError):
        write_atomically({tmp_path / "deep" / "a": b"a", tmp_path / "b": b"b"})
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "b", "deep"]
    write_atomically({tmp_path / "deep" / "a": b"new"})
    assert (tmp_path / "deep" / "a").read_bytes() == b"new"


def _file(place: Path) -> None:
    place.write_text("mine")


def _link(place: Path) -> None:
    place.symlink_to(_made(place.with_name("elsewhere")))


def _dangling(place: Path) -> None:
    place.symlink_to(place.with_name("nowhere"))


def _unmarked(place: Path) -> None:
    place.mkdir()
    (place / "f").write_text("mine")


def _other_kind(place: Path) -> None:
    _made(place, kind=FILMS)


def _stranger_inside(place: Path) -> None:
    (_made(place) / "sheets").mkdir()
    (place / "sheets" / "b.pdf").write_text("matches the patterns, but was not written by us")


def _older_with_stranger(place: Path) -> None:
    (_made(place) / "f").write_text("mine")
    (place / MARKER).unlink()


def _link_inside(place: Path) -> None:
    (_made(place) / "sheets").symlink_to(place.parent)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (_file, "is a file, expected a folder"),
        (_link, "is a link, expected a folder"),
        (_dangling, "is a link, expected a folder"),
        (_unmarked, "holds no songs of this program's making"),
        (_other_kind, "is marked as films, not as songs"),
        (_stranger_inside, r"holds sheets/b\.pdf, not written by this program"),
        (_older_with_stranger, "holds f, not written by this program"),
        (_link_inside, "holds sheets, not written by this program"),
    ],
)
def test_what_is_not_ours_is_not_replaced(
    tmp_path: Path, build: Callable[[Path], None], message: str
) -> None:
    place = tmp_path / "place"
    build(place)
    before = sorted((str(path), path.lstat().st_ino) for path in tmp_path.rglob("*"))
    whole = _made(tmp_path / "whole", "new")
    with pytest.raises(FolderInUse, match=message):
        swap_folder(whole, place, SONGS, overwrite=True)
    assert _texts(whole) == {"a.mp3": "new"}
    after = [entry for path in tmp_path.rglob("*") if whole not in (path, path.parent)
             for entry in [(str(path), path.lstat().st_ino)]]  # fmt: skip
    assert sorted(after) == before


def test_places_that_nobody_wants_to_lose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = _made(tmp_path / "ours")
    (ours / "inner" / "deep").mkdir(parents=True)
    refuse_folder_in_use(ours, SONGS, overwrite=True)
    with pytest.raises(FolderInUse, match="holds what is read"):
        refuse_folder_in_use(ours, SONGS, True, [ours / "a.mp3"])
    by_link = tmp_path / "by_link"
    by_link.symlink_to(ours / "inner")
    with pytest.raises(FolderInUse, match="holds what is read"):
        refuse_folder_in_use(ours, SONGS, True, [by_link])
    with pytest.raises(FolderInUse, match="is what is read"):
        refuse_folder_in_use(ours, SONGS, True, [ours / "inner" / ".."])
    refuse_folder_in_use(ours, SONGS, True, [tmp_path, tmp_path / "missing"])
    with monkeypatch.context() as patched:
        patched.setenv("HOME", str(ours / "inner"))
        with pytest.raises(FolderInUse, match="holds a home directory"):
            refuse_folder_in_use(ours, SONGS, True)
    monkeypatch.chdir(ours / "inner" / "deep")
    with pytest.raises(FolderInUse, match="holds the folder that the command was started in"):
        refuse_folder_in_use(Path("../.."), SONGS, True)
    with pytest.raises(FolderInUse, match="is the folder that the command was started in"):
        refuse_folder_in_use(Path("."), SONGS)


def test_many_strangers_are_counted_and_named_without_escapes(tmp_path: Path) -> None:
    ours = _made(tmp_path / "ours")
    for name in ("\x1b[31m", "b", "c", "d", "e"):
        (ours / name).write_text("mine")
    # Of the operating system, and of a killed process of ours.
    for name in (".DS_Store", ".tmp-123-a.mp3"):
        (ours / name).write_text("")
    assert strangers_in(ours, SONGS) == ["\x1b[31m", "b", "c", "d", "e"]
    with pytest.raises(FolderInUse) as caught:
        refuse_folder_in_use(ours, SONGS, overwrite=True)
    assert "holds '\\x1b[31m', b, c and 2 more, not written" in caught.value.found
    assert "\x1b" not in str(caught.value) and "move that away" in caught.value.remedy


def test_an_old_folder_is_replaced_by_a_new_one(tmp_path: Path) -> None:
    place, whole = _made(tmp_path / "place"), _made(tmp_path / "whole", "new")
    with pytest.raises(FolderInUse, match="not empty"):
        swap_folder(whole, place, SONGS)
    assert _texts(place) == {"a.mp3": "old"}
    (place / MARKER).unlink()  # As an older version left it.
    swap_folder(whole, place, SONGS, overwrite=True)
    assert _texts(place) == {"a.mp3": "new"} and list(tmp_path.iterdir()) == [place]


EXCHANGES = pytest.mark.parametrize("exchanges", [True, False])
"""Whether the system can exchange two names in one step."""


def _system(monkeypatch: pytest.MonkeyPatch, exchanges: bool) -> None:
    if not exchanges:
        monkeypatch.setattr(files, "_exchange", lambda first, second: False)
    elif sys.platform != "linux":
        pytest.skip("only Linux exchanges names")


@EXCHANGES
@pytest.mark.parametrize("error", [OSError("no"), KeyboardInterrupt()])
@pytest.mark.parametrize("failing", [0, 1, 2])
def test_a_failure_between_the_renames_leaves_the_old_one_whole(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    failing: int,
    exchanges: bool,
) -> None:
    _system(monkeypatch, exchanges)
    if exchanges and failing:
        monkeypatch.setattr(files, "_exchange", _raising(error))
        failing = 20
    place, whole = _made(tmp_path / "place"), _made(tmp_path / "whole", "new")
    rename, renames = os.rename, []

    def breaking(source: Path, target: Path) -> None:
        renames.append(source)
        if len(renames) == failing + 1:
            raise error
        rename(source, target)

    monkeypatch.setattr(files.os, "rename", breaking)
    with pytest.raises(type(error)):
        swap_folder(whole, place, SONGS, overwrite=True)
    assert _texts(place) == {"a.mp3": "old"} and _texts(whole) == {"a.mp3": "new"}
    assert sorted(tmp_path.iterdir()) == [place, whole]


def _raising(error: BaseException) -> Callable[..., bool]:
    def call(*_: object) -> bool:
        raise error

    return call


class _Killed(BaseException):
    """As if the process were gone: nothing is put right after it."""


@EXCHANGES
def test_a_kill_at_any_moment_of_a_swap_leaves_old_or_new_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchanges: bool
) -> None:
    """The process ends before each call that changes the disk; then the next one goes on."""
    _system(monkeypatch, exchanges)
    calls = [(files.os, "rename"), (files.Path, "unlink"), (files.Path, "rmdir")]
    calls += [(files, "_exchange")] * exchanges
    for moment in range(20):
        room = tmp_path / str(moment)
        room.mkdir()
        place, whole = _made(room / "place"), _made(room / "whole", "new")
        done = 0

        def dying(real: Callable[..., object], moment: int = moment) -> Callable[..., object]:
            def call(*arguments: object, **named: object) -> object:
                nonlocal done
                if done >= moment:
                    raise _Killed
                done += 1
                return real(*arguments, **named)

            return call

        with monkeypatch.context() as patched:
            for owner, name in calls:
                patched.setattr(owner, name, dying(getattr(owner, name)))
            try:
                swap_folder(whole, place, SONGS, overwrite=True)
                is_through = True
            except _Killed:
                is_through = False
        hidden = [path for path in room.iterdir() if path.name.startswith(".place.replaced-")]
        kept = [_texts(path) for path in (place, *hidden, whole) if path.exists()]
        assert {"a.mp3": "new"} in kept
        if exchanges:
            assert _texts(place) in ({"a.mp3": "old"}, {"a.mp3": "new"}), "at every moment one"
        if whole.exists():
            assert {"a.mp3": "old"} in kept, "nothing is removed before the new one is in place"
            restore_folder(place)
            assert _texts(place) == {"a.mp3": "old"}
            swap_folder(whole, place, SONGS, overwrite=True)
        else:
            restore_folder(place)
            assert _texts(place) in ({"a.mp3": "old"}, {"a.mp3": "new"})
            swap_folder(_made(room / "whole", "new"), place, SONGS, overwrite=True)
        assert _texts(place) == {"a.mp3": "new"} and list(room.iterdir()) == [place]
        if is_through:
            break
    renames = 2 if exchanges else 3
    assert moment == renames + 3, "and three steps of removing: file, marker, folder"


def test_folders_written_in_place_go_on_in_their_own_only(tmp_path: Path) -> None:
    claim_folder(tmp_path / "new", SONGS)
    (tmp_path / "new" / "f").write_text("mine")
    claim_folder(tmp_path / "new", SONGS)
    with pytest.raises(FolderInUse, match="is marked as songs, not as films"):
        claim_folder(tmp_path / "new", FILMS)
    with pytest.raises(FolderInUse, match="holds no songs"):
        claim_folder(tmp_path, SONGS)
    older = _made(tmp_path / "older")
    (older / MARKER).unlink()
    claim_folder(older, SONGS)
    assert (read_marker(older) or {})["kind"] == "songs"
    (tmp_path / "file").write_text("mine")
    with pytest.raises(FolderInUse, match="is a file"):
        claim_folder(tmp_path / "file", SONGS)
    assert (tmp_path / "new" / "f").read_text() == "mine"


def test_a_folder_takes_its_place_when_it_is_filled(tmp_path: Path) -> None:
    place = tmp_path / "deep" / "place"
    with fill_folder(place, SONGS) as folder:
        (folder / "sheets").mkdir()
        (folder / "sheets" / "a.pdf").write_text("new")
        assert folder.parent == place.parent and folder.name.startswith(".") and not place.exists()
    marker = read_marker(place)
    assert marker is not None and marker["files"] == ["sheets/a.pdf"] and "process" not in marker
    assert place.stat().st_mode == (tmp_path / "deep").stat().st_mode, "the user's usual mode"
    with pytest.raises(FolderInUse, match="not empty"), fill_folder(place, SONGS):
        pytest.fail("refused before anything is done")
    with (
        pytest.raises(KeyboardInterrupt),
        fill_folder(place, SONGS, overwrite=True) as folder,
    ):
        (folder / "a.mp3").write_text("half")
        raise KeyboardInterrupt
    assert _texts(place) == {"sheets/a.pdf": "new"}
    with fill_folder(place, SONGS, overwrite=True) as folder:
        (folder / "a.mp3").write_text("newer")
    assert _texts(place) == {"a.mp3": "newer"}
    assert list(place.parent.iterdir()) == [place]


def test_what_a_killed_process_left_of_a_folder_goes_and_nothing_else(tmp_path: Path) -> None:
    """Only what a dead process of this machine has marked; the first process never dies."""
    names = {"dead": ("songs", HOST, DEAD), "alive": ("songs", HOST, 1)}
    names |= {"elsewhere": ("songs", "other", DEAD), "films": ("films", HOST, DEAD)}
    for name, (kind, host, process) in names.items():
        left = tmp_path / f".place.unfinished-{name}"
        left.mkdir()
        mark_folder(left, FolderKind(kind), {"host": host, "process": process})
    (tmp_path / ".place.unfinished-mine").mkdir()
    with fill_folder(tmp_path / "place", SONGS) as folder:
        (folder / "a.mp3").write_text("new")
    left = {path.name for path in tmp_path.iterdir()} - {"place"}
    assert left == {f".place.unfinished-{name}" for name in ("alive", "elsewhere", "films", "mine")}


def test_a_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / f"{'x' * 250}.txt"  # as long as names may be, almost
    write_atomically({path: b"old"})
    with pytest.raises(KeyboardInterrupt), write_aside(path) as aside:
        aside.write_text("half")
        assert aside.suffix == ".txt" and aside.parent == path.parent
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    neighbour = tmp_path / "a.tmp"  # Nothing beside is touched.
    neighbour.write_text("mine")
    write_atomically({tmp_path / "a": b"new", path: b"new"}, is_durable=False)
    assert neighbour.read_text() == "mine" and path.read_bytes() == b"new"
    assert path.stat().st_mode == neighbour.stat().st_mode, "the user's usual mode"


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (_file, "exists"),
        (_unmarked, "is no file"),
        (_link, "is a link"),
        (_dangling, "is a link"),
        (lambda place: place.symlink_to(place.with_name("other")), "is a link"),
    ],
)
def test_a_file_in_use_is_refused(
    tmp_path: Path, build: Callable[[Path], object], says: str
) -> None:
    place = tmp_path / "place"
    refuse_file_in_use(place)
    (tmp_path / "other").write_text("theirs")
    build(place)
    if build is _file:
        refuse_file_in_use(place, overwrite=True, inputs=[tmp_path / "other", tmp_path / "none"])
        with pytest.raises(FolderInUse, match="is what is read"):
            refuse_file_in_use(place, overwrite=True, inputs=[tmp_path / "." / "place"])
    with pytest.raises(FolderInUse, match=says):
        refuse_file_in_use(place, overwrite=build is not _file)


def _unfinished(target: Path, record: int = 1) -> UnfinishedFolder:
    return UnfinishedFolder(target, SONGS, {"record": record, "size": (1, 2)})


def test_the_same_work_goes_on_and_other_work_begins_anew(tmp_path: Path) -> None:
    target = tmp_path / "K"
    for record, is_kept in ((1, False), (1, True), (2, False)):
        folder = _unfinished(target, record)
        folder.begin(overwrite=False)
        assert folder.has(["a.mp3"]) == is_kept
        folder.write("a.mp3", b"sound")
    folder.finish()
    assert list(tmp_path.iterdir()) == [target] and _texts(target) == {"a.mp3": "sound"}
    marker = read_marker(target)
    assert marker is not None and marker["files"] == ["a.mp3"]


def test_an_unfinished_folder_with_a_strangers_file_stays(tmp_path: Path) -> None:
    folder = _unfinished(tmp_path / "K")
    folder.begin(overwrite=False)
    folder.write("a.mp3", b"sound")
    (folder.path / "f").write_text("hi")
    with pytest.raises(FolderInUse, match=r"K\.unfinished holds f, which this program did not"):
        _unfinished(tmp_path / "K", 2).begin(overwrite=True)
    assert _texts(folder.path) == {"a.mp3": "sound", "f": "hi"}
    # The same work goes on beside it; later it is known as another one's.
    again = _unfinished(tmp_path / "K")
    again.begin(overwrite=False)
    again.finish()
    assert strangers_in(tmp_path / "K", SONGS) == ["f"]


@pytest.mark.parametrize("build", [_file, _link, _dangling, _unmarked, _other_kind, _made])
def test_what_has_the_name_of_an_unfinished_folder_stays(
    tmp_path: Path, build: Callable[[Path], object]
) -> None:
    """Even songs of ours: they were not made to become K."""
    build(tmp_path / "K.unfinished")
    before = sorted((str(path), path.lstat().st_ino) for path in tmp_path.rglob("*"))
    folder = _unfinished(tmp_path / "K")
    with pytest.raises(FolderInUse, match=r"K\.unfinished is in the way"):
        folder.begin(overwrite=True)
    folder.abandon()
    assert sorted((str(path), path.lstat().st_ino) for path in tmp_path.rglob("*")) == before


def test_what_a_kill_left_at_the_very_beginning_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "K.unfinished").mkdir()
    (tmp_path / "K.unfinished" / f".tmp-123-{MARKER}").write_text("{")
    folder = _unfinished(tmp_path / "K")
    folder.begin(overwrite=False)
    folder.write("a.mp3", b"sound")
    folder.finish()
    assert _texts(tmp_path / "K") == {"a.mp3": "sound"}


def test_what_came_into_the_place_meanwhile_stays(tmp_path: Path) -> None:
    folder = _unfinished(tmp_path / "K")
    folder.begin(overwrite=False)
    folder.write("a.mp3", b"sound")
    _made(tmp_path / "K")
    with pytest.raises(FolderInUse, match="not empty"):
        folder.finish()
    assert _texts(tmp_path / "K") == {"a.mp3": "old"} and _texts(folder.path) == {"a.mp3": "sound"}
    assert json.loads((folder.path / MARKER).read_text())["becomes"] == "K"
