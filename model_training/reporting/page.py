"""The frame of every page: one file without external content and without scripts."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

#: Second line of defence: if markup in a name of the data slipped through, a browser would load and run nothing.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page.

    Attributes:
        anchor: target of the link in the contents list.
        title: title of the part.
        content: HTML.
    """

    anchor: str
    title: str
    content: str


def page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return a whole HTML document.

    Args:
        title: title of the document.
        lead: HTML below the title.
        sections: parts of the document.
    """
    style = files("model_training.reporting").joinpath("page.css").read_text()
    contents = "".join(f'<a href="#{each.anchor}">{escape(each.title)}</a>' for each in sections)
    body = "".join(
        f'<section id="{each.anchor}"><h2>{escape(each.title)}</h2>{each.content}</section>' for each in sections
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head>\n<body><header><h1>{escape(title)}</h1>{lead}"
        f'<nav aria-label="Contents">{contents}</nav></header>\n<main>{body}</main></body></html>\n'
    )


def write_page(path: Path, document: str) -> None:
    """Write a document atomically.

    Args:
        path: file to write.
        document: the HTML.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(document, encoding="utf-8")
    part.rename(path)


def figure(content: str, caption: str) -> str:
    """Return a drawing or an image with its caption, as HTML.

    Args:
        content: HTML of the drawing.
        caption: text below it.
    """
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], *, kind: str = "figures") -> str:
    """Return a table as HTML; the first cell of a row is its heading.

    Args:
        caption: text above the table.
        head: HTML of the column headings.
        rows: HTML of the cells.
        kind: style class; ``last-told`` ends in a column of words.
    """
    top = "".join(f'<th scope="col"{" class=text" if k == 0 else ""}>{cell}</th>' for k, cell in enumerate(head))
    body = "".join(
        f'<tr><th scope="row">{row[0]}</th>{"".join(f"<td>{cell}</td>" for cell in row[1:])}</tr>' for row in rows
    )
    return (
        f'<div class="scroll"><table class="{kind}"><caption>{escape(caption)}</caption><thead><tr>{top}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
