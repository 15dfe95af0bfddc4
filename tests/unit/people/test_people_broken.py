"""Join a track to one that begins where it ends, if that is clear; a table of people overrules it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.people.broken import Break, find_breaks
from pasdedeux.people.decisions import Decision, decide
from pasdedeux.people.resolution import PeopleSettings, resolve_people
from tests.builders.walkers import walk


def rows(first: int, last: int, person_id: int, *, x_px: float = 0.0, size: float = 1.0, speed_px: float = 0.0) -> dict:
    """Return a walker's rows in these frames, 300 px tall, who moves across the image by so many pixels a frame."""
    frames = np.arange(first, last + 1)
    walker = walk(200, seed=2)[frames]
    walker = walker - walker.mean(axis=(0, 1))
    px = walker[..., :2] * [180.0, -180.0] * size + [900.0 + x_px, 500.0]
    px[..., 0] += speed_px * (frames - 60)[:, None]
    return {"frame": frames, "person_id": np.full(len(frames), person_id), "px": px}


def together(*people: dict) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in people]) for name in ("frame", "person_id", "px")}


def breaks(*people: dict) -> list[Break]:
    """Return the breaks in these rows at 24 Hz, all of whose joints are seen."""
    frame, person_id, px = together(*people).values()
    return find_breaks(frame, person_id, px, np.ones(px.shape[:2]), rate_hz=24.0)


def ends(*people: dict) -> list[tuple[int, int, bool]]:
    """Return who ends, who begins and whether it is clear."""
    return [(found.before, found.after, found.is_clear) for found in breaks(*people)]


def test_who_ends_and_goes_on_where_and_as_large_as_before_is_clearly_one_person() -> None:
    assert ends(rows(0, 40, 0), rows(0, 90, 1, x_px=400.0), rows(45, 90, 2)) == [(0, 2, True)]
    assert ends(rows(0, 50, 0, speed_px=5.0), rows(62, 110, 1, speed_px=5.0)) == [(0, 1, True)]


@pytest.mark.parametrize(
    ("leaving", "entering"),
    [
        (rows(0, 40, 0), [rows(45, 90, 1, x_px=150.0)]),
        (rows(0, 40, 0), [rows(45, 90, 1, size=1.3)]),
        (rows(0, 50, 0, speed_px=9.0), [rows(74, 110, 1, speed_px=-9.0, x_px=36.0)]),
        (rows(0, 40, 0), [rows(45, 90, 1, x_px=20.0), rows(46, 90, 2, x_px=-60.0)]),
    ],
    ids=["a little off", "larger", "walks the other way", "one of two"],
)
def test_who_may_be_the_one_who_ended_is_asked_about(leaving: dict, entering: list[dict]) -> None:
    assert ends(leaving, *entering) == [(0, 1, False)]


@pytest.mark.parametrize(
    "entering", [rows(45, 90, 2, x_px=400.0), rows(45, 90, 2, size=2.0), rows(130, 150, 2), rows(30, 90, 2)]
)
def test_who_begins_elsewhere_larger_much_later_or_at_the_same_time_is_somebody_else(entering: dict) -> None:
    assert ends(rows(0, 40, 0), entering) == []


def source(*people: dict) -> AnnotatedFrames:
    """Return rows as a detector that numbers people over time lists them."""
    frame, person_id, px = together(*people).values()
    seen, names = np.ones(px.shape[:2]), ("clip",) * len(frame)
    return AnnotatedFrames("op14", names, frame, person_id, px, seen, rate_hz=24.0, has_identities=True)


def test_a_person_lost_twice_is_one_and_the_table_of_people_says_so_and_overrules_it() -> None:
    seen = source(rows(0, 40, 0), rows(85, 110, 1), rows(150, 190, 2), rows(0, 190, 3, x_px=400.0))
    resolved = resolve_people(seen)
    assert set(resolved.frames.person_id.tolist()) == {0, 3}
    (sequence,) = resolved.sequences
    assert [decision.in_words() for decision in sequence.joined] == ["clip,85,110,1,0", "clip,150,190,2,0"]
    assert set(sequence.joined) < set(sequence.decisions)
    said = sequence.in_words()
    assert "0 ends where 2 begins, and is taken for the same person from frame 150 on" in said
    assert "clip,150,190,2,2" in said
    # Its words joined what was apart; the row that it gives takes them apart again, and leaves the other one joined.
    apart = resolve_people(seen, decisions=[Decision.from_words("clip,150,190,2,2")])
    assert set(apart.frames.person_id.tolist()) == {0, 2, 3}
    again = resolve_people(seen, decisions=sequence.decisions)
    np.testing.assert_array_equal(again.frames.person_id, resolved.frames.person_id)
    assert again.sequences[0].joined == ()
    given = resolve_people(seen, PeopleSettings(identities="given"))
    assert set(given.frames.person_id.tolist()) == {0, 1, 2, 3}


def test_rows_that_show_nobody_are_joined_with_the_others_and_never_two_of_one_frame() -> None:
    lost, found = rows(0, 110, 0), rows(85, 130, 2)
    lost["px"][41:] = np.nan
    assert set(resolve_people(source(lost, found)).frames.person_id.tolist()) == {0, 2}
    lost["px"][:] = rows(0, 110, 0)["px"]
    found["px"][:5] = found["px"][-5:] = np.nan
    lost = {name: values[:41] for name, values in lost.items()}
    (sequence,) = resolve_people(source(lost, found)).sequences
    assert [decision.in_words() for decision in sequence.joined] == ["clip,85,130,2,0"]


def test_the_row_of_a_break_joins_it() -> None:
    people = rows(0, 40, 0), rows(45, 90, 2, x_px=150.0)
    (asked,) = breaks(*people)
    frame, person_id, _ = together(*people).values()
    assert set(decide("clip", frame, person_id, [asked.joined("clip")])) == {0}
    assert replace(asked, is_clear=True).joined("clip") == Decision.from_words("clip,45,90,2,0")
