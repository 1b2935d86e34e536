"""``handavatar bench``: the paper's tables, measured here."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handavatar.cli.failures import USAGE, say
from handavatar.jobs.progress import Progress

if TYPE_CHECKING:
    from handavatar.evaluate.tables import ResultTable


@dataclass(frozen=True)
class _Bench:
    """One table: the options it takes, with ``total_steps``, and the function that makes it."""

    options: type[Any]
    make: "Callable[[Any, Progress], ResultTable]"


def _skin() -> _Bench:
    from handavatar.evaluate.skin_table import SkinTableOptions, skin_table

    return _Bench(SkinTableOptions, skin_table)


def _geometry() -> _Bench:
    from handavatar.train.geometry_table import GeometryTableOptions, geometry_table

    return _Bench(GeometryTableOptions, geometry_table)


def _speed() -> _Bench:
    from handavatar.evaluate.speed_table import SpeedTableOptions, speed_table

    return _Bench(SpeedTableOptions, speed_table)


def _training() -> _Bench:
    from handavatar.train.training_table import TrainingTableOptions, training_table

    return _Bench(TrainingTableOptions, training_table)


def _ablation() -> _Bench:
    from handavatar.train.ablation_table import AblationTableOptions, ablation_table

    return _Bench(AblationTableOptions, ablation_table)


def _lift() -> _Bench:
    from handavatar.evaluate.lift_table import LiftTableOptions, lift_table

    return _Bench(LiftTableOptions, lift_table)


def _peers() -> _Bench:
    from handavatar.peers.table import PeersTableOptions, peers_table

    return _Bench(PeersTableOptions, peers_table)


def _registration() -> _Bench:
    from handavatar.bench.registration import RegistrationTableOptions, registration_table

    return _Bench(RegistrationTableOptions, registration_table)


_TABLES: dict[str, Callable[[], _Bench]] = {
    "ablation": _ablation,
    "geometry": _geometry,
    "lift": _lift,
    "peers": _peers,
    "registration": _registration,
    "skin": _skin,
    "speed": _speed,
    "training": _training,
}
"""A new table needs a line here; what it takes and makes is the business of its own module."""


def bench(words: list[str], progress: Progress) -> int:
    """Measure a table: ``bench --table ablation|geometry|...``, or one of the other names."""
    from handavatar.cli.arguments import JSON, OVERWRITE, Extra, parse_with, print_json
    from handavatar.cli.inputs import AVATAR, CAPTURE
    from handavatar.jobs.files import refuse_file_in_use, write_atomically

    name = _named_table(words)
    if name not in _TABLES:
        known = f"one of: {', '.join(_TABLES)}\nits options: handavatar bench --table NAME --help"
        if not name and {"-h", "--help"} & set(words):
            print(f"usage: handavatar bench --table NAME\n\nNAME is {known}")
            return 0
        found = f"found {name!r}" if name else "--table is missing"
        print(f"handavatar bench: {found}, expected --table with {known}", file=sys.stderr)
        return USAGE
    chosen = _TABLES[name]()
    extras_wanted = (
        Extra("table", str, f"which table: {', '.join(_TABLES)}"),
        Extra("out", Path | None, "Markdown file to write as well", None),
        JSON,
        OVERWRITE,
    )
    inputs = {"capture": CAPTURE, "captures": CAPTURE, "avatar": AVATAR, "avatars": AVATAR}
    own = {field.name for field in fields(chosen.options)}
    reads = {field: expected for field, expected in inputs.items() if field in own}
    options, extras = parse_with(chosen.options, extras_wanted, words, "bench", reads=reads)
    if extras["out"] is not None:
        refuse_file_in_use(extras["out"], extras["overwrite"])
    with progress:
        table = chosen.make(options, progress)
    if extras["out"] is not None:
        write_atomically({extras["out"]: table.markdown().encode()})
    if extras["json"]:
        print_json(table.record())
    else:
        say(table.markdown())
    return 0


def _named_table(words: list[str]) -> str:
    """The word after ``--table``; it decides which other options there are."""
    for word, following in zip(words, [*words, ""][1:], strict=True):
        if word.startswith("--table="):
            return word.partition("=")[2]
        if word == "--table":
            return following
    return ""
