"""Names that are used and nowhere defined, which the shapes of jaxtyping hide from the linters.

``"rays 3"`` in an annotation is no forward reference, so ruff's F821 and mypy's ``name-defined``
are off. Here F821 is asked all the same, and what lies within a plain string is left out.
"""

import json
import subprocess
import sys
import tokenize
from pathlib import Path

FOLDERS = ("src", "tests", "scripts")


def find_undefined_names(folder: Path) -> list[str]:
    """Asks ruff in ``folder``; returns a line for each name, with its file and place."""
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F821"]
    command += ["--ignore-noqa", "--output-format", "json", "--target-version", "py311"]
    answer = subprocess.run([*command, *FOLDERS], cwd=folder, capture_output=True, text=True)
    if answer.returncode not in (0, 1):
        raise SystemExit(answer.stderr)
    found: list[str] = []
    strings: dict[str, list[tokenize.TokenInfo]] = {}
    for row in json.loads(answer.stdout):
        name = row["filename"]
        if name not in strings:
            strings[name] = _plain_strings(Path(name))
        place = (row["location"]["row"], row["location"]["column"] - 1)
        if not any(string.start <= place < string.end for string in strings[name]):
            found.append(f"{Path(name).relative_to(folder)}:{place[0]}: {row['message']}")
    return found


def _plain_strings(path: Path) -> list[tokenize.TokenInfo]:
    with tokenize.open(path) as source:
        tokens = list(tokenize.generate_tokens(source.readline))
    # Code stands in an f-string; before Python 3.12 it is one token with the text around it.
    is_plain = (
        token.type == tokenize.STRING and "f" not in token.string.split(token.string[-1])[0].lower()
        for token in tokens
    )
    return [token for token, plain in zip(tokens, is_plain, strict=True) if plain]


if __name__ == "__main__":
    names = find_undefined_names(Path(__file__).resolve().parents[1])
    print("\n".join(names))
    sys.exit(1 if names else 0)
