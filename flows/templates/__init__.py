"""Texts with gaps: a new study, the card of a model."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from pasdedeux.plain_text import markdown_value


def fill_template(template: str, **values: Any) -> str:
    """Return a template with its gaps filled."""
    environment = Environment(
        loader=PackageLoader("flows"),
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
        finalize=markdown_value if template.endswith(".md") else None,
    )
    return environment.get_template(template).render(**values)
