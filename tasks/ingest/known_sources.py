"""What is known of published files better than they say themselves: the CMU database's rates, scales and licence."""

from __future__ import annotations

import re
from dataclasses import dataclass

from storage_schema import SourceCredit

__all__ = ["CMU_CREDIT", "DUET_CREDIT", "KnownSource", "known_performance", "known_source"]

CMU_CREDIT = SourceCredit(
    name="CMU Graphics Lab Motion Capture Database",
    licence="Free for all uses; the data itself may not be resold",
    credit="The data used in this project was obtained from mocap.cs.cmu.edu. "
    "The database was created with funding from NSF EIA-0196217.",
)
DUET_CREDIT = SourceCredit(
    name="pasdedeux built-in duets", licence="Apache-2.0", credit="Closed-form choreography of the pasdedeux package"
)

_CMU_NAME = re.compile(r"^(\d{1,3})_(\d{1,3})\.(amc|bvh)$", re.IGNORECASE)
_AMC_RATE_HZ = 120.0
_SALSA_RATE_HZ = 60.0
"""Subjects 60 and 61 were captured at 60 Hz; the headers of their BVH files say 120."""
_SALSA_METRES_PER_UNIT = {"60": 1.263, "61": 1.191}
"""Scale of the BVH release of these subjects, against the lengths in their ASF files."""
_BVH_LAYOUT = "cmu_daz"


@dataclass(frozen=True)
class KnownSource:
    """Facts about a file; None where nothing is known and the file is believed."""

    rate_hz: float | None = None
    metres_per_unit: float | None = None


def known_source(file_name: str, layout: str) -> KnownSource:
    """Return what is known of a file of this name whose joints fit this layout.

    AMC files named like CMU's state no rate: it is 120 Hz, 60 Hz for subjects 60 and 61.  The BVH release of those two
    subjects states a wrong rate, and its unit differs between them.
    """
    match = _CMU_NAME.match(file_name)
    if match is None:
        return KnownSource()
    subject, kind = match.group(1).lstrip("0"), match.group(3).lower()
    is_salsa = subject in _SALSA_METRES_PER_UNIT
    if kind == "amc":
        return KnownSource(rate_hz=_SALSA_RATE_HZ if is_salsa else _AMC_RATE_HZ)
    if is_salsa and layout == _BVH_LAYOUT:
        return KnownSource(rate_hz=_SALSA_RATE_HZ, metres_per_unit=_SALSA_METRES_PER_UNIT[subject])
    return KnownSource()


def known_performance(file_name: str) -> str | None:
    """Name the performance that a file of this name holds, the same for its AMC and its BVH; None where unknown."""
    match = _CMU_NAME.match(file_name)
    return f"CMU {match.group(1).lstrip('0')}_{match.group(2).lstrip('0')}" if match else None
