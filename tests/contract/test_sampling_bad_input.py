"""Annotations and seeds as they should not be: each has a defined outcome, and a sentence that says it."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.synthetic import standing_pair
from pasdedeux.errors import InputError
from pasdedeux.formats.pair_file import PairFile, write_pair_json
from pasdedeux.sampling.chain import proposal_from_json
from pasdedeux.sampling.parameters import PairChart, gauge_fix
from pasdedeux.sampling.proposals import PROPOSALS
from pasdedeux.sampling.proposals.blocks import GaussianBlocks, StepSizes
from pasdedeux.sampling.proposals.proposal import ProposalKind
from pasdedeux.skeletons import PAIR17
from storage_schema import Manifest, Store
from tests.builders.poses import block_indices
from tests.builders.sampling_store import NUM_FRAMES, plan_chains, put_annotations, put_take, run_chains, with_seeds
from tests.builders.storage_rows import having

SKIPPED = "of 40 annotations show too little or have no view, and were skipped"
OPTIONS: dict[str, Any] = {"num_chains": 1, "proposal": "velocity", "densities": ("ic",)}


def sampled(
    store: Store, spoil: Callable[[np.ndarray], None] = lambda _: None, *, has_one_view: bool = False, **seeds: Any
) -> list[Manifest]:
    """Sample from annotations that `spoil` changed: pixels (annotation, frame, person, joint, 2), middle one seen."""
    annotations, views = put_annotations(store, "one", spoil=spoil, has_one_view=has_one_view)
    tables = {"poses": [put_take(store, "one")], "annotations": [annotations], "views": [views]}
    return run_chains(store, with_seeds(store, tables, **(seeds or {"num_seeds": 1})), **OPTIONS)


def hiding(index: Any) -> Callable[[np.ndarray], None]:
    """Return what hides these of the pixels."""

    def spoil(pixels: np.ndarray) -> None:
        pixels[index] = np.nan

    return spoil


def note_of(store: Store, made: list[Manifest]) -> str:
    (summary,) = having("chain_info", made)
    table = store.read(summary.ref, "chain_info")
    assert np.isfinite(table["log_density_mean"][0])
    return str(table["note"][0])


@pytest.mark.parametrize(
    ("hidden", "note"),
    [
        # One annotation of the fixture lacks another joint already.
        (np.s_[:, 1, 0, 7], "$"),
        (np.s_[10:15, 1, 0, PAIR17.indices(("neck", "left_hip", "right_hip"))], f"5 {SKIPPED}$"),
        (np.s_[20:30, 1, 1], f"10 {SKIPPED}"),
        (np.s_[: NUM_FRAMES - 9, 1], "9 annotations are fewer than the 20 that a view should be compared with"),
        (np.s_[1:, 1], "1 annotation is fewer than the 20 that a view should be compared with"),
    ],
    ids=["one joint", "too many joints", "a person", "nearly all", "all but one"],
)
def test_what_does_not_show_is_masked_and_annotations_that_show_too_little_are_counted(
    store: Store, hidden: Any, note: str
) -> None:
    assert re.match(note, note_of(store, sampled(store, hiding(hidden))))


def test_without_any_annotation_of_two_people_the_reason_is_given(store: Store) -> None:
    with pytest.raises(InputError, match="none of the 40 annotated pairs shows half of the joints"):
        sampled(store, hiding(np.s_[:, :, 1]))


def test_identical_frames_have_no_speed_and_change_nothing_else(store: Store) -> None:
    """All annotations the same, and nothing moves: the velocity-biased proposal is the unbiased one."""

    def spoil(pixels: np.ndarray) -> None:
        pixels[:] = pixels[5, 1]

    made = sampled(store, spoil)
    assert note_of(store, made) == ""
    _, local = proposal_from_json(str(store.read(made[0].ref, "chain_states")["proposal_state"][0]))
    assert local is not None
    assert np.isfinite(np.asarray(store.read(made[0].ref, "draws")["log_density"])).all()


def test_annotations_all_from_one_view_are_used_and_said(store: Store) -> None:
    made = sampled(store, has_one_view=True)
    assert note_of(store, made).startswith("nearly all annotations see the pair from one side, within 0 degrees")
    views = [store.read(manifest.ref, "draws")["view"] for manifest in having("draws", made)]
    assert np.isfinite(np.concatenate(views)).all()


def test_asking_for_the_full_density_alone_without_annotations_is_refused(store: Store) -> None:
    given = with_seeds(store, {"poses": [put_take(store, "one")]}, num_seeds=1)
    with pytest.raises(InputError, match=r"chains\.densities asks for ic alone, but there are no annotated pairs"):
        plan_chains(given, **OPTIONS)


def test_a_seed_with_density_zero_is_named_with_the_term_and_the_amount(store: Store, tmp_path: Path) -> None:
    chart = PairChart(gauge_fix(standing_pair()))
    bent = chart.seed_parameters()
    for person in range(2):
        for name in ("left_ankle", "right_ankle", "left_wrist", "right_wrist", "head", "neck"):
            bent[block_indices(PAIR17.index(name) + 17 * person)[:2]] = [1.8, 0.5]
    path = tmp_path / "broken.json"
    path.write_text(write_pair_json(PairFile(chart.positions(bent), made_from="a bad idea")))
    message = r"seed 0 \(a bad idea\): the seed has density 0: the prior found \d+ joint angles out of range, \d+ more"
    with pytest.raises(InputError, match=message):
        sampled(store, num_seeds=0, files=[{"path": path}])


def test_a_chain_that_cannot_move_is_reported_as_stuck(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    far = StepSizes(root_rotation_rad=3.0, root_position_m=9.0, joint_rotation_rad=3.0, max_blocks=34)
    monkeypatch.setitem(PROPOSALS, "velocity", ProposalKind("velocity", lambda _: GaussianBlocks(far)))
    info = store.read(sampled(store)[-1].ref, "chain_info")
    assert info["verdict"][0] == "fail"
    assert info["reason"][0].startswith("stuck: 0.00% of the proposals were accepted")
