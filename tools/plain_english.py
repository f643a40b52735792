"""Find phrases that are hard to read in pages, notebooks, help texts and source files.

python tools/plain_english.py    # `make lint` runs it; it prints each place and exits with 1
python tools/plain_english.py src/deepdetect/io    # only these files and folders

In Python files it reads docstrings, notes under constants, comments and the texts of messages.

codespell finds words, this tool finds phrases. To add one, add a line to `PHRASES`.
"""

from __future__ import annotations

import ast
import io
import json
import re
import sys
import tokenize
from collections.abc import Iterator
from itertools import pairwise
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
    r"\b(?:has|have|had) (?:not|none)(?=[.;:,)])": ("finish the clause: 'does not have one'"),
    r"\bis none of\b|\bare none of\b": "'is not one of'",
    r"\bhangs? together\b": "'are connected', 'overlap'",
    r"\bsatellite fix": "'GPS'",
    r"\blosses beside wins\b": "'including where it loses'",
    r"\bhad a say\b": "'we chose ... on ...'",
    r"\b(?:is|are) at work\b": "'is running'",
    r"\bat the most\b": "'at most'",
    r"\bso (?:many|few|much) (?:as|for)\b|\b(?:of more|of these), so many\b": "name the number",
    r"\bas of `": "'as in `...`'",
}
"""Patterns of phrases, each with a suggestion what to write."""

NOTE_BEGINNINGS = re.compile(
    r"(?:Of|To|For|From|In|With|By|At|On|Up|Over|Under|Below|Above|Around|Between|Beyond|Along|"
    r"Until|Through|After|Before|Within|Beside|As|So|Than|Relative|Also|Least|Largest|Smallest|Most)"
    r"\b(?! is\b)"
)
"""Beginnings of notes that continue the name of their constant instead of being a sentence."""

PYTHON = ("src", "lab/src", "benchmarks", "tools", "examples")
"""Folders whose Python files are read."""

NOT_PROSE = re.compile(
    r"<!-- results?:.*?<!-- /results? -->|^ *```.*?^ *```$|`[^`\n]*`|\]\([^)]*\)",
    re.DOTALL | re.MULTILINE,
)


def texts() -> dict[str, str]:
    """Return the texts that users read, by their names."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    found = {page.name: page.read_text("utf-8") for page in pages}
    for notebook in sorted((ROOT / "docs/notebooks").glob("*.ipynb")):
        cells = json.loads(notebook.read_text("utf-8"))["cells"]
        prose = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
        found[notebook.name] = "\n\n".join(prose)
    return found | {"--help-all": cli_page.make_page()}


def python_texts(path: Path) -> Iterator[tuple[int, str, bool]]:
    """Yield all prose of a file: the line, the text, and whether it is a note under a constant.

    Strings of one or two words are skipped as names, and examples in docstrings as code.
    """
    source = path.read_text("utf-8")
    tree = ast.parse(source)
    inside = {id(part) for f in ast.walk(tree) if isinstance(f, ast.JoinedStr) for part in f.values}
    notes = {
        id(after.value)
        for body in (getattr(node, "body", ()) for node in ast.walk(tree))
        if isinstance(body, list)
        for before, after in pairwise(body)
        if isinstance(before, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [str(p.value) if isinstance(p, ast.Constant) else "{}" for p in node.values]
            text = "".join(parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = "" if id(node) in inside else node.value
        else:
            continue
        if len(text.split()) > 2:
            prose = re.sub(r"^ *(?:>>>|\.\.\.) .*$", "", text, flags=re.MULTILINE)
            yield node.lineno, prose, id(node) in notes
    comments: list[tuple[int, str]] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            text = token.string.lstrip("#! ")
            if comments and comments[-1][0] + comments[-1][1].count("\n") + 1 == token.start[0]:
                comments[-1] = (comments[-1][0], f"{comments[-1][1]}\n{text}")
            else:
                comments.append((token.start[0], text))
    yield from ((line, text, False) for line, text in comments)


def python_problems(path: Path) -> list[str]:
    """Return a line for each phrase in the prose of a Python file."""
    found = []
    name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else str(path)
    for line, text, is_note in python_texts(path):
        for problem in problems("", text):
            _, number, rest = problem.split(":", 2)
            found.append(f"{name}:{line + int(number) - 1}:{rest}")
        if is_note and NOTE_BEGINNINGS.match(text):
            found.append(f"{name}:{line}: {text.split()[0]!r}: give the note a subject of its own")
    return found


def problems(name: str, text: str) -> list[str]:
    """Return a line for each phrase in a text, with its place and a suggestion.

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
    """Print all problems; exit with 1 if there are any."""
    chosen = [Path(word).resolve() for word in sys.argv[1:]]
    found = []
    if not chosen:
        found = [line for name, text in texts().items() for line in problems(name, text)]
    for folder in chosen or [ROOT / folder for folder in PYTHON]:
        for path in [folder] if folder.is_file() else sorted(folder.rglob("*.py")):
            if path != Path(__file__).resolve():
                found += python_problems(path)
    if found:
        raise SystemExit("\n".join(found))


if __name__ == "__main__":
    main()
