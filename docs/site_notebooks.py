"""A hook of mkdocs.yml: the notebooks of docs/notebooks become pages, with the outputs that are stored in them.

Nothing is executed. `site_hooks` moves links to a notebook to its page.
"""

from __future__ import annotations

from pathlib import Path

import nbformat
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File
from nbconvert import MarkdownExporter

ENDING = ".ipynb"


# Before `site_hooks` looks through the pages for links.
@event_priority(100)
def on_files(files, config):
    """Put a page and its pictures in the place of each notebook."""
    for notebook in [file for file in files if file.src_uri.endswith(ENDING)]:
        files.remove(notebook)
        name = Path(notebook.src_uri).stem
        folder = notebook.src_uri.removesuffix(f"{name}{ENDING}")
        resources = {"unique_key": name, "output_files_dir": f"{name}_files"}
        stored = nbformat.read(str(Path(config.docs_dir) / notebook.src_uri), as_version=4)
        text, made = MarkdownExporter().from_notebook_node(stored, resources)
        files.append(File.generated(config, f"{folder}{name}.md", content=text))
        for picture, content in made["outputs"].items():
            files.append(File.generated(config, f"{folder}{picture}", content=content))
    return files
