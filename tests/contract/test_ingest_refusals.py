"""What ingest refuses while it plans: spoiled, unequal, missing or changed files, and parameters that do not fit."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from pasdedeux.choreography.duets import duet_style
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh_writer import write_bvh
from storage_schema import Store
from tasks.ingest import STAGE, IngestParameters
from tests.builders.ingest_runs import planned, write_figure_pair
from tests.builders.source_samples import figure_motion


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    return write_figure_pair(tmp_path)


def put_a_folder_in_its_place(path: Path) -> None:
    path.unlink()
    path.mkdir()


def cut_the_last_frame(path: Path) -> None:
    head, _, row = path.read_text().rstrip().rpartition("\n")
    path.write_text(f"{head}\n{row[: len(row) // 2]}\n")


def shrink_a_bone_to_nothing(path: Path) -> None:
    text = path.read_text()
    offset = text.index("OFFSET", text.index("JOINT left_knee"))
    path.write_text(text[:offset] + "OFFSET 0 0 0" + text[text.index("\n", offset) :])


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (Path.unlink, "file .*/61_01.bvh does not exist"),
        (put_a_folder_in_its_place, ".*61_01.bvh is a folder, and a regular file is needed"),
        (cut_the_last_frame, r"61_01.bvh: line \d+.* values where 69 are needed"),
        (shrink_a_bone_to_nothing, "61_01.bvh: .*'left_hip' to 'left_knee' of 'pair17'"),
    ],
)
def test_a_bad_file_is_named_with_its_take_and_what_is_wrong(
    pair: tuple[Path, Path], spoil: Callable[[Path], object], says: str
) -> None:
    takes = [{"id": "dance", "files": list(pair)}]
    assert planned(takes=takes)
    spoil(pair[1])
    with pytest.raises(InputError, match=f"^take dance: {says}"):
        planned(takes=takes)


def test_files_of_unequal_length_are_refused_or_trimmed_when_the_study_says_so(pair: tuple[Path, Path]) -> None:
    pair[1].write_text(write_bvh(figure_motion(num_frames=30, rate_hz=60.0)))
    take = {"id": "d", "files": list(pair)}
    assert planned(takes=[take | {"on_unequal": "trim"}])[0].parameters.persons[1].num_frames == 30
    with pytest.raises(InputError, match=r'\(60_01.bvh 40 and 61_01.bvh 30 frames\); set on_unequal = "trim" to keep'):
        planned(takes=[take])
    with pytest.raises(InputError, match=r"frames from 0 to 35 are wanted, but 61_01.bvh has 30 frames"):
        planned(takes=[take | {"frames": [0, 35]}])


def test_frames_that_one_take_holds_out_and_another_learns_from_are_refused(pair: tuple[Path, Path]) -> None:
    learned = {"id": "learned", "files": list(pair), "frames": [0, 20]}
    held_out = {"id": "kept", "files": list(pair), "frames": [10, 30]}
    with pytest.raises(InputError, match=r"takes learned and kept share frames of 60_01.bvh, but only one .* held out"):
        planned(takes=[learned, held_out], held_out=["kept"])
    assert planned(takes=[learned, held_out | {"frames": [20, 40]}], held_out=["kept"])
    assert planned(takes=[learned, held_out])


def test_amc_and_bvh_of_one_cmu_performance_are_known_for_the_same(data_dir: Path) -> None:
    alone = {"id": "alone", "files": [data_dir / "cmu_asfamc" / "60_01.amc"], "rate_hz": 60}
    salsa = {"folder": data_dir / "cmu_salsa_bvh", "subjects": ["60", "61"], "id": "salsa_{take}"}
    with pytest.raises(InputError, match=r"alone and salsa_01 share frames of 60_01.amc, also 60_01.bvh, but only one"):
        planned(takes=[alone], pairs={"salsa": salsa | {"takes": ["01"]}}, held_out=["salsa_01"])
    assert planned(takes=[alone], pairs={"salsa": salsa | {"takes": ["02"]}}, held_out=["salsa_02"])


def test_an_unclear_unit_is_named(tmp_path: Path) -> None:
    strange = tmp_path / "strange.bvh"
    strange.write_text(write_bvh(figure_motion(), units_per_metre=7.0))
    with pytest.raises(InputError, match=r"its unit of length is unknown .*set metres_per_unit"):
        planned(takes=[{"id": "d", "files": [strange]}])


@pytest.mark.parametrize(
    ("section", "sentence"),
    [
        ({"held_out": ["waltzz"]}, "'waltzz' is not a take of this study; did you mean 'waltz'"),
        ({"duets": [{"name": "waltz"}, {"name": "waltz"}]}, "two takes are named 'waltz'"),
        (
            {"duets": [{"name": "waltz"}], "held_out": ["waltz"], "prior": ["waltz"]},
            "is held out and cannot be a prior",
        ),
        ({"duetts": []}, "Extra inputs are not permitted"),
        ({"takes": [{"id": "a/b", "files": ["x"]}]}, "should match pattern"),
        ({"takes": [{"id": "a", "files": ["x"], "frames": [5, 5]}]}, "one past the last"),
    ],
)
def test_parameters_that_do_not_fit_are_refused(section: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        IngestParameters.model_validate(section)


def test_an_unknown_duet_is_named() -> None:
    with pytest.raises(InputError, match="duet 'tango' is not known; known duets: waltz"):
        planned(duets=[{"name": "tango"}])


@pytest.mark.parametrize(
    ("style", "sentence"),
    [
        ({"heights_m": (1.7, 1.8, 1.9)}, "duet 'waltz': 3 heights are given for 2 people"),
        ({"stride": 0.2}, "duet 'waltz': stride is 0.2: Extra inputs are not permitted"),
        ({"speed": 9.0}, "duet 'waltz': speed is 9.0: Input should be less than or equal to"),
    ],
)
def test_a_style_that_a_duet_does_not_have_is_refused(style: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)):
        duet_style("waltz", **style)


def test_a_file_that_changes_after_planning_is_noticed(store: Store, pair: tuple[Path, Path]) -> None:
    shards = planned(takes=[{"id": "d", "files": list(pair)}])
    pair[0].write_text(pair[0].read_text() + "\n")
    with pytest.raises(InputError, match=r"60_01.bvh changed since the run was planned"):
        STAGE.run_shard(shards[0], store)
