"""The errors of the store: one root and a few children, which all survive pickling."""

# ruff: noqa: N818 - these names say what is wrong; that they are errors shows where they are raised

from __future__ import annotations

from typing import ClassVar


class StorageError(Exception):
    """Root of every error that the store raises on purpose; the message is one clear sentence.

    `is_input` distinguishes errors that the user can correct before any work starts (exit code 2) from failed work
    (exit code 1).
    """

    is_input: ClassVar[bool] = False


class _InputError(StorageError):
    """An error in the input, which the user can correct."""

    is_input: ClassVar[bool] = True


class MissingArtifact(StorageError):
    """An artifact, or a requested part of it, is not in the store."""


class CorruptArtifact(StorageError):
    """The contents of the store do not match its manifests."""


class NamedByDataset(StorageError):
    """An artifact that a dataset needs was computed again with other bytes; the old one stays."""


class SchemaError(StorageError):
    """Values do not fit their table; the message names the column and the allowed values."""


class NewerSchema(_InputError):
    """The store was written by a newer version of the program."""


class OlderSchema(MissingArtifact):
    """The requested artifact was written under an older schema; the message names the release that reads it."""

    is_input: ClassVar[bool] = True


class NotAStore(_InputError):
    """The path is not the folder of a store."""


class FullDisk(StorageError):
    """The disk of the store is full; no partial file is left."""


class UnknownReference(_InputError):
    """A reference names nothing, or more than one thing; the message lists the known names."""


class BadName(_InputError):
    """A name cannot be that of a folder on every system."""


class DatasetExists(_InputError):
    """A dataset of this name and version exists; datasets never change."""
