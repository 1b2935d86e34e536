"""Mutants of files: bytes, JSON values and tensors, changed at random, always in the same way."""

import copy
import io
import json
import pickle
import random
import resource
import signal
import struct
import traceback
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from handavatar.cli.failures import OUR_BUG, OUT_OF_SPACE, explanation
from handavatar.errors import printable

HOSTILE: list[Any] = [
    *(None, True, False, 0, -1, 1, 2, 7, 0.5, -0.0, 1e-300, 1e308, 2**31, 2**63, 10**30, 10**400),
    *("", "x", "\x1b[31mRED\x1b]0;pwned\x07", "\ud800", "../../etc/passwd", "a" * 5000, "NaN", "1"),
    *([], {}, [[]], [None], [1, 2, 3], [[1, 2, 3]] * 16, {"a": 1}, {"": None}),
    *(float("nan"), float("inf"), -float("inf")),
]
MOST_SECONDS = 20
"""A reader that takes longer hangs."""
_MOST_MEMORY = 2 * 2**30
"""Bytes beyond what the process takes anyway."""


def changed_bytes(data: bytes, chance: random.Random) -> bytes:
    """Some bytes flipped, cut off, repeated, cleared or put in."""
    changed = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 2, 5, 20))):
        if not changed:
            break
        place = chance.randrange(len(changed))
        # The beginnings of files say more than the rest.
        place = chance.randrange(min(len(changed), 512)) if chance.random() < 0.5 else place
        size = chance.choice((1, 1, 1, 2, 4, 16, 200))
        match chance.randrange(6):
            case 0:
                changed[place] ^= 1 << chance.randrange(8)
            case 1:
                changed[place : place + size] = chance.randbytes(size)
            case 2:
                del changed[place : place + size]
            case 3:
                changed[place:place] = changed[place : place + size]
            case 4:
                del changed[place:]
            case 5:
                value = chance.choice((0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000))
                changed[place : place + 4] = struct.pack(chance.choice("<>") + "I", value)
    return bytes(changed)


def changed_json(value: Any, chance: random.Random) -> Any:
    """One to three values replaced, left out, repeated or put elsewhere; a copy."""
    value = json.loads(json.dumps(value))
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        places = list(_places(value, 0))
        if not places:
            return copy.deepcopy(chance.choice(HOSTILE))
        # The outer levels say more than the many numbers below.
        depth = chance.randrange(1 + max(level for _, _, level in places))
        holder, key, _ = chance.choice([p for p in places if p[2] <= depth] or places)
        match chance.randrange(6):
            case 0 | 1 | 2:
                holder[key] = copy.deepcopy(chance.choice(HOSTILE))
            case 3:
                del holder[key]
            case 4:
                holder[key] = copy.deepcopy([holder[key]] * chance.choice((1, 2, 16)))
            case 5:
                other, place, _ = chance.choice(places)
                try:
                    holder[key] = json.loads(json.dumps(other[place]))
                except (KeyError, IndexError):
                    holder[key] = None
    return value


def _places(value: Any, level: int) -> Iterator[tuple[Any, Any, int]]:
    """Where values lie: their holder, key and depth; of long lists the first and last entries."""
    if isinstance(value, dict):
        keys: list[Any] = list(value)
    elif isinstance(value, list):
        keys = sorted({*range(min(3, len(value))), *range(max(0, len(value) - 2), len(value))})
    else:
        return
    for key in keys:
        yield value, key, level
        yield from _places(value[key], level + 1)


def changed_json_bytes(data: bytes, chance: random.Random) -> bytes:
    """A file of JSON with other values, or other bytes."""
    if chance.random() < 0.2:
        return changed_bytes(data, chance)
    text = json.dumps(changed_json(json.loads(data), chance))
    # Half of a pair of characters, as a careless program writes it.
    return text.encode("utf-8", "surrogatepass")


