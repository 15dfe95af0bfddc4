"""Ranges of motion: the angles determined by the joint positions of pair17, with their published limits.

Sources, in degrees from the neutral position:

- CDC: Soucie et al. 2011, "Range of motion measurements: reference values and a database for comparison studies",
  Haemophilia 17, 500-507 (the CDC Normal Joint Study); the greatest mean of its age groups.
- AAOS: American Academy of Orthopaedic Surgeons, "Joint Motion: Method of Measuring and Recording", 1965.
- anatomy: our own allowance for angles in no table, because they depend on where a skeleton places its joints (hips
  below the pelvis, shoulders beside the chest), not on mobility.
"""

from __future__ import annotations

from dataclasses import dataclass

MARGIN_DEG = 10.0
"""Added at both ends of every range, degrees: tables give means over people, and skeletons place joints differently."""

SLACK_RAD = 0.1
"""Uncertainty of a direction in captured data, radians (1-2 cm at the end of a limb bone)."""

TINY = 1e-9
"""Tolerance for rounding at a limit, radians."""


@dataclass(frozen=True)
class AngleRange:
    """The published range of one angle: its joint of pair17, its name, its limits in degrees, their source."""

    joint: str
    angle: str
    lower_deg: float
    upper_deg: float
    source: str


_LEFT_RIGHT = ("left", "right")

ANGLES: tuple[AngleRange, ...] = (
    # Hip joints on the pelvis, relative to the bone pelvis-spine.
    *(AngleRange(f"{side}_hip", "elevation", -50.0, 20.0, "anatomy") for side in _LEFT_RIGHT),
    AngleRange("pelvis", "hip_spread", 155.0, 205.0, "anatomy"),
    # The bend of the trunk at the spine joint; AAOS thoracolumbar spine.
    AngleRange("spine", "flexion", -30.0, 80.0, "AAOS"),
    AngleRange("spine", "lateral", -35.0, 35.0, "AAOS"),
    AngleRange("spine", "torsion", -45.0, 45.0, "AAOS"),
    # Shoulders on the chest, relative to the bone spine-chest.
    *(AngleRange(f"{side}_shoulder", "elevation", 0.0, 75.0, "anatomy") for side in _LEFT_RIGHT),
    AngleRange("chest", "shoulder_spread", 110.0, 250.0, "anatomy"),
    # The neck leaves the chest, the head leaves the neck; AAOS cervical spine.
    AngleRange("chest", "flexion", -45.0, 45.0, "AAOS"),
    AngleRange("chest", "lateral", -45.0, 45.0, "AAOS"),
    AngleRange("neck", "flexion", -45.0, 45.0, "AAOS"),
    AngleRange("neck", "lateral", -45.0, 45.0, "AAOS"),
    # The upper arm in the frame of the chest: how far back (extension), how far across the body (horizontal flexion of
    # 135 degrees is 45 beyond straight ahead; AAOS adduction 50), and its rotation, seen by a bent elbow.  Rotation is
    # stated for the arm held sideways (-70 to 90); the reference carried to a raised or hanging arm, whose shoulder
    # blade turns too, is up to 45 and 20 degrees off.
    *(
        AngleRange(f"{side}_shoulder", angle, lower, upper, "AAOS")
        for side in _LEFT_RIGHT
        for angle, lower, upper in (("extension", -90.0, 60.0), ("crossing", -90.0, 50.0), ("rotation", -90.0, 135.0))
    ),
    *(AngleRange(f"{side}_elbow", "flexion", 0.0, 152.9, "CDC") for side in _LEFT_RIGHT),
    # The thigh in the frame of the pelvis, and its rotation, seen by a bent knee.
    *(
        AngleRange(f"{side}_hip", angle, lower, upper, source)
        for side in _LEFT_RIGHT
        for angle, lower, upper, source in (
            ("flexion", -28.3, 140.8, "CDC"),
            ("abduction", -30.0, 45.0, "AAOS"),
            ("rotation", -45.0, 45.0, "AAOS"),
        )
    ),
    *(AngleRange(f"{side}_knee", "flexion", 0.0, 152.6, "CDC") for side in _LEFT_RIGHT),
)
"""Every angle, in the order of all arrays of angles; 29 of them."""

NUM_ANGLES = len(ANGLES)
ANGLE_INDEX = {(angle.joint, angle.angle): index for index, angle in enumerate(ANGLES)}
"""Index of each angle in `ANGLES`, by joint and name."""
