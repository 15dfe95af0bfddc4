"""Two seconds of real salsa through every stage: people stand where they belong, nothing is mirrored or leaks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pasdedeux.skeletons import BODY22, OP14
from storage_schema import Store, open_table
from tests.builders.real_study import STUDIES, build_here

pytestmark = [pytest.mark.slow, pytest.mark.data]

NUM_FRAMES = 30
TAKES = ("salsa_01", "salsa_03")


@pytest.fixture(scope="module")
def store(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the study in this process."""
    store = tmp_path_factory.mktemp("salsa") / "store"
    build_here(STUDIES / "slice.toml", store, f"ingest.pairs.salsa.folder={data_dir / 'cmu_salsa_bvh'}")
    return store


def pairs(store: Path, take: str) -> np.ndarray:
    """Return the positions (frame, person, 22, 3) of a take."""
    poses = open_table(f"poses:slice/{take}", store)
    return poses["body22_m"].astype(np.float64).reshape(2, NUM_FRAMES, 22, 3).swapaxes(0, 1)


@pytest.mark.parametrize("take", TAKES)
def test_two_adults_dance_within_reach_with_their_feet_on_the_floor(store: Path, take: str) -> None:
    people = pairs(store, take)
    head, pelvis = BODY22.index("head"), BODY22.index("pelvis")
    feet = BODY22.indices(["left_toe", "right_toe", "left_ankle", "right_ankle"])
    assert np.all((people[:, :, head, 1] > 1.2) & (people[:, :, head, 1] < 1.95))
    lowest = people[:, :, feet, 1].min(axis=-1)
    assert np.all(lowest > -0.1)
    assert np.all(np.median(lowest, axis=0) < 0.15)
    apart = np.linalg.norm(people[:, 0, pelvis] - people[:, 1, pelvis], axis=-1)
    assert np.all((apart > 0.2) & (apart < 2.6))
    # At the true rate of 60 Hz nobody's hips are faster than a few metres a second; read as 120 Hz all would be double.
    speed = np.linalg.norm(np.diff(people[:, :, pelvis], axis=0), axis=-1) * 15.0
    assert speed.max() < 3.0


@pytest.mark.parametrize("take", TAKES)
def test_no_limb_is_mirrored(store: Path, take: str) -> None:
    """Toes point where the chest faces, and the left side is on the left of that."""
    people = pairs(store, take)
    left, right = (people[:, :, BODY22.index(f"{side}_hip")] for side in ("left", "right"))
    to_left = left - right
    forward = np.cross(to_left, [0.0, 1.0, 0.0])
    toes = sum(
        people[:, :, BODY22.index(f"{side}_toe")] - people[:, :, BODY22.index(f"{side}_ankle")]
        for side in ("left", "right")
    )
    assert np.mean((toes * forward).sum(-1) > 0) > 0.9
    shoulders = people[:, :, BODY22.index("left_shoulder")] - people[:, :, BODY22.index("right_shoulder")]
    assert np.mean((shoulders * to_left).sum(-1) > 0) > 0.9


def test_the_held_out_dancers_are_reconstructed_the_right_way_round(store: Path) -> None:
    motions = open_table("motions:slice", store)
    assert set(motions["sequence_id"]) == {"salsa_03.video00"}
    assert set(motions["person_id"]) == {0, 1}
    scores = open_table("scores:slice", store)
    is_error = (scores["topic"] == "reconstruction") & (scores["metric"] == "error_root_kept")
    last = list(dict.fromkeys(motions["method"]))[-1]
    errors = scores["value"][is_error & (scores["method"] == last)]
    assert len(errors) == 2
    assert np.all(errors < 0.35)
    rows = motions["method"] == last
    moved = motions["op14_m"][rows]
    assert np.mean(moved[:, OP14.index("head"), 1] > moved[:, OP14.index("left_ankle"), 1] + 0.8) > 0.95


def test_nothing_is_learned_from_the_held_out_take(store: Path) -> None:
    learned = {"torso_basis", "joint_limits", "seeds", "draws", "projections", "models"}
    made = [manifest for manifest in Store(store).artifacts() if learned & {*manifest.tables}]
    assert learned == {table for manifest in made for table in manifest.tables} & learned
    assert [manifest.name for manifest in made if "salsa_03" in manifest.facts["takes"]] == []


def test_variants_keep_contacts_better_than_plain_kinematics(store: Path) -> None:
    quality = open_table("variant_quality:slice", store)
    assert quality.num_rows == 8
    assert quality["bone_error_m"].max() < 1e-4
    is_touching = np.isfinite(quality["contact_drift_m"]) & (quality["num_contact_pairs"] > 0)
    assert is_touching.any()
    assert np.all(quality["contact_drift_m"][is_touching] < quality["contact_drift_fk_m"][is_touching])


def test_the_report_credits_the_database_and_has_a_clip_of_each_take(store: Path) -> None:
    (report,) = (store / "runs").glob("*/report")
    assert "NSF EIA-0196217" in (report / "card.md").read_text()
    assert "salsa_03 (held out for evaluation)" in (report / "card.md").read_text()
    assert {path.name for path in report.glob("clip-*")} == {f"clip-{take}.video00.player.json" for take in TAKES}
