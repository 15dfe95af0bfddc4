"""Identities of people in a source of 2D poses, repair of detections, and pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.errors import InputError, NobodyError
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.people.broken import find_breaks, join_breaks
from pasdedeux.people.decisions import Decision, decide, spans_of, stated_couples
from pasdedeux.people.identity import follow_people, mean_of_two
from pasdedeux.people.pairs import NearPeople, choose_pairs
from pasdedeux.people.repair import repair_rows
from pasdedeux.people.video import MAX_REPAIR_GAP_S, typical_gap_s, why_no_video, why_not_followed
from pasdedeux.plain_text import counted
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS, KeypointLayout
from pasdedeux.skeletons.layouts.keypoints import Keypoints


class PeopleSettings(Settings):
    """How identities are resolved."""

    identities: Literal["auto", "follow", "given"] = Field(
        "auto",
        description="Who is who: followed by pose and motion, as given, or followed where people are numbered anew in "
        "every frame (OpenPose, COCO without track_id) and checked by pose and motion where they are not.  Single "
        "images are never followed: numbers far apart, or nobody near anybody of the image before",
    )
    couples: tuple[tuple[int, int], ...] = Field(
        (), description="Partners that are known, by their numbers; who is in none gets a partner by nearness and size"
    )
    has_repair: bool = Field(
        True,
        description="Swapped sides, exchanged limbs and wild keypoints of a video are put right or masked; not where "
        "its frames are typically more than half a second apart",
    )

    @field_validator("couples")
    @classmethod
    def _check_couples(cls, couples: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
        people = [person for couple in couples for person in couple]
        if len(set(people)) < len(people):
            raise ValueError("a person is in two couples, or twice in one")
        return couples


@dataclass(frozen=True)
class SequencePeople:
    """Decisions about one sequence.

    Args:
        sequence_id: The sequence.
        num_people: People in it.
        pairs: Pairs of partners; empty if people have numbers within an image only.
        why_not_followed: Why people cannot be followed, if it is not a video; else empty.
        num_merged_rows: Number of doubled detections, and parts of people, that were merged.
        num_ghost_rows: Number of dropped detections.
        num_repaired_joints: Number of joints of op14 that were corrected or masked.
        num_renamed_rows: Number of detections whose person differs from that in the source.
        decisions: Identities for the table of people; empty for images whose people have no numbers over time.
        joined: Those decisions that join a track that ends where another begins.
    """

    sequence_id: str
    num_people: int
    pairs: tuple[NearPeople, ...]
    why_not_followed: str
    num_merged_rows: int = 0
    num_ghost_rows: int = 0
    num_repaired_joints: int = 0
    num_renamed_rows: int = 0
    decisions: tuple[Decision, ...] = ()
    joined: tuple[Decision, ...] = ()

    def in_words(self) -> str:
        """Describe it in a line."""
        words = [counted(self.num_people, "person")]
        words += [
            f"{pair.first} and {pair.second} are partners (near in {counted(pair.num_near, 'frame')})"
            for pair in self.pairs
        ]
        if self.why_not_followed:
            words.append(self.why_not_followed)
        counts = (
            (self.num_renamed_rows, "detections are somebody else than the source says"),
            (self.num_merged_rows, "doubled or split detections merged"),
            (self.num_ghost_rows, "detections dropped"),
            (self.num_repaired_joints, "joints repaired or masked"),
        )
        words += [f"{count} {what}" for count, what in counts if count]
        words += [pair.as_joined() for pair in self.joined]
        return f"{self.sequence_id}: {', '.join(words)}"


@dataclass(frozen=True)
class ResolvedPeople:
    """A source of 2D poses with resolved identities; rows sorted by sequence, frame and person.

    Args:
        frames: The remaining rows with persons and repaired keypoints.
        source_person_id: Number of each row's person in the source (row,).
        partner_id: The partner of each row's person (row,); -1 for nobody.
        op14: Keypoints (row, 14, 2) and confidences (row, 14), repaired.
        sequences: Decisions about each sequence, by name.
    """

    frames: AnnotatedFrames
    source_person_id: Integers
    partner_id: Integers
    op14: Keypoints
    sequences: tuple[SequencePeople, ...]


@dataclass(frozen=True)
class SequenceRows:
    """The rows of one sequence.

    Args:
        frame: (row,).
        person_id: (row,).
        keypoints_px: (row, K, 2) of the source's layout; NaN where not seen.
        confidence: (row, K); 0 where not seen.
        source_row: Index of each row in the source (row,).
    """

    frame: Integers
    person_id: Integers
    keypoints_px: Array
    confidence: Array
    source_row: Integers

    def chosen(self, rows: Integers | Flags) -> SequenceRows:
        """Return the selected rows."""
        return SequenceRows(*(getattr(self, column.name)[rows] for column in fields(self)))


@dataclass(frozen=True)
class ResolvedSequence:
    """One sequence with resolved identities: rows by frame and person, op14, partners (row,), -1 for nobody."""

    rows: SequenceRows
    op14: Keypoints
    partner_id: Integers
    decided: SequencePeople


def resolve_people(
    frames: AnnotatedFrames,
    settings: PeopleSettings | None = None,
    decisions: Sequence[Decision] = (),
    *,
    is_start: bool = False,
) -> ResolvedPeople:
    """Resolve identities in every sequence, repair the detector's faults, and find the pairs.

    Args:
        frames: The rows of a source, with their rate.
        settings: The settings.
        decisions: Decisions of the user, which are binding; those about other sequences are ignored.
        is_start: Whether the rows are only the start of longer sequences; then decisions about missing people or frames
            are ignored.

    Raises:
        InputError: The rate is unknown, nobody is left, or a decision is about missing people or frames.
    """
    if frames.rate_hz is None:
        raise InputError("people cannot be followed without the frame rate of the video")
    sequences = []
    sequence_of = np.array(frames.sequence_id, dtype=object)
    for name in sorted(set(frames.sequence_id)):
        at = np.flatnonzero(sequence_of == name)
        rows = SequenceRows(frames.frame[at], frames.person_id[at], frames.keypoints_px[at], frames.confidence[at], at)
        sequences.append(
            resolve_sequence(
                name,
                rows,
                KEYPOINT_LAYOUTS[frames.layout],
                rate_hz=frames.rate_hz,
                has_identities=frames.has_identities,
                settings=settings,
                decisions=[decision for decision in decisions if decision.sequence_id == name],
                is_start=is_start,
            )
        )
    if not sum(len(sequence.rows.frame) for sequence in sequences):
        raise NobodyError("no frame shows enough joints of a person")
    paired = {(pair.first, pair.second) for sequence in sequences for pair in sequence.decided.pairs}
    for couple in settings.couples if settings and not is_start else ():
        if tuple(sorted(couple)) not in paired:
            people = sorted({person for sequence in sequences for person in sequence.rows.person_id.tolist()})
            raise InputError(f"couple {list(couple)} is never seen together; persons: {', '.join(map(str, people))}")
    columns: dict[str, Any] = {
        field.name: np.concatenate([getattr(sequence.rows, field.name) for sequence in sequences])
        for field in fields(SequenceRows)
    }
    source_row = columns.pop("source_row")
    names = tuple(sequence.decided.sequence_id for sequence in sequences for _ in sequence.rows.frame)
    return ResolvedPeople(
        frames=replace(
            frames,
            sequence_id=names,
            status=None if frames.status is None else frames.status[source_row],
            **columns,
        ),
        source_person_id=frames.person_id[source_row],
        partner_id=np.concatenate([sequence.partner_id for sequence in sequences]),
        op14=Keypoints(
            np.concatenate([sequence.op14.positions for sequence in sequences]),
            np.concatenate([sequence.op14.confidence for sequence in sequences]),
        ),
        sequences=tuple(sequence.decided for sequence in sequences),
    )


def resolve_sequence(
    sequence_id: str,
    rows: SequenceRows,
    layout: KeypointLayout,
    *,
    rate_hz: float,
    has_identities: bool,
    settings: PeopleSettings | None = None,
    decisions: Sequence[Decision] = (),
    is_start: bool = False,
) -> ResolvedSequence:
    """Resolve the identities in one sequence; see `resolve_people`.

    Args:
        sequence_id: Its name.
        rows: The rows in the source.
        layout: Layout of the keypoints.
        rate_hz: Frames per second.
        has_identities: Whether a person has the same number in every frame.
        settings: The settings.
        decisions: Decisions of the user about this sequence.
        is_start: Whether the rows are only the start of a longer sequence.
    """
    settings = settings or PeopleSettings()
    is_followed = settings.identities == "follow" or (settings.identities == "auto" and not has_identities)
    op14 = layout.derive(OP14.name, rows.keypoints_px, rows.confidence)
    reason = why_no_video(rows.frame)
    if not reason and (is_followed or not has_identities):
        reason = why_not_followed(rows.frame, op14.positions, op14.confidence, rate_hz=rate_hz)
    has_numbers = has_identities or not reason
    merged = ghosts = repaired = renamed = 0
    joined: list[Decision] = []
    if settings.identities != "given" and not reason:
        given_id = None if is_followed else rows.person_id
        followed = follow_people(rows.frame, op14.positions, op14.confidence, rate_hz=rate_hz, given_id=given_id)
        person_id = followed.track_id if is_followed else _names_of(rows, followed.track_id)
        if is_followed:
            ghosts = followed.num_ghosts
        else:
            renamed = int(np.count_nonzero((person_id != rows.person_id) & (followed.twin < 0)))
        rows, merged = _merged(replace(rows, person_id=person_id), followed.twin), followed.num_merged
        rows = rows.chosen(rows.person_id >= 0)
        seen = layout.derive(OP14.name, rows.keypoints_px, rows.confidence)
        breaks = find_breaks(rows.frame, rows.person_id, seen.positions, seen.confidence, rate_hz=rate_hz)
        stated = {name for row in decisions for name in (row.person, row.is_person)}
        joined = join_breaks(sequence_id, [gap for gap in breaks if not {gap.before, gap.after} & stated])
    decided = decide(sequence_id, rows.frame, rows.person_id, [*decisions, *joined], is_start=is_start)
    spans = spans_of(sequence_id, rows.frame, rows.person_id, decided) if has_numbers else []
    rows = replace(rows, person_id=decided).chosen(decided >= 0)
    rows = rows.chosen(np.lexsort([rows.person_id, rows.frame]))
    op14 = layout.derive(OP14.name, rows.keypoints_px, rows.confidence)
    if settings.has_repair and not reason and typical_gap_s(rows.frame, rate_hz) <= MAX_REPAIR_GAP_S:
        keypoints_px, confidence, op14, repaired = repair_rows(
            rows.frame, rows.person_id, rows.keypoints_px, rows.confidence, op14, layout, rate_hz=rate_hz
        )
        rows = replace(rows, keypoints_px=keypoints_px, confidence=confidence)
    couples = [*(settings.couples if has_numbers else ()), *stated_couples(decisions)]
    pairs, partner = _partners(rows, op14, couples, has_identities=has_numbers)
    num_people = len(np.unique(rows.person_id))
    counts = (merged, ghosts, repaired, renamed)
    people = SequencePeople(sequence_id, num_people, tuple(pairs), reason, *counts, tuple(spans), tuple(joined))
    return ResolvedSequence(rows, op14, partner, people)


def _merged(rows: SequenceRows, twin: Integers) -> SequenceRows:
    """Merge rows into their twins (row,), -1 for none, and return the others."""
    keypoints_px, confidence = rows.keypoints_px.copy(), rows.confidence.copy()
    for row in np.flatnonzero(twin >= 0):
        both = np.array([twin[row], row])
        keypoints_px[both[0]], confidence[both[0]] = mean_of_two(keypoints_px[both], confidence[both])
    return replace(rows, keypoints_px=keypoints_px, confidence=confidence).chosen(twin < 0)


def _names_of(rows: SequenceRows, track_id: Integers) -> Integers:
    """Return the person of each row (row,), if the source numbers people over time but may confuse them.

    Tracks (row,) were followed with the numbers as evidence.  A track gets the most frequent number of its rows.
    Several tracks get one number only if they are never there together, so a person who returns keeps the number.
    """
    is_followed = track_id >= 0
    votes, counts = np.unique(np.stack([track_id, rows.person_id])[:, is_followed], axis=1, return_counts=True)
    taken = set(zip(rows.person_id[~is_followed].tolist(), rows.frame[~is_followed].tolist(), strict=True))
    person_id = rows.person_id.copy()
    named: set[int] = set()
    for vote in np.argsort(-counts, kind="stable"):
        track, name = votes[:, vote].tolist()
        places = {(name, at) for at in rows.frame[track_id == track].tolist()}
        if track not in named and not places & taken:
            person_id[track_id == track] = name
            named.add(track)
            taken |= places
    for track in sorted(set(track_id[is_followed].tolist()) - named):
        person_id[track_id == track] = int(person_id.max()) + 1
    return person_id


def _partners(
    rows: SequenceRows, op14: Keypoints, couples: Sequence[tuple[int, int]], *, has_identities: bool
) -> tuple[list[NearPeople], Integers]:
    """Return the pairs of a sequence, and each row's partner; without identities each image is paired alone.

    `couples` are the stated pairs.
    """
    partner = np.full(len(rows.frame), -1, dtype=np.int64)
    groups = [np.arange(len(rows.frame))]
    if not has_identities:
        groups = [np.flatnonzero(rows.frame == number) for number in np.unique(rows.frame)]
    pairs: list[NearPeople] = []
    for group in groups:
        seen = (rows.frame[group], rows.person_id[group], op14.positions[group], op14.confidence[group])
        pairs = choose_pairs(*seen, couples)
        for pair in pairs:
            for person, other in ((pair.first, pair.second), (pair.second, pair.first)):
                partner[group[rows.person_id[group] == person]] = other
    return (pairs if has_identities else []), partner
