"""`pasdedeux check` of a small folder: a good pair, each fault, one person alone, units, a file that cannot be read."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from benchmarks.check_faults import FAULTS, drift
from flows.console.app import run_command_line
from pasdedeux.augmentation import Augmenter
from pasdedeux.augmentation.variations import Variation
from pasdedeux.choreography.duets import make_duet
from pasdedeux.evaluation.motion_check import CheckedMotion
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.rigs.own_skeleton import ended
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import LAYOUTS
from tests.builders.browser import in_browser
from tests.builders.pages import Page
from tests.builders.rigs import RIGS

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
    return np.stack([derive_working_poses(one, LAYOUTS["body22"]).body22_m for one in motions], axis=1), 30.0


def write_waltz(folder: Path, *, metres_per_unit: float = 0.01, people: str = "AB") -> None:
    for letter, motion in zip("AB", make_duet("waltz", duration_s=4.0).motions, strict=True):
        text = write_bvh(ended(motion.resample(30.0)), units_per_metre=1 / metres_per_unit, decimals=5)
        if letter in people:
            (folder / f"{folder.name}_{letter}.bvh").write_text(text)


def write_positions(path: Path, people_m: np.ndarray, rate_hz: float) -> None:
    np.savez(path, positions_m=people_m, joint_names=np.array(BODY22.joint_names), rate_hz=rate_hz)


def check(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Mapping[str, Any]]]:
    """Run the command with --json, and give its exit code and its rows by name."""
    code = run_command_line(["check", *map(str, arguments), "--json"])
    said = capsys.readouterr()
    return code, {row["name"]: row for row in json.loads(said.out or "[]")}


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


def test_every_fault_of_a_folder_is_named(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, rows = check(capsys, folder, "--page", tmp_path / "page.html")
    assert code == 2, "a file cannot be read"
    assert rows.pop("cut")["verdict"] == "unreadable"
    assert (rows["good"]["verdict"], rows["good"]["reason"]) == ("pass", "")
    assert "one person only" in rows["alone_A"]["reason"]
    assert len(rows["alone_A"]["people"]) == 1
    assert "the same motion twice" in rows["twins"]["reason"]
    for kind, said in SAID.items():
        row = rows[kind.replace(" ", "-")]
        assert row["verdict"] in ("warn", "fail"), kind
        assert said in row["reason"], kind
    assert not (tmp_path / "check.html").exists()


def test_json_has_how_files_were_read_and_every_figure(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, rows = check(capsys, folder / "good", "--page", tmp_path / "page.html")
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


def test_a_unit_is_told_by_the_bodies_or_by_the_option(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    _, guessed = check(capsys, folder / "inches", "--page", page)
    _, stated = check(capsys, folder / "inches", "--page", page, "--unit", 0.0254)
    _, wrong = check(capsys, folder / "inches", "--page", page, "--unit", 0.0508)
    assert guessed["inches"]["people"][0]["metres_per_unit"] == pytest.approx(0.0254)
    assert stated["inches"]["verdict"] == "pass"
    assert "m tall by the legs" in wrong["inches"]["reason"]


@pytest.mark.parametrize(("beside", "metres"), [({}, 0.0254), ({"bvh_metres_per_unit": 0.022}, 0.022), (None, 0.0254)])
def test_the_npz_beside_an_exported_bvh_states_its_unit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], beside: Mapping[str, float] | None, metres: float
) -> None:
    write_waltz(tmp_path, metres_per_unit=0.0254)
    for path in sorted(tmp_path.glob("*.bvh")):
        if beside is None:
            path.with_suffix(".npz").write_text("no npz")
        else:
            np.savez(path.with_suffix(".npz"), **beside)
    _, rows = check(capsys, tmp_path, "--page", tmp_path / "page.html")
    (row,) = rows.values()
    assert [person["metres_per_unit"] for person in row["people"]] == pytest.approx([metres] * 2, rel=1e-3)
    _, rows = check(capsys, tmp_path, "--page", tmp_path / "page.html", "--unit", 0.0254)
    (row,) = rows.values()
    assert row["people"][0]["metres_per_unit"] == 0.0254


@pytest.mark.parametrize(("fail_on", "name", "code"), [(None, "twins", 0), ("warn", "good", 0), ("warn", "alone", 1)])
def test_fail_on_decides_the_exit_code(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], fail_on: str | None, name: str, code: int
) -> None:
    path = next(path for path in (folder / name, folder / f"{name}.npz") if path.exists())
    options = ["--fail-on", fail_on] if fail_on else []
    assert check(capsys, path, "--page", tmp_path / "page.html", *options)[0] == code


@pytest.mark.parametrize(
    ("path", "said"), [("nowhere", "nowhere does not exist"), ("", "there are no motion files (.bvh")]
)
def test_bad_input_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str], path: str, said: str) -> None:
    assert run_command_line(["check", str(tmp_path / path)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1


def test_a_contact_that_drifts_is_found_against_its_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    people, rate_hz = people_of_waltz()
    source = CheckedMotion("waltz", people, rate_hz).source
    scale = np.stack([np.ones(22), np.full(22, 0.9)])
    variant = Augmenter(source).solve([Variation("B", scale)])[0].positions_m
    for name in ("takes", "variants"):
        (tmp_path / name).mkdir()
    write_positions(tmp_path / "takes" / "waltz.npz", people, rate_hz)
    write_positions(tmp_path / "takes" / "hug.npz", people, rate_hz)
    write_positions(tmp_path / "variants" / "waltz_good.npz", variant, rate_hz)
    drifting = drift(variant, source, np.random.default_rng(0))
    write_positions(tmp_path / "variants" / "waltz_drift.npz", drifting, rate_hz)
    write_positions(tmp_path / "variants" / "waltz_short.npz", variant[:-5], rate_hz)
    write_positions(tmp_path / "variants" / "judo.npz", variant, rate_hz)
    options = ("--source", tmp_path / "takes", "--page", tmp_path / "page.html")
    code, rows = check(capsys, tmp_path / "variants", *options)
    assert code == 2, "some have no source that fits"
    assert rows["waltz_good"]["verdict"] == "pass"
    assert rows["waltz_good"]["source"] == "waltz"
    assert rows["waltz_good"]["against_source"]["contact_drift_m"] < 0.005
    assert rows["waltz_drift"]["verdict"] in ("warn", "fail")
    assert re.search(r"the contact of A \w+ and B \w+ drifts by 0\.\d+ m", rows["waltz_drift"]["reason"])
    assert rows["waltz_good"]["against_source"]["worst_contact_m"] < 0.006
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


def test_the_page_shows_the_worst_in_players_at_any_width(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "check.html"
    check(capsys, folder, "--page", path)
    page = Page(path.read_text(encoding="utf-8"))
    assert not page.problems
    assert not page.outside, "the page needs no other file"
    assert not page.unnamed
    assert 8 <= len(page.scenes) <= 10
    assert "unreadable" in page.cells
    probe = "return [document.documentElement.scrollWidth <= innerWidth, document.querySelectorAll('canvas').length]"
    for width in (1280, 400):
        answer = in_browser(page.text, probe, tmp_path, width=width)
        assert answer == {"found": [True, len(page.scenes)], "errors": []}


def test_the_naming_of_the_augmentation_paper_is_read_by_check_study_new_and_plan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head, _, frames = next(rig for rig in RIGS if rig.layout == "points17").bvh().partition("Frame Time")
    assert "RghtHand" in head
    time, *rows_of_a = frames.strip().splitlines()
    shifted = [f"{float(row.split()[0]) + 30} {row.split(maxsplit=1)[1]}" for row in rows_of_a]
    for letter, lines in (("A", rows_of_a), ("B", shifted)):
        (tmp_path / f"pair_{letter}.bvh").write_text("\n".join([f"{head}Frame Time{time}", *lines]) + "\n")
    code, rows = check(capsys, tmp_path, "--page", tmp_path / "page.html")
    assert code == 0
    person = rows["pair"]["people"][0]
    assert person["layout"] == "points17"
    assert person["metres_per_unit"] == pytest.approx(0.0254)
    assert person["stature_m"] == pytest.approx(1.7, abs=0.15)
    study = tmp_path / "mine.toml"
    files = [word for letter in "AB" for word in ("--from", str(tmp_path / f"pair_{letter}.bvh"))]
    assert run_command_line(["study", "new", str(study), *files]) == 0
    assert 'layout = "points17"' in study.read_text()
    study.write_text(study.read_text().replace("# metres_per_unit", "metres_per_unit"))
    assert run_command_line(["plan", str(study), "--store", str(tmp_path / "store")]) == 0
    assert "ingest" in capsys.readouterr().out


def write_dataset(folder: Path, clips: Mapping[str, np.ndarray]) -> None:
    """Write the folder of a dataset with a take and variants, a row group each, as docs/datasets.md has it."""
    table = []
    for kind in ("poses", "variants"):
        path = folder / "data" / kind / "train-00000-of-00001.parquet"
        path.parent.mkdir(parents=True)
        schema = pa.schema({"person": pa.int32(), "frame": pa.int32(), "body22_m": pa.list_(pa.float32(), 66)})
        with parquet.ParquetWriter(path, schema) as writer:
            own = {name: people for name, people in clips.items() if ("/" in name) == (kind == "variants")}
            for number, (name, people) in enumerate(own.items()):
                person, frame = np.meshgrid([0, 1], np.arange(len(people)), indexing="ij")
                order = np.lexsort((person.ravel(), frame.ravel())) if kind == "variants" else slice(None)
                values = people.swapaxes(0, 1).reshape(-1, 66)[order]
                arrays = [pa.array(person.ravel()[order], pa.int32()), pa.array(frame.ravel()[order], pa.int32())]
                arrays.append(pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), pa.float32()), 66))
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
                take, _, variant = name.partition("/")
                row = {"clip_id": name, "take_id": take, "variant_id": variant or None, "row_group": number}
                table.append({**row, "file": f"data/{kind}/{path.name}", "num_people": 2, "rate_hz": 30.0})
    (folder / "data" / "clips").mkdir()
    parquet.write_table(pa.Table.from_pylist(table), folder / "data" / "clips" / "train-00000-of-00001.parquet")


def test_the_folder_of_a_dataset_is_checked_with_its_own_sources(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    people, rate_hz = people_of_waltz()
    source = CheckedMotion("waltz", people, rate_hz).source
    drifting = drift(people, source, np.random.default_rng(0))
    write_dataset(tmp_path / "set", {"waltz": people, "waltz/same": people, "waltz/drift": drifting})
    code, rows = check(capsys, tmp_path / "set", "--page", tmp_path / "page.html")
    assert code == 0
    assert {name: row["verdict"] for name, row in rows.items()} == {
        "waltz": "pass",
        "waltz/same": "pass",
        "waltz/drift": rows["waltz/drift"]["verdict"],
    }
    assert rows["waltz/same"]["source"] == "waltz"
    (tmp_path / "set" / "data" / "variants" / "train-00000-of-00001.parquet").write_bytes(b"PAR1")
    code, rows = check(capsys, tmp_path / "set", "--page", tmp_path / "page.html")
    assert code == 2
    assert [row["verdict"] for row in rows.values()].count("unreadable") == 2
