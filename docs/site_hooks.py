"""Hooks of mkdocs.yml, by which the pages of this folder, written for the repository's web view, become a site.

A page links files of the repository that lie outside of docs, such as stored results. On the site they lie under
`files`, copied as they are, and a folder becomes a list of what is in it. Two pages from elsewhere become pages of the
site; notebooks do so by `site_notebooks`.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path, PurePosixPath
from posixpath import normpath, relpath

from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
# Pages that lie elsewhere in the repository, and where they are on the site.
ELSEWHERE = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "examples/ros2/README.md": "ros2.md"}
PLACES = {"README.md": "index.md", **ELSEWHERE}
# Holds the package as it is installed, while the process lives.
_TREE = tempfile.TemporaryDirectory()
FOLDERS_OF_CODE = ("envs", "train", "benchmarks")
_LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")
_CELL = re.compile(r"<t[dh].*?</t[dh]>", re.DOTALL)
# Code without other tags in it; where a long name in it may be broken.
_PLAIN = re.compile(r"(?<=<code>)[^<]*(?=</code>)")
_BREAK = re.compile(r"([._/|])(?=[A-Za-z])")
_PICTURE = re.compile(r'<img [^>]*src="([^"]+)"[^>]*>')
_INTERVAL = re.compile(r"\([-+]?[\d.]+ to [-+]?[\d.]+\)")
_CODE = re.compile(r"(^```.*?^```$|`(?:[^`\n]|\n(?!\n))+`)", re.MULTILINE | re.DOTALL)


@event_priority(100)
def on_config(config):
    """Let the API reference find `mechsearch_jax.envs` and its like, which lie beside the package in a checkout."""
    package = Path(_TREE.name) / "mechsearch_jax"
    if not package.exists():
        package.mkdir()
        for child in (*(ROOT / "mechsearch_jax").iterdir(), *(ROOT / name for name in FOLDERS_OF_CODE)):
            (package / child.name).symlink_to(child)
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [str(package.parent)]
    return config


def on_files(files, config):
    """Add the pages from elsewhere, and whatever pages link outside of docs."""
    for place, uri in ELSEWHERE.items():
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / place)))
    for page in list(files.documentation_pages()):
        for path in map(str, _linked(page, page.content_string)):
            uri = _on_site(path)
            if not files.get_file_from_path(uri):
                files.append(_outside(config, path, uri))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turn links to files of the repository into links to where these are on the site."""
    here = PurePosixPath(page.file.src_uri).parent

    def moved(match):
        if ":" in match[2]:
            return match[0]
        uri = _on_site(_in_repository(page.file, match[2]))
        return f"{match[1]}{relpath(uri, here)}{match[3]}"

    return "".join(part if part.startswith("`") else _LINK.sub(moved, part) for part in _CODE.split(markdown))


def on_page_content(html, page, config, files):
    """Show bars in the code of a table as the repository's web view does, and keep an interval in one line.

    A long name in a table may be broken after its dots and underscores, and a click on a picture opens it in its size.
    """

    def code(match):
        return _BREAK.sub(r"\1<wbr>", match[0].replace("\\|", "|"))

    html = _CELL.sub(lambda cell: _PLAIN.sub(code, cell[0]), html)
    html = _PICTURE.sub(r'<a href="\1">\g<0></a>', html)
    return _INTERVAL.sub(lambda interval: interval[0].replace(" ", "&nbsp;"), html)


def _in_repository(file, link):
    """The path from the root of the repository of what a page links."""
    source = {uri: place for place, uri in ELSEWHERE.items()}.get(file.src_uri, f"docs/{file.src_uri}")
    return normpath(f"{PurePosixPath(source).parent}/{link}")


def _on_site(path):
    """Where a file of the repository is on the site, from its root."""
    if path in PLACES:
        return PLACES[path]
    if path.startswith("docs/"):
        return re.sub(r"\.ipynb$", ".md", path.removeprefix("docs/"))
    return f"files/{path}.md" if (ROOT / path).is_dir() else f"files/{path}"


def _linked(file, markdown):
    """The paths in the repository, outside of docs, that a page links."""
    for part in _CODE.split(markdown):
        links = () if part.startswith("`") else _LINK.findall(part)
        for _, link, _ in links:
            path = _in_repository(file, link)
            if ":" not in link and not path.startswith("docs/") and path not in PLACES:
                yield path


def _outside(config, path, uri):
    """A file of the repository as one of the site; of a folder a page that lists it."""
    place = ROOT / path
    if not place.exists():
        raise PluginError(f"{path}: a page links it, and it is not there")
    if place.is_file():
        return File.generated(config, uri, abs_src_path=str(place))
    names = sorted(child.name for child in place.iterdir())
    text = "\n".join([f"# {path}", "", "In the repository this folder holds", "", *(f"- `{name}`" for name in names)])
    return File.generated(config, uri, content=text + "\n")
