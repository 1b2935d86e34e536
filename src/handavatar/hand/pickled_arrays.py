"""Arrays out of an inert pickle: numpy's, scipy's sparse ones and chumpy's expressions.

numpy, scipy and chumpy are not called to rebuild what the file describes; bytes of the file are
looked at as numbers, after their count was compared with the shape that goes with them.
"""

import math
from typing import Any

import numpy as np

from handavatar.hand.inert_pickle import GlobalName, InertObject, PickleError

_RECONSTRUCT = frozenset(
    {"numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct"}
)
# The same class under the names of old and new versions.
_SPARSE = frozenset(
    {
        "scipy.sparse.csc.csc_matrix",
        "scipy.sparse._csc.csc_matrix",
        "scipy.sparse.csc_matrix",
    }
)
_VARIABLE = frozenset({"chumpy.ch.Ch", "chumpy.Ch"})
_SELECT = "chumpy.reordering.Select"
_ENCODE = "_codecs.encode"
_OLD_OBJECT = frozenset({"copy_reg._reconstructor", "copyreg._reconstructor"})

ARRAY_NAMES = (
    _RECONSTRUCT
    | _SPARSE
    | _VARIABLE
    | _OLD_OBJECT
    | {
        _SELECT,
        _ENCODE,
        "numpy.ndarray",
        "numpy.dtype",
        # What else a chumpy object carries about itself; never looked at.
        "__builtin__.object",
        "builtins.object",
        "__builtin__.set",
        "builtins.set",
    }
)
"""Every name that a pickle of such arrays may contain."""

_MAX_DEPTH = 6
_NUMBERS = frozenset({"f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"})


def array_of(value: Any, shape: tuple[int, ...], depth: int = 0) -> np.ndarray:
    """The numbers of a pickled array.

    Args:
        value: from :func:`~handavatar.hand.inert_pickle.read_pickle`.
        shape: what it must have; nothing larger is built.
        depth: how many expressions enclose it.

    Raises:
        PickleError: it is no array of numbers of this shape.
    """
    found = _any_array(value, shape, depth)
    if found.shape != shape:
        raise PickleError(f"its shape is {found.shape}, expected {shape}")
    return found


def dense_array(value: Any) -> np.ndarray:
    """The numbers of a pickled numpy array of any shape.

    Args:
        value: from :func:`~handavatar.hand.inert_pickle.read_pickle`.

    Raises:
        PickleError: it is no numpy array of numbers.
    """
    if not isinstance(value, InertObject) or _class_of(value) not in _RECONSTRUCT:
        raise PickleError(f"it is {_kind(value)}, expected an array")
    return _dense(value.state)


def single_object(value: Any) -> Any:
    """What a pickled array of no dimension holds: ``np.save`` writes a dictionary so.

    Raises:
        PickleError: it is no such array.
    """
    is_array = isinstance(value, InertObject) and _class_of(value) in _RECONSTRUCT
    state = value.state if is_array else None
    if not isinstance(state, tuple) or len(state) != 5 or state[1] != ():
        raise PickleError(f"it is {_kind(value)}, expected one object in an array")
    if not isinstance(state[4], list) or len(state[4]) != 1:
        raise PickleError("its array does not hold one object")
    return state[4][0]


def text_of(value: Any) -> str:
    """Text, whichever version of Python wrote it.

    Raises:
        PickleError: it is no text.
    """
    if isinstance(value, InertObject) and value.made_by == _ENCODE:
        value = _raw(value)
    if isinstance(value, bytes):
        return value.decode("latin-1")
    if not isinstance(value, str):
        raise PickleError(f"it is {_kind(value)}, expected text")
    return value


def _any_array(value: Any, shape: tuple[int, ...], depth: int) -> np.ndarray:
    if depth > _MAX_DEPTH:
        raise PickleError(f"its expression is more than {_MAX_DEPTH} deep")
    if not isinstance(value, InertObject):
        raise PickleError(f"it is {_kind(value)}, expected an array")
    made_by = _class_of(value)
    if made_by in _RECONSTRUCT:
        return _dense(value.state)
    if made_by in _SPARSE:
        return _from_sparse(_fields(value), shape, depth)
    if made_by in _VARIABLE:
        return _any_array(_field(value, "x"), shape, depth + 1)
    if made_by == _SELECT:
        return _selected(value, shape, depth)
    raise PickleError(f"it is {_kind(value)}, expected an array")


def _class_of(value: InertObject) -> str:
    """The class that was to be made; protocols 0 and 1 name it as an argument."""
    if value.made_by in _OLD_OBJECT and value.arguments:
        first = value.arguments[0]
        return first.dotted if isinstance(first, GlobalName) else ""
    return value.made_by


def _dense(state: Any) -> np.ndarray:
    """A numpy array of the five values that it pickles: version, shape, type, order, bytes."""
    if not isinstance(state, tuple) or len(state) != 5:
        raise PickleError("its array is not described as numpy does")
    _, shape, kind, is_fortran, raw = state
    dtype, content = _dtype(kind), _raw(raw)
    sizes = _sizes(shape)
    if math.prod(sizes) * dtype.itemsize != len(content):
        raise PickleError(
            f"its array of shape {sizes} and type {dtype} has {len(content)} bytes, "
            f"expected {math.prod(sizes) * dtype.itemsize}"
        )
    if not content:
        raise PickleError(f"its array of shape {sizes} is empty")
    return np.frombuffer(content, dtype).reshape(sizes, order="F" if is_fortran else "C")


