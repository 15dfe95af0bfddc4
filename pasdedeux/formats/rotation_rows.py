"""Reading bare rows of joint angles over a BVH template, as the projection database of Yiannakides et al. (2019) ships.

Each line is a frame: for every joint of the template in its order three Euler angles in degrees, in the order of the
joint's rotation channels, without a root translation.
"""

from __future__ import annotations

import re

import numpy as np

from pasdedeux.errors import FormatError
from pasdedeux.formats.bvh import read_bvh_hierarchy
from pasdedeux.formats.euler import identity_unitquat, unitquat_from_euler
from pasdedeux.formats.file_format import FileStart, MotionFormat
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.text import decode, parse_number, split_lines


def read_rotation_rows(data: bytes | str, template: bytes | str) -> SourceMotion:
    """Read rows of angles over a template; the root stays at the template's OFFSET.

    Raises:
        FormatError: The template is no BVH file with three rotations per joint, or a row has a wrong number of values
            or a value that is no finite number; the line is named.
    """
    header = read_bvh_hierarchy(template)
    joints = [i for i, channels in enumerate(header.channels) if channels]
    axes = ["".join(name[0] for name in header.channels[i] if name.endswith("rotation")) for i in joints]
    if any(len(order) != 3 for order in axes):
        raise FormatError("the template of rotation rows needs three rotation channels for every joint")
    rows = []
    for number, line in enumerate(split_lines(decode(data, "file of rotation rows")), start=1):
        words = line.split()
        if not words:
            continue
        if len(words) != 3 * len(joints):
            raise FormatError(
                f"line {number}: {len(words)} values, but the template has {len(joints)} joints x 3 angles"
            )
        rows.append([parse_number(word, f"line {number}") for word in words])
    angles = np.deg2rad(np.array(rows)).reshape(len(rows), len(joints), 3)
    local_unitquat = identity_unitquat(len(rows), header.skeleton.num_joints)
    for index, (joint, order) in enumerate(zip(joints, axes, strict=True)):
        local_unitquat[:, joint] = unitquat_from_euler(angles[:, index], order)
    return SourceMotion(
        skeleton=header.skeleton,
        rest_offsets=header.rest_offsets,
        root_translation=np.tile(header.rest_offsets[header.skeleton.root], (len(rows), 1)),
        local_unitquat=local_unitquat,
        end_sites=header.end_sites,
    )


class RotationRows(MotionFormat):
    """Rows of angles over a BVH template; they say nothing of rate, unit and axis."""

    name = "rotation_rows"
    recognised_by = "rows of nothing but numbers, three for each joint"
    suffixes = ()
    companion = "BVH template"

    def recognises(self, start: FileStart) -> bool:
        """Tell whether the first line is at least three triples of numbers."""
        words = start.first_row.split()
        return len(words) >= 9 and len(words) % 3 == 0 and all(re.fullmatch(r"[-+0-9.eE]+", word) for word in words)

    def companion_names(self, name: str) -> tuple[str, ...]:
        """Return the template's name, beside the file or above."""
        return ("template.bvh", "../template.bvh")

    def read(self, data: bytes, companion: bytes = b"") -> SourceMotion:
        """Read everything."""
        return read_rotation_rows(data, companion)
