"""Pickle files as plain values: a reader that can run nothing, because it calls nothing.

A pickle is a small program. This module walks through it with a stack of its own: numbers, text,
lists and dictionaries become what they are, and whatever the file wants to be called or built
becomes an :class:`InertObject` that merely says so. No name is ever looked up. Names that the
caller does not expect end the reading at once, and so do persistent references, extension codes
and old-style instances. Work and memory are bounded by the size of the file.
"""

import codecs
import re
import struct
from dataclasses import dataclass
from typing import Any

from handavatar.errors import HandAvatarError

MAX_INSTRUCTIONS = 20_000
"""A MANO file has a few hundred."""
_MAX_INTEGER_BYTES = 16
_MAX_LINE_OF_NUMBER = 40

_REFUSED = {
    b"P": "a persistent reference",
    b"Q": "a persistent reference",
    b"\x82": "an extension code",
    b"\x83": "an extension code",
    b"\x84": "an extension code",
    b"\x92": "an object with keyword arguments",
    b"\x96": "a byte array",
    b"\x97": "a buffer outside the file",
    b"\x98": "a buffer outside the file",
}
_CONSTANTS: dict[bytes, Any] = {b"N": None, b"\x88": True, b"\x89": False, b")": ()}
_SHORT_TUPLES = {b"\x85": 1, b"\x86": 2, b"\x87": 3}
# How long the length is, and what becomes of the bytes; Python 2's text is read as Latin-1.
_COUNTED: dict[bytes, tuple[int, str]] = {
    b"U": (1, "latin-1"),
    b"T": (4, "latin-1"),
    b"X": (4, "utf-8"),
    b"\x8c": (1, "utf-8"),
    b"\x8d": (8, "utf-8"),
    b"C": (1, ""),
    b"B": (4, ""),
    b"\x8e": (8, ""),
}
_INTEGERS = {b"K": "<B", b"M": "<H", b"J": "<i"}
# What Python 2 writes between quotes.
_ESCAPED = re.compile(
    rb"""(?:[^\\]|\\(?:[\\'"abfnrtv]|x[0-9a-fA-F]{2}|[0-3][0-7]{2}))*""", re.DOTALL
)
_INDEX_SIZES = {b"h": 1, b"j": 4, b"q": 1, b"r": 4}


class PickleError(HandAvatarError):
    """A pickle that is refused or damaged: what was found in it."""


@dataclass(frozen=True)
class GlobalName:
    """A class or function that a pickle names; it is not looked up.

    Attributes:
        dotted: e.g. ``numpy.dtype``.
    """

    dotted: str


@dataclass(eq=False)
class InertObject:
    """What a pickle wants to be made; it is not made.

    Attributes:
        made_by: dotted name of the class or function that was to be called.
        arguments: that it was to be called with.
        state: that was to be put into the result; None if there was none.
    """

    made_by: str
    arguments: tuple[Any, ...]
    state: Any = None


class _Mark:
    """Stands on the stack where a group begins."""


def read_pickle(content: bytes, allowed: frozenset[str]) -> Any:
    """The value that a pickle of any protocol up to 5 describes.

    Args:
        content: of the file; what follows the end of the pickle is not looked at.
        allowed: dotted names that it may contain.

    Returns:
        None, numbers, text, bytes, lists, tuples, dictionaries with plain keys,
        :class:`GlobalName` and :class:`InertObject`. Lists and objects may contain themselves.

    Raises:
        PickleError: another name is in it, or something that cannot be read without running it,
            or it is cut, damaged or too large.
    """
    return _Reader(content, allowed).value()


