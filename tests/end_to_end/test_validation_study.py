"""The study for film with ground truth, on a rendered film with a clock of its own; and beside the wrong take."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from flows.study_files import study_text
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.choreography.duets import make_duet
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.projections.sources import op14_from_working
from pasdedeux.skeletons import BODY22
from storage_schema import Store, read_latest
from tasks.stage.facts import TopicFacts
from tests.builders.real_study import build_here
from tests.builders.walkers_on_video import openpose

pytestmark = pytest.mark.slow

OFFSET_S, FILM_HZ, PITCH_DEG = 0.43, 24.0, 15.0


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with takes of two duets as npz, and OpenPose files of one of them, people in any order."""
    folder, rng = tmp_path_factory.mktemp("film"), np.random.default_rng(0)
    for name in ("waltz", "hug"):
        duet = make_duet(name, duration_s=3.0)
        positions = duet.positions_m()
        for person, letter in enumerate("AB"):
            np.savez(
                folder / f"{name}_{letter}.npz",
                positions_m=positions[:, person],
                joint_names=np.array(BODY22.joint_names),
                rate_hz=duet.rate_hz,
            )
        if name == "waltz":
            op14 = op14_from_working(positions, BODY22)
            camera = look_at_camera(
                mid_hip(op14).mean(axis=(0, 1)),
                distance_m=4.5,
                yaw_rad=0.6,
                pitch_rad=np.deg2rad(PITCH_DEG),
                focal_px=1300.0,
            )
            (folder / "keypoints").mkdir()
            for number in range(48):
                px = camera.project(op14[round((OFFSET_S + number / FILM_HZ) * duet.rate_hz)]).px
                text = openpose(rng.permutation(px + rng.normal(0.0, 2.0, px.shape)))
                (folder / "keypoints" / f"film_{number:012d}_keypoints.json").write_text(text)
    return folder


def build(film: Path, folder: Path, take: str) -> tuple[Store, TopicFacts, dict[tuple[str, str, str], float]]:
    """Build the study over the film with a duet as database; gives notes and scores of its reconstruction."""
    families = tomllib.loads(study_text("everyday", Path()))["ingest"]["pairs"]
    study = folder / "mine.toml"
    study.write_text(
        '[study]\nname = "mine"\nextends = "validation"\ntitle = "Mine"\n'
        '[ingest]\nduets = [{ name = "waltz", id = "other", count = 2, duration_s = 3 }]\n'
        + "".join(f"[ingest.pairs.{name}]\ntakes = []\n" for name in families)
        + "[projections]\npitches_deg = [0, 10, 20]\n"
    )
    build_here(
        study,
        folder / "store",
        f'ingest.takes.0.files=["{film / take}_A.npz", "{film / take}_B.npz"]',
        f"ingest.annotations.0.path={film / 'keypoints'}",
        f"ingest.annotations.0.rate_hz={FILM_HZ}",
        "ingest.annotations.0.image_size_px=[1920, 1080]",
    )
    store = Store(folder / "store")
    last = read_latest(store, "mine")
    assert last is not None
    (ref,) = (ref for ref in last.refs("evaluation") if store.manifest(ref).partition == "reconstruction")
    manifest = store.manifest(ref)
    scores = {}
    if "scores" in manifest.tables:
        table = store.read(ref, "scores")
        for metric, method, item, value in zip(*(table[n] for n in ("metric", "method", "item", "value")), strict=True):
            scores[str(metric), str(method), str(item)] = float(value)
    return store, TopicFacts.of(manifest), scores


def test_a_film_is_scored_against_its_take_and_not_against_another(film: Path, tmp_path: Path) -> None:
    _, facts, scores = build(film, tmp_path, "waltz")
    assert scores["clock_offset", "truth", "keypoints"] == pytest.approx(OFFSET_S, abs=0.03)
    assert scores["clock_rate", "truth", "keypoints"] == pytest.approx(1.0, abs=0.02)
    assert scores["camera_pitch_error", "level", "keypoints"] == pytest.approx(PITCH_DEG, abs=1.0)
    assert scores["image_residual", "truth", "keypoints"] < 0.02
    (note,) = facts.notes
    assert "is A" in note
    assert "is B" in note
    people = {item for metric, _, item in scores if metric == "error_root_kept"}
    assert people == {"keypoints person 0", "keypoints person 1"}
    for person in people:
        errors = {method: scores["error_root_kept", method, person] for method in ("nearest", "level", "fit_clean")}
        # The other waltz is the same dance of other bodies: the fit is near the truth, a level camera leans it back.
        assert errors["fit_clean"] < 0.12
        assert errors["fit_clean"] < errors["level"]
    pair = "keypoints person 0 with 1"
    assert scores["pair_place_error", "fit_clean", pair] < scores["pair_place_error", "level", pair] + 0.05
    assert ("pair_place_error", "equal_depth", pair) in scores
    _, facts, scores = build(film, tmp_path, "hug")
    assert not scores
    assert facts.notes[0].startswith("keypoints: under no camera and clock do the joints of the take lie on")
