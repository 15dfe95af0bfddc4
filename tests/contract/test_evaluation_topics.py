"""Every registered topic: what it finds arrives in the report, with its heading and introduction; so does a new one."""

from __future__ import annotations

import base64
import html
import json
import re
import tomllib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.evaluation.pictures import PLAYER, Picture, compared_figure
from pasdedeux.evaluation.score_tables import TextTable, format_score
from pasdedeux.evaluation.scores import COLUMNS, Score
from pasdedeux.evaluation.verdicts import Criterion, Items, part_name
from pasdedeux.reconstruction.matching import Method
from pasdedeux.verdict import Level, Verdict
from storage_schema import Manifest, SourceCredit, Store
from tasks import generation, ingest, reconstruction, training
from tasks.evaluation import STAGE, TOPICS, evaluation_stage, lifting
from tasks.evaluation.topic import ScoresOf, Topic, TopicResult
from tasks.stage import Parameters, Shard, Stage, StageInputs
from tasks.stage.judgements import verdict_of, verdicts_of_parts
from tests.builders.browser import in_browser
from tests.builders.ingest_runs import planned, run
from tests.builders.pages import Page
from tests.builders.painted_film import painted, write_keys
from tests.builders.real_study import SMALL, BuiltStudy
from tests.builders.rendered_film import write_film
from tests.builders.storage_rows import having, put, take_rows

pytestmark = pytest.mark.slow

EVERYTHING = {
    "num_truth_pairs": 8,
    "num_completed_pairs": 1,
    "unseen_views_deg": (0.0,),
    "num_realism_variants": 4,
    "num_downstream_seeds": 1,
    "classifier": {"num_steps": 1},
    "predictor": {"num_steps": 1},
}
"""Settings under which every topic has something to do on the small study."""
ERRORS = {
    "contact_drift_mean",
    "contact_error",
    "E_r",
    "error_root_kept",
    "identity_switches_per_minute",
    "in_between_error_mean",
    "in_between_lifted_error_mean",
    "JME_mean",
    "lifted_pair_error_mean",
    "occluded_joint_error_mean",
    "view_error_mean",
}
"""Figures that are errors against the truth: it has none of them."""
SHARES = {"accuracy": 100.0}
"""Figures of which the truth has all there is."""


def inputs_of(store: Store, stage: Stage) -> StageInputs:
    """Return what the stages before left in a store, by table."""
    made = [manifest for manifest in store.artifacts() if manifest.ref.stage != stage.name]
    made.sort(key=lambda manifest: (manifest.ref.stage, manifest.partition, manifest.name))
    return StageInputs({table: having(table, made) for table in stage.reads}, seed=3)


def evaluate(store: Store, stage: Stage, **settings: object) -> list[Manifest]:
    """Return what each shard committed; the last is the report."""
    shards = stage.plan(inputs_of(store, stage), stage.parameters(**settings))
    return [store.manifest(stage.run_shard(shard, store)) for shard in shards]


def page_of(store: Store, made: Sequence[Manifest]) -> str:
    text = store.attachment(made[-1].ref, "report.html").decode()
    return html.unescape(text.replace("<code>", "`").replace("</code>", "`"))


Judged = list[tuple[Criterion, Items, Collection[str]]]
Evaluated = tuple[Store, list[Manifest], str]


@pytest.fixture(scope="module")
def judged() -> Iterator[Judged]:
    """Give what is judged while the module runs: criterion, items and baselines."""
    found: Judged = []
    verdict = Criterion.verdict

    def heard(criterion: Criterion, items: Items, baselines: Collection[str]) -> Verdict | None:
        found.append((criterion, items, baselines))
        return verdict(criterion, items, baselines)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Criterion, "verdict", heard)
        yield found


