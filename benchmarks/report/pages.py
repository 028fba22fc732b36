"""A page of headings, paragraphs, tables and pictures, written as Markdown, LaTeX or one HTML file."""

from __future__ import annotations

import base64
import dataclasses
import html
import re
import string
from collections.abc import Mapping, Sequence


@dataclasses.dataclass(frozen=True)
class Heading:
    """A heading; `level` is 1 for the page's own."""

    text: str
    level: int = 2


@dataclasses.dataclass(frozen=True)
class Paragraph:
    """Plain text."""

    text: str


@dataclasses.dataclass(frozen=True)
class Table:
    """Lines of cells beneath a header.

    Attributes:
      header: names of the columns.
      lines: as many cells each.
      texts: how many columns, the first ones, are texts; the others are aligned as numbers.
      folded: whether a page that can fold shows it only on demand; others leave it out and say `instead`.
      title: of a folded one.
      instead: what stands in its place.
    """

    header: Sequence[str]
    lines: Sequence[Sequence[str]]
    texts: int = 1
    folded: bool = False
    title: str = ""
    instead: str = ""


@dataclasses.dataclass(frozen=True)
class Picture:
    """A PNG file beside the page, by its name, and what it shows."""

    file: str
    caption: str


Block = Heading | Paragraph | Table | Picture


def as_markdown(blocks: Sequence[Block]) -> str:
    """The page as Markdown, which refers to its pictures."""
    return "\n\n".join(filter(None, map(_markdown, blocks))) + "\n"


def _markdown(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"{'#' * level} {text}"
        case Paragraph(text):
            return text
        case Picture(file, caption):
            return f"![{caption}]({file})"
        case Table() if block.folded:
            return block.instead
    return "\n".join(_line(cells) for cells in (block.header, ["---"] * len(block.header), *block.lines))


def _line(cells: Sequence[str]) -> str:
    # A bar would end the cell.
    return "| " + " | ".join(" ".join(cell.replace("|", "\\|").split()) for cell in cells) + " |"


_LATEX = {
    **{char: f"\\{char}" for char in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "-": "-"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "γ": r"$\gamma$", "→": r"$\to$", "|": r"\textbar{}"},
}


def latex_text(text: str) -> str:
    """Text with what LaTeX takes for something else escaped."""
    return "".join(_LATEX.get(char, char) for char in " ".join(text.split()))


def as_latex(blocks: Sequence[Block]) -> str:
    """The tables and pictures as LaTeX for \\input; it needs the packages booktabs, longtable and graphicx."""
    parts = ["% Needs \\usepackage{booktabs,longtable,graphicx}"]
    return "\n\n".join([*parts, *filter(None, map(_latex, blocks))]) + "\n"


def _latex(block: Block) -> str:
    match block:
        case Heading(text, level):
            return f"\\{'sub' * (level - 1)}section*{{{latex_text(text)}}}"
        case Paragraph(text):
            return latex_text(text)
        case Picture(file, caption):
            stem = file.removesuffix(".png")
            return (
                "\\begin{figure}[htbp]\n\\centering\n"
                f"\\includegraphics[width=\\linewidth]{{{stem}.png}}\n"
                f"\\caption{{{latex_text(caption)}}}\n\\end{{figure}}"
            )
        case Table() if block.folded:
            return latex_text(block.instead)
    header, *lines = (" & ".join(map(latex_text, cells)) + r" \\" for cells in (block.header, *block.lines))
    places = "l" * block.texts + "r" * (len(block.header) - block.texts)
    rows = "\n".join(lines)
    return (
        f"\\begin{{longtable}}{{{places}}}\n\\toprule\n{header}\n\\midrule\n\\endhead\n"
        f"{rows}\n\\bottomrule\n\\end{{longtable}}"
    )


def as_html(blocks: Sequence[Block], title: str, pictures: Mapping[str, bytes]) -> str:
    """The page as one HTML file that holds everything.

    Args:
      blocks: of the page.
      title: of the window.
      pictures: the PNG files that the blocks name.
    """
    body = "\n".join(_html(block, pictures) for block in blocks)
    return _PAGE.substitute(title=html.escape(title), body=body)


_EMPHASIS = re.compile(r"[*]([^*]+)[*]")


def _html(block: Block, pictures: Mapping[str, bytes]) -> str:
    match block:
        case Heading(text, level):
            return f"<h{level}>{html.escape(text)}</h{level}>"
        case Paragraph(text):
            emphasised = _EMPHASIS.sub(r"<em>\1</em>", html.escape(text))
            return f"<p>{emphasised}</p>"
        case Picture(file, caption):
            data = base64.b64encode(pictures[file]).decode()
            told = html.escape(caption)
            return (
                f'<figure><img src="data:image/png;base64,{data}" alt="{told}"><figcaption>{told}</figcaption></figure>'
            )
    table = _html_table(block)
    if not block.folded:
        return table
    return f"<details><summary>{html.escape(block.title)}</summary>{table}</details>"


def _html_table(table: Table) -> str:
    def cells(kind: str, values: Sequence[str]) -> str:
        each = (
            f"<{kind}{'' if i < table.texts else ' class=n'}>{html.escape(value)}</{kind}>"
            for i, value in enumerate(values)
        )
        return f"<tr>{''.join(each)}</tr>"

    body = "\n".join(cells("td", line) for line in table.lines)
    return f"<div class=wide><table><thead>{cells('th', table.header)}</thead>\n<tbody>{body}</tbody></table></div>"


# A click on a header sorts by that column: by numbers where both cells begin with one.
_PAGE = string.Template(
    """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>$title</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #22303c; max-width: 1100px; margin: 2em auto; padding: 0 1em; }
h1, h2, h3 { line-height: 1.2; margin-top: 1.6em; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: 3px 10px; text-align: left; border-bottom: 1px solid #e3e6e9; white-space: nowrap; }
th { position: sticky; top: 0; background: #f3f1ec; cursor: pointer; }
.n { text-align: right; }
.wide { overflow: auto; max-height: 80vh; margin: 1em 0; }
figure { margin: 1em 0; }
img { max-width: 100%; }
figcaption { color: #75828e; font-size: 13px; }
summary { cursor: pointer; color: #1b5fc1; }
tbody tr:hover { background: #f7f9fb; }
</style></head><body>
$body
<script>
document.querySelectorAll("th").forEach(function (head) {
  head.addEventListener("click", function () {
    var body = head.closest("table").tBodies[0], i = head.cellIndex, down = head.dataset.down !== "1";
    head.dataset.down = down ? "1" : "";
    var lines = Array.from(body.rows).map(function (line) {
      var text = line.cells[i].textContent, number = parseFloat(text);
      return { line: line, text: text, number: number };
    });
    lines.sort(function (a, b) {
      var both = !isNaN(a.number) && !isNaN(b.number);
      return (both ? a.number - b.number : a.text.localeCompare(b.text)) * (down ? 1 : -1);
    });
    lines.forEach(function (one) { body.appendChild(one.line); });
  });
});
</script>
</body></html>
"""
)
