"""`pasdedeux check` of a small folder: a good pair, each fault, one person alone, units, a file that cannot be read."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.check_faults import FAULTS, drift
from flows.console.app import run_command_line
from flows.dataset_folder import write_folder
from pasdedeux.augmentation import Augmenter
from pasdedeux.augmentation.variations import Variation
from pasdedeux.choreography.duets import make_duet
from pasdedeux.evaluation.motion_check import CheckedMotion
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.rigs.own_skeleton import ended
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import LAYOUTS
from storage_schema import Store
from tests.builders.browser import in_browser
from tests.builders.pages import Page
from tests.builders.stored_datasets import VARIANTS, put_dataset

SAID = {
    "floor offset": "people stand on floors",
    "floor tilt": "floor and people tilt",
    "foot slide": "the supporting feet slide",
    "first-frame jump": "out of its first frame",
    "swapped bodies": "jumps by",
    "wrong size": "tall by the legs",
    "penetration": "inside each other",
}


def people_of_waltz() -> tuple[np.ndarray, float]:
    """Return the positions (frame, 2, 22, 3) of four seconds of a waltz, metres, and their rate."""
    motions = [motion.resample(30.0) for motion in make_duet("waltz", duration_s=4.0).motions]
    return np.stack([derive_working_poses(motion, LAYOUTS["body22"]).body22_m for motion in motions], axis=1), 30.0


def write_waltz(folder: Path, *, metres_per_unit: float = 0.01, people: str = "AB") -> None:
    for letter, motion in zip("AB", make_duet("waltz", duration_s=4.0).motions, strict=True):
        text = write_bvh(ended(motion.resample(30.0)), units_per_metre=1 / metres_per_unit, decimals=5)
        if letter in people:
            (folder / f"{folder.name}_{letter}.bvh").write_text(text)


def write_positions(path: Path, people_m: np.ndarray, rate_hz: float) -> None:
    np.savez(path, positions_m=people_m, joint_names=np.array(BODY22.joint_names), rate_hz=rate_hz)


Checked = tuple[int, dict[str, Mapping[str, Any]]]
"""Exit code, and rows by name."""


def check(page_folder: Path, *arguments: object) -> Checked:
    """Run the command with --json, its page in a folder."""
    with redirect_stdout(io.StringIO()) as said:
        code = run_command_line(["check", *map(str, arguments), "--page", str(page_folder / "page.html"), "--json"])
    return code, {row["name"]: row for row in json.loads(said.getvalue())}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with everything."""
    folder = tmp_path_factory.mktemp("clips")
    for name, options in {"good": {}, "alone": {"people": "A"}, "inches": {"metres_per_unit": 0.0254}}.items():
        (folder / name).mkdir()
        write_waltz(folder / name, **options)  # type: ignore[arg-type]
    people, rate_hz = people_of_waltz()
    for number, (kind, plant) in enumerate(FAULTS.items()):
        planted = plant(people, rate_hz, np.random.default_rng(number))
        write_positions(folder / f"{kind.replace(' ', '-')}.npz", planted, rate_hz)
    write_positions(folder / "twins.npz", people[:, [0, 0]] + np.array([[0, 0, 0], [1.2, 0, 0]])[:, None], rate_hz)
    (folder / "cut.bvh").write_text((folder / "good" / "good_A.bvh").read_text()[:3000])
    (folder / "notes.txt").write_text("no motion")
    return folder


@pytest.fixture(scope="module")
def page_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("page")


@pytest.fixture(scope="module")
def checked(folder: Path, page_folder: Path) -> Checked:
    return check(page_folder, folder)


def test_every_fault_of_a_folder_is_named(checked: Checked) -> None:
    code, rows = checked
    assert code == 2, "a file cannot be read"
    assert rows["cut"]["verdict"] == "unreadable"
    assert (rows["good"]["verdict"], rows["good"]["reason"]) == ("pass", "")
    assert "one person only" in rows["alone_A"]["reason"]
    assert len(rows["alone_A"]["people"]) == 1
    assert "the same motion twice" in rows["twins"]["reason"]
    for kind, said in SAID.items():
        row = rows[kind.replace(" ", "-")]
        assert row["verdict"] in ("warn", "fail"), kind
        assert said in row["reason"], kind


def test_json_has_how_files_were_read_and_every_figure(folder: Path, tmp_path: Path) -> None:
    code, rows = check(tmp_path, folder / "good")
    assert code == 0
    row = rows["good"]
    assert row["num_contacts"] >= 1
    assert 0 < row["contact_share"] <= 1
    assert [Path(file).name for file in row["files"]] == ["good_A.bvh", "good_B.bvh"]
    read = {"format": "bvh", "layout": "body22", "rate_hz": 30.0, "metres_per_unit": 0.01, "up_axis": "y"}
    for person in row["people"]:
        assert {name: person[name] for name in read} == read
        assert {"stature_m", "jump_m", "tilt_rad", "floor_gap_m", "penetration_m", "twin_m"} <= person.keys()
    assert "source" not in row


def test_a_unit_is_told_by_the_bodies_or_by_the_option(folder: Path, tmp_path: Path) -> None:
    _, guessed = check(tmp_path, folder / "inches")
    _, stated = check(tmp_path, folder / "inches", "--unit", 0.0254)
    _, wrong = check(tmp_path, folder / "inches", "--unit", 0.0508)
    assert guessed["inches"]["people"][0]["metres_per_unit"] == pytest.approx(0.0254)
    assert stated["inches"]["verdict"] == "pass"
    assert "m tall by the legs" in wrong["inches"]["reason"]