def _sizes(shape: Any) -> tuple[int, ...]:
    is_plain = isinstance(shape, tuple) and len(shape) <= 8
    if not is_plain or not all(type(size) is int and 0 <= size < 2**40 for size in shape):
        raise PickleError("its array has a shape that is none")
    return shape


def _dtype(described: Any) -> np.dtype:
    """A type of numbers; objects, records and text are refused."""
    if not isinstance(described, InertObject) or described.made_by != "numpy.dtype":
        raise PickleError("its array has a type that numpy does not know")
    arguments, state = described.arguments, described.state
    letters = text_of(arguments[0]) if arguments else ""
    if letters not in _NUMBERS:
        raise PickleError(f"its array is of type {letters[:20]!a}, expected numbers")
    order = "|"
    if state is not None:
        is_plain = isinstance(state, tuple) and 5 <= len(state) <= 9
        if not is_plain or any(part is not None for part in state[2:5]):
            raise PickleError("its array has a type of several fields, expected plain numbers")
        order = text_of(state[1])
    if order not in ("<", ">", "|", "="):
        raise PickleError(f"its array has the byte order {order[:20]!a}")
    return np.dtype(order + letters)


def _raw(value: Any) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, InertObject) and value.made_by == _ENCODE:
        # Python 3 writes bytes so for Python 2.
        if len(value.arguments) != 2 or text_of(value.arguments[1]) != "latin1":
            raise PickleError("its bytes are encoded in an unknown way")
        value = value.arguments[0]
    if not isinstance(value, str):
        raise PickleError(f"its bytes are {_kind(value)}")
    try:
        return value.encode("latin-1")
    except UnicodeEncodeError as error:
        raise PickleError("its bytes are text of another alphabet") from error


def _from_sparse(state: dict[Any, Any], shape: tuple[int, ...], depth: int) -> np.ndarray:
    """A compressed sparse column matrix, filled in."""
    found = state.get("_shape", state.get("shape"))
    if found != shape or len(shape) != 2:
        is_short = isinstance(found, tuple) and len(found) < 9
        shown = _sizes(found) if is_short else _kind(found)
        raise PickleError(f"its shape is {shown}, expected {shape}")
    rows, columns = shape
    starts = _integers(state.get("indptr"), depth)
    places = _integers(state.get("indices"), depth)
    values = _any_array(state.get("data"), shape, depth + 1)
    if starts.shape != (columns + 1,) or values.shape != places.shape or values.ndim != 1:
        raise PickleError("its sparse matrix has arrays that do not fit together")
    counts = np.diff(starts)
    if starts[0] != 0 or starts[-1] != len(values) or (counts < 0).any():
        raise PickleError("its sparse matrix has columns that do not follow one another")
    if len(places) and not 0 <= places.min() <= places.max() < rows:
        raise PickleError(f"its sparse matrix names rows {places.min()} to {places.max()}")
    dense = np.zeros(shape)
    np.add.at(dense, (places, np.repeat(np.arange(columns), counts)), values)
    return dense


def _selected(value: InertObject, shape: tuple[int, ...], depth: int) -> np.ndarray:
    """What chumpy chose of an array: ``a.ravel()[idxs].reshape(preferred_shape)``."""
    source = _any_array(_field(value, "a"), shape, depth + 1).ravel()
    chosen = _integers(_field(value, "idxs"), depth)
    if chosen.size != math.prod(shape):
        raise PickleError(f"it chooses {chosen.size} numbers, expected {math.prod(shape)}")
    if chosen.size and not 0 <= chosen.min() <= chosen.max() < source.size:
        raise PickleError(f"it chooses elements {chosen.min()} to {chosen.max()} of {source.size}")
    preferred = _fields(value).get("preferred_shape", shape)
    sizes = _sizes(preferred)
    if sizes != shape:
        raise PickleError(f"its shape is {sizes}, expected {shape}")
    return source[chosen.ravel()].reshape(shape)


def _integers(value: Any, depth: int) -> np.ndarray:
    found = _any_array(value, (), depth + 1)
    if found.dtype.kind not in "iu":
        raise PickleError(f"its indices are of type {found.dtype}, expected integers")
    return found.astype(np.int64)


def _fields(value: InertObject) -> dict[Any, Any]:
    if not isinstance(value.state, dict):
        raise PickleError(f"its {_class_of(value)} holds nothing")
    return value.state


def _field(value: InertObject, name: str) -> Any:
    fields = _fields(value)
    if name not in fields:
        raise PickleError(f"its {_class_of(value)} lacks {name!r}")
    return fields[name]


def _kind(value: Any) -> str:
    """What a value is, in words of bounded length."""
    if isinstance(value, InertObject):
        return f"an object of {value.made_by}"
    return f"of type {type(value).__name__}"
