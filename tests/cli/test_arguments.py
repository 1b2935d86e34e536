"""Words of the command line become options."""

from dataclasses import dataclass

import pytest

from handavatar.cli.arguments import Extra, parse, parse_with


@dataclass(frozen=True)
class Options:
    """Does nothing."""

    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """red, green and blue"""
    names: tuple[str, ...] = ()
    """of anything"""
    size: int | None = None
    """pixels"""


def test_values_separated_by_commas_are_as_many_as_there_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert parse(Options, ["--shift", "1,2.5,-3"], "made").shift == (1.0, 2.5, -3.0)
    assert parse(Options, ["--names", "a,b,c,d"], "made").names == ("a", "b", "c", "d")
    for words in ("1,2", "1,2,3,4"):
        with pytest.raises(SystemExit) as ended:
            parse(Options, ["--shift", words], "made")
        assert ended.value.code == 2
        assert "expected 3 values" in capsys.readouterr().err


def test_a_value_that_a_command_gives_stays_unless_a_word_sets_it() -> None:
    size = Extra("size", int | None, "pixels", None)
    for words, expected in (([], 5), (["--size", "7"], 7)):
        options, extras = parse_with(Options, (size,), words, "made", given={"size": 5})
        assert options.size == expected
        assert extras["size"] == (7 if words else None)
    # Without an extra of its name no word sets it.
    with pytest.raises(SystemExit):
        parse_with(Options, (), ["--size", "7"], "made", given={"size": 5})
    assert parse_with(Options, (), [], "made", given={"size": 5})[0].size == 5
