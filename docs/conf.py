"""How the pages and the docstrings become a site: ``sphinx-build -W -c docs . build/site``.

Its source folder is the repository's, so that the links between pages, records and figures are
those that work where the files are looked at as they are.
"""

import re
import shutil
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

from jaxdyna import __version__
from jaxdyna.fields import Leaf

ROOT = Path(__file__).parents[1]
CONTENTS = {
    "Guides": (
        "running-experiments", "your-own-problem", "your-own-agent", "your-own-model", "scale",
        "gallery",
    ),
    "Results": (
        "claims", "results-cartpole", "results-maze", "results-pong", "results-planning",
        "paper-method", "protocol", "benchmark", "../experiments/README",
    ),
    "Reference": (
        "api/types", "api/envs", "api/agents", "api/models", "api/dyna", "api/planners",
        "api/networks", "api/replay", "api/statistics", "api/experiments",
    ),
    "How it is made": (
        "architecture", "reliability", "development-log", "../CONTRIBUTING", "../CHANGELOG",
    ),
}  # fmt: skip
"""The side bar: pages as seen from ``docs``. A page that is in none of its lists is a warning."""

project, author, release = "jaxdyna", "jaxdyna developers", __version__
copyright = author
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "experiments/**.md"]
exclude_patterns = [".*", "build", "runs"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = "jaxdyna"

default_role = "py:obj"  # `name` in a docstring
suppress_warnings = ["ref.python"]  # where several are called so
napoleon_attr_annotations = False
napoleon_numpy_docstring = False
napoleon_use_ivar = True
autodoc_member_order = "bysource"
autodoc_default_options = {
    "members": True, "special-members": "__call__", "exclude-members": "replace"
}  # fmt: skip
maximum_signature_line_length = 88


def contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Gives the first page the side bar, the lab book's its records; a folder is no page."""
    here = (ROOT / page).parent

    def unlinked(found: re.Match) -> str:
        return found[1] if (here / found[2]).is_dir() else found[0]

    source[0] = re.sub(r"(?<!!)\[([^]]+)\]\(([^)#]+)\)", unlinked, source[0])
    lists = {}
    if page == root_doc:
        lists = {name: [f"docs/{each}" for each in pages] for name, pages in CONTENTS.items()}
    elif page == "experiments/README":
        records = sorted(here.glob("*/report.md"))
        lists = {"Records": [f"{path.parent.name} <{path.parent.name}/report>" for path in records]}
    for name, pages in lists.items():
        head = ["\n```{toctree}", ":hidden:", f":caption: {name}", ""]
        source[0] += "\n".join([*head, *pages, "```\n"])


def readable(
    app: Sphinx, what: str, name: str, of: Any, options: Any, signature: str | None, returns: Any
) -> tuple[str | None, Any]:
    """Signatures with the names of default functions and modules in place of what they print."""
    if signature:
        signature = re.sub(r"<locals>|PjitFunction of ", "", signature)
        signature = re.sub(r"<+function [\w.]*?(\w+)>+", r"\1", signature)
        signature = re.sub(r"<.*?>+", "...", signature)  # lambdas, factories, sentinels
        signature = re.sub(r"\(\s+# attributes.*?\s\)", "(...)", signature, flags=re.DOTALL)
        signature = re.sub(r", parent: .*?, name: [^=]*= None", "", signature)  # of Flax
    return signature, returns


def as_written(app: Sphinx, what: str, name: str, of: Any, options: Any, lines: list[str]) -> None:
    """Keeps Napoleon from taking what stands before a colon for a type."""
    if what in ("attribute", "data"):
        lines.insert(0, "\\ ")


def settings(app: Sphinx, what: str, name: str, of: Any, options: Any, lines: list[str]) -> None:
    """Says of a class's fields what `jaxdyna.fields.setting` does, and leaves as its members those
    that have a comment: no defaults that are functions, no numbers of a NamedTuple's.
    """
    if what == "class" and is_dataclass(of):
        declared = {field.name: field.metadata.get("jaxdyna") for field in fields(of)}
        said = {field: leaf for field, leaf in declared.items() if leaf and leaf.help}
        lines += [f":param {field}: {sentence(leaf)}" for field, leaf in said.items()] + [""]
        for field in declared.keys() & vars(of).keys():
            delattr(of, field)
    for field in getattr(of, "_fields", ()):
        getattr(of, field).__doc__ = ""


def sentence(leaf: Leaf) -> str:
    """What a setting is, and where it may lie."""
    limits = "" if leaf.range == Leaf().range else f" ({leaf.range})"
    return f"{leaf.help.rstrip('.')}{limits}."


def front(app: Sphinx, error: Exception | None) -> None:
    """The first page is what a browser opens."""
    if error is None:
        shutil.copyfile(Path(app.outdir) / f"{root_doc}.html", Path(app.outdir) / "index.html")


def setup(app: Sphinx) -> None:
    """Sphinx calls this."""
    app.connect("source-read", contents)
    app.connect("autodoc-process-signature", readable)
    app.connect("autodoc-process-docstring", as_written, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", settings, priority=900)
    app.connect("build-finished", front)
