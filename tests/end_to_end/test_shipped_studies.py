"""Every study that ships runs to its end and leaves its report: cut short, on duets or made-up files, in one store."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from flows.execution import begin, execute
from flows.outcomes import Outcome, Run
from flows.planning import StageSelection, make_plan
from flows.study import Study, load_study
from flows.study_files import shipped_studies
from pasdedeux.choreography.duets import make_duet
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.kinematics import Motion
from storage_schema import Store
from tasks.evaluation import TOPICS, report
from tasks.ingest import IngestParameters
from tasks.ingest.takes.known_sources import note_fetched, usual_rate_hz
from tasks.shards import HerePool
from tests.builders.own_sources import asf_text, danced_amc, film_duet, write_openpose
from tests.builders.pages import Page
from tests.builders.real_study import graph

pytestmark = pytest.mark.slow

FEW: Mapping[str, Any] = {
    "ingest.rate_hz": 12.0,
    "ingest.duets.*.duration_s": 1.0,
    "ingest.duets.*.count": 2,
    "ingest.virtual_video.num_videos": 1,
    "ingest.virtual_video.num_random_views": 6,
    "ingest.virtual_video.leave_one_out_every": 3,
    "seeds.num_seeds": 1,
    "seeds.num_grown": 4,
    "seeds.num_starts": 1,
    "seeds.num_filled": 2,
    "chains.num_draws": 8,
    "chains.segment_draws": 8,
    "chains.num_candidates": 6,
    "chains.num_views": 4,
    "chains.num_dispersing": 4,
    "chains.num_warm_up": 4,
    "chains.thin": 2,
    "chains.repair_steps": 5,
    "lifting.max_frames": 2,
    "lifting.between_frames": 3,
    "lifting.num_spans": 1,
    "projections.pitches_deg": [0.0, 20.0],
    "projections.num_clusters": 4,
    "augmentation.scales": [0.75, 0.95, 1.05, 1.25],
    "augmentation.persons": ["A"],
    "training.splits": ["cross_interaction", "extrapolation"],
    "training.seeds": [0],
    "training.*.num_steps": 1,
    "training.*.segment_steps": 1,
    "generation.num_variants": 2,
    "evaluation.num_truth_pairs": 4,
    "evaluation.num_completed_pairs": 1,
    "evaluation.num_realism_variants": 1,
    "evaluation.num_test_variants": 1,
    "evaluation.num_downstream_seeds": 1,
    "evaluation.num_training_takes": [1],
    "evaluation.*.num_steps": 1,
    "evaluation.unseen_views_deg": [0],
}
"""What a study has more of is cut to this, in its sweeps too; `*` is any name, of a list the length counts."""
_FILM_S = 2.0
_NUM_DUETS = 5
"""The first so many lines of duets are kept; what is held out of others is not."""
FILMED = {"film"}
"""Topics of film, of which no study that ships has any."""

Build = Callable[[str], tuple[Study, Store, Outcome]]


def studies_to_run() -> list[str]:
    """Return the names of the studies that ship; those without a name in their file are for others to extend."""
    return [name for name, text in shipped_studies().items() if "name" in tomllib.loads(text)["study"]]


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


def cut_short(study: Study) -> list[str]:
    """Return the settings that make a study small: few of everything, and of its files what it names elsewhere."""
    sections = study.resolved()
    duets = _keep_few_duets(sections["ingest"])
    few = [
        f"{'.'.join(path)}={json.dumps(wanted)}"
        for key, wanted in FEW.items()
        for prefix in ((), ("sweep", "*"))
        for path, value in _values(sections, (key.split(".")[0], *prefix, *key.split(".")[1:]))
        if (len(value) > len(wanted) if isinstance(wanted, list) else value is not None and value > wanted)
    ]
    families = sections["ingest"]["pairs"]
    taken = [f"ingest.pairs.{name}.takes={json.dumps(_few_takes(study, family))}" for name, family in families.items()]
    cut = [f"ingest.pairs.{name}.frames=[1, 60]" for name, family in families.items() if family["frames"]]
    return ["ingest.take_seconds=1.0", *duets, *few, *taken, *cut]


def _values(node: Any, path: Sequence[str]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every key of tables that fits, and its value."""
    if not path:
        yield (), node
        return
    items = list(enumerate(node)) if isinstance(node, list) else list(node.items()) if isinstance(node, dict) else []
    for name, value in items:
        if path[0] in ("*", name):
            yield from (((str(name), *rest), found) for rest, found in _values(value, path[1:]))


