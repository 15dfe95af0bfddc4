"""Files of detectors: paths, or addresses with digests, whose files `pasdedeux fetch detector` downloads."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pasdedeux.errors import InputError
from storage_schema.durable import cache_folder
from tasks.files.downloads import check_host
from tasks.files.user_files import user_file_digest
from tasks.stage import SourceFile

_ADDRESS = re.compile(r"(https://[^#\s]+)#sha256=([0-9a-f]{64})")


class NetworkAddress(NamedTuple):
    """Address of a network on the internet, and the sha256 of its file."""

    url: str
    sha256: str

    @property
    def kept(self) -> Path:
        """Path of its file after it was fetched."""
        return cache_folder() / "detectors" / f"{self.sha256}.onnx"


@dataclass(frozen=True)
class KnownDetector:
    """A detector with a name.

    Args:
        address: Address of its network.
        num_bytes: Size of its file.
        licence: Its licence.
        meaning: What it detects.
    """

    address: NetworkAddress
    num_bytes: int
    licence: str
    meaning: str


KNOWN_DETECTORS = {
    "rtmo-m": KnownDetector(
        NetworkAddress(
            "https://huggingface.co/Xenova/RTMO-m/resolve/3aba1280472b98ee2bf663482e27e243038d23fe/onnx/model.onnx",
            "76d82c45e5c4810baf587ecf2638d15cbf7ed196afb2055e977382532021b59e",
        ),
        89_291_929,
        "Apache-2.0",
        "several people, COCO's 17 keypoints, images of 640 x 640",
    )
}
"""Detectors by name; the first is the default."""


def fetched_detectors() -> tuple[str, ...]:
    """Return the names of the known detectors that were fetched."""
    return tuple(name for name, known in KNOWN_DETECTORS.items() if known.address.kept.exists())


def find_network(stated: str) -> SourceFile:
    """Return the file of a network given as a name, a path, or an address that ends in #sha256=DIGEST.

    Nothing is downloaded.

    Raises:
        InputError: It does not exist, was not fetched yet, or has another digest.
    """
    known = KNOWN_DETECTORS.get(stated)
    if known is None and "://" not in stated:
        path = Path(stated).expanduser()
        if not path.exists():
            raise InputError(
                f"detector {stated} does not exist; give the ONNX file of RTMO, RTMPose or MoveNet, an address with "
                f"#sha256=DIGEST, or a name: {', '.join(KNOWN_DETECTORS)}"
            )
        return SourceFile(path=str(path), sha256=user_file_digest(path))
    address = known.address if known else network_address(stated)
    if not address.kept.exists():
        raise InputError(
            f"detector {stated} is not on this machine, and a study fetches nothing by itself; bring it with "
            f"`pasdedeux fetch detector {stated if known else repr(stated)}`"
        )
    check_network(address)
    return SourceFile(path=str(address.kept), sha256=address.sha256)


def network_address(stated: str) -> NetworkAddress:
    """Parse an address in a study: https, a host with a public name, and a digest.

    Raises:
        InputError: It has another form.
    """
    match = _ADDRESS.fullmatch(stated)
    if match is None:
        raise InputError(
            f"detector {stated}: an address is https://HOST/FILE#sha256=DIGEST with the 64 digits of its file's digest"
        )
    check_host(match[1])
    return NetworkAddress(match[1], match[2])


def check_network(address: NetworkAddress) -> None:
    """Refuse a fetched file whose content has changed.

    Raises:
        InputError: Its digest is not the one in its name.
    """
    if user_file_digest(address.kept) != address.sha256:
        raise InputError(f"detector {address.kept} is damaged: it has another digest than its name; delete it")
