"""Sphinx's configuration: ``make doc``. The source folder is that of the repository, so that links between pages of docs/,
tutorials/ and the README are the same here as on a code host."""

import importlib
import inspect
import re
from pathlib import Path

from docutils import nodes
from docutils.statemachine import StringList
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).resolve().parent.parent

project = "sb3_combrel"
author = "The sb3_combrel authors"
version = release = (ROOT / "sb3_combrel" / "version.txt").read_text().strip()

root_doc = "docs/index"
include_patterns = [
    "docs/*.md",
    "docs/results/*.md",
    "docs/results/benchmark/benchmark.md",
    "tutorials/*.md",
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "envs/combrel_envs/assets/*.md",
]
# Folders beside the pages need not be searched.
exclude_patterns = ["docs/_build", ".*", "build", "dist"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
# As on a code host: anchors of headings, and nothing else that one does not show.
myst_heading_anchors = 4

autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"show-inheritance": True}

html_theme = "alabaster"
html_theme_options = {
    "description": "Fitted R-Max with TIMBREL and COMBREL, for Stable-Baselines3",
    "fixed_sidebar": True,
    "page_width": "1100px",
    "sidebar_width": "260px",
}
html_show_sourcelink = False
html_copy_source = False
# Blocks of output and file trees are not code.
highlight_language = "none"


def read_directives(app: Sphinx, docname: str, source: list[str]) -> None:
    """Directives stand in comments, which a code host does not show: ``<!-- sphinx: eval-rst``, lines, ``-->``."""
    source[0] = re.sub(r"^<!-- sphinx: (\S+)(.*?)^-->$", r"```{\1}\2```", source[0], flags=re.DOTALL | re.MULTILINE)


class Environment(SphinxDirective):
    """
    The docstring of an environment's class, which is written in Markdown as Gymnasium's are.

    Its argument is the class: ``combrel_envs.mountain_car_gym.MountainCar4DEnv``.
    """

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        module, _, name = self.arguments[0].rpartition(".")
        text = inspect.cleandoc(getattr(importlib.import_module(module), name).__doc__)
        # Each environment has the same headings: in the text they are paragraphs, the contents name the environments alone.
        text = re.sub(r"^## (.*)$", r"**\1**", text, flags=re.MULTILINE)
        section = nodes.container()
        self.state.nested_parse(StringList(text.splitlines(), source=self.arguments[0]), 0, section)
        return section.children


def show_links_to_folders_as_text(app: Sphinx, document: nodes.document) -> None:
    """A code host shows folders, these pages do not: of a link to one only its text stays."""
    here = ROOT / Path(app.env.doc2path(app.env.docname, base=False)).parent
    for link in list(document.findall(addnodes.pending_xref)):
        if link.get("reftype") == "myst" and (here / link["reftarget"]).is_dir():
            link.replace_self(link.children)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("environment", Environment)
    app.connect("source-read", read_directives)
    app.connect("doctree-read", show_links_to_folders_as_text)
    return {"parallel_read_safe": True}