UNIT = {"bvh_metres_per_unit": 0.022}


def test_the_npz_beside_an_exported_bvh_states_its_unit(tmp_path: Path) -> None:
    write_waltz(tmp_path, metres_per_unit=0.0254)
    for unit, options, metres in (({}, (), 0.0254), (UNIT, (), 0.022), (UNIT, ("--unit", 0.0254), 0.0254)):
        for path in sorted(tmp_path.glob("*.bvh")):
            np.savez(path.with_suffix(".npz"), **unit)
        _, rows = check(tmp_path, tmp_path, *options)
        (row,) = rows.values()
        assert [person["metres_per_unit"] for person in row["people"]] == pytest.approx([metres] * 2, rel=1e-3)


@pytest.mark.parametrize(("fail_on", "name", "code"), [(None, "twins", 0), ("warn", "good", 0), ("warn", "alone", 1)])
def test_fail_on_decides_the_exit_code(folder: Path, tmp_path: Path, fail_on: str | None, name: str, code: int) -> None:
    path = next(path for path in (folder / name, folder / f"{name}.npz") if path.exists())
    options = ["--fail-on", fail_on] if fail_on else []
    assert check(tmp_path, path, *options)[0] == code


@pytest.mark.parametrize(
    ("path", "said"), [("nowhere", "nowhere does not exist"), ("", "there are no motion files (.bvh")]
)
def test_bad_input_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str], path: str, said: str) -> None:
    assert run_command_line(["check", str(tmp_path / path)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1


def test_a_contact_that_drifts_is_found_against_its_source(tmp_path: Path) -> None:
    people, rate_hz = people_of_waltz()
    source = CheckedMotion("waltz", people, rate_hz).source
    scale = np.stack([np.ones(22), np.full(22, 0.9)])
    variant = Augmenter(source).solve([Variation("B", scale)])[0].positions_m
    drifting = drift(variant, source, np.random.default_rng(0))
    variants = {"waltz_good": variant, "waltz_drift": drifting, "waltz_short": variant[:-5], "judo": variant}
    for folder, motions in (("takes", {"waltz": people, "hug": people}), ("variants", variants)):
        (tmp_path / folder).mkdir()
        for name, positions_m in motions.items():
            write_positions(tmp_path / folder / f"{name}.npz", positions_m, rate_hz)
    code, rows = check(tmp_path, tmp_path / "variants", "--source", tmp_path / "takes")
    assert code == 2, "some have no source that fits"
    good = rows["waltz_good"]
    assert (good["verdict"], good["source"]) == ("pass", "waltz")
    assert good["against_source"]["contact_drift_m"] < 0.005
    assert good["against_source"]["worst_contact_m"] < 0.006
    assert rows["waltz_drift"]["verdict"] in ("warn", "fail")
    assert re.search(r"the contact of A \w+ and B \w+ drifts by 0\.\d+ m", rows["waltz_drift"]["reason"])
    assert "115 frames of 2 people at 30 Hz, its source waltz 120" in rows["waltz_short"]["reason"]
    assert "no source has a name that this begins with; sources: hug, waltz" in rows["judo"]["reason"]


@pytest.mark.parametrize(("moved_m", "said"), [(0.002, None), (0.02, "10 mm"), (0.1, "30 mm")])
def test_joints_between_joints_of_a_rig_may_move_on_their_bones_by_millimetres(
    moved_m: float, said: str | None
) -> None:
    people, rate_hz = people_of_waltz()
    wandering = people.copy()
    wandering[::3, :, 0, 1] += moved_m
    quality, _, verdict = CheckedMotion("waltz_B", wandering, rate_hz).held_against(
        CheckedMotion("waltz", people, rate_hz)
    )
    assert moved_m / 2 < quality.bone_error_m <= moved_m
    assert re.findall(r"bone error [0-9.]+ mm is above (\d+ mm)", verdict.reason) == ([said] if said else [])
    assert ("frames fail" in verdict.reason) == (moved_m > 0.03)


@pytest.mark.usefixtures("checked")
def test_the_page_shows_the_worst_in_players_at_any_width(page_folder: Path, tmp_path: Path) -> None:
    page = Page((page_folder / "page.html").read_text(encoding="utf-8"))
    assert (page.problems, page.outside, page.unnamed) == ([], [], [])
    assert 8 <= len(page.scenes) <= 10
    assert "unreadable" in page.cells
    probe = "return [document.documentElement.scrollWidth <= innerWidth, document.querySelectorAll('canvas').length]"
    for width in (1280, 400):
        answer = in_browser(page.text, probe, tmp_path, width=width)
        assert answer == {"found": [True, len(page.scenes)], "errors": []}


def test_the_folder_of_a_dataset_is_checked_with_its_own_sources(store: Store, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    write_folder(store, put_dataset(store, {"waltz": False}, num_frames=30), folder)
    code, rows = check(tmp_path, folder)
    assert code == 0
    assert rows.keys() == {"waltz", *(f"waltz/{name}" for name in VARIANTS)}
    same, larger = (rows[f"waltz/{VARIANTS[at]}"] for at in (0, 2))
    assert (same["source"], larger["source"]) == ("waltz", "waltz")
    assert same["against_source"]["contact_drift_m"] < 1e-6 < larger["against_source"]["contact_drift_m"]
    next((folder / "data" / "variants").iterdir()).write_bytes(b"PAR1")
    code, rows = check(tmp_path, folder)
    assert code == 2
    assert [row["verdict"] for row in rows.values()].count("unreadable") == len(VARIANTS)
