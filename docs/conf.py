"""Sphinx: README.md, CHANGELOG.md, deploy/README.md and docs/ as a site that works without a network and without a server (`make site`)."""

from __future__ import annotations

import importlib.metadata
import re
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

project = "Abbe"
release = importlib.metadata.version("abbe")
author = project_copyright = "The Abbe maintainers"
extensions = ["myst_nb"]
root_doc = "docs/index"
include_patterns = ["README.md", "CHANGELOG.md", "deploy/README.md", "docs/**"]
exclude_patterns = ["docs/schemas", "docs/conf.py"]
suppress_warnings = ["myst.xref_missing"]  # links to files and folders that are no pages; tests/project/test_docs.py checks them
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_execution_cache_path = ".venv-site/notebooks"
nb_execution_in_temp = True
nb_merge_streams = True
html_theme = "furo"
html_title = f"Abbe {release}"
html_copy_source = False
html_show_sourcelink = False

MENU = {
    "Start": ("../README", "tutorial"),
    "How to": ("how-to/*",),
    "Notebooks": ("notebooks/*",),
    "Reference": ("reference/*", "protocols/*"),
}
MENU |= {"Explanation": ("explanation/*", "decisions/README"), "More": ("../deploy/README", "../CHANGELOG")}


def menu(_: Sphinx, page: str, text: list[str]) -> None:
    """The sidebar: every page, in the order of the index."""
    if page == root_doc:
        for title, names in MENU.items():
            text[0] += "\n\n```{toctree}\n:hidden:\n:glob:\n:caption: " + title + "\n\n" + "\n".join(names) + "\n```"
    if page == "docs/decisions/README":
        text[0] += "\n\n```{toctree}\n:hidden:\n:glob:\n\n0*\n```"


def front(app: Sphinx, failed: Exception | None) -> None:
    """The folder's own page leads to the index; no page may load anything from elsewhere."""
    foreign = re.compile(r'<(?:script|img|iframe)[^>]+src="(?:https?:)?//[^"]+|<link[^>]+href="(?:https?:)?//[^"]+')
    found = [f"{page}: {one}" for page in Path(app.outdir).rglob("*.html") for one in foreign.findall(page.read_text(encoding="utf-8"))]
    if found:
        raise ExtensionError("foreign requests:\n" + "\n".join(found))
    if failed is None:
        Path(app.outdir, "index.html").write_text(
            '<!doctype html><meta http-equiv="refresh" content="0; url=docs/index.html">\n', encoding="utf-8"
        )


def setup(app: Sphinx) -> None:
    """What Sphinx calls."""
    app.connect("source-read", menu)
    app.connect("build-finished", front)
