"""Facts about published files that override the files: rates, scales and licence of the CMU database."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from pasdedeux.errors import InputError
from pasdedeux.formats.rigs.resolution import KnownSource
from storage_schema import SourceCredit
from tasks.files.user_files import read_text_file

CMU_CREDIT = SourceCredit(
    name="CMU Graphics Lab Motion Capture Database",
    licence="Free for all uses; the data itself may not be resold",
    credit="The data used in this project was obtained from mocap.cs.cmu.edu. "
    "The database was created with funding from NSF EIA-0196217.",
)
DUET_CREDIT = SourceCredit(
    name="pasdedeux built-in duets", licence="Apache-2.0", credit="Closed-form choreography of the pasdedeux package"
)

FETCHED_FILE = "CMU.sha256"
"""File with the digests of the files in a folder that `pasdedeux fetch` downloaded from CMU."""
_CMU_NAME = re.compile(r"^(\d{1,3})_(\d{1,3})\.(amc|bvh)$", re.IGNORECASE)
_USUAL_RATE_HZ = 120.0
_SALSA_RATE_HZ = 60.0
"""Subjects 60 and 61 were captured at 60 Hz; the headers of their BVH files say 120."""
_SALSA_METRES_PER_UNIT = {"60": 1.263, "61": 1.191}
"""Scale of the BVH release of these subjects, from the lengths in their ASF files."""
_BVH_LAYOUT = "cmu_daz"


def known_source(file_name: str, layout: str, *, stated_hz: float | None, is_fetched: bool = False) -> KnownSource:
    """Return the known facts of a file of this name, layout and stated rate.

    An AMC file states no rate; it is known for files that `pasdedeux fetch` downloaded from CMU, not by the name alone.
    The BVH release of subjects 60 and 61 states a wrong rate, 120 Hz, and its unit differs between them.
    """
    subject = _cmu_subject(file_name)
    if is_fetched:
        return KnownSource(rate_hz=usual_rate_hz(file_name))
    is_lying = layout == _BVH_LAYOUT and stated_hz is not None and abs(stated_hz - _USUAL_RATE_HZ) < 0.1
    if is_lying and file_name.lower().endswith(".bvh") and subject in _SALSA_METRES_PER_UNIT:
        return KnownSource(rate_hz=_SALSA_RATE_HZ, metres_per_unit=_SALSA_METRES_PER_UNIT[subject])
    return KnownSource()


def usual_rate_hz(file_name: str) -> float | None:
    """Return the rate of CMU's AMC file of this name; None for other names."""
    subject = _cmu_subject(file_name)
    if subject is None or not file_name.lower().endswith(".amc"):
        return None
    return _SALSA_RATE_HZ if subject in _SALSA_METRES_PER_UNIT else _USUAL_RATE_HZ


def note_fetched(path: Path, data: bytes) -> None:
    """Record beside a file that `pasdedeux fetch` downloads it from CMU: digest and name, as in `sha256sum --check`.

    This is recorded before the file is written, because the origin of an existing file is unknown.
    """
    notes = path.with_name(FETCHED_FILE)
    lines = [line for line in _notes(path) if not line.endswith(f"  {path.name}")]
    digest = hashlib.sha256(data).hexdigest()
    coming = notes.with_name(f"{notes.name}.part")
    coming.write_text("".join(f"{line}\n" for line in [*lines, f"{digest}  {path.name}"]), encoding="utf-8")
    coming.replace(notes)


def was_fetched(path: Path, sha256: str) -> bool:
    """Return whether `pasdedeux fetch` downloaded a file of this content from CMU, as recorded beside it."""
    return any(line.startswith(f"{sha256} ") for line in _notes(path))


def has_changed(path: Path, data: bytes) -> bool:
    """Return whether the content differs from the recorded one: an AMC file that was cut off may be valid."""
    noted = [line for line in _notes(path) if line.endswith(f"  {path.name}")]
    return bool(noted) and f"{hashlib.sha256(data).hexdigest()}  {path.name}" not in noted


def _notes(path: Path) -> list[str]:
    """Return the recorded lines beside a file; empty if they cannot be read."""
    try:
        return read_text_file(path.with_name(FETCHED_FILE)).splitlines()
    except InputError:
        return []


def known_performance(file_name: str) -> str | None:
    """Return the performance in a file of this name, the same for AMC and BVH; None if unknown."""
    match = _CMU_NAME.match(file_name)
    return f"CMU {match.group(1).lstrip('0')}_{match.group(2).lstrip('0')}" if match else None


def _cmu_subject(file_name: str) -> str | None:
    match = _CMU_NAME.match(file_name)
    return match.group(1).lstrip("0") if match else None
