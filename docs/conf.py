"""The site of the documentation: `make docs` builds it into docs/_build, and every warning is an error."""

from __future__ import annotations

import re
from typing import Any

from pygments.lexers.special import TextLexer

project = "pasdedeux"
project_copyright = "the maintainers of pasdedeux"
html_title = "pasdedeux"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
suppress_warnings = ["ref.python"]  # fields of several classes have one name
html_theme = "furo"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
highlight_language = "text"  # of blocks without a language, such as output
myst_heading_anchors = 4
default_role = "code"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_default_options = {"exclude-members": "model_config"}
autodoc_type_aliases = {name: name for name in ("Array", "Flags", "Integers", "Limits")}
python_use_unqualified_type_names = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

_ELSEWHERE = {"../storage_schema/DATA_DICTIONARY.md": "data-dictionary.md", "../deploy/README.md": "operating.md"}
"""Pages that lie beside what they describe, and the pages of the site that include them."""


def _link(app: Any, name: str, content: list[str]) -> None:
    """Turn links to pages that lie elsewhere into links within the site."""
    up = "../" * name.count("/")
    for path, page in _ELSEWHERE.items():
        content[0] = content[0].replace(f"({up}{path}", f"({up}{page}")


def _link_included(app: Any, path: Any, parent: str, content: list[str]) -> None:
    """Do the same in a page that is included: its links to pages of `docs/` are links to their neighbours."""
    content[0] = content[0].replace("(../docs/", "(")


def _signature(
    app: Any, what: str, name: str, owner: Any, options: Any, signature: str | None, answer: str | None
) -> tuple[str, str] | None:
    """Leave out the signature of settings, whose fields are listed below it, and name types by their aliases."""
    if hasattr(owner, "model_fields"):
        return "", ""
    plain = [re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", words or "") for words in (signature, answer)]
    return None if signature is None else (plain[0], plain[1])


def _document(app: Any, what: str, name: str, owner: Any, options: Any, lines: list[str]) -> None:
    """List the fields of settings, and show the asterisk of shapes, `(*batch, 3)`, as it is."""
    if what == "class" and hasattr(owner, "model_fields"):
        lines += ["", *(f":param {key}: {field.description}" for key, field in owner.model_fields.items())]
    lines[:] = [re.sub(r"(?<!\\)\*(?=\w)", r"\\*", line) for line in lines]


def _style(app: Any, page: str, template: str, context: Any, tree: Any) -> None:
    """Break long paths in the tables of the papers."""
    if page == "papers":
        app.add_css_file("papers.css")


def setup(app: Any) -> None:
    """Connect the links and styles, and show diagrams as text."""
    app.connect("html-page-context", _style)
    app.connect("source-read", _link)
    app.connect("include-read", _link_included)
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-process-docstring", _document)
    app.add_lexer("mermaid", TextLexer)
