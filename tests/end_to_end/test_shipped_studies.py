"""Every study that ships runs to its end and leaves its report: cut short, on duets or made-up files, in one store."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from flows.execution import begin, execute
from flows.outcomes import Outcome, Run
from flows.planning import StageSelection, make_plan
from flows.study import Study, load_study
from storage_schema import Store
from tasks.evaluation import TOPICS, report
from tasks.shards import HerePool
from tests.builders.pages import Page
from tests.builders.real_study import graph
from tests.builders.shipped_studies import cut_short, studies_to_run, write_files

pytestmark = pytest.mark.slow

FILMED = {"film"}
"""Topics of film, of which no study that ships has any."""

Build = Callable[[str], tuple[Study, Store, Outcome]]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Return what builds a study, once, in this process: what studies share is computed once too."""
    folder = tmp_path_factory.mktemp("shipped")
    store, built = Store(folder / "store"), dict[str, tuple[Study, Store, Outcome]]()

    def build_once(name: str) -> tuple[Study, Store, Outcome]:
        if name not in built:
            whole, _ = load_study(name, graph(), folder=folder, environment={})
            study, stages = load_study(name, graph(), folder=folder, environment={}, settings=cut_short(whole))
            write_files(study)
            run, plan = Run(study, stages, store, StageSelection()), make_plan(study, stages, store)
            built[name] = study, store, execute(run, begin(run, plan), plan, HerePool(str(store)))
        return built[name]

    return build_once


def topics_of(store: Store, outcome: Outcome) -> set[str]:
    evaluated = [ref for stage in outcome.stages if stage.name == "evaluation" for ref in stage.artifacts]
    return {store.manifest(ref).partition for ref in evaluated} - {report.PARTITION}


@pytest.mark.parametrize("name", studies_to_run())
def test_a_study_that_ships_makes_what_it_asks_for_and_a_report_with_every_topic(build: Build, name: str) -> None:
    study, store, outcome = build(name)
    assert outcome.missing == ()
    assert {stage.name for stage in outcome.stages if stage.artifacts} >= study.asked
    if "evaluation" not in study.asked:
        return
    assert outcome.report is not None
    page = Page((outcome.report / "report.html").read_text(encoding="utf-8"))
    assert (page.problems, page.outside, page.unnamed) == ([], [], [])
    headings = {heading for _, heading in page.headings}
    assert {topic.heading for topic in TOPICS if topic.name in topics_of(store, outcome)} <= headings


def test_all_topics_are_reached_by_some_study_that_ships(build: Build) -> None:
    reached = {topic for name in studies_to_run() for topic in topics_of(*build(name)[1:])}
    assert reached == {topic.name for topic in TOPICS} - FILMED