class _Reader:
    """One pass through one pickle."""

    def __init__(self, content: bytes, allowed: frozenset[str]) -> None:
        self._content = content
        self._allowed = allowed
        self._position = 0
        self._stack: list[Any] = []
        # A dictionary: a list would grow to whatever index the file names.
        self._memo: dict[int, Any] = {}

    def value(self) -> Any:
        for _ in range(MAX_INSTRUCTIONS):
            instruction = self._bytes(1)
            if instruction == b".":
                if len(self._stack) != 1 or self._stack[0] is _Mark:
                    raise PickleError(f"it ends with {len(self._stack)} values instead of one")
                return self._stack[0]
            self._follow(instruction)
        raise PickleError(f"it has more than {MAX_INSTRUCTIONS} instructions")

    def _follow(self, instruction: bytes) -> None:
        if instruction in _REFUSED:
            raise PickleError(f"it contains {_REFUSED[instruction]}")
        if not (
            self._follow_plain(instruction)
            or self._follow_group(instruction)
            or self._follow_memory(instruction)
            or self._follow_object(instruction)
        ):
            raise PickleError(f"it contains the unknown instruction {instruction!r}")

    def _follow_plain(self, instruction: bytes) -> bool:
        """Numbers and text."""
        if instruction in _CONSTANTS:
            value = _CONSTANTS[instruction]
        elif instruction in _INTEGERS:
            value = self._unpacked(_INTEGERS[instruction])
        elif instruction in _COUNTED:
            size, encoding = _COUNTED[instruction]
            raw = self._bytes(self._count(size))
            value = _decoded(raw, encoding) if encoding else raw
        elif instruction in (b"I", b"L"):
            value = _integer(self._line())
        elif instruction == b"F":
            value = _float(self._line())
        elif instruction == b"G":
            value = self._unpacked(">d")
        elif instruction in (b"\x8a", b"\x8b"):
            size = self._count(1 if instruction == b"\x8a" else 4)
            if size > _MAX_INTEGER_BYTES:
                raise PickleError(f"it contains an integer of {size} bytes")
            value = int.from_bytes(self._bytes(size), "little", signed=True)
        elif instruction == b"S":
            value = _quoted(self._line())
        elif instruction == b"V":
            value = _decoded(self._line(), "raw-unicode-escape")
        else:
            return False
        self._stack.append(value)
        return True

    def _follow_group(self, instruction: bytes) -> bool:
        """Lists, tuples, dictionaries and sets."""
        if instruction == b"(":
            self._stack.append(_Mark)
        elif instruction == b"t":
            self._stack.append(tuple(self._since_mark()))
        elif instruction in _SHORT_TUPLES:
            members = [self._pop() for _ in range(_SHORT_TUPLES[instruction])]
            self._stack.append(tuple(reversed(members)))
        elif instruction in (b"]", b"l"):
            self._stack.append(self._since_mark() if instruction == b"l" else [])
        elif instruction in (b"}", b"d"):
            members = self._since_mark() if instruction == b"d" else []
            self._stack.append({})
            self._set_items(members)
        elif instruction in (b"a", b"e"):
            members = self._since_mark() if instruction == b"e" else [self._pop()]
            self._top(list).extend(members)
        elif instruction in (b"s", b"u"):
            members = (
                self._since_mark() if instruction == b"u" else [self._pop(), self._pop()][::-1]
            )
            self._set_items(members)
        elif instruction == b"\x8f":
            self._stack.append(InertObject("builtins.set", ([],)))
        elif instruction == b"\x90":
            members = self._since_mark()
            first = self._top(InertObject).arguments[:1]
            if not first or type(first[0]) is not list:
                raise PickleError("it adds members to something that is no set")
            first[0].extend(members)
        elif instruction == b"\x91":
            self._stack.append(InertObject("builtins.frozenset", (self._since_mark(),)))
        else:
            return False
        return True

    def _follow_memory(self, instruction: bytes) -> bool:
        """What was seen before, and where the file says of itself how it is written."""
        if instruction in (b"g", b"h", b"j"):
            index = self._index(instruction, b"g")
            if index not in self._memo:
                raise PickleError(f"it recalls value {index}, which it never kept")
            self._stack.append(self._memo[index])
        elif instruction in (b"p", b"q", b"r"):
            self._memo[self._index(instruction, b"p")] = self._peek()
        elif instruction == b"\x94":
            self._memo[len(self._memo)] = self._peek()
        elif instruction == b"0":
            self._pop()
        elif instruction == b"1":
            self._since_mark()
        elif instruction == b"2":
            self._stack.append(self._peek())
        elif instruction == b"\x80":
            if self._count(1) > 5:
                raise PickleError("its protocol is newer than 5")
        elif instruction == b"\x95":
            self._count(8)
        else:
            return False
        return True

    def _follow_object(self, instruction: bytes) -> bool:
        """What is to be called: noted, not done."""
        if instruction == b"c":
            self._stack.append(self._named(self._text_line(), self._text_line()))
        elif instruction == b"\x93":
            name, module = self._pop(), self._pop()
            if not isinstance(name, str) or not isinstance(module, str):
                raise PickleError("it names a class by something that is no text")
            self._stack.append(self._named(module, name))
        elif instruction == b"i":
            named = self._named(self._text_line(), self._text_line())
            raise PickleError(f"it contains an old-style instance of {named.dotted}")
        elif instruction == b"o":
            members = self._since_mark()
            what = (
                members[0].dotted if members and isinstance(members[0], GlobalName) else "nothing"
            )
            raise PickleError(f"it contains an old-style instance of {what}")
        elif instruction in (b"R", b"\x81"):
            arguments, called = self._pop(), self._pop()
            if not isinstance(called, GlobalName) or not isinstance(arguments, tuple):
                raise PickleError("it calls something that is no named function or class")
            self._stack.append(InertObject(called.dotted, arguments))
        elif instruction == b"b":
            state, built = self._pop(), self._top(InertObject)
            if built.state is not None:
                raise PickleError(f"it fills an object of {built.made_by} twice")
            built.state = state
        else:
            return False
        return True

    def _named(self, module: str, name: str) -> GlobalName:
        dotted = f"{module}.{name}"
        if dotted not in self._allowed:
            raise PickleError(f"it names {_shown(dotted)}, which has no place in it")
        return GlobalName(dotted)

    def _set_items(self, members: list[Any]) -> None:
        target = self._top(dict)
        if len(members) % 2:
            raise PickleError("it has a key without a value")
        for key, value in zip(members[::2], members[1::2], strict=True):
            # Hashing nested tuples would recurse as deeply as the file likes.
            if not isinstance(key, str | bytes | int):
                raise PickleError(f"it has a key that is a {type(key).__name__}")
            target[key] = value

    def _bytes(self, count: int) -> bytes:
        end = self._position + count
        if end > len(self._content):
            raise PickleError(f"it ends within an instruction, at byte {len(self._content)}")
        taken = self._content[self._position : end]
        self._position = end
        return taken

    def _line(self) -> bytes:
        end = self._content.find(b"\n", self._position)
        if end < 0:
            raise PickleError(f"it ends within a line, at byte {len(self._content)}")
        line = self._content[self._position : end]
        self._position = end + 1
        return line

    def _text_line(self) -> str:
        return _decoded(self._line(), "utf-8")

    def _count(self, size: int) -> int:
        return int.from_bytes(self._bytes(size), "little")

    def _unpacked(self, layout: str) -> Any:
        return struct.unpack(layout, self._bytes(struct.calcsize(layout)))[0]

    def _index(self, instruction: bytes, as_text: bytes) -> int:
        if instruction == as_text:
            return _integer(self._line())
        return self._count(_INDEX_SIZES[instruction])

    def _peek(self) -> Any:
        if not self._stack or self._stack[-1] is _Mark:
            raise PickleError("it takes a value where there is none")
        return self._stack[-1]

    def _pop(self) -> Any:
        self._peek()
        return self._stack.pop()

    def _top(self, kind: type) -> Any:
        """The uppermost value, which an instruction is about to fill."""
        top = self._peek()
        if type(top) is not kind:
            raise PickleError(f"it fills a {type(top).__name__} as if it were something else")
        return top

    def _since_mark(self) -> list[Any]:
        members: list[Any] = []
        while self._stack:
            top = self._stack.pop()
            if top is _Mark:
                return members[::-1]
            members.append(top)
        raise PickleError("it closes a group that it never opened")


