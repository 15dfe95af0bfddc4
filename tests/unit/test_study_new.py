"""A new study: valid TOML that ingest accepts, with guesses that say how sure they are."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from flows.console.study_new import new_study, write_new_study
from flows.study import load_study
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.guess import guess_motion
from tasks.graph import load_graph
from tasks.ingest import IngestParameters
from tasks.projections import ProjectionsParameters
from tasks.seeds import SeedsParameters
from tasks.seeds.parameters import GROWN_OF_2D_ALONE, LIFTED_OF_2D_ALONE
from tasks.views import ViewsParameters
from tests.builders.source_samples import bvh_text, csv_text, figure_motion, openpose_text


def ingest_of(text: str) -> IngestParameters:
    return IngestParameters.model_validate(tomllib.loads(text)["ingest"])


def test_without_files_it_is_a_study_of_the_built_in_duets() -> None:
    parameters = ingest_of(new_study("mine"))
    assert len(parameters.resolved_duets()) == 4


def test_two_files_become_a_pair_with_what_is_known_of_them(tmp_path: Path) -> None:
    for name in ("a one.bvh", "b.bvh"):
        (tmp_path / name).write_text(bvh_text(rate_hz=60.0))
    text = write_new_study(tmp_path / "my study.toml", [tmp_path / "a one.bvh", tmp_path / "b.bvh"])
    parameters = ingest_of(text)
    take = parameters.takes[0]
    assert [path.as_posix() for path in take.files] == ["a one.bvh", "b.bvh"]
    assert (take.layout, take.up_axis, take.rate_hz) == ("body22", "y", 60.0)
    assert [person.metres_per_unit for person in take.persons] == [0.01, 0.01]
    assert "files lie about this" in text
    assert tomllib.loads(text)["study"]["name"] == "my_study"
    with pytest.raises(InputError, match="is there already"):
        write_new_study(tmp_path / "my study.toml")


def test_a_unit_that_cannot_be_told_is_left_to_the_user(tmp_path: Path) -> None:
    path = tmp_path / "odd.bvh"
    path.write_text(write_bvh(figure_motion(), units_per_metre=7.0))
    text = new_study("odd", [path])
    assert "# metres_per_unit = 0.1" in text
    assert "A GUESS - SET IT" in text
    assert ingest_of(text).takes[0].persons[0].metres_per_unit is None


@pytest.mark.parametrize(("units_per_metre", "unit"), [(1.0, 1.0), (100.0, 0.01), (39.3701, 0.0254), (1000.0, 0.001)])
def test_known_units_are_told_from_the_size_of_the_body(units_per_metre: float, unit: float) -> None:
    guess = guess_motion(read_bvh(write_bvh(figure_motion(), units_per_metre=units_per_metre)))
    assert guess.unit.metres_per_unit == unit
    assert guess.unit.confidence >= 0.5
    assert guess.up.axis == "y"
    assert guess.up.confidence > 0.8


def test_folders_of_motion_are_paired_by_take_and_folders_of_json_are_annotations(tmp_path: Path) -> None:
    for name in ("60_01", "61_01", "60_02", "61_02", "62_03"):
        (tmp_path / f"{name}.bvh").write_text(bvh_text())
    walk = tmp_path / "walk"
    walk.mkdir()
    (walk / "w_000000000000_keypoints.json").write_text(openpose_text())
    (tmp_path / "table.csv").write_text(csv_text())
    parameters = ingest_of(new_study("s", [tmp_path, walk], base=tmp_path))
    assert [(take.id, len(take.files)) for take in parameters.takes] == [("60_01", 2), ("60_02", 2), ("62_03", 1)]
    assert {source.format for source in parameters.annotations} == {"openpose", "annotation_csv"}


def test_what_is_no_motion_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.bvh").write_text("hello")
    with pytest.raises(InputError, match=r"x.bvh: this file is none of the known formats"):
        new_study("s", [tmp_path / "x.bvh"])
    with pytest.raises(InputError, match="does not exist"):
        new_study("s", [tmp_path / "y.bvh"])


def test_salsa_files_are_known_to_lie_by_their_names(data_dir: Path) -> None:
    folder = data_dir / "cmu_salsa_bvh"
    text = new_study("salsa", [folder / "60_10.bvh", folder / "61_10.bvh"])
    assert 'layout = "cmu_daz"' in text
    assert "rate_hz = 60         # known of CMU's files; the header says 120" in text
    assert "metres_per_unit = 1.263   # known" in text
    assert "metres_per_unit = 1.191   # known" in text


def test_salsa_files_of_another_name_get_the_guess_and_the_doubt_they_deserve(data_dir: Path, tmp_path: Path) -> None:
    for name, other in (("60_10.bvh", "leader.bvh"), ("61_10.bvh", "follower.bvh")):
        (tmp_path / other).symlink_to(data_dir / "cmu_salsa_bvh" / name)
    text = new_study("salsa", [tmp_path / "leader.bvh", tmp_path / "follower.bvh"])
    assert "rate_hz = 120         # stated by the file" in text  # it lies: 60 Hz is true
    assert text.count("A GUESS - SET IT") == 2  # 1.29 m tall in metres: not believed


def test_2d_alone_gets_the_sections_that_make_3d_with_what_is_assumed_as_keys(tmp_path: Path) -> None:
    first = csv_text().splitlines()
    second = [line.replace(",0,", ",1,", 1) for line in first if line[0].isdigit()]
    (tmp_path / "table.csv").write_text("\n".join([*first, *second]))
    study = tmp_path / "mine.toml"
    write_new_study(study, [tmp_path / "table.csv"])
    chosen, _ = load_study(str(study), load_graph())
    views, seeds, projections = (chosen.parameters[name] for name in ("views", "seeds", "projections"))
    assert isinstance(views, ViewsParameters)
    assert views == ViewsParameters()
    assert {"distance_m", "camera_pitch_deg", "lean_deviation_deg"} <= views.model_fields_set
    assert chosen.asked >= {"views", "seeds", "chains", "lifting", "projections", "reconstruction"}
    assert isinstance(seeds, SeedsParameters)
    assert (seeds.num_lifted, seeds.num_grown) == (LIFTED_OF_2D_ALONE, GROWN_OF_2D_ALONE)
    assert isinstance(projections, ProjectionsParameters)
    assert projections.include_draws


def test_key_frames_are_lifted_and_no_motion_is_asked_of_them(tmp_path: Path) -> None:
    rows = [line for line in csv_text(60).splitlines() if not line[0].isdigit() or int(line.split(",")[0]) % 2 == 0]
    frames = [re.sub(r"^(\d+),", lambda found: f"{500 * int(found[1])},", line) for line in rows]
    second = [line.replace(",0,", ",1,", 1) for line in frames if line[0].isdigit()]
    (tmp_path / "keys.csv").write_text("\n".join([*frames, *second]))
    sections = tomllib.loads(new_study("keys", [tmp_path / "keys.csv"]))
    assert {"views", "seeds", "chains", "lifting"} <= set(sections)
    assert not {"projections", "reconstruction"} & set(sections)
