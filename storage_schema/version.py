"""The version of the storage format, in one place."""

from __future__ import annotations

SCHEMA_VERSION = 2
"""Raised by hand when an older program could misread a newer store; part of every artifact key."""
