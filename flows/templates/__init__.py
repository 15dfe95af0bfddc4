"""Texts with gaps: a new study, the card of a model."""

from __future__ import annotations

from typing import Any


def render(template: str, **values: Any) -> str:
    """Return a template with its gaps filled."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # here: other commands need not wait for it

    loader = PackageLoader("flows")
    environment = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True)
    return environment.get_template(template).render(**values)
