"""Plain prose of Markdown pages and of docstrings, and its Flesch reading ease."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from benchmarks.report import ROOT

#: Packages whose docstrings count.
PACKAGES = ("streetfix", "service", "model_training", "research")
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_CODE = re.compile(r"`+[^`]*`+")
#: Words of letters without digits or signs inside. Names of code and figures are not prose.
_WORD = re.compile(r"[A-Za-z][A-Za-z'-]*[A-Za-z]|[A-Za-z]")


def pages(root: Path = ROOT) -> list[Path]:
    """Return README and all pages of ``docs``, including the decision log.

    Args:
        root: folder of the repository.
    """
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def prose_of_markdown(text: str) -> str:
    """Return paragraphs and list items, without code, tables, headings, addresses of images and comments.

    Args:
        text: content of a page.
    """
    text = _COMMENT.sub("", _FENCE.sub("", text))
    kept = [line for line in text.splitlines() if not line.lstrip().startswith(("|", "#"))]
    # A list item counts as a sentence, with or without a full stop.
    items = [re.sub(r"^\s*(?:[-*]|\d+\.)\s+", "\n\n", line) for line in kept]
    return _plain("\n".join(items))


def prose_of_docstrings(source: str) -> str:
    """Return the docstrings of a module, one paragraph each, without doctests and names in backquotes.

    Args:
        source: source code of the module.
    """
    nodes = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    found = [ast.get_docstring(node) or "" for node in ast.walk(ast.parse(source)) if isinstance(node, nodes)]
    # An entry of ``Args:`` begins with a name and a colon.
    entries = [re.sub(r"^\s+(?:\w+|\*+\w+):\s", "\n\n", text, flags=re.MULTILINE) for text in found]
    headless = [
        re.sub(r"^(?:Args|Attributes|Raises|Returns|Yields):$", "", text, flags=re.MULTILINE) for text in entries
    ]
    return _plain("\n\n".join(headless))


def docstrings(root: Path = ROOT) -> Iterator[str]:
    """Yield the prose of each module of ``PACKAGES``, except generated ones.

    Args:
        root: folder of the repository.
    """
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            if "generated" not in path.parts:
                yield prose_of_docstrings(path.read_text())


def reading_ease(text: str) -> float:
    """Compute the Flesch reading ease: 206.835 - 1.015 words per sentence - 84.6 syllables per word (Flesch, 1948).

    Args:
        text: prose whose paragraphs end with a full stop.

    Raises:
        ValueError: the text has no words.
    """
    import textstat  # only this report needs it

    if not _WORD.search(text):
        raise ValueError("the text has no word")
    return float(textstat.flesch_reading_ease(text))


def _plain(text: str) -> str:
    """Keep words and sentence ends only."""
    text = _LINK.sub(r"\1", text)
    text = _CODE.sub("", text)
    paragraphs = (" ".join(part.split()).strip(" *_>") for part in re.split(r"\n\s*\n", text))
    ended = [part if part[-1] in ".!?:" else f"{part}." for part in paragraphs if _WORD.search(part)]
    # A colon or a semicolon ends a clause, but Flesch counts sentences. Only full stops count here.
    words = [" ".join(re.findall(rf"{_WORD.pattern}|[.!?](?=\s|$)", part)) for part in ended]
    return "\n".join(re.sub(r"\s+([.!?])", r"\1", part) for part in words)
