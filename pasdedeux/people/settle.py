"""Who is who in a source of 2D poses, decided once: identities, faults of the detector, and pairs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.formats import AnnotatedFrames
from pasdedeux.people.faults import repair_faults
from pasdedeux.people.identity import follow_people, mean_of_two
from pasdedeux.people.pairs import Paired, choose_pairs
from pasdedeux.people.video import why_no_video
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, KeypointLayout
from pasdedeux.skeletons.layouts.keypoints import Keypoints

__all__ = ["PeopleSettings", "SequencePeople", "SettledPeople", "settle_people"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


class PeopleSettings(Settings):
    """How it is settled who is who."""

    identities: Literal["auto", "follow", "given"] = Field(
        "auto",
        description="Who is who: followed by pose and motion, as given, or followed where people are numbered anew in "
        "every frame (OpenPose, COCO without track_id).  Single images are never followed",
    )
    has_repair: bool = Field(
        True, description="Swapped sides, exchanged limbs and wild keypoints of a video are put right or left out"
    )


@dataclass(frozen=True)
class SequencePeople:
    """What was decided of one sequence.

    Args:
        sequence_id: The sequence.
        num_people: People in it.
        pairs: Who is whose partner; none chosen here where people have a number within one image only.
        why_not_followed: Why it is no video, whose people could be followed; empty where it is one.
        num_merged_rows: Doubled detections that were merged.
        num_ghost_rows: Detections that were dropped.
        num_repaired_joints: Joints of op14 that were put right or masked.
    """

    sequence_id: str
    num_people: int
    pairs: tuple[Paired, ...]
    why_not_followed: str
    num_merged_rows: int = 0
    num_ghost_rows: int = 0
    num_repaired_joints: int = 0

    def in_words(self) -> str:
        """Say it in a line."""
        words = [f"{self.num_people} {'person' if self.num_people == 1 else 'people'}"]
        words += [f"{one.first} and {one.second} are partners (near in {one.num_near} frames)" for one in self.pairs]
        if self.why_not_followed:
            words.append(self.why_not_followed)
        counts = (
            (self.num_merged_rows, "doubled detections merged"),
            (self.num_ghost_rows, "detections dropped"),
            (self.num_repaired_joints, "joints repaired or left out"),
        )
        words += [f"{count} {what}" for count, what in counts if count]
        return f"{self.sequence_id}: {', '.join(words)}"


@dataclass(frozen=True)
class SettledPeople:
    """A source of 2D poses whose people are settled; rows sorted by sequence, frame and person.

    Args:
        frames: The rows that are left, with who each is and with repaired keypoints.
        source_person_id: The person of each row (row,) as the source numbers them.
        partner_id: The partner of each row's person (row,); -1 for nobody.
        op14: Keypoints (row, 14, 2) and confidences (row, 14), repaired.
        sequences: What was decided of each sequence, by name.
    """

    frames: AnnotatedFrames
    source_person_id: Integers
    partner_id: Integers
    op14: Keypoints
    sequences: tuple[SequencePeople, ...]


@dataclass(frozen=True)
class _Rows:
    """The rows of one sequence; keypoints (row, K, 2) of the source's layout, confidences (row, K)."""

    frame: Integers
    person_id: Integers
    source_person_id: Integers
    keypoints_px: Array
    confidence: Array

    def chosen(self, rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> _Rows:
        """Return some of the rows."""
        return _Rows(*(getattr(self, name)[rows] for name in _Rows.__dataclass_fields__))


def settle_people(frames: AnnotatedFrames, settings: PeopleSettings | None = None) -> SettledPeople:
    """Decide who is who in every sequence, repair the detector's faults, and find the pairs.

    Args:
        frames: The rows as a source gives them, with their rate.
        settings: How.

    Raises:
        InputError: The rate is not known, or nobody is left.
    """
    settings = settings or PeopleSettings()
    if frames.rate_hz is None:
        raise InputError("people cannot be followed without the frame rate of the video")
    layout = KEYPOINT_LAYOUTS[frames.layout]
    is_followed = settings.identities == "follow" or (settings.identities == "auto" and not frames.has_identities)
    sequence_of = np.array(frames.sequence_id, dtype=object)
    everyone = _Rows(
        frames.frame, frames.person_id, frames.person_id, frames.keypoints_px.copy(), frames.confidence.copy()
    )
    parts, points, partners, decided = [], [], [], []
    for name in sorted(set(frames.sequence_id)):
        rows = everyone.chosen(np.flatnonzero(sequence_of == name))
        reason = why_no_video(rows.frame)
        merged = ghosts = repaired = 0
        if is_followed and not reason:
            rows, merged, ghosts = _followed(rows, layout, frames.rate_hz)
        rows = rows.chosen(np.lexsort([rows.person_id, rows.frame]))
        op14 = layout.derive(OP14.name, rows.keypoints_px, rows.confidence)
        if settings.has_repair and not reason:
            rows, op14, repaired = _repaired(rows, op14, layout, frames.rate_hz)
        pairs, partner = _partners(rows, op14, has_identities=frames.has_identities or not reason)
        parts.append(rows)
        points.append(op14)
        partners.append(partner)
        num_people = len(np.unique(rows.person_id))
        decided.append(SequencePeople(name, num_people, tuple(pairs), reason, merged, ghosts, repaired))
    if not sum(len(part.frame) for part in parts):
        raise InputError("no frame shows enough joints of a person")
    joined = _Rows(*(np.concatenate([getattr(part, name) for part in parts]) for name in _Rows.__dataclass_fields__))
    return SettledPeople(
        frames=replace(
            frames,
            sequence_id=tuple(one.sequence_id for one, part in zip(decided, parts, strict=True) for _ in part.frame),
            frame=joined.frame,
            person_id=joined.person_id,
            keypoints_px=joined.keypoints_px,
            confidence=joined.confidence,
        ),
        source_person_id=joined.source_person_id,
        partner_id=np.concatenate(partners),
        op14=Keypoints(
            np.concatenate([one.positions for one in points]), np.concatenate([one.confidence for one in points])
        ),
        sequences=tuple(decided),
    )


def _followed(rows: _Rows, layout: KeypointLayout, rate_hz: float) -> tuple[_Rows, int, int]:
    """Return the rows of those who are people, as the persons they are, and how many were merged and dropped."""
    op14 = layout.derive(OP14.name, rows.keypoints_px, rows.confidence)
    found = follow_people(rows.frame, op14.positions, op14.confidence, rate_hz=rate_hz)
    for row in np.flatnonzero(found.twin >= 0):
        both = np.array([found.twin[row], row])
        rows.keypoints_px[both[0]], rows.confidence[both[0]] = mean_of_two(
            rows.keypoints_px[both], rows.confidence[both]
        )
    settled = replace(rows, person_id=found.track_id).chosen(found.track_id >= 0)
    return settled, found.num_merged, found.num_ghosts


def _repaired(rows: _Rows, op14: Keypoints, layout: KeypointLayout, rate_hz: float) -> tuple[_Rows, Keypoints, int]:
    """Return the rows and their op14 with faults put right, and how many joints were touched.

    What is found on op14 goes for the keypoints that move with its joints.  Somebody of whom nothing would be left
    stays as they were.
    """
    people, person = np.unique(rows.person_id, return_inverse=True)
    at = rows.frame - (int(rows.frame.min()) if len(rows.frame) else 0)
    shape = (len(people), int(at.max()) + 1 if len(at) else 0, OP14.num_joints)
    points, confidence = np.full((*shape, 2), np.nan), np.zeros(shape)
    points[person, at], confidence[person, at] = op14.positions, op14.confidence
    row_of = np.full(shape[:2], -1, dtype=np.int64)
    row_of[person, at] = np.arange(len(at))
    found = repair_faults(points, confidence, rate_hz=rate_hz)
    is_kept = np.array([(one > 0).any() for one in found.confidence], dtype=bool)[person]
    is_touched = found.is_touched[person, at] & (op14.confidence > 0) & is_kept[:, None]
    source_row = row_of[found.source_person[person, at], at[:, None]]
    keypoints_px, seen = rows.keypoints_px.copy(), rows.confidence.copy()
    for keypoint, (joint, mirror) in enumerate(_joints_of(layout)):
        if joint < 0:
            continue
        source = np.where(found.source_joint[person, at, joint] == joint, keypoint, mirror)
        change = is_kept & (source_row[:, joint] >= 0)
        keypoints_px[change, keypoint] = rows.keypoints_px[source_row[change, joint], source[change]]
        seen[change, keypoint] = rows.confidence[source_row[change, joint], source[change]]
        masked = is_kept & found.is_masked[person, at, joint]
        keypoints_px[masked, keypoint], seen[masked, keypoint] = np.nan, 0.0
    repaired = Keypoints(
        np.where(is_kept[:, None, None], found.keypoints_px[person, at], op14.positions),
        np.where(is_kept[:, None], found.confidence[person, at], op14.confidence),
    )
    return replace(rows, keypoints_px=keypoints_px, confidence=seen), repaired, int(is_touched.sum())


def _joints_of(layout: KeypointLayout) -> list[tuple[int, int]]:
    """Return for each keypoint the joint of op14 that it moves with, -1 for none, and its mirrored keypoint."""
    names = layout.keypoint_names
    single = {next(iter(means[0])): joint for joint, means in layout.recipes[OP14.name].items() if len(means[0]) == 1}
    found = []
    for keypoint, name in enumerate(names):
        side, _, part = name.partition("_")
        joint = single.get(name, f"{side}_ankle" if part in _OF_FOOT else "")
        other = {"left": f"right_{part}", "right": f"left_{part}"}.get(side, name)
        found.append((OP14.index(joint) if joint else -1, names.index(other) if other in names else keypoint))
    return found


_OF_FOOT = ("big_toe", "small_toe", "heel")


def _partners(rows: _Rows, op14: Keypoints, *, has_identities: bool) -> tuple[list[Paired], Integers]:
    """Return the pairs of a sequence, and each row's partner; images whose people have no names are paired singly."""
    partner = np.full(len(rows.frame), -1, dtype=np.int64)
    groups = [np.arange(len(rows.frame))]
    if not has_identities:
        groups = [np.flatnonzero(rows.frame == number) for number in np.unique(rows.frame)]
    pairs: list[Paired] = []
    for group in groups:
        pairs = choose_pairs(rows.frame[group], rows.person_id[group], op14.positions[group], op14.confidence[group])
        for pair in pairs:
            for one, other in ((pair.first, pair.second), (pair.second, pair.first)):
                partner[group[rows.person_id[group] == one]] = other
    return (pairs if has_identities else []), partner
