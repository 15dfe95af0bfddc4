"""The graph of stages: its order follows from reads and writes, and what cannot be run is refused."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from flows.planning import make_plan
from flows.study import load_study
from flows.study_files import study_text
from pasdedeux.errors import InputError
from storage_schema import Store
from tasks.graph import Graph, GraphError, load_graph
from tasks.stage import Stage
from tests.builders.toys import TOYS, AsideParameters, plan_aside, run_aside


def stage(name: str, reads: tuple[str, ...], writes: tuple[str, ...]) -> Stage:
    return Stage(name, 1, reads, writes, AsideParameters, plan_aside, run_aside)


def test_every_stage_comes_after_those_that_write_what_it_reads_and_the_order_never_varies() -> None:
    assert TOYS.names == ("aside", "grow", "bend", "judge")
    assert Graph(tuple(reversed(TOYS.stages))).names == TOYS.names


def test_above_and_below_follow_the_tables() -> None:
    assert TOYS.above("judge") == {"grow", "bend"}
    assert TOYS.below("grow") == {"bend", "judge"}
    assert TOYS.below("aside") == frozenset()


@pytest.mark.parametrize(
    ("stages", "said"),
    [
        ((stage("a", ("seeds",), ("draws",)), stage("b", ("draws",), ("seeds",))), "the stages form a cycle"),
        ((stage("a", ("draws",), ("draws",)),), "reads a table that it writes itself"),
        ((stage("a", (), ("draws",)), stage("b", (), ("draws",))), "table 'draws' is written by two stages"),
        ((stage("a", (), ("draws",)), stage("a", (), ("seeds",))), "two stages are named 'a'"),
    ],
)
def test_stages_that_form_no_graph_are_refused(stages: tuple[Stage, ...], said: str) -> None:
    with pytest.raises(GraphError, match=said):
        Graph(stages)


def test_a_part_of_the_graph_reads_only_what_its_own_stages_write() -> None:
    part = TOYS.only(["bend", "judge"])
    assert part.names == ("bend", "judge")
    assert part.upstream == {"bend": (), "judge": ("bend",)}


def test_the_stages_of_the_program_form_a_graph() -> None:
    graph = load_graph()
    for stage in graph.stages:
        assert stage.meaning, f"stage {stage.name} says nothing about itself"
        for name in graph.upstream[stage.name]:
            assert graph.names.index(name) < graph.names.index(stage.name)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["augmentation.scales=[0.9]"], "split 'cross_scale' has no training variant"),
        (["augmentation.contacts.nobody=[]"], "augmentation.contacts: take 'nobody' is not there; takes: hug, hug-001"),
        (
            ["seeds.frames=[{take='hug-001', frame=3}]"],
            "take 'hug-001' is no take of two people that may be learned from",
        ),
        (["ingest.duets=[]", "ingest.held_out=[]"], "seeds.num_seeds asks for 2 frames of takes, but there is no take"),
        (
            ["ingest.virtual_video.num_videos=0", "ingest.virtual_video.num_random_views=0"],
            "seeds.num_grown lift annotations, but there are no annotated pairs with views, neither",
        ),
    ],
)
def test_what_is_known_to_fail_is_said_before_anything_runs(tmp_path: Path, settings: list[str], said: str) -> None:
    study, stages = load_study("duets", load_graph(), settings=settings)
    with pytest.raises(InputError, match=said):
        make_plan(study, stages, Store(tmp_path / "store"))


def test_a_section_that_is_not_in_the_study_is_checked_as_well_as_its_stage_runs(tmp_path: Path) -> None:
    path = tmp_path / "short.toml"
    path.write_text('[study]\nname = "short"\n[ingest]\nduets = [{ name = "hug" }]\n[augmentation]\nscales = [0.9]\n')
    study, stages = load_study(str(path), load_graph())
    assert "training" not in study.asked
    with pytest.raises(InputError, match="has no t"):
        make_plan(study, stages, Store(tmp_path / "store"))


def test_the_small_study_of_the_augmentation_paper_can_be_planned_without_files(tmp_path: Path) -> None:
    text = study_text("augmentation_paper", tmp_path).replace("\\\n", " ").replace("#", "")
    command = text.partition("pasdedeux run augmentation_paper --preview")[2].partition("\n")[0]
    study, stages = load_study("augmentation_paper_duets", load_graph(), settings=shlex.split(command)[3::2])
    trained = study.sections_of("training")["training"]
    assert trained["paper_cvae"]["num_steps"] == 20
    make_plan(study, stages, Store(tmp_path / "store"))


def test_what_adds_to_a_table_comes_before_those_that_read_it_but_not_before_what_it_rests_on() -> None:
    make = stage("make", (), ("variants",))
    train = stage("train", ("variants",), ("models",))
    sample = replace(stage("sample", ("models",), ()), adds_to=("variants",))
    judge = stage("judge", ("variants", "models"), ("scores",))
    graph = Graph((judge, sample, train, make))
    assert graph.names == ("make", "train", "sample", "judge")
    assert graph.upstream == {
        "make": (),
        "train": ("make",),
        "sample": ("train",),
        "judge": ("make", "train", "sample"),
    }
