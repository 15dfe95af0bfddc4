"""A new study: valid TOML that ingest accepts, with guesses that say how sure they are."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from flows.console.study_new import _drafted, write_new_study
from flows.study import load_study
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh import read_bvh
from pasdedeux.formats.bvh_writer import write_bvh
from tasks.graph import load_graph
from tasks.ingest import IngestParameters
from tasks.ingest.takes.known_sources import note_fetched
from tasks.ingest.takes.parameters import TakeParameters
from tasks.projections import ProjectionsParameters
from tasks.seeds import SeedsParameters
from tasks.seeds.parameters import GROWN_OF_2D_ALONE, LIFTED_OF_2D_ALONE
from tasks.views import ViewsParameters
from tests.builders.command_line import CommandLine
from tests.builders.guesses import guess_motion
from tests.builders.ingest_runs import planned
from tests.builders.own_sources import write_walk
from tests.builders.painted_film import write_keys
from tests.builders.rendered_film import write_film
from tests.builders.rigs import RIGS, Rig
from tests.builders.source_samples import bvh_text, figure_motion, pair_csv_text
from tests.builders.tiny_networks import movenet


class New(NamedTuple):
    """A study that was written: its text, its section `ingest`, and what was said of the files."""

    text: str
    ingest: IngestParameters
    said: list[str]


def new_study(*files: Path, name: str = "mine") -> New:
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.toml"
        said = write_new_study(path, files)
        text = path.read_text(encoding="utf-8")
    return New(text, IngestParameters.model_validate(tomllib.loads(text)["ingest"]), said)


def write_odd(path: Path, units_per_metre: float = 7.0) -> Path:
    """Write a motion in a unit that nobody uses."""
    path.write_text(write_bvh(figure_motion(), units_per_metre=units_per_metre))
    return path


def write_motions(folder: Path, **num_frames: int) -> list[Path]:
    """Write motions of so many frames, by their names."""
    paths = [folder / f"{name}.bvh" for name in num_frames]
    for path, count in zip(paths, num_frames.values(), strict=True):
        path.write_text(bvh_text(num_frames=count))
    return paths


def test_without_files_it_is_a_study_of_the_built_in_duets() -> None:
    parameters = new_study().ingest
    assert len(parameters.resolved_duets()) == 4


def test_two_files_become_a_pair_with_what_is_known_of_them(tmp_path: Path) -> None:
    for number, name in enumerate(("a one.bvh", "b.bvh")):
        (tmp_path / name).write_text(bvh_text(rate_hz=60.0, seed=number))
    write_new_study(tmp_path / "my study.toml", [tmp_path / "a one.bvh", tmp_path / "b.bvh"])
    text = (tmp_path / "my study.toml").read_text()
    take = IngestParameters.model_validate(tomllib.loads(text)["ingest"]).takes[0]
    assert (take.id, [path.as_posix() for path in take.files]) == ("a_one", ["a one.bvh", "b.bvh"])
    assert (take.layout, take.up_axis, take.rate_hz) == ("body22", "y", 60.0)
    assert [person.metres_per_unit for person in take.persons] == [0.01, 0.01]
    assert "stated rates are often wrong" in text
    assert tomllib.loads(text)["study"]["name"] == "my_study"
    with pytest.raises(InputError, match="already exists"):
        write_new_study(tmp_path / "my study.toml")


def test_what_is_said_of_a_file_has_its_length_and_names_stay_as_they_are_written(tmp_path: Path) -> None:
    (tmp_path / "T\u00e4nzer.bvh").write_text(bvh_text(num_frames=90, rate_hz=60.0))
    written = new_study(tmp_path / "T\u00e4nzer.bvh")
    assert 'T\u00e4nzer.bvh"' in written.text
    assert re.fullmatch(r"found T\u00e4nzer\.bvh: 90 frames \(1\.5 s at 60 Hz\), about 1\.\d\d m tall", written.said[0])
    amc = new_study(write_walk(tmp_path))
    assert " s at 120 Hz), about " in amc.said[0], "CMU's of this name has it"


@pytest.mark.parametrize("name", ["odd", "odd\nseed = 7 #\x1b"])
def test_a_unit_that_cannot_be_told_is_left_to_the_user_and_names_stay_in_notes(tmp_path: Path, name: str) -> None:
    written = new_study(write_odd(tmp_path / f"{name}.bvh"))
    assert "# metres_per_unit = 0.1" in written.text
    assert "A GUESS - SET IT" in written.text
    assert "\nseed = 7" not in written.text
    assert written.ingest.takes[0].persons[0].metres_per_unit is None


def test_the_npz_beside_an_exported_bvh_states_its_unit(tmp_path: Path) -> None:
    path = write_odd(tmp_path / "odd.bvh")
    np.savez(path.with_suffix(".npz"), bvh_metres_per_unit=1.0 / 7.0)
    written = new_study(path)
    assert "# stated by the npz beside it: sure" in written.text
    assert re.search(r"about 1\.7\d m tall", written.said[0])
    assert written.ingest.takes[0].persons[0].metres_per_unit == pytest.approx(1.0 / 7.0, rel=1e-9)


@pytest.mark.parametrize(("units_per_metre", "unit"), [(1.0, 1.0), (100.0, 0.01), (39.3701, 0.0254), (1000.0, 0.001)])
def test_known_units_are_told_from_the_size_of_the_body(units_per_metre: float, unit: float) -> None:
    guess = guess_motion(read_bvh(write_bvh(figure_motion(), units_per_metre=units_per_metre)))
    assert guess.unit.metres_per_unit == unit
    assert guess.unit.confidence >= 0.5
    assert guess.up.axis == "y"
    assert guess.up.confidence > 0.8


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("\n", r"x.bvh: this file is empty$"),
        ("hello", r"x.bvh: this file is none of the known formats"),
        (None, "does not exist"),
    ],
)
def test_what_is_no_motion_is_refused(tmp_path: Path, text: str | None, sentence: str) -> None:
    if text is not None:
        (tmp_path / "x.bvh").write_text(text)
    with pytest.raises(InputError, match=sentence):
        new_study(tmp_path / "x.bvh")


@pytest.mark.parametrize("second", [0, 1])
def test_one_file_for_two_people_is_refused(tmp_path: Path, invoke: CommandLine, second: int) -> None:
    files = write_motions(tmp_path, a=12, b=12)
    said = invoke.refusal("study", "new", tmp_path / "mine.toml", "--from", files[0], "--from", files[second])
    assert f"{files[second].name} are identical" in said
    assert not (tmp_path / "mine.toml").exists()


def test_files_of_two_takes_are_doubted_and_not_trimmed(tmp_path: Path) -> None:
    written = new_study(*write_motions(tmp_path, **{"60_01": 40, "61_02": 60}))
    said = "\n".join(written.said)
    assert "found 60_01.bvh: 40 frames" in said
    assert 'in doubt: on_unequal = "trim": the files have 40 and 60 frames: ARE THEY OF ONE TAKE? Then' in said
    assert "on_unequal" not in tomllib.loads(written.text)["ingest"]["takes"][0]


def test_a_frame_more_or_less_is_one_take(tmp_path: Path) -> None:
    written = new_study(*write_motions(tmp_path, a=100, b=99))
    assert written.ingest.takes[0].on_unequal == "trim"
    assert written.said[2:] == [
        'in doubt: on_unequal = "trim": the files have 100 and 99 frames: ARE THEY OF ONE TAKE?'
    ]


def test_a_giant_is_doubted(tmp_path: Path) -> None:
    written = new_study(write_odd(tmp_path / "tall.bvh", units_per_metre=121.0))
    doubt = "in doubt: metres_per_unit = 0.01: tall.bvh: in units of one centimetre the body is 2.08 m tall"
    assert doubt in "\n".join(written.said)
    assert re.search(r"metres_per_unit = 0.01 .*A GUESS - CHECK IT", written.text)
    assert "likely" not in written.text


def test_a_rate_that_only_a_name_tells_is_doubted(tmp_path: Path) -> None:
    path = write_walk(tmp_path)
    written, why = new_study(path), "the file states none, CMU's of this name has it: A GUESS"
    assert any(line.startswith(f"in doubt: rate_hz = 120: {why}") for line in written.said)
    assert re.search(rf"rate_hz = 120 +# {why} - CHECK IT", written.text)
    note_fetched(path, path.read_bytes())
    assert not [line for line in new_study(path).said if "in doubt" in line]


def test_salsa_files_are_known_to_lie_by_their_names(data_dir: Path) -> None:
    folder = data_dir / "cmu_salsa_bvh"
    text = new_study(folder / "60_10.bvh", folder / "61_10.bvh").text
    assert 'layout = "cmu_daz"' in text
    assert "rate_hz = 60         # known of CMU's files; the header says 120" in text
    assert re.findall(r"metres_per_unit = ([\d.]+) +# known", text) == ["1.263", "1.191"]


def test_salsa_files_of_another_name_get_the_guess_and_the_doubt_they_deserve(data_dir: Path, tmp_path: Path) -> None:
    for name, renamed in (("60_10.bvh", "leader.bvh"), ("61_10.bvh", "follower.bvh")):
        (tmp_path / renamed).symlink_to(data_dir / "cmu_salsa_bvh" / name)
    text = new_study(tmp_path / "leader.bvh", tmp_path / "follower.bvh").text
    assert "rate_hz = 120         # stated by the file" in text  # it lies: 60 Hz is true
    assert text.count("A GUESS - SET IT") == 2  # 1.29 m tall in metres: not believed


def test_2d_alone_gets_the_sections_that_make_3d_with_what_is_assumed_as_keys(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(pair_csv_text())
    study = tmp_path / "mine.toml"
    write_new_study(study, [tmp_path / "table.csv"])
    chosen, _ = load_study(str(study), load_graph())
    views, seeds, projections = (chosen.parameters[name] for name in ("views", "seeds", "projections"))
    assert views == ViewsParameters()
    assert {"distance_m", "camera_pitch_deg", "lean_deviation_deg"} <= views.model_fields_set
    assert chosen.asked >= {"views", "seeds", "chains", "lifting", "projections", "reconstruction"}
    assert isinstance(seeds, SeedsParameters)
    assert (seeds.num_lifted, seeds.num_grown) == (LIFTED_OF_2D_ALONE, GROWN_OF_2D_ALONE)
    assert isinstance(projections, ProjectionsParameters)
    assert projections.include_draws


def test_key_frames_are_lifted_and_no_motion_is_asked_of_them(tmp_path: Path) -> None:
    text = re.sub(r"^(\d+),", lambda found: f"{1000 * int(found[1])},", pair_csv_text(30), flags=re.MULTILINE)
    (tmp_path / "keys.csv").write_text(text)
    sections = tomllib.loads(new_study(tmp_path / "keys.csv", name="keys").text)
    assert {"views", "seeds", "chains", "lifting"} <= set(sections)
    assert not {"projections", "reconstruction"} & set(sections)


@pytest.mark.parametrize("option", ["keys", "detections", "detect"])
def test_a_film_is_named_with_where_its_2d_poses_come_from(tmp_path: Path, option: str, invoke: CommandLine) -> None:
    film = write_film(tmp_path / "dance.avi", [np.full((400, 480, 3), 90, dtype=np.uint8)] * 20)
    study = tmp_path / "film.toml"
    given = write_keys(tmp_path / "keys.csv", [0, 19])
    if option == "detect":
        given = tmp_path / "net.onnx"
        given.write_bytes(movenet())
    said = invoke("study", "new", study, "--from", film, f"--{option}", given).out
    assert 'found film "dance.avi": 20 frames at 30 Hz, 480 x 400' in said
    values = tomllib.loads(study.read_text())
    (source,) = values["ingest"]["videos"]
    assert source == {"id": "dance", "path": "dance.avi", option: ["net.onnx"] if option == "detect" else "keys.csv"}
    assert (values["seeds"]["num_lifted"], values["reconstruction"]) == (LIFTED_OF_2D_ALONE, {"sequences": "given"})
    assert load_study(str(study), load_graph())[0].resolved()["ingest"]["videos"][0]["id"] == "dance"


def test_options_of_a_film_need_a_film(tmp_path: Path, invoke: CommandLine) -> None:
    (tmp_path / "a.csv").write_text("frame,person,joint,x,y\n")
    said = invoke.refusal("study", "new", tmp_path / "one.toml", "--from", tmp_path / "a.csv", "--keys", "keys.csv")
    assert "are of one film, found 0; name it by --from" in said


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_what_a_new_study_calls_sure_is_what_a_plan_accepts(tmp_path: Path, rig: Rig) -> None:
    """Whatever the rig: the study is planned as it was written."""
    path = tmp_path / "person.bvh"
    path.write_text(rig.bvh())
    study = tmp_path / "mine.toml"
    said = write_new_study(study, [path])
    section = tomllib.loads(study.read_text(encoding="utf-8"))["ingest"]
    section["takes"][0]["files"] = [str(path)]
    assert not [line for line in said if "SET IT" in line]
    shards = planned(**section)
    assert shards[0].options(TakeParameters).persons[0].layout == rig.layout
    assert f'layout = "{rig.layout}"' in study.read_text(encoding="utf-8")


def of_no_program(text: str) -> str:
    """Return the BVH of a rig with names of joints that say nothing."""
    for number, name in enumerate(dict.fromkeys(re.findall(r"(?:ROOT|JOINT) (\S+)", text))):
        text = re.sub(rf"\b{name}\b", f"bone{number}", text)
    return text


def test_a_mapping_is_drafted_shown_and_accepted_where_no_layout_fits(tmp_path: Path) -> None:
    path, study = tmp_path / "odd.bvh", tmp_path / "mine.toml"
    path.write_text(of_no_program(RIGS[0].bvh()))
    said = write_new_study(study, [path])
    assert any("drafted mapping:" in line for line in said)
    assert any(line.split()[:1] == ["left_knee"] for line in said)
    section = tomllib.loads(study.read_text(encoding="utf-8"))["ingest"]
    assert len(section["mappings"]["odd"]["parts"]) >= 13
    assert planned(**{**section, "takes": [section["takes"][0] | {"files": [str(path)]}]})


def test_two_files_of_one_rig_share_a_mapping_and_those_of_two_do_not(tmp_path: Path) -> None:
    """Also where the files of two rigs have one name."""
    rigs = [RIGS[0], RIGS[0], next(rig for rig in RIGS if len(rig.names) < len(RIGS[0].names) - 3)]
    paths = [tmp_path / name for name in ("a/odd.bvh", "b/second.bvh", "b/odd.bvh")]
    for number, (path, rig) in enumerate(zip(paths, rigs, strict=True)):
        path.parent.mkdir(exist_ok=True)
        path.write_text(of_no_program(rig.bvh()).replace("Frame Time: ", f"Frame Time: {' ' * number}"))
    written = new_study(*paths)
    assert sum("drafted mapping:" in line for line in written.said) == 2
    mappings = written.ingest.mappings
    assert list(mappings) == ["odd", "odd_2"]
    assert mappings["odd"]["parts"] != mappings["odd_2"]["parts"]
    assert [person.layout for person in written.ingest.takes[0].persons] == ["odd", "odd", "odd_2"]


def test_two_rigs_rates_and_axes_are_written_for_each(tmp_path: Path) -> None:
    first, second = tmp_path / "a.bvh", tmp_path / "b.bvh"
    rigs = {rig.name: rig for rig in RIGS}
    first.write_text(rigs["mixamo with a namespace"].bvh())
    text = rigs["unreal"].bvh()
    step = re.search(r"Frame Time: (\S+)", text)
    second.write_text(text.replace(step[0], f"Frame Time: {float(step[1]) / 2:.9f}"))
    written = new_study(first, second)
    people = written.ingest.takes[0].persons
    assert [person.layout for person in people] == ["mixamo", "unreal"]
    assert [person.rate_hz for person in people] == [30.0, 60.0]
    assert [person.up_axis for person in people] == ["y", "z"]
    assert "12 frames" in written.said[0]
    assert any("0.40 and 0.20 seconds: ARE THEY" in line for line in written.said)


@pytest.mark.parametrize(
    ("layout", "missing", "is_why_said"),
    [
        ("", None, True),
        ("", (), True),
        ("", ("left_knee", "head"), False),
        ("mine", (), False),
        ("body22", None, False),
    ],
)
def test_why_no_layout_fits_is_said(layout: str, missing: tuple[str, ...] | None, is_why_said: bool) -> None:
    part = SimpleNamespace(part="pelvis", joint="Hips", is_sure=False, reason="its place")
    draft = None if missing is None else SimpleNamespace(parts=[part], missing=missing)
    taken = SimpleNamespace(why_no_layout="two joints are one; give another")
    lines = _drafted([SimpleNamespace(path=Path("a.bvh"), layout=layout, draft=draft, taken=taken)])  # type: ignore[list-item]
    assert ("a.bvh: two joints are one; give another" in lines) is is_why_said
    lacking = [line for line in lines if "no joint was found for" in line]
    assert lacking == ["a.bvh: no joint was found for left_knee, head; set them in the study"] * bool(missing)
    assert any(line.split() == ["pelvis", "Hips", "A", "GUESS", "its", "place"] for line in lines) is (
        draft is not None
    )
