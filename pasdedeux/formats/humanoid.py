"""Motions for characters: BVH and npz of a hips-rooted body that stands in a T-pose when nothing is turned."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array, Flags
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.npz import write_motion_npz
from pasdedeux.kinematics import Motion
from pasdedeux.plain_text import counted
from pasdedeux.skeletons.humanoid import END_SITES, HUMANOID

UNITS_PER_METRE = {"cm": 100.0, "m": 1.0}
_SPELT = {"cm": "centimetres", "m": "metres"}
"""Units of BVH files; centimetres by default, which most programs assume."""

AXES = "right-handed, Y up, facing +Z at rest, the left side on +X"


@dataclass(frozen=True)
class HumanoidMotion:
    """A person's motion over the frames of a video.

    Args:
        motion: On `body22`, from the standing T-pose, floor at y = 0, metres.
        first_frame: Its first frame in the video.
        is_seen: Frames (frame,) in which enough of the person was seen; other poses are interpolated or, before and
            after that, held.
    """

    motion: Motion
    first_frame: int
    is_seen: Flags

    def bvh(self, units: str = "cm") -> str:
        """Return BVH text with lengths in `cm` or `m`."""
        return write_bvh(humanoid_motion(self.motion), units_per_metre=UNITS_PER_METRE[units], decimals=8)


def humanoid_motion(motion: Motion) -> Motion:
    """Convert a motion of body22, whose rest pose is the T-pose, to `HUMANOID`: other names, and end sites."""
    carriers = motion.skeleton.indices(END_SITES)
    lengths_m = [np.linalg.norm(motion.rest_offsets_m[joint]) for joint in carriers]
    offsets_m = [np.array(offset) * length_m for offset, length_m in zip(END_SITES.values(), lengths_m, strict=True)]
    ended = motion.with_joints([f"{joint}_end" for joint in END_SITES], carriers, offsets_m)
    return replace(ended, skeleton=HUMANOID)


def write_npz(human: HumanoidMotion, **facts: Array) -> bytes:
    """Return a motion as an npz archive: as `write_motion_npz`, with `is_seen` (frame,), `first_frame`, and facts."""
    return write_motion_npz(
        humanoid_motion(human.motion), axes=AXES, is_seen=human.is_seen, first_frame=human.first_frame, **facts
    )


def units_text(human: HumanoidMotion, units: str) -> str:
    """Return the text file that describes the files of a video: units, axes, joints."""
    return (
        f"BVH files are in {_SPELT[units]} and degrees, npz files in metres and unit quaternions (x, y, z, w).\n"
        f"Axes: {AXES}; the floor is at y = 0, z points to the camera of the video.\n"
        "The rest pose is a standing T-pose, joints have Mixamo's names without their prefix.\n"
        f"All files have the same {counted(human.motion.num_frames, 'frame')} at {human.motion.rate_hz:.6g} Hz, from "
        f"frame {human.first_frame} of the video on; `is_seen` of the npz tells in which a person was seen, in the "
        "others the pose is interpolated or, before and after, held.\n"
        "`camera_...` of the npz and the camera of the GLB file are in the same axes; a camera looks along its own -z, "
        "x right, y up. Of film of a camera that moves they are those of its steady image, and `steady_from_image` "
        "(frame, 3, 3) takes pixels (x, y, 1) of each frame to it, a homography. `cameras_...` has all cameras where "
        "several saw the take.\n"
    )