@pytest.fixture(scope="module")
def evaluated(small: BuiltStudy, judged: Judged, tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    """Return the small study's store with every topic scored in it, what was made, and the page."""
    store = Store(small.copy_store(tmp_path_factory.mktemp("topics")))
    _detect(store)
    _learn_to_draw(store)
    _dance_again(store)
    _film(store, tmp_path_factory.mktemp("film"))
    made = evaluate(store, STAGE, **EVERYTHING)
    return store, made, page_of(store, made)


def _dance_again(store: Store) -> None:
    """Put more takes of each duet into the small study's store, long enough to predict: splits by take need two."""
    again = [duet | {"duration_s": 3.1, "count": 2} for duet in tomllib.loads(SMALL)["ingest"]["duets"]]
    run(store, planned(duets=again, rate_hz=12.0))


def _film(store: Store, folder: Path) -> None:
    """Put a shot of a film into the small study's store."""
    film = write_film(folder / "walk.mp4", (painted(0, frame) for frame in range(12)))
    source = {"id": "walk", "path": film, "keys": write_keys(folder / "keys.csv", [0, 11]), "leave_one_out_every": 0}
    run(store, planned(videos=[source]))


def _learn_to_draw(store: Store) -> None:
    """Put a model that draws scales itself into the small study's store, hardly trained."""
    models = ["copy", "naive_fk", "ridge_scale", "actor_like"]
    trained = {"splits": ["cross_interaction"], "models": models, "actor_like": {"num_steps": 1}}
    drawn = {"model": "actor_like", "num_variants": 2}
    for stage, section in ((training.STAGE, trained), (generation.STAGE, drawn)):
        for shard in stage.plan(inputs_of(store, stage), stage.parameters.model_validate(section)):
            stage.run_shard(shard, store)


def _detect(store: Store) -> None:
    """Put the held-out take as a detector sees it into the small study's store, and what is reconstructed of that."""
    section = tomllib.loads(SMALL)["ingest"] | {"virtual_video": {"num_random_views": 12, "has_detector": True}}
    shards = ingest.plan(StageInputs({}, seed=3), ingest.IngestParameters.model_validate(section))
    shards = [shard for shard in shards if (shard.partition, shard.name) == ("hug", "detector")]
    database = having("projections", store.artifacts("projections"))
    inputs = StageInputs({"annotations": list(run(store, shards).values()), "projections": database}, seed=3)
    for shard in reconstruction.plan(inputs, reconstruction.ReconstructionParameters(methods=(Method.NEAREST,))):
        reconstruction.run_shard(shard, store)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_what_a_topic_finds_arrives_in_the_report(evaluated: Evaluated, topic: Topic[Any]) -> None:
    store, made, page = evaluated
    parts = [part for part in made if part.partition == topic.name]
    assert parts, f"the small study has nothing for topic {topic.name}: let EVERYTHING ask for it"
    section = page.split(f">{topic.heading}</h2>")[1].split("<h2")[0]
    assert topic.introduction in section
    assert ('class="badge' in section) == any(verdict_of(part) is not None for part in parts)
    shown = 0
    for part in parts:
        for note in part.facts["notes"]:
            assert (note.partition(": ")[2] or note) in section
        for name in part.attachments:
            content = store.attachment(part.ref, name)
            shown_as = json.loads(content)["data"] if name.endswith(PLAYER) else base64.b64encode(content).decode()
            assert shown_as in section
            assert part.facts["captions"][name] in section
            shown += 1
        if "scores" in part.tables:
            table = store.read(part.ref, "scores")
            assert set(table["topic"]) == {topic.name}
            for row in zip(*(table[name].tolist() for name in COLUMNS), strict=True):
                score = Score(**dict(zip(COLUMNS, row, strict=True)))
                assert not np.isnan(score.at) or f"<td>{format_score(score)}</td>" in section
            shown += table.num_rows
    assert shown > 0


def test_what_a_verdict_has_a_method_beat_is_what_page_and_scores_call_its_baselines(evaluated: Evaluated) -> None:
    store, made, _ = evaluated
    judged = 0
    for part in made:
        topics = [topic for topic in TOPICS if topic.name == part.partition]
        metrics = {criterion.name: criterion.metric for topic in topics for criterion in topic.criteria}
        for name, verdict in verdicts_of_parts(part).items():
            if (paired := verdict.paired) is None:
                continue
            table = store.read(part.ref, "scores")
            is_mine = table["metric"] == metrics[name]
            marked = set(table["method"][is_mine & table["is_baseline"]])
            assert marked.issuperset(paired.baselines), (part.partition, name)
            assert paired.method in set(table["method"][is_mine]) - marked, (part.partition, name)
            judged += 1
    assert judged > 8


@pytest.mark.parametrize("topic", [topic for topic in TOPICS if topic.criteria], ids=lambda topic: topic.name)
def test_no_criterion_fails_the_truth(evaluated: Any, judged: Judged, topic: Topic[Any]) -> None:
    """The truth takes the place of what is judged: a yardstick that it fails measures something else."""
    cases = [case for case in judged if case[0] in topic.criteria]
    assert cases, f"the small study has nothing that topic {topic.name} judges"
    for criterion, items, baselines in cases:
        if criterion.metric in ERRORS:
            truth = np.zeros(len(items.takes))
        elif criterion.metric in SHARES:
            truth = np.full(len(items.takes), SHARES[criterion.metric])
        else:
            truth = items.values["real_frames"]
        beside = {name: found for name, found in items.values.items() if name in baselines}
        values = {(criterion.methods or ("judged",))[0]: truth}
        verdict = criterion.verdict(replace(items, values=beside | values), baselines)
        assert verdict is not None
        assert verdict.level is not Level.FAIL, verdict.reason


def test_what_a_model_draws_is_judged_as_a_distribution_beside_chance(evaluated: Evaluated) -> None:
    store, made, _ = evaluated
    (part,) = [part for part in made if part.partition == "realism"]
    scores = store.read(part.ref, "scores")
    drawn = (scores["item"] == "generated") & (scores["metric"] == "FID")
    assert set(scores["method"][drawn]) == {"actor_like", "copy", "naive_fk", "ridge_scale", "solver"}
    of_solver = scores["value"][(scores["method"] == "solver") & (scores["metric"] == "FID")]
    assert len(set(of_solver.tolist())) == 1  # chance is the same for what is predicted and what is drawn


def test_the_page_is_whole_small_and_opens_in_a_browser(evaluated: Evaluated, tmp_path: Path) -> None:
    store, made, _ = evaluated
    text = store.attachment(made[-1].ref, "report.html").decode()
    page = Page(text)
    assert (page.problems, page.outside, page.unnamed) == ([], [], [])
    assert {link.removeprefix("#") for link in page.links} <= page.ids
    assert len(text) < 5e6
    assert len(page.scenes) >= 6
    players = "document.querySelectorAll('figure.player').forEach(ready);"
    answer = in_browser(text, f"{players} return document.querySelectorAll('canvas').length;", tmp_path)
    assert answer == {"found": len(page.scenes), "errors": []}


def test_sections_come_in_the_order_of_the_registry_and_verdicts_first(evaluated: Evaluated) -> None:
    store, made, page = evaluated
    headings = re.findall(r'<h2 id="[^"]*">(.*?)<', page)
    topics = [topic.heading for topic in TOPICS]
    assert headings == ["What was built", "Is it good?", *topics, "Skipped, and why", "Sources and licences"]
    judged = {part.partition for part in made if verdict_of(part) is not None}
    table = store.read(made[-1].ref, "verdicts")
    ours = [name for stage, name in zip(table["stage"], table["partition"], strict=True) if stage == "evaluation"]
    assert {name.split()[0] for name in ours} == judged
    assert {"views", "reconstruction", "augmentation", "models", "sets", "lifting"} <= judged
    assert "Rows of the evaluation compare results with a baseline" in page
    sections = {"ingest": "takes", "training": "models", "augmentation": "augmentation", "chains": "chains"}
    for stage, section in sections.items():
        assert f'<a href="#{section}"><b>{stage}</b></a>' in page
    card = store.attachment(made[-1].ref, "card.md").decode()
    assert "## Is it good?" in card
    for name in ours:
        assert f"evaluation: {name.replace('_', ' ')}" in page
        assert f"- evaluation: {name.replace('_', ' ')}: " in card


def test_topics_that_need_torch_are_planned_everywhere_and_its_lack_is_one_sentence(
    evaluated: Evaluated, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, _, _ = evaluated
    names = {"realism", "recognition", "prediction"}
    stage = evaluation_stage([topic for topic in TOPICS if topic.name in names])
    given = inputs_of(store, stage), stage.parameters(num_realism_variants=2, num_downstream_seeds=1)
    here = stage.plan(*given)
    monkeypatch.setattr("pasdedeux.learning.settings.find_spec", lambda name: None)
    assert stage.plan(*given) == here
    assert {shard.partition for shard in here[:-1]} == names
    for shard in here[:-1]:
        with pytest.raises(InputError, match=r"needs torch, which is not installed .* --set evaluation.num_\w+=0"):
            stage.run_shard(shard, store)


class ToySettings(Parameters):
    num_toys: int = 0


def plan_toys(inputs: StageInputs, settings: ToySettings) -> list[Shard]:
    return [TOY.shard(inputs, "all", ToySettings(num_toys=settings.num_toys), takes=inputs.of("poses"))]


def count_toys(shard: Shard, store: Store) -> TopicResult[float]:
    count = shard.options(ToySettings).num_toys * len(shard.refs("takes"))
    values = {"counted": np.full(12, float(count)), "guessed": np.full(12, 7.0), "thrown": np.full(12, 9.0)}
    scores = [Score("toys", name, value[0]) for name, value in values.items()]
    items = {"": Items(values, ["box"] * 12, np.arange(12.0)), "broken toys": Items()}
    return TopicResult(scores, ["Toys were counted."], items, ("guessed", "thrown"), shown=count)


def draw_toys(count: float) -> Iterator[Picture]:
    yield Picture("toy.svg", f"{count:g} toys.", compared_figure({"a": count}, (), goal=1.0, x_label=""))


def tabulate_toys(scores: ScoresOf) -> list[TextTable]:
    return [TextTable("Toys by name", ("name",), tuple((score.method,) for score in scores["toys"]))]


TOY = Topic(
    name="toys",
    heading="Toys & games",
    introduction="How many toys there are.",
    reads=("poses",),
    plan=plan_toys,
    compute=count_toys,
    draw=draw_toys,
    tabulate=tabulate_toys,
    settings=ToySettings,
    criteria=(Criterion("toys", "toys", "", "boxes"), Criterion("toys", "toys", "", "boxes", name="broken toys")),
    cautions=(("poses", "Toys break."),),
)


def test_a_new_topic_is_one_more_in_the_registry(small: BuiltStudy, tmp_path: Path) -> None:
    store = Store(small.copy_store(tmp_path))
    stage = evaluation_stage([topic for topic in TOPICS if topic.name == "takes"] + [TOY])
    assert set(stage.parameters.model_fields) == {"title", "description", "num_toys"}
    made = evaluate(store, stage, num_toys=3)
    page = page_of(store, made)
    words = ("Toys & games", "How many toys there are.", "Toys were counted.", "6 toys.", "Toys by name", "Toys break.")
    assert all(text in page for text in (*words, "<td>6</td>"))
    table = store.read(made[-1].ref, "verdicts")
    names = ("partition", "level", "value", "baseline", "baseline_name", "count", "thing")
    toys = [row for row in zip(*(table[name].tolist() for name in names), strict=True) if row[0].startswith("toys")]
    assert toys[0] == ("toys", "pass", 6.0, 7.0, "guessed", 12, "boxes")
    assert toys[1][:2] == ("toys broken toys", "not judged")
    assert "counted performed better than guessed, by 1 (1 to 1, over 12 blocks of 1 s)" in page
    assert '<span class="badge not-judged">? not judged</span>' in page
    worse = page_of(store, evaluate(store, stage, num_toys=4))
    assert "counted performed worse than guessed, by 1" in worse, "better than the other guess is not enough"


def test_another_licence_of_the_same_data_is_another_page(tmp_path: Path) -> None:
    """The data are not made anew, so the page has to learn of it by its own key; no topic is computed again."""
    columns, facts = take_rows("waltz", 2, 2)
    take, stage = put(Store(tmp_path / "store"), "ingest", "waltz", {"poses": columns}, facts), evaluation_stage([TOY])
    once, again = (
        stage.plan(StageInputs({"poses": [replace(take, sources=(source,))]}, seed=0), stage.parameters())
        for source in (SourceCredit("waltz", licence, "a studio") for licence in ("CC0-1.0", "CC-BY-NC-ND-4.0"))
    )
    assert [shard.key for shard in once[:-1]] == [shard.key for shard in again[:-1]]
    assert once[-1].key != again[-1].key


def test_only_what_was_held_out_is_judged(evaluated: Evaluated) -> None:
    _, made, _ = evaluated
    assert [verdict_of(part).count > 0 for part in made if part.partition == "sets"] == [True]
    for part in made:
        for verdict in verdicts_of_parts(part).values():
            if part.partition in ("views", "lifting", "sets", "leave_one_out") and verdict.paired is not None:
                assert set(verdict.paired.takes) == {"hug"}, "the take that is held out"


def test_what_lifting_fills_in_has_verdicts_of_its_own(evaluated: Evaluated) -> None:
    store, made, page = evaluated
    judged = {name for part in made if part.partition == "lifting" for name in verdicts_of_parts(part)}
    assert judged == {criterion.name for criterion in lifting.TOPIC.criteria}
    table = store.read(made[-1].ref, "verdicts")
    for name in judged:
        assert f"lifting {name}".strip() in table["partition"].tolist()
        assert part_name("evaluation", f"lifting {name}".strip()) in page
