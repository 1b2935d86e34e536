"""Plain values come out as pickle gives them; nothing that a file wants done is done."""

import pickle
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mano_files import Python2Pickler, as_released, hand_fields, old_modules, python2_pickle

from handavatar.hand import inert_pickle
from handavatar.hand.inert_pickle import InertObject, PickleError, read_pickle
from handavatar.hand.mano import read_mano
from handavatar.hand.pickled_arrays import ARRAY_NAMES, array_of
from handavatar.hand.rig import RigError

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**100), 2**100)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary(max_size=300),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=5).map(tuple)
        | st.dictionaries(st.text(max_size=5) | st.integers(0, 9), inner, max_size=4)
    ),
    max_leaves=20,
)


@settings(max_examples=150, deadline=None)
@given(PLAIN, st.sampled_from([3, 4, 5]))
def test_plain_values_are_read_as_pickle_reads_them(value: Any, protocol: int) -> None:
    written = pickle.dumps(value, protocol)
    assert read_pickle(written, frozenset()) == pickle.loads(written) == value


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.none()
        | st.booleans()
        | st.integers(-(2**100), 2**100)
        | st.floats(allow_nan=False)
        | st.text(st.characters(max_codepoint=255)),
        max_size=6,
    ),
    st.sampled_from([0, 1, 2]),
)
def test_python_2_text_is_latin_1(value: list[Any], protocol: int) -> None:
    written = python2_pickle(value, protocol)
    expected = pickle.loads(written, encoding="latin1")
    assert read_pickle(written, frozenset()) == expected == value


def test_lists_may_contain_themselves() -> None:
    endless: list[Any] = []
    endless.append(endless)
    found = read_pickle(pickle.dumps(endless, 4), frozenset())
    assert found[0] is found


def test_objects_are_noted_and_not_made() -> None:
    allowed = frozenset({"builtins.complex"})
    found = read_pickle(b"cbuiltins\ncomplex\n(K\x01K\x02tR}b.", allowed)
    assert isinstance(found, InertObject)
    assert (found.made_by, found.arguments, found.state) == ("builtins.complex", (1, 2), {})


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", ["<f8", ">f8", "<f4", "<i4", ">u2", "|i1", "<u8"])
@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4])
def test_arrays_come_back(protocol: int, kind: str, order: Any) -> None:
    array = np.asarray(np.arange(24).reshape(2, 3, 4), dtype=kind, order=order)
    for written in (pickle.dumps(array, protocol), python2_pickle(array, min(protocol, 2))):
        found = array_of(read_pickle(written, ARRAY_NAMES), (2, 3, 4))
        assert found.dtype == array.dtype
        np.testing.assert_array_equal(found, array)


# --- what is refused ------------------------------------------------------------------------------


class Call:
    """Pickles as a call, with state if there is any."""

    def __init__(self, *reduced: Any) -> None:
        self.reduced = reduced

    def __reduce__(self) -> Any:
        return self.reduced


def _text(value: str) -> bytes:
    return b"X" + struct.pack("<I", len(value)) + value.encode()


def _touch(path: Path) -> str:
    return f"touch {path}"


def _calling(module: str, name: str, *arguments: bytes) -> bytes:
    return f"c{module}\n{name}\n".encode() + b"(" + b"".join(arguments) + b"tR."


