"""The table of people: decisions on identities, which users can read, edit and return.

A row maps a person, by the number from following (or from the source), to an identity for some frames::

    sequence,first_frame,last_frame,person,is
    clip1,0,299,0,0
    clip1,0,119,1,1
    clip1,120,299,1,2
    clip1,40,61,3,nobody

Both frames are included.  Two ids of one person get the same number in `is`; an id of two people gets a row for each
part; `nobody` drops a person.  Persons without a row do not change.  The optional column `partner` states the partner
of a person, by the number of the partner in `is`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Integers
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.text import Lines, parse_integer, shorten
from pasdedeux.plain_text import csv_line, from_cell

COLUMNS = ("sequence", "first_frame", "last_frame", "person", "is")
PARTNER = "partner"
NOBODY = "nobody"
_MAX_LISTED = 20


@dataclass(frozen=True)
class Decision:
    """The identity of a person of a sequence in the frames from `first_frame` to `last_frame`; -1 for nobody.

    `partner` is the stated partner, None if none is stated.
    """

    sequence_id: str
    first_frame: int
    last_frame: int
    person: int
    is_person: int
    partner: int | None = None

    @classmethod
    def from_words(cls, row: str) -> Decision:
        """Parse a row of `in_words`."""
        (decision,) = read_decisions(f"{','.join(COLUMNS)}\n{row}")
        return decision

    def in_words(self) -> str:
        """Return it as a row of the table, without partner."""
        name = NOBODY if self.is_person < 0 else str(self.is_person)
        return csv_line(self.sequence_id, self.first_frame, self.last_frame, self.person, name)

    def as_joined(self) -> str:
        """Describe a decision of the program, with the row that would revert it."""
        apart = replace(self, is_person=self.person)
        return (
            f"{self.is_person} ends where {self.person} begins, and is taken for the same person from frame "
            f"{self.first_frame} on; else say so in the table of people: {apart.in_words()}"
        )


def read_decisions(data: bytes | str) -> list[Decision]:
    """Read the table of people."""
    decisions: list[Decision] = []
    with Lines(data, "table of people") as lines:
        for row in lines.table(COLUMNS, (*COLUMNS, PARTNER))[1]:
            first, last, person = (parse_integer(row[name], name) for name in COLUMNS[1:4])
            is_person = -1 if row["is"].lower() == NOBODY else parse_integer(row["is"], f"is (a person or '{NOBODY}')")
            if last < first:
                raise FormatError(f"frames {first} to {last} end before they begin")
            partner = parse_integer(row[PARTNER], PARTNER) if row.get(PARTNER) else None
            decision = Decision(from_cell(row["sequence"]), first, last, person, is_person, partner)
            for other in decisions:
                is_same = (other.sequence_id, other.person) == (decision.sequence_id, decision.person)
                if is_same and other.first_frame <= last and first <= other.last_frame:
                    raise FormatError(
                        f"person {person} of '{shorten(decision.sequence_id)}' is named twice in frame "
                        f"{max(first, other.first_frame)}"
                    )
            decisions.append(decision)
    return decisions


def check_sequences(decisions: Sequence[Decision], known: Collection[str]) -> None:
    """Refuse decisions about unknown sequences."""
    for row in decisions:
        if row.sequence_id not in known:
            raise InputError(
                f"people, row '{row.in_words()}': there is no such sequence; sequences: "
                f"{', '.join(sorted(known)[:_MAX_LISTED])}"
            )


def write_decisions(decisions: Iterable[Decision]) -> str:
    """Return decisions as the table of people."""
    return "".join(f"{row}\n" for row in (",".join(COLUMNS), *(decision.in_words() for decision in decisions)))


def stated_couples(decisions: Iterable[Decision]) -> list[tuple[int, int]]:
    """Return the couples stated in decisions about one sequence, each once, the smaller number first.

    Raises:
        InputError: A person would have two partners, or be their own partner, or is nobody.
    """
    couples: dict[int, int] = {}
    for row in decisions:
        if row.partner is None:
            continue
        for person, partner in ((row.is_person, row.partner), (row.partner, row.is_person)):
            if min(person, partner) < 0 or person == partner or couples.setdefault(person, partner) != partner:
                also = couples.get(person, partner)
                other = f" and of {also}" if also != partner else ""
                where = f"people of '{row.sequence_id}', row '{row.in_words()}'"
                raise InputError(f"{where}: {person} cannot be the partner of {partner}{other}")
    return sorted({(min(both), max(both)) for both in couples.items()})


def decide(
    sequence_id: str, frame: Integers, person_id: Integers, decisions: Sequence[Decision], *, is_start: bool = False
) -> Integers:
    """Return the identity of each row (row,) of a sequence, -1 for nobody.

    If the rows are only the start of a sequence, decisions about other people and frames are ignored.

    Raises:
        InputError: A decision is about people or frames that are not there, or two people would be one in a frame.
    """
    decided = person_id.copy()
    people = [int(number) for number in np.unique(person_id)]
    for decision in decisions:
        is_meant = (frame >= decision.first_frame) & (frame <= decision.last_frame) & (person_id == decision.person)
        decided[is_meant] = decision.is_person
        if is_start or is_meant.any():
            continue
        where = f"people of '{sequence_id}', row '{decision.in_words()}'"
        if decision.person not in people:
            raise InputError(f"{where}: there is no person {decision.person}; persons: {', '.join(map(str, people))}")
        at = frame[person_id == decision.person]
        raise InputError(
            f"{where}: person {decision.person} is in none of these frames, but in {at.min()} to {at.max()}"
        )
    order = np.lexsort([decided, frame])
    order = order[decided[order] >= 0]
    for before, after in pairwise(order):
        if frame[before] == frame[after] and decided[before] == decided[after]:
            raise InputError(
                f"people of '{sequence_id}', frame {frame[after]}: persons {person_id[before]} and {person_id[after]} "
                f"are both there and cannot both be {decided[after]}; say '{NOBODY}' of one of them in these frames"
            )
    return decided


def spans_of(sequence_id: str, frame: Integers, person_id: Integers, is_person: Integers) -> list[Decision]:
    """Return decisions that map each person (row,) to their identity (row,), one per span without change."""
    spans = []
    for person in np.unique(person_id):
        rows = np.flatnonzero(person_id == person)
        rows = rows[np.argsort(frame[rows], kind="stable")]
        cuts = np.flatnonzero(np.diff(is_person[rows])) + 1
        for part in np.split(rows, cuts):
            spans.append(
                Decision(sequence_id, int(frame[part[0]]), int(frame[part[-1]]), int(person), int(is_person[part[0]]))
            )
    return spans
