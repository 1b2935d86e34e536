"""From words to an options dataclass, by tyro; and from results to standard output."""

import dataclasses
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from handavatar.cli.failures import say
from handavatar.cli.inputs import Expected, require
from handavatar.errors import ArgumentError, require_range

Options = TypeVar("Options")


@dataclasses.dataclass(frozen=True)
class Extra:
    """An option of the command itself, not of the code it calls.

    Attributes:
        name: without the dashes.
        kind: its type.
        help: one line.
        default: value if it is not given; ``...`` means that it is required.
        is_positional: stands without a name, before the others.
        least: of a number; not looked at where it is above ``most``.
        most: of a number.
    """

    name: str
    kind: Any
    help: str
    default: Any = ...
    is_positional: bool = False
    least: int | float = 1
    most: int | float = 0


JSON = Extra("json", bool, "print one JSON object and nothing else", False)
OUT = Extra("out", Path, "folder to write; must not exist, or be empty")
OVERWRITE = Extra("overwrite", bool, "replace what lies there", False)


def parse(
    options: type[Options],
    words: list[str],
    command: str,
    positional: tuple[str, ...] = (),
    reads: Mapping[str, Expected] | None = None,
) -> Options:
    """Reads the options of a command; ``--help`` and mistakes end the program.

    Args:
        options: a dataclass; its documentation is the help.
        words: after the command's name.
        command: for the usage line.
        positional: fields that stand without a name, in this order.
        reads: as for :func:`parse_with`.
    """
    return parse_with(options, (), words, command, positional, reads=reads)[0]


def parse_with(
    options: type[Options],
    extras: tuple[Extra, ...],
    words: list[str],
    command: str,
    positional: tuple[str, ...] = (),
    given: Mapping[str, Any] | None = None,
    about: str = "",
    reads: Mapping[str, Expected] | None = None,
) -> tuple[Options, dict[str, Any]]:
    """As :func:`parse`, with the values of further options by name.

    Fields in ``given`` have these values, and no word sets them, unless an extra has their name:
    if it is set, its value is the field's as well.

    Args:
        options: as for :func:`parse`.
        extras: further options.
        words: after the command's name.
        command: for the usage line.
        positional: fields that stand without a name, in this order.
        given: values of fields.
        about: says what the command does, if the options' documentation does not.
        reads: what must be of which kind, by the name of the field or extra that names its path.

    Raises:
        WrongInput: a path is of another kind.
        ArgumentError: a number is out of range.

    Tyro reads a subclass of the dataclass that carries the command line's own conventions, so
    that the code it serves need not know them.
    """
    fields: list[tuple[str, Any, Any]] = []
    for extra in extras:
        named: Any = Annotated[extra.kind, tyro.conf.arg(help=extra.help)]
        default = dataclasses.MISSING if extra.default is ... else extra.default
        kind = _positional(named, extra.name) if extra.is_positional else named
        fields.append((extra.name, kind, dataclasses.field(default=default)))
    own = dataclasses.fields(options)  # type: ignore[arg-type]
    taken, values = {extra.name for extra in extras}, dict(given or {})
    for field in own:
        if field.name in taken:
            continue
        if field.name in values:
            fixed: Any = Annotated[field.type, tyro.conf.Fixed, tyro.conf.Suppress]
            default = dataclasses.field(default=values[field.name])
            fields.append((field.name, fixed, default))
            continue
        if dataclasses.is_dataclass(field.type):
            fields.append(_unchecked_field(field))
            continue
        named = _comma_separated(field.type)
        kind = _positional(named, field.name) if field.name in positional else named
        # Either of the two is MISSING, which stands for none.
        defaults: Any = {"default": field.default, "default_factory": field.default_factory}
        fields.append((field.name, kind, dataclasses.field(**defaults)))
    twin: Any = _unchecked(options, fields)
    twin.__doc__ = about or options.__doc__
    parsed: Any = tyro.cli(
        twin, args=words, prog=f"handavatar {command}", config=(tyro.conf.FlagCreatePairsOff,)
    )
    for extra in extras:
        if extra.least <= extra.most:
            require_range(extra.name, getattr(parsed, extra.name), extra.least, extra.most)
    found = {
        field.name: _rebuilt(getattr(parsed, field.name), field.type, field.name) for field in own
    }
    found |= {name: value for name, value in values.items() if found[name] is None}
    for name, expected in (reads or {}).items():
        shown = name.upper() if name in positional else "--" + name.replace("_", "-")
        for path in _paths(getattr(parsed, name)):
            require(path, expected, f"{shown} of handavatar {command}")
    for name in {*found, *(extra.name for extra in extras)} - set(reads or ()):
        for path in _paths(getattr(parsed, name)) if _holds_paths(getattr(parsed, name)) else []:
            _require_utf8(name, path)
    return (
        options(**found),
        {extra.name: getattr(parsed, extra.name) for extra in extras},
    )