def _array(dtype: bytes, shape: bytes, raw: bytes, kind_state: bytes | None = None) -> bytes:
    """A numpy array with chosen parts, as an instruction sequence without the end."""
    plain = b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    return (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR(K\x01"
        + shape
        + b"cnumpy\ndtype\n("
        + dtype
        + b"K\x00K\x01tR"
        + (plain if kind_state is None else kind_state)
        + b"\x89"
        + raw
        + b"tb"
    )


def _field(name: str, value: bytes) -> bytes:
    """A whole MANO file in which one field is replaced by an instruction sequence."""
    whole = python2_pickle(as_released(hand_fields()), 2)
    assert whole.endswith(b"u.")
    return whole[:-1] + b"U" + bytes([len(name)]) + name.encode() + value + b"s."


# What to write for a path that must not come to exist, and what the message must contain.
CALLS: dict[str, tuple[Callable[[Path], bytes], str]] = {
    "os.system": (lambda p: _calling("os", "system", _text(_touch(p))), "os.system"),
    "posix.system": (lambda p: _calling("posix", "system", _text(_touch(p))), "posix.system"),
    "nt.system": (lambda p: _calling("nt", "system", _text(_touch(p))), "nt.system"),
    "os.popen": (lambda p: _calling("os", "popen", _text(_touch(p))), "os.popen"),
    "subprocess.Popen": (
        lambda p: _calling("subprocess", "Popen", b"](", _text("touch"), _text(str(p)), b"e"),
        "subprocess.Popen",
    ),
    "subprocess.check_output": (
        lambda p: pickle.dumps(Call(subprocess.check_output, (["touch", str(p)],)), 4),
        "subprocess.check_output",
    ),
    "eval": (
        lambda p: _calling("__builtin__", "eval", _text(f"open({str(p)!r}, 'w')")),
        "__builtin__.eval",
    ),
    "builtins.eval": (
        lambda p: _calling("builtins", "eval", _text(f"open({str(p)!r}, 'w')")),
        "builtins.eval",
    ),
    "exec": (
        lambda p: _calling("builtins", "exec", _text(f"open({str(p)!r}, 'w')")),
        "builtins.exec",
    ),
    "compile": (
        lambda p: _calling("builtins", "compile", _text("1"), _text("x"), _text("eval")),
        "builtins.compile",
    ),
    "open": (lambda p: _calling("builtins", "open", _text(str(p)), _text("w")), "builtins.open"),
    "io.open": (lambda p: _calling("io", "open", _text(str(p)), _text("w")), "io.open"),
    "getattr": (lambda p: _calling("builtins", "getattr", b"cos\n__dict__\n"), "builtins.getattr"),
    "builtins.getattr": (
        lambda p: _calling("builtins", "getattr", _text("a"), _text("upper")),
        "builtins.getattr",
    ),
    "__import__": (
        lambda p: _calling("builtins", "__import__", _text("antigravity")),
        "builtins.__import__",
    ),
    "importlib": (
        lambda p: _calling("importlib", "import_module", _text("this")),
        "importlib.import_module",
    ),
    "runpy": (lambda p: _calling("runpy", "run_path", _text(str(p))), "runpy.run_path"),
    "pickle.loads": (lambda p: _calling("pickle", "loads", b"C\x01."), "pickle.loads"),
    "marshal.loads": (lambda p: _calling("marshal", "loads", b"C\x01."), "marshal.loads"),
    "functools.partial": (
        lambda p: _calling("functools", "partial", b"cos\nsystem\n"),
        "functools.partial",
    ),
    "operator.attrgetter": (
        lambda p: _calling("operator", "attrgetter", _text("system")),
        "operator.attrgetter",
    ),
    "types.CodeType": (lambda p: _calling("types", "CodeType"), "types.CodeType"),
    "types.FunctionType": (lambda p: _calling("types", "FunctionType"), "types.FunctionType"),
    "ctypes": (lambda p: _calling("ctypes", "CDLL", _text("libc.so.6")), "ctypes.CDLL"),
    "socket": (lambda p: _calling("socket", "socket"), "socket.socket"),
    "shutil.rmtree": (lambda p: _calling("shutil", "rmtree", _text(str(p))), "shutil.rmtree"),
    "webbrowser": (lambda p: _calling("webbrowser", "open", _text("x")), "webbrowser.open"),
    "pip": (lambda p: _calling("pip", "main", b"]"), "pip.main"),
    "numpy.load": (lambda p: _calling("numpy", "load", _text(str(p))), "numpy.load"),
    "numpy.runstring": (
        lambda p: _calling("numpy.testing._private.utils", "runstring", _text("1"), b"}"),
        "numpy.testing._private.utils.runstring",
    ),
    "numpy.memmap": (lambda p: _calling("numpy", "memmap", _text(str(p))), "numpy.memmap"),
    "numpy.fromfile": (lambda p: _calling("numpy", "fromfile", _text(str(p))), "numpy.fromfile"),
    "numpy.zeros": (lambda p: _calling("numpy", "zeros", b"\x8a\x06\0\0\0\0\0\x10"), "numpy.zeros"),
    "scipy.io.loadmat": (lambda p: _calling("scipy.io", "loadmat", _text("x")), "scipy.io.loadmat"),
    "torch.load": (lambda p: _calling("torch", "load", _text(str(p))), "torch.load"),
    "chumpy's other classes": (lambda p: _calling("chumpy.ch", "pickle"), "chumpy.ch.pickle"),
    "a module under an allowed one": (
        lambda p: b"\x80\x04" + _text("numpy") + _text("dtype.__class__") + b"\x93.",
        "numpy.dtype.__class__",
    ),
    "a dotted walk": (
        lambda p: b"\x80\x04" + _text("chumpy.ch") + _text("Ch.__init__.__globals__") + b"\x93.",
        "Ch.__init__.__globals__",
    ),
    "STACK_GLOBAL os.system": (
        lambda p: b"\x80\x04" + _text("os") + _text("system") + b"\x93" + _text("x") + b"\x85R.",
        "os.system",
    ),
    "STACK_GLOBAL of no text": (lambda p: b"\x80\x04K\x01K\x02\x93.", "no text"),
    "INST": (lambda p: b"(" + _text(_touch(p)) + b"ios\nsystem\n.", "os.system"),
    "INST of an allowed class": (lambda p: b"(ichumpy.ch\nCh\n.", "old-style instance"),
    "OBJ": (lambda p: b"(cos\nsystem\n" + _text(_touch(p)) + b"o.", "os.system"),
    "OBJ of an allowed class": (lambda p: b"(cchumpy.ch\nCh\no.", "old-style instance"),
    "NEWOBJ": (lambda p: b"csubprocess\nPopen\n" + _text("x") + b"\x85\x81.", "subprocess.Popen"),
    "NEWOBJ_EX": (lambda p: b"cchumpy.ch\nCh\n)}\x92.", "keyword arguments"),
    "EXT1": (lambda p: b"\x80\x02\x82\x01.", "extension code"),
    "EXT2": (lambda p: b"\x80\x02\x83\x01\x00.", "extension code"),
    "EXT4": (lambda p: b"\x80\x02\x84\x01\x00\x00\x00.", "extension code"),
    "PERSID": (lambda p: b"Pos.system\n.", "persistent reference"),
    "BINPERSID": (lambda p: _text("os.system") + b"Q.", "persistent reference"),
    "an outside buffer": (lambda p: b"\x80\x05\x97.", "buffer"),
    "__setstate__ through BUILD": (
        lambda p: b"cchumpy.ch\nCh\n}U\x0c__setstate__cos\nsystem\nsb" + _text(_touch(p)) + b"b.",
        "os.system",
    ),
    "BUILD into a class": (lambda p: b"cchumpy.ch\nCh\n}U\x03newK\x01sb.", "fills a GlobalName"),
    "BUILD twice": (lambda p: b"cchumpy.ch\nCh\n)\x81}b}b.", "twice"),
    "BUILD into text": (lambda p: _text("a") + b"}b.", "fills a str"),
    "a call of a call": (lambda p: b"cnumpy\ndtype\n)R)R.", "no named function"),
    "a call of text": (lambda p: _text("os.system") + b")R.", "no named function"),
    "arguments that are no tuple": (lambda p: b"cnumpy\ndtype\n]R.", "no named function"),
    "nested in a field": (
        lambda p: _field("hands_mean", _calling("os", "system", _text(_touch(p)))[:-1]),
        "os.system",
    ),
    "nested in chumpy's state": (
        lambda p: _field(
            "shapedirs",
            b"cchumpy.ch\nCh\n)\x81}U\x01x"
            + _calling("os", "system", _text(_touch(p)))[:-1]
            + b"sb",
        ),
        "os.system",
    ),
    "as a key": (lambda p: b"}cos\nsystem\nNs.", "os.system"),
    "in a list never used": (lambda p: b"](cos\nsystem\ne0}.", "os.system"),
    "after text that hides it": (lambda p: b"\x80\x02U\x02..0cos\nsystem\n.", "os.system"),
}
MALFORMED: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "ends within"),
    "only a stop": (b".", "0 values"),
    "two values": (b"NN.", "2 values"),
    "only a mark": (b"(.", "instead of one"),
    "an unknown instruction": (b"\xff.", "unknown instruction"),
    "no pickle at all": (b"\x93NUMPY\x01\x00", "no value|takes a value"),
    "protocol 9": (b"\x80\x09N.", "newer than 5"),
    "cut within a name": (b"cos\nsys", "ends within a line"),
    "a text longer than the file": (b"X\xff\xff\xff\x7fabc.", "ends within"),
    "bytes of 2^62": (b"\x8e" + struct.pack("<Q", 2**62) + b"abc.", "ends within"),
    "text of 2^62": (b"\x8d" + struct.pack("<Q", 2**62) + b"abc.", "ends within"),
    "a byte array of 2^62": (b"\x96" + struct.pack("<Q", 2**62) + b"abc.", "byte array"),
    "an integer of a million bytes": (b"\x8b\x40\x42\x0f\x00" + bytes(10), "integer of 1000000"),
    "an integer of many digits": (b"I" + b"9" * 100_000 + b"\n.", "integer that is none"),
    "an integer of letters": (b"Iabc\n.", "integer that is none"),
    "a number of letters": (b"Fabc\n.", "number that is none"),
    "text without quotes": (b"Sabc\n.", "without quotes"),
    "text with a broken escape": (b"S'\\x1'\n.", "broken escape"),
    "text that is no UTF-8": (b"X\x01\x00\x00\x00\xff.", "not utf-8"),
    "a memo at 2^31": (b"Nr\xff\xff\xff\x7f0h\x07.", "recalls value 7"),
    "recalling what was never kept": (b"h\x00.", "recalls value 0"),
    "popping nothing": (b"0N.", "where there is none"),
    "a tuple without a mark": (b"Nt.", "never opened"),
    "a short tuple across a mark": (b"N(\x86.", "where there is none"),
    "a key without a value": (b"}(Nu.", "key without a value"),
    "a tuple as a key": (b"})Ns.", "key that is a tuple"),
    "a deep tuple as a key": (b"}" + b")" + b"\x85" * 19_000 + b"Ns.", "key that is a tuple"),
    "appending to text": (b"X\x01\x00\x00\x00aNa.", "fills a str"),
    "setting into a list": (b"](NNu.", "fills a list"),
    "members of no set": (b"\x80\x04}(N\x90.", "fills a dict"),
    "nothing but marks": (b"(" * 20_001, "20000 instructions"),
    "a memo bomb": (b"N" + b"2\x94" * 10_001, "20000 instructions"),
    "text at the top": (b"X\x01\x00\x00\x00a.", "no dictionary"),
    "a list at the top": (b"].", "no dictionary"),
    "a deep list at the top": (b"]" * 9_900 + b"a" * 9_899 + b".", "no dictionary"),
    "an object at the top": (b"cchumpy.ch\nCh\n)\x81.", "no dictionary"),
    "nothing in it": (b"}.", "lacks"),
}
FLOATS = b"U\x02f8"
BAD_ARRAYS: dict[str, tuple[bytes, str]] = {
    "a shape of 2^60": (
        _array(FLOATS, b"\x8a\x08" + struct.pack("<q", 2**60) + b"\x85", b"U\x00"),
        "a shape that is none",
    ),
    "a shape of 10^9 x 10^9": (
        _array(FLOATS, b"J\x00\xca\x9a\x3bJ\x00\xca\x9a\x3b\x86", b"U\x00"),
        "has 0 bytes",
    ),
    "a negative shape": (_array(FLOATS, b"J\xff\xff\xff\xff\x85", b"U\x00"), "shape that is none"),
    "a shape of text": (_array(FLOATS, b"U\x01a\x85", b"U\x00"), "shape that is none"),
    "many dimensions": (_array(FLOATS, b"(" + b"K\x01" * 99 + b"t", b"U\x00"), "shape that is"),
    "no numbers": (_array(FLOATS, b"K\x00\x85", b"U\x00"), "empty"),
    "fewer bytes than numbers": (_array(FLOATS, b"K\x2d\x85", b"U\x04abcd"), "4 bytes"),
    "objects": (_array(b"U\x02O8", b"K\x2d\x85", b"]"), "type 'O8'"),
    "records": (
        _array(
            FLOATS,
            b"K\x01\x85",
            b"U\x08abcdefgh",
            b"(K\x03U\x01<NU\x01a\x85}U\x01aNsK\x01K\x01K\x00tb",
        ),
        "several fields",
    ),
    "an unknown byte order": (
        _array(FLOATS, b"K\x01\x85", b"U\x08abcdefgh", b"(K\x03U\x01!NNNK\x01K\x01K\x00tb"),
        "byte order '!'",
    ),
    "a type that is an array": (
        _array(b"]", b"K\x01\x85", b"U\x08abcdefgh"),
        "expected text",
    ),
    "complex numbers": (_array(b"U\x03c16", b"K\x01\x85", b"U\x08abcdefgh"), "'c16'"),
    "bytes of another alphabet": (_array(FLOATS, b"K\x01\x85", b"V\\u1234\n"), "another alphabet"),
    "bytes that are a list": (_array(FLOATS, b"K\x01\x85", b"]"), "type list"),
    "no array": (b"K\x01", "type int"),
    "text": (b"U\x01a", "type str"),
    "a list": (b"]K\x01a", "type list"),
    "a class": (b"cnumpy\nndarray\n", "type GlobalName"),
    "a set": (b"c__builtin__\nset\n]\x85R", "object of __builtin__.set"),
    "an array never filled": (
        b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR",
        "not described",
    ),
    "an expression of itself": (
        b"cchumpy.ch\nCh\n)\x81r\xf0\x00\x00\x00}U\x01xj\xf0\x00\x00\x00sb",
        "more than 6 deep",
    ),
    "a variable without a value": (b"cchumpy.ch\nCh\n)\x81}b", "lacks 'x'"),
    "a variable without anything": (b"cchumpy.ch\nCh\n)\x81", "holds nothing"),
    "a choice beyond its array": (
        b"cchumpy.reordering\nSelect\n)\x81}(U\x01a"
        + _array(FLOATS, b"K\x01\x85", b"U\x08abcdefgh")
        + b"U\x04idxs"
        + _array(b"U\x02i4", b"K\x2d\x85", b"U\xb4" + bytes([1]) * 180)
        + b"ub",
        "of 1",
    ),
    "a choice by fractions": (
        b"cchumpy.reordering\nSelect\n)\x81}(U\x01a"
        + _array(FLOATS, b"K\x01\x85", b"U\x08abcdefgh")
        + b"U\x04idxs"
        + _array(FLOATS, b"K\x01\x85", b"U\x08abcdefgh")
        + b"ub",
        "expected integers",
    ),
    "a huge sparse matrix": (
        b"cscipy.sparse.csc\ncsc_matrix\n)\x81}U\x06_shapeJ\x00\xca\x9a\x3bJ\x00\xca\x9a\x3b\x86sb",
        "(1000000000, 1000000000)",
    ),
    "a sparse matrix of no shape": (b"cscipy.sparse.csc\ncsc_matrix\n)\x81}b", "type NoneType"),
}


