"""A page of headings, paragraphs, tables and pictures, written as Markdown, LaTeX or one HTML file.

pandas writes the tables, Jinja2 the HTML page from `page.html.jinja`.
"""

from __future__ import annotations

import base64
import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jinja2
import markupsafe
import pandas

_TEMPLATE = Path(__file__).with_name("page.html.jinja")
_EMPHASIS = re.compile(r"[*]([^*]+)[*]")
_LATEX = {
    **{char: f"\\{char}" for char in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "γ": r"$\gamma$", "→": r"$\to$", "|": r"\textbar{}"},
}


@dataclasses.dataclass(frozen=True)
class Heading:
    """A heading; `level` is 1 for the page's own."""

    kind: ClassVar[str] = "heading"
    text: str
    level: int = 2


@dataclasses.dataclass(frozen=True)
class Paragraph:
    """Plain text, in which a part between asterisks is emphasised."""

    kind: ClassVar[str] = "paragraph"
    text: str


@dataclasses.dataclass(frozen=True)
class Picture:
    """A PNG file beside the page, by its name, and what it shows."""

    kind: ClassVar[str] = "picture"
    file: str
    caption: str


@dataclasses.dataclass(frozen=True)
class Link:
    """A link to a file beside the page."""

    kind: ClassVar[str] = "link"
    text: str
    file: str


@dataclasses.dataclass(frozen=True)
class Table:
    """A table whose cells are texts without line breaks.

    Attributes:
      cells: of the table; see `of`.
      texts: how many columns, the first ones, are aligned as texts; the others are aligned as numbers.
      folded: a title, beneath which the HTML page shows the table on demand; empty where it is always shown.
      instead: what Markdown and LaTeX have in place of a folded table.
    """

    kind: ClassVar[str] = "table"
    cells: pandas.DataFrame
    texts: int = 1
    folded: str = ""
    instead: str = ""

    @classmethod
    def of(cls, header: Sequence[str], lines: Sequence[Sequence[Any]], texts: int = 1) -> Table:
        """The table of lines beneath a header, with as many cells each."""
        frame = pandas.DataFrame(list(lines), columns=pandas.Index(header, dtype=object), dtype=object)
        return cls(frame.map(lambda cell: " ".join(str(cell).split())), texts)

    @property
    def alignment(self) -> list[str]:
        """Of each column: "left" or "right"."""
        return ["left" if i < self.texts else "right" for i in range(self.cells.shape[1])]

    def html(self) -> str:
        """The table as HTML; its class says how many of its columns are texts."""
        with pandas.option_context("display.max_colwidth", None):
            return self.cells.to_html(index=False, border=0, classes=f"texts{self.texts}")


class Mark(NamedTuple):
    """A cell of a matrix.

    Attributes:
      kind: what it stands for.
      text: in it, a few letters.
      colour: as HTML has it.
      file: beside the page, which a click opens; empty without one.
    """

    kind: str
    text: str
    colour: str
    file: str = ""


@dataclasses.dataclass(frozen=True)
class Matrix:
    """A map of coloured cells, which the HTML page alone shows.

    Attributes:
      columns: their headings.
      lines: the heading of each line, and its cells; None for an empty one.
      legend: colours, and what they stand for.
      instead: what Markdown and LaTeX have in its place.
    """

    kind: ClassVar[str] = "matrix"
    columns: tuple[str, ...]
    lines: tuple[tuple[str, tuple[Mark | None, ...]], ...]
    legend: tuple[tuple[str, str], ...]
    instead: str


Block = Heading | Paragraph | Table | Picture | Link | Matrix


def as_markdown(blocks: Sequence[Block]) -> str:
    """The page as Markdown, which refers to its pictures."""
    return "\n\n".join(map(_markdown, blocks)) + "\n"


def _markdown(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {text}"
        case Paragraph(text):
            return text
        case Picture(file, caption):
            return f"![{caption}]({file})"
        case Link(text, file):
            return f"[{text}]({file})"
        case Matrix():
            return block.instead
        case Table() if block.folded:
            return block.instead
    # A bar would end the cell.
    cells = block.cells.map(lambda cell: cell.replace("|", "\\|"))
    return cells.to_markdown(index=False, disable_numparse=True, colalign=block.alignment)


def latex_text(text: str) -> str:
    """Text with LaTeX's special characters escaped."""
    return "".join(_LATEX.get(char, char) for char in " ".join(text.split()))


def as_latex(blocks: Sequence[Block]) -> str:
    """The tables and pictures as LaTeX for \\input; it needs the packages booktabs, longtable and graphicx."""
    return "\n\n".join(["% Needs \\usepackage{booktabs,longtable,graphicx}", *map(_latex, blocks)]) + "\n"


def _latex(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"\\{'sub' * (level - 1)}section*{{{latex_text(text)}}}"
        case Paragraph(text):
            return latex_text(text)
        case Picture(file, caption):
            return (
                "\\begin{figure}[htbp]\n\\centering\n"
                f"\\includegraphics[width=\\linewidth]{{{file}}}\n"
                f"\\caption{{{latex_text(caption)}}}\n\\end{{figure}}"
            )
        case Link(text, file):
            return latex_text(f"{text}: {file}")
        case Matrix():
            return latex_text(block.instead)
        case Table() if block.folded:
            return latex_text(block.instead)
    # pandas would leave <, > and | as they are.
    cells = block.cells.map(latex_text).rename(columns=latex_text)
    places = "".join(side[0] for side in block.alignment)
    return cells.to_latex(index=False, escape=False, longtable=True, column_format=places).rstrip()


def as_html(blocks: Sequence[Block], title: str, pictures: Mapping[str, bytes]) -> str:
    """The page as one HTML file that holds everything.

    Args:
      blocks: of the page.
      title: of the window.
      pictures: the PNG files that the blocks name.
    """
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["emphasised"] = _emphasised
    images = {name: base64.b64encode(data).decode() for name, data in pictures.items()}
    texts = sorted({block.texts for block in blocks if isinstance(block, Table)})
    marks = (
        m for block in blocks if isinstance(block, Matrix) for _, cells in block.lines for m in cells if m is not None
    )
    colours = sorted({(mark.kind, mark.colour) for mark in marks})
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(blocks=blocks, title=title, images=images, texts=texts, colours=colours)


def _emphasised(text: str) -> markupsafe.Markup:
    return markupsafe.Markup(_EMPHASIS.sub(r"<em>\1</em>", str(markupsafe.escape(text))))
