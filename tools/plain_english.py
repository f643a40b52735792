"""Phrases that must be read twice, in the README, the pages, the notebooks and the help texts.

python tools/plain_english.py    # `make lint` runs it; it ends with 1 and names each place

codespell knows words; this knows phrases. To add one, write a line of `PHRASES`.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs/hooks"))

import cli_page  # noqa: E402

PHRASES = {
    r"(?:^|[.!?:]\s+|\| |[-*] |\*\*)Of\s(?!course)": "begin with the subject, not with 'Of'",
    r"\bso (?:many|few) (?=of|pixels|megapixels)|\b(?:the first|with|of) so (?:many|few|much)\b": (
        "name the number"
    ),
    r",? \btoo(?=[.;:)|])|, too\b": "'also', before the verb",
    r"\bsuch(?=[.;:)|,])": "name the thing",
    r"\bbeside(?=[.;:)|])": "'beside it', or 'for comparison'",
    r"without a word\b": "'silently'",
    r"(?<![\w.\]/])\.\d+\b": "a zero before the point: 0.5",
    r"licen[cs]es alone|of free licen[cs]es": "'only on freely licensed images'",
    r"\b(?:is|are) said (?:when|where|so)\b": "'the error tells you'",
    r"\bgo(?:es)? on(?=[.;:,]| when| where)": "'continue'",
    r"\bright matches\b|\b(?:more|fewer) right ones\b|\bright to \d": "'correct'",
    r"\bbut for\b": "'except for'",
    r": in that of\b|, in that of\b": "'relative to'",
    r"\bbears? turned\b": "'work on turned images'",
    r"\bof equal colou?r\b|\bbelong together\b": "'matching points share a colour'",
    r"\bthat this divides\b": "'every N-th'",
    r"\bwithout a question\b": "'has not asked'",
    r"\bread wrongly\b": "'misread'",
    r"\bit is needed\b(?=\.)": "say when",
    r"\bas (?:it is )?told\b": "'as you set'",
}
"""Patterns of phrases, with what to write."""

NOT_PROSE = re.compile(
    r"<!-- results?:.*?<!-- /results? -->|^ *```.*?^ *```$|`[^`\n]*`|\]\([^)]*\)",
    re.DOTALL | re.MULTILINE,
)


def texts() -> dict[str, str]:
    """Return what users read, by its name."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    found = {page.name: page.read_text("utf-8") for page in pages}
    for notebook in sorted((ROOT / "docs/notebooks").glob("*.ipynb")):
        cells = json.loads(notebook.read_text("utf-8"))["cells"]
        prose = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
        found[notebook.name] = "\n\n".join(prose)
    return found | {"--help-all": cli_page.make_page()}


def problems(name: str, text: str) -> list[str]:
    """Return a line for each phrase in a text, with its place and what to write.

    Example:
        >>> problems("a.md", "It is fast, too.")
        ["a.md:1: ', too': 'also', before the verb"]
        >>> problems("a.md", "It costs `.5 s`, or 0.5 s.")
        []
    """
    prose = NOT_PROSE.sub(lambda m: "\n" * m[0].count("\n"), text)
    return [
        f"{name}:{prose[: m.start()].count(chr(10)) + 1}: {' '.join(m[0].split())!r}: {remedy}"
        for pattern, remedy in PHRASES.items()
        for m in re.finditer(pattern, prose, re.MULTILINE)
    ]


def main() -> None:
    """Print all problems, and end with 1 if there are any."""
    found = [line for name, text in texts().items() for line in problems(name, text)]
    if found:
        raise SystemExit("\n".join(found))


if __name__ == "__main__":
    main()
