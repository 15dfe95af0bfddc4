"""People on the source's own skeleton: read from the store, and written as BVH and npz."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flows.exports.export_format import FileNames, RestPose, Units, write_text, write_units
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.npz import write_motion_npz
from pasdedeux.formats.rigs.own_skeleton import BodyMap, OwnSkeleton, standing, with_end_sites
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.people.names import person_name
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import BODY22, Skeleton
from storage_schema import ArtifactRef, Store

_POSED = {"source": "that of the source's file", "standing": "a standing T-pose"}
_AXES = "right-handed, Y up"
TAKE_NAMES = (
    "Files of takes are named TAKE, of variants TAKE_VARIANT: in `waltz_A-0.75` person A of the take waltz has 0.75 of "
    "the size, in `waltz_B-legs-1.10` the legs of B have 1.10 of their length. The end of a "
    "file for one person says whose motion it is: `waltz_A-0.75.B`."
)
"""Meaning of file names."""
_SAID = (
    TAKE_NAMES,
    "BVH files are in the unit said below and degrees, npz files in metres and unit quaternions (x, y, z, w).",
    f"Axes: {_AXES}; in a standing T-pose people face +Z, the left side on +X, arms out along X.",
    "Joints have the names of the source; `_end` are End Sites, added where the source has none.",
)
_EXTREMITIES = BODY22.indices(f"{side}_{joint}" for side in ("left", "right") for joint in ("wrist", "ankle", "toe"))


@dataclass(frozen=True)
class TakePerson:
    """A person of a take.

    Args:
        take_id: The take.
        letter: A, B, ...
        own: The motion on the source's own skeleton.
        metres_per_unit: Length of one unit of the source's file.
        layout: Name of the layout of its joints.
        up_axis: Axis that points up in the source's file.
        source_rate_hz: Frames per second of the source's file; 0 if unknown.
    """

    take_id: str
    letter: str
    own: OwnSkeleton
    metres_per_unit: float
    layout: str
    up_axis: str = "y"
    source_rate_hz: float = 0.0


def people_of_take(store: Store, ref: ArtifactRef) -> list[TakePerson]:
    """Return the people of a take, A first, from the artifact that holds it."""
    takes = store.read(ref, "takes")
    poses = store.read(ref, "poses", columns=["person", "root_translation_m", "local_unitquat"])
    people = []
    for index in range(takes.num_rows):
        take = takes.row(index)
        joints = len(take["joint_names"])
        part = np.flatnonzero(poses["person"] == take["person"])
        rotations = np.stack([poses["local_unitquat"][row] for row in part]).astype(np.float64)
        motion = Motion(
            skeleton=Skeleton(
                str(take["take_id"]), tuple(take["joint_names"]), tuple(int(parent) for parent in take["joint_parents"])
            ),
            rest_offsets_m=np.asarray(take["rest_offset_m"], dtype=np.float64).reshape(joints, 3),
            root_translation_m=poses["root_translation_m"][part].astype(np.float64),
            local_unitquat=normalise(rotations.reshape(len(part), joints, 4)),
            rate_hz=float(take["rate_hz"]),
        )
        body = BodyMap(
            np.asarray(take["body22_weight"], dtype=np.float64).reshape(BODY22.num_joints, joints),
            np.asarray(take["body22_offset_m"], dtype=np.float64).reshape(BODY22.num_joints, joints, 3),
        )
        letter = person_name(int(take["person"]))
        skeleton = OwnSkeleton(motion, body)
        unit, layout, up_axis = float(take["metres_per_unit"]), str(take["layout"]), str(take["up_axis"])
        rate_hz = float(take["source_rate_hz"])
        people.append(TakePerson(str(take["take_id"]), letter, skeleton, unit, layout, up_axis, rate_hz))
    return people


def rate_in_words(rate_hz: float, source_rate_hz: float) -> str:
    """Return a rate in words, with the source's rate if it differs.

    >>> rate_in_words(30.0, 120.0), rate_in_words(30.0, 30.0)
    ('30 Hz (the source: 120 Hz)', '30 Hz')
    """
    is_other = source_rate_hz and abs(source_rate_hz - rate_hz) > 1e-3 * rate_hz
    other = f" (the source: {source_rate_hz:.6g} Hz)" if is_other else ""
    return f"{rate_hz:.6g} Hz{other}"


def rig_of(own_skeleton: OwnSkeleton, rest_pose: RestPose) -> OwnSkeleton:
    """Return a skeleton for other programs: every joint has a length, and the rest pose is the requested one."""
    ended = with_end_sites(own_skeleton)
    return standing(ended) if rest_pose == "standing" else ended


class RigFiles:
    """Files of people: a BVH and an npz each, and at the end a text about them.

    Args:
        out: Folder, which exists.
        rest_pose: Of the source, or a standing T-pose.
        units: Of BVH files: centimetres, metres, or those of each source's file.
    """

    def __init__(self, out: Path, *, rest_pose: RestPose, units: Units) -> None:
        self._out, self._rest_pose, self._units = out, rest_pose, units
        self._names = FileNames(out)
        self._lines: dict[str, str] = {}
        self._paths: list[Path] = []

    def write(
        self,
        parts: Sequence[str | int],
        person: TakePerson,
        own_skeleton: OwnSkeleton,
        wanted_m: np.ndarray | None = None,
        *,
        is_apart: bool = False,
    ) -> None:
        """Write a person's motion as BVH and npz.

        Args:
            parts: Parts of the name of both files, before the person.
            person: The person.
            own_skeleton: The motion.
            wanted_m: body22 of the variant (frame, 22, 3), metres; None for the source itself.
            is_apart: Whether it goes to the folder of worse results.
        """
        path = self._names.path(*parts, suffix=".bvh", who=person.letter, is_apart=is_apart)
        motion = rig_of(own_skeleton, self._rest_pose).motion
        metres = {"cm": 0.01, "m": 1.0, "source": person.metres_per_unit}[self._units]
        rate = rate_in_words(motion.rate_hz, person.source_rate_hz)
        line = f"{counted(motion.num_frames, 'frame')} at {rate}, one unit of the BVH is {metres:.9g} m"
        facts = {
            "rest_pose": self._rest_pose,
            "bvh_metres_per_unit": metres,
            "body22_joint": own_skeleton.body.joint_names(own_skeleton.motion.skeleton),
        }
        if wanted_m is not None:
            away_m = np.linalg.norm(own_skeleton.body.of(own_skeleton.motion) - wanted_m, axis=-1)
            line += (
                f"; joints lie within {1e3 * np.percentile(away_m, 95):.1f} mm (95 %) of the variant's body22, "
                f"at worst {1e3 * away_m.max():.1f} mm, "
                f"hands and feet within {1e3 * away_m[:, _EXTREMITIES].max():.1f} mm"
            )
        self._lines[str(path.with_suffix("").relative_to(self._out))] = (
            f"{line}; the rest pose is {_POSED[self._rest_pose]}"
        )
        text = write_bvh(motion, units_per_metre=1.0 / metres, decimals=8)
        self._paths += [write_text(path, text), path.with_suffix(".npz")]
        axes = f"{_AXES}; the rest pose is {_POSED[self._rest_pose]}"
        self._paths[-1].write_bytes(write_motion_npz(motion, axes=axes, **facts))

    def write_variant(
        self, variant_id: str, people: Sequence[TakePerson], motion_m: np.ndarray, bone_scale: np.ndarray
    ) -> None:
        """Write a variant's motion (frame, P, 22, 3), metres, with scales (P, 22), on the skeletons of its people."""
        for person, wanted_m, scale in zip(people, np.moveaxis(motion_m, 1, 0), bone_scale, strict=True):
            retargeted = person.own.retargeted(wanted_m, scale)
            self.write((person.take_id, variant_id), person, retargeted, wanted_m)

    def close(self) -> Sequence[Path]:
        """Write what someone who finds the files has to know, and return all files."""
        return [*self._paths, write_units(self._out, _SAID, self._lines)] if self._paths else []
