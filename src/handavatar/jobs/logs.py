"""Files of one JSON object a line, which whoever reads them may find torn or damaged."""

import json
import math
from collections.abc import Iterator
from typing import Any

_LARGEST = 1e300
"""JSON has whole numbers that no float holds."""


def json_lines(data: bytes) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """The lines that are whole objects, and the objects; a line that a kill tore is left out.

    Args:
        data: of the file, or of a part that begins with a line.
    """
    for line in data.splitlines(keepends=True):
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if line.endswith(b"\n") and isinstance(record, dict):
            yield line, record


def is_step(value: object) -> bool:
    """Whether a value of such a line can be the number of a step."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53


def finite_figures(record: dict[str, Any]) -> dict[str, float]:
    """The numbers of such a line by name; what is no finite number is left out.

    Args:
        record: of :func:`json_lines`.
    """
    return {
        name: float(value)
        for name, value in record.items()
        if isinstance(value, int | float) and abs(value) <= _LARGEST and math.isfinite(value)
    }
