"""The colour and marker that a method has in every figure of every page."""

from __future__ import annotations

from typing import NamedTuple
from zlib import crc32

from pasdedeux.evaluation.names import base_name, known_methods

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Colours safe for colour-blind readers (Okabe and Ito 2008, without yellow, which is faint on white)."""
MARKERS = ("o", "s", "^", "D", "v", "X", "P", "*")


class Style(NamedTuple):
    """Colour and marker of a method."""

    colour: str
    marker: str


def method_style(method: str) -> Style:
    """Return the style of a method; a variant of it, such as `ic_repaired`, has its colour and another marker.

    Neighbours among the methods that have words differ in colour and marker. The style of other methods follows from
    their name.

    >>> method_style("interaction_mesh"), method_style("naive_fk")
    (Style(colour='#0072b2', marker='o'), Style(colour='#d55e00', marker='s'))
    """
    base, methods = base_name(method), known_methods()
    number = methods.index(base) if base in methods else crc32(base.encode())
    return Style(COLOURS[number % len(COLOURS)], MARKERS[(number + (base != method)) % len(MARKERS)])