def _keep_few_duets(ingest: dict[str, Any]) -> list[str]:
    """Keep the first duets of a study that has many, and of its held out takes those; return the settings."""
    duets = ingest["duets"] or []
    if len(duets) <= _NUM_DUETS:
        return []
    gone = {take.take_id for take in IngestParameters(duets=duets).resolved_duets()}
    ingest["duets"] = duets[:_NUM_DUETS]
    gone -= {take.take_id for take in IngestParameters(duets=ingest["duets"]).resolved_duets()}
    ingest["held_out"] = [take for take in ingest["held_out"] if take not in gone]
    lines = (
        ", ".join(f"{key} = {json.dumps(value)}" for key, value in duet.items() if value) for duet in ingest["duets"]
    )
    return [f"ingest.duets=[{', '.join(f'{{ {line} }}' for line in lines)}]", f"ingest.held_out={ingest['held_out']}"]


def _few_takes(study: Study, family: Mapping[str, Any]) -> list[str]:
    """Return the takes of a family that the study names elsewhere too, and another; two at least."""
    ingest = study.resolved()["ingest"]
    named = {*ingest["held_out"], *ingest["prior"], *(ingest["virtual_video"]["takes"] or ())}
    ids = {take: family["id"].format(subject=family["subjects"][0], take=take) for take in family["takes"]}
    wanted = [take for take in ids if ids[take] in named]
    return sorted([*wanted, *[take for take in ids if take not in wanted][: max(1, 2 - len(wanted))]])


def write_files(study: Study) -> None:
    """Write all files that a study takes, where it looks for them."""
    ingest = study.resolved()["ingest"]
    for family in ingest["pairs"].values():
        for number, take in enumerate(family["takes"]):
            _write_take(family, take, number)
    for take in ingest["takes"]:
        for path, motion in zip(take["files"], make_duet("hug", duration_s=_FILM_S).motions, strict=True):
            Path(path).parent.mkdir(exist_ok=True)
            Path(path).write_text(write_bvh(motion))
    for source in ingest["annotations"]:
        write_openpose(Path(source["path"]), film_duet("hug", duration_s=_FILM_S, rate_hz=25.0), "body25")


def _write_take(family: Mapping[str, Any], take: str, number: int) -> None:
    """Write a take of a family: CMU's as `fetch` brings them, others as BVH or rows of a template's angles."""
    folder = Path(family["folder"])
    folder.mkdir(parents=True, exist_ok=True)
    for subject, person in zip(family["subjects"], (0, 1), strict=False):
        name = f"{subject}_{take}.amc"
        rate_hz = family["rate_hz"] or usual_rate_hz(name) or 120.0
        motion = _danced(number, person, rate_hz)
        if family["format"] == "rotation_rows":
            header, rows = write_bvh(motion).split("MOTION")
            (folder.parent / "template.bvh").write_text(f"{header}MOTION{rows}")
            (folder / take).write_text("".join(" ".join(r.split()[3:]) + "\n" for r in rows.splitlines()[3:]))
        elif family["frames"]:
            (folder / f"{subject}_{take}.bvh").write_text(write_bvh(motion))
        else:
            for path, text in ((folder / f"{subject}.asf", asf_text(subject)), (folder / name, danced_amc(motion))):
                note_fetched(path, text.encode())
                path.write_text(text)


def _danced(number: int, person: int, rate_hz: float) -> Motion:
    """Return what a person dances in the n-th take of a family: the duets in turn, each time in another variation."""
    name = ("waltz", "hug", "judo", "push_hands")[number % 4]
    return make_duet(name, variation=number, duration_s=1.1, rate_hz=rate_hz).motions[person]