def _refused(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    with pytest.raises(RigError) as caught:
        read_mano(path)
    message = str(caught.value)
    assert str(path) in message and "mano.is.tue.mpg.de" in message
    assert len(message.splitlines()) <= 6 and len(message) < 900
    return message


@pytest.mark.parametrize("name", CALLS)
def test_what_wants_to_run_is_refused_by_name(name: str, tmp_path: Path) -> None:
    make, expected = CALLS[name]
    sentinel = tmp_path / "sentinel"
    message = _refused(tmp_path / "MANO_RIGHT.pkl", make(sentinel))
    assert expected in message
    assert not sentinel.exists()


def test_the_sentinel_would_appear_if_the_file_were_unpickled(tmp_path: Path) -> None:
    sentinel = tmp_path / "sentinel"
    pickle.loads(CALLS["posix.system"][0](sentinel))
    assert sentinel.exists()


@pytest.mark.parametrize("name", MALFORMED)
def test_damaged_and_swollen_files_are_refused(name: str, tmp_path: Path) -> None:
    content, expected = MALFORMED[name]
    message = _refused(tmp_path / "MANO_RIGHT.pkl", content)
    assert any(part in message for part in expected.split("|")), message


@pytest.mark.parametrize("name", BAD_ARRAYS)
def test_arrays_that_are_none_are_refused(name: str, tmp_path: Path) -> None:
    value, expected = BAD_ARRAYS[name]
    path = tmp_path / "MANO_RIGHT.pkl"
    message = _refused(path, _field("J_regressor" if "sparse" in name else "hands_mean", value))
    assert expected in message, message


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    whole = python2_pickle(as_released(hand_fields()), 2)
    for end in range(0, len(whole), len(whole) // 40):
        with pytest.raises(PickleError):
            read_pickle(whole[:end], ARRAY_NAMES)


def test_bytes_changed_at_random_never_do_anything_else(tmp_path: Path) -> None:
    """Whatever the bytes: a value, or PickleError and nothing else."""
    random = np.random.default_rng(0)
    base = pickle.dumps({"a": [1, 2.5, (3,), "x"], "b": np.arange(3.0), "c": {4}}, 2)
    for _ in range(400):
        content = bytearray(base)
        for place in random.integers(0, len(base), 3):
            content[place] = random.integers(256)
        try:
            found = read_pickle(bytes(content), ARRAY_NAMES)
            array_of(found["b"] if isinstance(found, dict) and "b" in found else None, (3,))
        except PickleError:
            continue


def test_the_reader_imports_nothing_that_can_build_objects() -> None:
    names = set(vars(inert_pickle))
    assert not names & {"pickle", "importlib", "sys", "os", "builtins", "numpy", "np"}


def test_pickles_are_written_with_the_names_of_their_time() -> None:
    with old_modules():
        assert Python2Pickler.dispatch[str] is Python2Pickler.dispatch[bytes]
    written = python2_pickle(as_released(hand_fields()), 2)
    for name in (
        b"cchumpy.ch\nCh\n",
        b"cchumpy.reordering\nSelect\n",
        b"cscipy.sparse.csc\ncsc_matrix\n",
        b"cnumpy.core.multiarray\n_reconstruct\n",
        b"c__builtin__\nset\n",
    ):
        assert name in written