def _decoded(raw: bytes, encoding: str) -> str:
    try:
        return raw.decode(encoding, "surrogatepass" if encoding == "utf-8" else "strict")
    except UnicodeDecodeError as error:
        raise PickleError(f"it contains text that is not {encoding}") from error


def _quoted(line: bytes) -> str:
    """Python 2's text in quotes with escapes, as Latin-1."""
    if len(line) < 2 or line[:1] != line[-1:] or line[:1] not in (b"'", b'"'):
        raise PickleError("it contains text without quotes")
    if not _ESCAPED.fullmatch(line, 1, len(line) - 1):
        raise PickleError("it contains text with a broken escape")
    return codecs.escape_decode(line[1:-1])[0].decode("latin-1")


def _integer(line: bytes) -> int | bool:
    if line in (b"00", b"01"):
        return line == b"01"
    try:
        if len(line) > _MAX_LINE_OF_NUMBER:
            raise ValueError
        return int(line.removesuffix(b"L"))
    except ValueError as error:
        raise PickleError("it contains an integer that is none") from error


def _float(line: bytes) -> float:
    try:
        return float(line[:_MAX_LINE_OF_NUMBER])
    except ValueError as error:
        raise PickleError("it contains a number that is none") from error


def _shown(text: str) -> str:
    """A name from outside, fit for a message."""
    return ascii(text[:80])[1:-1]
