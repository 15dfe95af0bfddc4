"""Read and apply tables of people: merge, rename, drop, split by frames; refuse bad rows in one sentence."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.errors import FormatError, InputError
from pasdedeux.people.decisions import Decision, decide, read_decisions, spans_of, write_decisions

HEADER = "sequence,first_frame,last_frame,person,is\n"
FRAME = np.repeat(np.arange(10), 3)
PERSON = np.tile([0, 1, 2], 10)


def decided(rows: str) -> np.ndarray:
    return decide("v", FRAME, PERSON, read_decisions(HEADER + rows)).reshape(10, 3)


@given(
    st.lists(
        st.tuples(st.integers(0, 9), st.integers(0, 2), st.integers(-1, 4)), unique_by=lambda row: row[:2], max_size=30
    )
)
def test_what_is_written_gives_the_same_people_again(rows: list[tuple[int, int, int]]) -> None:
    frame, person, is_person = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    kept = [(at, name) for at, _, name in rows if name >= 0]
    spans = read_decisions(write_decisions(spans_of("v", frame, person, is_person)))
    if len(set(kept)) < len(kept):
        with pytest.raises(InputError, match="cannot both be"):
            decide("v", frame, person, spans)
    else:
        np.testing.assert_array_equal(decide("v", frame, person, spans), is_person)


def test_people_are_dropped_renamed_split_and_merged() -> None:
    found = decided("v,0,9,2,nobody\nv,5,9,1,7\n")
    assert (found[:, 2] == -1).all()
    assert found[:, 1].tolist() == [1] * 5 + [7] * 5
    assert (found[:, 0] == 0).all()
    swapped = decided("v,4,9,0,1\nv,4,9,1,0\n")
    assert swapped[3:5, :2].tolist() == [[0, 1], [1, 0]]
    merged = decided("v,0,4,1,nobody\nv,5,9,0,nobody\nv,5,9,1,0\n")
    assert merged[:5, 0].tolist() == merged[5:, 1].tolist() == [0] * 5


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("v,0,9,5,0\n", "there is no person 5; persons: 0, 1, 2"),
        ("v,20,30,1,0\n", "person 1 is in none of these frames, but in 0 to 9"),
        ("v,2,3,1,0\n", "frame 2: persons 0 and 1 are both there and cannot both be 0; say 'nobody' of one"),
        ("v,3,2,1,0\n", "line 2: frames 3 to 2 end before they begin"),
        ("v,0,5,1,0\nv,5,9,1,0\n", "line 3: person 1 of 'v' is named twice in frame 5"),
        ("v,0,5,1\n", "line 2: 4 values where 5 are needed"),
        ("v,0,x,1,0\n", "line 2: last_frame"),
        ("v,0,5,1,-3\n", "line 2: is (a person or 'nobody') is -3; allowed: 0 to"),
        ("v,0,5,1,me\n", "line 2: is"),
    ],
)
def test_a_bad_row_gets_one_clear_sentence(rows: str, message: str) -> None:
    with pytest.raises(InputError, match=r"\A[^\n]*\Z") as caught:
        decided(rows)
    assert message in str(caught.value)


def test_another_table_is_refused() -> None:
    with pytest.raises(FormatError, match="line 1: column 'frame' is unknown or double; known: sequence, first_frame"):
        read_decisions("sequence,frame,person\n")
    with pytest.raises(FormatError, match="empty"):
        read_decisions(b"")
    assert read_decisions(HEADER) == []
    assert write_decisions([Decision("v", 0, 3, 1, -1)]) == HEADER + "v,0,3,1,nobody\n"