def _unchecked(kind: type[Any], fields: list[tuple[str, Any, Any]]) -> type[Any]:
    """A subclass that takes any values: tyro would make what its class says of them a riddle."""
    namespace = {"__post_init__": lambda self: None}
    return dataclasses.make_dataclass(
        kind.__name__, fields, bases=(kind,), namespace=namespace, kw_only=True, frozen=True
    )


def _unchecked_field(field: dataclasses.Field[Any]) -> tuple[str, Any, Any]:
    """A field that is an options class itself, for tyro."""
    own: Any = field.type
    within = [f for f in dataclasses.fields(own) if dataclasses.is_dataclass(f.type)]
    kind = _unchecked(own, [_unchecked_field(each) for each in within])
    given: Any = field.default_factory
    return field.name, kind, dataclasses.field(default_factory=lambda: _rebuilt(given(), kind, ""))


def _rebuilt(value: Any, kind: Any, name: str) -> Any:
    """An options class within another as its own class, which looks at the values; else as it is.

    Raises:
        ArgumentError: one is out of range; it is named as in ``fit.focal_share``.
    """
    if not (dataclasses.is_dataclass(kind) and isinstance(kind, type)):
        return value
    try:
        parts = {
            field.name: _rebuilt(getattr(value, field.name), field.type, field.name)
            for field in dataclasses.fields(kind)
        }
        return kind(**parts)
    except ArgumentError as error:
        raise ArgumentError(
            f"{name}.{error.argument}", error.found, error.expected, error.remedy
        ) from error


def _holds_paths(value: Any) -> bool:
    return isinstance(value, Path) or (
        isinstance(value, tuple) and any(isinstance(each, Path) for each in value)
    )


def _require_utf8(name: str, path: Path) -> None:
    """What is written must be read again, and safetensors reads no file of another name."""
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError as error:
        raise ArgumentError(name, str(path), "a name in UTF-8", "choose plain letters") from error


def _paths(value: Any) -> list[Path]:
    """Those that an option names."""
    if value is None:
        return []
    return [Path(each) for each in value] if isinstance(value, tuple) else [Path(value)]


def _positional(kind: Any, name: str) -> Any:
    return Annotated[kind, tyro.conf.Positional, tyro.conf.arg(metavar=name.upper())]


def _comma_separated(kind: Any) -> Any:
    """Tuples of simple values are written ``a,b,c``."""
    members = get_args(kind)
    if get_origin(kind) is not tuple or members[0] not in (str, int, float):
        return kind
    count = None if members[-1] is Ellipsis else len(members)

    def from_words(words: list[str]) -> tuple[Any, ...]:
        values = tuple(members[0](part) for part in words[0].split(",") if part.strip())
        if count is not None and len(values) != count:
            raise ValueError(f"expected {count} values separated by commas, found {len(values)}")
        return values

    letters = "ABCDEFGH"
    return Annotated[
        kind,
        PrimitiveConstructorSpec(
            nargs=1,
            metavar=",".join(letters[:count]) if count else "A,B,...",
            instance_from_str=from_words,
            is_instance=lambda value: isinstance(value, tuple),
            str_from_instance=lambda value: [",".join(str(part) for part in value)],
        ),
    ]


def print_json(value: dict[str, Any]) -> None:
    """One JSON object on standard output."""
    json.dump(value, sys.stdout, indent=2, allow_nan=False)
    sys.stdout.write("\n")


def print_figures(value: dict[str, Any], indent: int = 0) -> None:
    """Nested results as indented lines for a person."""
    width = max((len(str(name)) for name in value), default=0)
    for name, figure in value.items():
        label = " " * indent + f"{name:<{width}}"
        if isinstance(figure, dict):
            say(label.rstrip())
            print_figures(figure, indent + 2)
        elif isinstance(figure, float):
            say(f"{label}  {figure:.4g}")
        else:
            say(f"{label}  {'-' if figure is None else figure}")
