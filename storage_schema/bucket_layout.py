"""Layout of a bucket, below a prefix, for stores and for datasets that are pushed there.

`parts/<sha256>` is a data file, `manifests/<stage>/<key>` the manifest of an artifact, `records/...` a file of the same
name in a store's folder (`runs/`, `store.json`), `datasets/<name>@<version>` a dataset's folder as a tar file, and
`lease` names the build that has the store. Parts are written before the manifest that names them, and a manifest is
written once, so that visible artifacts are complete.
"""

from __future__ import annotations

import io
import json
import re
import tarfile
from collections.abc import Mapping

from storage_schema.bucket import RemoteStore
from storage_schema.columns import is_plain_name
from storage_schema.errors import CorruptArtifact
from storage_schema.manifest import ArtifactRef

MANIFEST_PLACE = re.compile(r"manifests/([a-z][a-z0-9_]*)/([0-9a-f]{64})")
RECORD_PLACE = re.compile(r"records/(store\.json|runs(?:/[^/.][^/]*)+)")
DATASET_PLACE = re.compile(r"datasets/[A-Za-z0-9][A-Za-z0-9._-]*@[A-Za-z0-9][A-Za-z0-9._-]*")
"""Patterns of the files of a store; other files in the bucket are ignored."""
MAX_DATASET_BYTES = 200_000_000
"""Largest tar file of a dataset: its list, card, study and environment."""


def part_place(sha256: str) -> str:
    """Return the path of a data file."""
    return f"parts/{sha256}"


def manifest_place(ref: ArtifactRef) -> str:
    """Return the path of an artifact's manifest."""
    return f"manifests/{ref.stage}/{ref.key}"


def read_dataset(remote: RemoteStore, label: str) -> bytes:
    """Return the tar file of a dataset.

    Raises:
        FileNotFoundError: There is no such dataset.
        CorruptArtifact: The file is too large to be a dataset.
    """
    return remote.read(f"datasets/{label}", limit=MAX_DATASET_BYTES)


def is_old_list(data: bytes) -> bool:
    """Return whether the file of a dataset has the form of an earlier release: only its list, as JSON."""
    return data[:1] == b"{"


def pack_dataset(files: Mapping[str, bytes]) -> bytes:
    """Return the files of a dataset as a tar file, without owner and time."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for name, data in sorted(files.items()):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return packed.getvalue()


def unpack_dataset(data: bytes, where: str) -> dict[str, bytes]:
    """Return the files of a dataset's tar; it must not be compressed, so that it cannot grow.

    Raises:
        CorruptArtifact: It is no tar file, or contains anything but plain files.
    """
    files: dict[str, bytes] = {}
    try:
        with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
            for member in archive:
                name = member.name.removeprefix("./")
                if member.isdir() and name == ".":
                    continue
                is_file = member.isreg() and not member.issparse()
                if not is_file or not is_plain_name(name) or name.startswith(".") or name in files:
                    raise tarfile.TarError(f"it holds {json.dumps(member.name)[:80]}, which is no file of a dataset")
                content = archive.extractfile(member)
                files[name] = b"" if content is None else content.read()
    except tarfile.ReadError:
        raise CorruptArtifact(
            f"{where} is not a dataset: it is no tar file as this program writes it, without compression"
        ) from None
    except tarfile.TarError as error:
        raise CorruptArtifact(f"{where} is not a dataset: {error}") from None
    return files