def changed_tensors(data: bytes, chance: random.Random) -> bytes:
    """A safetensors file whose header says something else, or whose numbers are others."""
    kind = chance.random()
    if kind < 0.1:
        return changed_bytes(data, chance)
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), bytearray(data[8 + size :])
    names = [name for name in header if name != "__metadata__"]
    name = chance.choice(names)
    entry = header[name]
    begin, end = entry["data_offsets"]
    facts = header.get("__metadata__", {})
    if kind < 0.35 and facts:
        key = chance.choice(list(facts))
        try:
            facts[key] = json.dumps(changed_json(json.loads(facts[key]), chance))
        except ValueError:
            facts[key] = str(chance.choice(HOSTILE))
    elif kind < 0.4 and facts:
        del facts[chance.choice(list(facts))]
    elif kind < 0.55:  # The same bytes of another type or shape, as far as the format allows.
        count = end - begin
        match chance.randrange(4):
            case 0:
                entry["dtype"], entry["shape"] = "U8", [count]
            case 1:
                entry["shape"] = [1, *entry["shape"]]
            case 2:
                entry["shape"] = entry["shape"][::-1]
            case 3:
                if count % 4 == 0:
                    entry["dtype"] = {"F32": "I32"}.get(entry["dtype"], "F32")
                    entry["shape"] = [count // 4]
    elif kind < 0.7:
        header[chance.choice([name + "x", "x", *names])] = header.pop(name)
    elif kind < 0.75:
        header[name] = changed_json(entry, chance)
    elif begin < end:
        for _ in range(chance.choice((1, 10, 1000))):
            place = begin + 4 * chance.randrange(max(1, (end - begin) // 4))
            value = chance.choice((float("nan"), float("inf"), -1.0, 0.0, 1e30, 7.0))
            number = chance.choice(
                (struct.pack("<f", value), struct.pack("<i", 2**30), b"\xff" * 4)
            )
            body[place : place + 4] = number[: max(0, end - place)]
    text = json.dumps(header).encode("utf-8", "surrogatepass")
    return struct.pack("<Q", len(text)) + text + bytes(body)


def changed_text(data: bytes, chance: random.Random) -> bytes:
    """Lines of words in which some are others, or bytes changed at random."""
    if chance.random() < 0.3:
        return changed_bytes(data, chance)
    lines = [line.split(" ") for line in data.decode().split("\n")]
    for _ in range(chance.choice((1, 1, 2, 3))):
        words = chance.choice([words for words in lines if words] or [[""]])
        place = chance.randrange(len(words))
        match chance.randrange(4):
            case 0 | 1:
                words[place] = str(chance.choice(HOSTILE))
            case 2:
                words[place : place + 1] = words * chance.randrange(3)
            case 3:
                lines.insert(chance.randrange(len(lines)), words)
    return "\n".join(map(" ".join, lines)).encode("utf-8", "surrogatepass")


def limit_memory() -> None:
    """So that a reader that takes all there is takes it from itself alone."""
    most = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (most + 4 * _MOST_MEMORY,) * 2)


@contextmanager
def _measured(told: list[str]) -> Iterator[None]:
    """Tells whether much more memory was taken than before, which is looked at once and again."""
    before = _resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # The peak is that of now.
    try:
        yield
    finally:
        taken = _resident("VmHWM") - before
        if taken > _MOST_MEMORY:
            told.append(f"takes {taken / 2**30:.1f} GiB")


def _resident(name: str) -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split(f"{name}:")[1].split()[0])


def changed_arrays(data: bytes, chance: random.Random) -> bytes:
    """An npz file whose arrays are others, or called otherwise, or whose bytes are changed."""
    if chance.random() < 0.1:
        return changed_bytes(data, chance)
    arrays = dict(np.load(io.BytesIO(data)))
    if chance.random() < 0.2:  # The bytes of one array, header and all, in a sound archive.
        name = chance.choice(list(arrays))
        written = io.BytesIO()
        np.save(written, arrays[name])
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w") as members:
            members.writestr(f"{name}.npy", changed_bytes(written.getvalue(), chance))
            for other in set(arrays) - {name}:
                written = io.BytesIO()
                np.save(written, arrays[other])
                members.writestr(f"{other}.npy", written.getvalue())
        return archive.getvalue()
    written = io.BytesIO()
    np.savez(written, **_changed_fields(arrays, chance))
    return written.getvalue()


def changed_pickle(data: bytes, chance: random.Random) -> bytes:
    """A pickled dictionary of arrays that holds others, or whose bytes are changed."""
    if chance.random() < 0.6:
        return changed_bytes(data, chance)
    return pickle.dumps(_changed_fields(pickle.loads(data), chance), 4)


def _changed_fields(fields: dict[str, Any], chance: random.Random) -> dict[str, Any]:
    fields = dict(fields)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        if not fields:
            break
        name = chance.choice(list(fields))
        array = np.array(fields[name])
        match chance.randrange(8):
            case 0:
                del fields[name]
            case 1:
                fields[chance.choice([name + "x", "\x1b[31m", *fields])] = fields.pop(name)
            case 2:
                fields[name] = array.reshape(chance.choice([(-1,), (1, *array.shape)]))
            case 3:
                fields[name] = array[..., : chance.randrange(4)] if array.ndim else array[None]
            case 4:
                kinds = ("float16", "int8", "uint64", "bool", "complex64", "S4", "U4", "M8[s]")
                fields[name] = np.zeros(array.shape, chance.choice(kinds))
            case 5 | 6:
                array = array.copy() if array.dtype.kind == "f" else np.zeros(array.shape)
                numbers = (float("nan"), float("inf"), 1e308, -1e300, 1e-300, 1e18, 7.0, -1.0, 0.5)
                array.reshape(-1)[: chance.choice((1, 3, array.size))] = chance.choice(numbers)
                fields[name] = array
            case 7:
                times = chance.choice((2, 300))
                fields[name] = np.repeat(array[None], times if array.size < 10_000 else 1, 0)
    return fields


class Hangs(Exception):
    """A reader took too long."""


@contextmanager
def _limited() -> Iterator[None]:
    def stop(number: int, frame: FrameType | None) -> None:
        raise Hangs

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(MOST_SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _is_own(file: str) -> bool:
    return "handavatar" in file


def fault_of(read: Callable[[], Any]) -> str:
    """How a reader failed on a mutant; empty if it read or refused it as it should."""
    heavy: list[str] = []
    try:
        with _measured(heavy), _limited():
            read()
    except Hangs:
        return f"hangs for {MOST_SECONDS} s"
    except Exception as error:
        code, message = explanation(error)
        if code == OUR_BUG:
            frames = traceback.extract_tb(error.__traceback__)
            own = [f"{Path(f.filename).name}:{f.lineno}" for f in frames if _is_own(f.filename)]
            return f"{message[:150]!r} in {' < '.join(own[::-1][:4])}"
        shown = printable(message)
        if any(ord(sign) < 32 and sign != "\n" for sign in shown):
            return f"an escape sequence in {shown!r}"
        if code == OUT_OF_SPACE:
            return f"{message[:150]!r}"
    return heavy[0] if heavy else ""
