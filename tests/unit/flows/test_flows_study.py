"""Studies: what wins over what, and one clear sentence for everything that is wrong."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict, Field

from flows.study import Study, load_study
from flows.study_files import StudyError, shipped_studies
from pasdedeux.evaluation.scores import FEWEST_UNITS
from pasdedeux.evaluation.verdicts import FEWEST_BLOCKS
from tasks.graph import Graph, load_graph
from tasks.ingest import IngestParameters
from tasks.stage import Parameters, Stage
from tasks.stage.sweep import merged
from tests.builders.toys import TOYS, plan_aside, run_aside


class Person(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    path: Path
    metres_per_unit: float = Field(1.0, gt=0)


class LoadParameters(Parameters):
    people: tuple[Person, ...] = ()
    folder: Path | None = None
    rate_hz: float = Field(30.0, gt=0)


GRAPH = Graph((*TOYS.stages, Stage("load", 1, (), ("takes",), LoadParameters, plan_aside, run_aside)))
HEAD = '[study]\nname = "mine"\n'


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(HEAD + text)
    return path


def load(path: Path | str, *settings: str, environment: dict[str, str] | None = None) -> Study:
    return load_study(str(path), GRAPH, settings=settings, environment=environment or {})[0]


def problems(path: Path | str, *settings: str, environment: dict[str, str] | None = None) -> list[str]:
    with pytest.raises(StudyError) as caught:
        load(path, *settings, environment=environment)
    return caught.value.problems


def grow(study: Study) -> dict[str, object]:
    return study.parameters["grow"].model_dump()


def test_settings_win_over_environment_over_file_over_defaults(tmp_path: Path) -> None:
    assert grow(load(write(tmp_path, "[grow]\nnum_takes = 5\n")))["num_segments"] == 3
    path = write(tmp_path, "[grow]\nnum_takes = 5\nnum_segments = 5\nscale = 5.0\n")
    environment = {"PASDEDEUX_SET__GROW__NUM_SEGMENTS": "6", "PASDEDEUX_SET__GROW__SCALE": "6.0"}
    section = grow(load(path, "grow.scale=7.0", "grow.scale=7.5", environment=environment))
    assert (section["num_takes"], section["num_segments"], section["scale"]) == (5, 6, 7.5), (
        "the later of equal settings"
    )


def test_a_setting_reaches_into_lists_and_takes_text_without_quotes(tmp_path: Path) -> None:
    path = write(tmp_path, '[[load.people]]\npath = "a.bvh"\n[[load.people]]\npath = "b.bvh"\n')
    study = load(path, "load.people.1.metres_per_unit=0.5", "judge.title=hello there")
    assert [p["metres_per_unit"] for p in study.resolved()["load"]["people"]] == [1.0, 0.5]
    assert study.resolved()["judge"]["title"] == "hello there"


def test_unknown_keys_are_named_with_the_nearest_known_name(tmp_path: Path) -> None:
    sentences = problems(write(tmp_path, "[grow]\nnum_take = 2\n[bent]\nstep = 1\n"))
    assert any("grow.num_take: unknown; did you mean num_takes?" in p for p in sentences)
    assert any("bent: unknown; did you mean bend?" in p for p in sentences)
    assert "did you mean duets?" in problems("duetts")[0]


def test_a_sweep_merges_tables_and_replaces_everything_else() -> None:
    base = {"kept": 1, "table": {"x": 1, "in": {"y": 2, "z": 3}}, "list": [1, 2], "none": None, "was": {"x": 1}}
    sweep = {"table": {"in": {"y": 4}}, "list": [5], "none": {"x": 6}, "was": 7, "new": {"x": 8}}
    replaced = {"list": [5], "none": {"x": 6}, "was": 7, "new": {"x": 8}}
    assert merged(base, sweep) == {"kept": 1, "table": {"x": 1, "in": {"y": 4, "z": 3}}} | replaced
    assert base["table"] == {"x": 1, "in": {"y": 2, "z": 3}}, "other sweeps begin with it again"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[chains.sweep.hot]\nproposals = "velocity"', r"chains\.sweep\.hot\.proposals: .*did you mean proposal\?"),
        ("[chains.sweep.hot]\nsigma_l = -1.0", r"chains\.sweep\.hot\.sigma_l\."),
        ("[chains.sweep.hot.sweep.hotter]", r"chains\.sweep: .*a sweep has no sweeps"),
        ("[chains.sweep.ic]", r"chains\.sweep: 'ic' is the name of a density"),
        (
            '[chains]\nstarts = "every"\nsweep.ic_repaired = {}',
            r"chains\.sweep: 'ic_repaired' is the name of a density",
        ),
        (
            "[training.sweep.near.mesh_refine]\nnum_iterations = -1",
            r"training\.sweep\.near\.mesh_refine\.num_iterations: ",
        ),
        ('[training.sweep.soft]\nmodels = ["oracle"]', r"'oracle' is not known; known models"),
        ("[training.sweep.copy]", r"training\.sweep: 'copy' is the name of a model"),
    ],
)
def test_what_is_wrong_in_a_sweep_is_said_with_its_full_path(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(StudyError, match=message):
        load_study(str(write(tmp_path, text)), load_graph(), environment={})


@pytest.mark.parametrize(
    ("text", "setting", "sentence"),
    [
        (
            HEAD + '[[load.people]]\npath = "a.bvh"\nmeters_per_unit = 1.0',
            "",
            "0.meters_per_unit: unknown; did you mean",
        ),
        (HEAD + "[[load.people]]", "", "load.people.0.path: missing"),
        (HEAD + "[grow]\nscale = 1.0", "grow.scale.x=1", "is a single value"),
        (HEAD, "study.extends=duets", "study.extends: can be said in a study's file only"),
        (HEAD + "[grow", "", "not valid TOML: Expected ']' at the end of a table declaration (at line 3"),
        ("[study]", "", "study.name: missing"),
        ('[study]\nname = "../up"', "", "study.name: "),
        ("study = 3", "", "study: should be a table; found 3"),
        (HEAD, 'load.people="a.bvh"', 'load.people: should be a list, such as ["a.bvh"]; found'),
        (None, "", "does not exist"),
    ],
)
def test_wrong_input_is_one_sentence(tmp_path: Path, text: str | None, setting: str, sentence: str) -> None:
    path = tmp_path / "mine.toml"
    if text is not None:
        path.write_text(f"{text}\n")
    (problem,) = problems(path, *filter(None, [setting]))
    assert sentence in problem


def test_every_problem_is_listed_at_once(tmp_path: Path) -> None:
    sentences = problems(write(tmp_path, '[grow]\nnum_takes = 0\nscale = "big"\n'), "nonsense", "judge.nothing=1")
    assert len(sentences) == 4
    for words in (
        "grow.num_takes: should be greater than or equal to 1; found 0",
        "grow.scale: should be a valid number, unable to parse string as a number; found 'big'",
        "--set nonsense: expected section.name=value",
        "judge.nothing: unknown; ",
    ):
        assert any(words in problem for problem in sentences), sentences


def test_a_study_may_stop_at_some_stages(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(f'{HEAD}stages = ["grow", "bend"]\n')
    study, graph = load_study(str(path), GRAPH, environment={})
    assert graph.names == ("grow", "bend")
    assert set(study.parameters) == {"grow", "bend"}
    path.write_text(f'{HEAD}stages = ["grew"]\n')
    assert any("did you mean grow?" in problem for problem in problems(path))


def test_the_real_environment_is_read_when_none_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "PASDEDEUX_SET__GROW__NUM_TAKES", "9")
    study, _ = load_study(str(write(tmp_path, "")), GRAPH)
    assert study.resolved()["grow"]["num_takes"] == 9


def chain_of(tmp_path: Path, **texts: str) -> Path:
    """Write studies `name.toml` and return the path of the last one."""
    for name, text in texts.items():
        path = tmp_path / f"{name}.toml"
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_text(text)
    return path


def test_a_study_takes_over_what_it_does_not_say_itself_through_several_levels(tmp_path: Path) -> None:
    path = chain_of(
        tmp_path,
        base='[study]\ntitle = "a base"\nseed = 7\n[grow]\nnum_takes = 2\nnum_segments = 4\n[judge]\ntitle = "old"\n',
        middle='[study]\nname = "middle"\nextends = "base.toml"\n[grow]\nnum_takes = 3\n',
        mine='[study]\nname = "mine"\nextends = "./middle.toml"\n[judge]\ntitle = "new"\n',
    )
    study = load(path, "grow.num_segments=5", environment={"PASDEDEUX_SET__GROW__SCALE": "6.0"})
    assert (study.name, study.head.title, study.head.seed) == ("mine", "", 7)
    assert grow(study)["num_takes"] == 3
    assert (grow(study)["num_segments"], grow(study)["scale"]) == (5, 6.0)
    assert study.resolved()["judge"]["title"] == "new"


def test_lists_of_an_extended_study_are_replaced_not_joined(tmp_path: Path) -> None:
    path = chain_of(
        tmp_path,
        base='[[load.people]]\npath = "a.bvh"\n[[load.people]]\npath = "b.bvh"\n[load]\nrate_hz = 60\n',
        mine='[study]\nname = "mine"\nextends = "base.toml"\n[[load.people]]\npath = "c.bvh"\n',
    )
    section = load(path).resolved()["load"]
    assert [person["path"] for person in section["people"]] == [str(tmp_path / "c.bvh")]
    assert section["rate_hz"] == 60


def test_paths_are_relative_to_their_file_and_those_of_settings_to_the_current_folder(tmp_path: Path) -> None:
    path = chain_of(
        tmp_path,
        **{
            "shared/base": '[load]\nfolder = "data"\n[[load.people]]\npath = "a.bvh"\n',
            "own/mine": '[study]\nname = "mine"\nextends = "../shared/base.toml"\n',
            "own/other": '[study]\nname = "other"\nextends = "mine.toml"\n[load]\nfolder = "here"\n',
        },
    )
    section = load(path).resolved()["load"]
    assert section["folder"] == str(tmp_path / "own" / "here")
    assert section["people"][0]["path"] == str(tmp_path / "shared" / "a.bvh")
    study, _ = load_study(str(path), GRAPH, settings=["load.folder=x"], environment={}, folder=tmp_path)
    assert study.resolved()["load"]["folder"] == str(tmp_path / "x")


@pytest.mark.parametrize(
    ("texts", "sentence"),
    [
        ({"mine": 'extends = "mine.toml"'}, "extends itself: "),
        ({"a": 'extends = "mine.toml"', "mine": 'extends = "a.toml"'}, "a.toml -> "),
        ({"mine": 'extends = "duetts"'}, "study.extends: study 'duetts': unknown; did you mean duets?"),
        ({"mine": 'extends = "none.toml"'}, "study.extends: study file none.toml does not exist"),
        ({"mine": "extends = 3"}, "study.extends: should be the name or the path of one study"),
        ({"a": "name = ", "mine": 'extends = "a.toml"'}, "study a.toml is not valid TOML"),
    ],
)
def test_an_impossible_extension_is_one_sentence(tmp_path: Path, texts: dict[str, str], sentence: str) -> None:
    (problem,) = problems(chain_of(tmp_path, **{name: f"[study]\n{text}\n" for name, text in texts.items()}))
    assert sentence in problem


def test_every_study_that_ships_can_be_run_or_is_extended_by_one_that_can() -> None:
    heads = {name: tomllib.loads(text)["study"] for name, text in shipped_studies().items()}
    extended = {head.get("extends") for head in heads.values()}
    for name, head in heads.items():
        assert head["title"]
        assert name in extended if "name" not in head else head["name"] == name
        if "name" in head:
            assert load_study(name, load_graph(), environment={})[0].name == name


@pytest.mark.parametrize(("key", "title"), [("", "Two people"), ('title = "Other"\n', "Other")])
def test_a_study_gives_its_report_a_title_unless_it_has_one(tmp_path: Path, key: str, title: str) -> None:
    path = chain_of(tmp_path, mine=f'{HEAD}title = "Two people"\n[evaluation]\n{key}')
    study, _ = load_study(str(path), load_graph())
    assert study.parameters["evaluation"].model_dump()["title"] == title


def test_the_demo_holds_out_enough_short_takes_to_be_judged_over_takes() -> None:
    study, _ = load_study("duets", load_graph(), environment={})
    ingest = study.parameters["ingest"]
    assert isinstance(ingest, IngestParameters)
    takes = {duet.take_id: duet.duration_s for duet in ingest.resolved_duets()}
    held_out = [takes[name] for name in ingest.held_out]
    assert len(held_out) >= FEWEST_UNITS
    assert sum(held_out) >= FEWEST_BLOCKS
    assert max(held_out) <= 3.0, "what is held out costs as much as what is learned from"
