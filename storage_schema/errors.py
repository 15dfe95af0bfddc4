"""The errors of the store: one root, a few children, all of them survive pickling."""

# ruff: noqa: N818 - these names say what is wrong; that they are errors shows where they are raised

from __future__ import annotations

from typing import ClassVar


class StorageError(Exception):
    """Root of every error that the store raises on purpose; the message is one clear sentence.

    `is_input` tells a command line whether the user can put it right before any work starts (exit code 2) or whether
    the work itself failed (exit code 1).
    """

    is_input: ClassVar[bool] = False


class _InputError(StorageError):
    """Something that was given or asked for, which the user can put right."""

    is_input: ClassVar[bool] = True


class MissingArtifact(StorageError):
    """An artifact, or a part of it that was asked for, is not in the store."""


class CorruptArtifact(StorageError):
    """The contents of the store do not match its manifests."""


class NamedByDataset(StorageError):
    """An artifact that a dataset needs was computed again with other bytes: the old one stays."""


class SchemaError(StorageError):
    """Values do not fit the table they are written to or read from: says which column and what is allowed."""


class NewerSchema(_InputError):
    """The store was written by a newer version of the program."""


class OlderSchema(MissingArtifact):
    """What is asked for was written under an older schema: says which release of the program reads it."""

    is_input: ClassVar[bool] = True


class NotAStore(_InputError):
    """The path is not the folder of a store."""


class FullDisk(StorageError):
    """The disk of the store is full; no partial file is left."""


class UnknownReference(_InputError):
    """A reference names nothing, or more than one thing: says which, and what is there."""


class BadName(_InputError):
    """A name that was given to something cannot be that of a folder on every machine."""


class DatasetExists(_InputError):
    """A dataset of this name and version was already made; datasets never change."""
