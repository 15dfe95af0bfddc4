"""Unsupported file kinds: recognised by their first bytes, and refused with advice."""

from __future__ import annotations

import io
import re
import zipfile

from pasdedeux.errors import FormatError

_AS_BVH = "import it into Blender and export its armature as BVH, a file for each person"
_UNPACK = "unpack it and give the files inside"
_NOT_READ = "which is not read here: "
_KINDS = {
    rb"version https://git-lfs": "a git-LFS pointer, not the file itself: run `git lfs pull` where it came from",
    rb"Kaydara FBX Binary|;\s*FBX \d": f"an FBX scene, {_NOT_READ}{_AS_BVH}",
    rb"glTF": f"a glTF scene, which is written here and not read: {_AS_BVH}",
    rb"PXR-USDC|#usda": f"a USD scene, {_NOT_READ}{_AS_BVH}",
    rb"BLENDER": f"a Blender file, {_NOT_READ}open it there and export its armature as BVH, a file for each person",
    rb"(<\?xml[^>]*>\s*)?(<!--.*?-->\s*)*<COLLADA": f"a COLLADA scene, {_NOT_READ}{_AS_BVH}",
    rb"(<\?xml[^>]*>\s*)?(<!--.*?-->\s*)*<mvnx": f"an MVNX file of Xsens, {_NOT_READ}export it as BVH in its program",
    rb"Vocaloid Motion Data": f"a motion of MikuMikuDance, {_NOT_READ}{_AS_BVH}",
    rb"(?i:<!doctype html|<html)": "a web page, not what it should have held: download the file again, signed in",
    rb"\x80[\x00-\x05]": "a pickle, which may run any program when it is opened and is never opened here; "
    "docs/body-models.md has the lines that turn one into npz",
    rb"\x1f\x8b|BZh|\xfd7zXZ|7z\xbc\xaf|Rar!|\x28\xb5\x2f\xfd|PK\x05\x06|.{257}ustar": f"a packed archive: {_UNPACK}",
    rb"\x89HDF|MATLAB 5": f"a MATLAB or HDF5 file, {_NOT_READ}write its arrays as npz (docs/formats-and-units.md)",
    rb"\x93NUMPY": "a single array without names: write an npz with 'positions_m', 'joint_names' and 'rate_hz'",
    rb"%PDF": "a PDF document, not a motion",
    rb"\x89PNG|\xff\xd8\xff|GIF8|RIFF.{4}WEBP": "a picture: name its folder or its video as film (docs/own-2d.md)",
    rb"....ftyp|RIFF.{4}AVI |\x1a\x45\xdf\xa3": "a video: name it under [[ingest.videos]] (docs/own-2d.md)",
    rb"NO_OF_FRAMES": f"a table of markers of Qualisys, {_NOT_READ}export joints as C3D or TRC, or the skeleton as BVH",
    rb"(?i:format version,)": f"a table of Motive, {_NOT_READ}export the skeleton as BVH",
}
"""Patterns of the beginning of files, and the kind of file with advice."""
_STARTS = {re.compile(rb"(?:\xef\xbb\xbf)?\s*(?:%s)" % start, re.DOTALL): what for start, what in _KINDS.items()}
_MAX_NAMED = 3


def refuse_foreign(data: bytes) -> None:
    """Refuse a file of a known but unsupported kind; accept any other file.

    Raises:
        FormatError: One sentence: the kind of file, and what to do.
    """
    for start, what in _STARTS.items():
        if start.match(data):
            raise FormatError(f"this is {what}")
    if data[:4] == b"PK\x03\x04" and (members := _members(data)) and not any(name.endswith(".npy") for name in members):
        named = ", ".join(members[:_MAX_NAMED]) + (", ..." if len(members) > _MAX_NAMED else "")
        raise FormatError(f"this is a zip archive of {named[:100]}: {_UNPACK}")


def _members(data: bytes) -> list[str]:
    """Return the names of the files in a zip archive; empty for a damaged one."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return [name for name in archive.namelist() if not name.endswith("/")]
    except (zipfile.BadZipFile, NotImplementedError, OSError, ValueError):
        return []
