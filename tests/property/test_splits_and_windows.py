"""Draw stores and test that no model learns from a tested interaction, and that windows hold their frames."""

from __future__ import annotations

import tempfile
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pasdedeux.errors import InputError
from storage_schema import ArtifactRef, Manifest
from tasks.data import Data
from tasks.evaluation.downstream import OneTraining, split_takes
from tasks.training.items import interaction_of
from tasks.windows import PairDataset, SplitName
from tests.builders.drawn_stores import Drawn, aside, drawn_store, motion
from tests.builders.storage_rows import take_rows

pytestmark = pytest.mark.usefixtures("own_cache")

TAKES = st.lists(
    st.builds(
        Drawn,
        interaction=st.sampled_from(["waltz", "hug", "push", ""]),
        num_frames=st.integers(2, 9),
        is_held_out=st.booleans(),
        verdicts=st.lists(st.sampled_from(["pass", "warn", "fail"]), min_size=1, max_size=2).map(tuple),
    ),
    min_size=1,
    max_size=8,
)


def planned_take(number: int, drawn: Drawn) -> Manifest:
    """Return a take as planning sees it, from no store."""
    name = f"take-{number}"
    _, facts = take_rows(name, 2, drawn.num_frames, is_held_out=drawn.is_held_out)
    parameters = {"duet": {"name": drawn.interaction}} if drawn.interaction else {}
    ref = ArtifactRef("ingest", f"{number:064x}", "0" * 64)
    versions = {"schema_version": 1, "code_version": "", "source_digest": "", "package_versions": {}}
    return Manifest(ref, name, name, 1, parameters, 0, (), (), {}, {}, facts, (), **versions)


@given(takes=TAKES, window=st.integers(1, 4), by=st.sampled_from(["take", "interaction"]), seed=st.integers(0, 3))
@settings(max_examples=12)
def test_nothing_that_stays_together_is_on_two_sides_and_no_group_of_a_held_out_take_is_learned_from(
    takes: list[Drawn], window: int, by: Any, seed: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        store, _ = drawn_store(folder, takes)
        sides: dict[str, set[int]] = {}
        for split in get_args(SplitName):
            try:
                items = PairDataset("variants:drawn", window, split, store=store, by=by, seed=seed)
            except InputError:
                continue  # nothing is on this side
            names = items[range(len(items))]["name"]
            shown = {
                (int(take.removeprefix("take-")), int(variant.removeprefix("v")))
                for take, _, variant in (name.partition(", ") for name in names)
            }
            assert all(takes[number].verdicts[variant] != "fail" for number, variant in shown)
            sides[split] = {number for number, _ in shown}
    groups = [
        drawn.interaction if by == "interaction" and drawn.interaction else number for number, drawn in enumerate(takes)
    ]
    usable = {number for number, drawn in enumerate(takes) if set(drawn.verdicts) != {"fail"}}
    held_out = {number for number in usable if takes[number].is_held_out}
    tested = {groups[number] for number in held_out}
    seen: dict[Any, str] = {}
    for split, numbers in sides.items():
        for number in numbers:
            assert seen.setdefault(groups[number], split) == split
            assert groups[number] not in tested or number in held_out, "it is a performance of what is tested"
    long_enough = {number for number in usable if takes[number].num_frames >= window}
    if tested:
        assert sides.get("test", set()) & long_enough == held_out & long_enough
    free = {group for number, group in enumerate(groups) if number in usable and group not in tested}
    placed = [number for numbers in sides.values() for number in numbers]
    assert set(placed) & long_enough <= {number for number in usable if groups[number] in free or number in held_out}
    assert len(placed) == len(set(placed))


@given(
    takes=TAKES.filter(lambda takes: any(set(drawn.verdicts) != {"fail"} for drawn in takes)),
    window=st.integers(1, 4),
    stride=st.integers(1, 5),
)
@settings(max_examples=8)
def test_the_nth_window_holds_the_frames_of_its_take_variant_and_contacts(
    takes: list[Drawn], window: int, stride: int
) -> None:
    takes = [Drawn(drawn.interaction, drawn.num_frames, True, drawn.verdicts) for drawn in takes]  # all on one side
    expected = [
        (number, index, start)
        for number, drawn in enumerate(takes)
        for index, verdict in enumerate(drawn.verdicts)
        if verdict != "fail"
        for start in range(0, drawn.num_frames - window + 1, stride)
    ]
    with tempfile.TemporaryDirectory() as folder:
        store, _ = drawn_store(folder, takes)
        if not expected:
            return
        items = PairDataset("variants:drawn", window, "test", store=store, stride=stride)
        assert len(items) == len(expected)
        rows = {clip.name: clip.contacts for clip in Data(store).takes("drawn")}
        for at in [*range(len(expected)), 0]:
            number, index, start = expected[at]
            item = items[at]
            frames = slice(start, start + window)
            pair = motion(number, takes[number].num_frames)[frames]
            assert (item["name"], item["start"]) == (f"take-{number}, v{index}", start)
            np.testing.assert_allclose(item["source"], pair, atol=1e-6)
            np.testing.assert_allclose(item["positions"], pair + aside(index), atol=1e-6)
            wanted = np.zeros((window, 22, 22))
            contacts = rows[f"take-{number}"]
            columns = (contacts.frame, contacts.person, contacts.bone, contacts.weight)
            for frame, person, bone, weight in zip(*columns, strict=True):
                if frames.start <= frame < frames.stop and set(person) == {0, 1}:
                    a, b = bone[np.argsort(person)]
                    wanted[frame - start, a, b] = max(wanted[frame - start, a, b], weight)
            np.testing.assert_allclose(item["contacts"][:, 0], wanted, atol=1e-6)


@given(
    takes=TAKES,
    seen=st.sets(st.integers(0, 7)),
    shares=st.sampled_from(["80/10/10", "50/20/30"]),
    seed=st.integers(0, 3),
)
@settings(max_examples=40)
def test_a_repetition_never_learns_from_what_it_tests_and_never_tests_what_a_model_saw(
    takes: list[Drawn], seen: set[int], shares: str, seed: int
) -> None:
    names = {f"take-{number}" for number, drawn in enumerate(takes) if number in seen and not drawn.is_held_out}
    options = OneTraining.model_construct(shares=shares, seed=0, seen=tuple(names))
    manifests = [planned_take(number, drawn) for number, drawn in enumerate(takes)]
    train, test = (
        {take.name for take in side} for side in split_takes(manifests, options, np.random.default_rng(seed))
    )
    held_out = {f"take-{number}" for number, drawn in enumerate(takes) if drawn.is_held_out}
    assert not train & test
    assert not train & held_out
    assert not test & names
    for kind in {interaction_of(take) for take in manifests}:
        performances = {take.name for take in manifests if interaction_of(take) == kind}
        num_test = max(round({"80/10/10": 0.1, "50/20/30": 0.3}[shares] * len(performances)), 1)
        unseen, saved = performances - names, performances & held_out
        assert len(test & performances) == min(num_test, len(unseen))
        assert len(test & saved) == min(num_test, len(saved)), "held-out takes are the first to be tested"
