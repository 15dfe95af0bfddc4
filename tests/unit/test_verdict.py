"""Verdicts: one word, one sentence, one figure; a method beside every baseline; many as one, however they were cut."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.summary import Summary
from pasdedeux.evaluation.verdicts import Criterion, Items, figure_words, merge_verdicts
from pasdedeux.verdict import Level, Verdict
from storage_schema import Store
from tasks.stage import Parameters, Shard
from tasks.stage.committing import commit
from tasks.stage.facts import Facts
from tasks.summary import judge, stage_verdict, summary_of

BASELINES = ("lifting", "chance", "mean_pair", "real_frames")
CRITERION = Criterion("error", "error of lifted pairs", "m", "images", ("fitted",))


def items(*, takes: Sequence[str], seconds: int, **values: float | np.ndarray) -> Items:
    """Return one item in every second of every take."""
    count = len(takes) * seconds
    noise = 0.001 * np.random.default_rng(0).normal(size=count)
    named = {name: np.broadcast_to(value, count) + noise for name, value in values.items()}
    times_s = np.tile(np.arange(seconds) + 0.5, len(takes))
    return Items(named, np.repeat(takes, seconds).tolist(), times_s)


def verdict_on(some: Items, criterion: Criterion = CRITERION) -> Verdict:
    return criterion.verdict(some, BASELINES)  # type: ignore[return-value]


def test_a_verdict_comes_back_from_json_as_it_was() -> None:
    verdict = Verdict(Level.WARN, "drifts", "contact drift", 0.01, "m", 0.2, "plain forward kinematics", 3, "variants")
    compared = verdict_on(items(takes=["a"], seconds=12, fitted=0.1, lifting=0.2))
    for given in (verdict, compared, merge_verdicts([verdict, compared])):
        assert Verdict.from_json(json.loads(json.dumps(given.to_json(), sort_keys=True))) == given
    bare = Verdict.from_json(Verdict(Level.PASS).to_json())
    assert bare.level is Level.PASS
    assert math.isnan(bare.value)


def test_a_figure_that_is_not_finite_is_kept_as_none_at_all() -> None:
    verdict = Verdict(Level.FAIL, "nothing was found", "distance", math.inf, "m", -math.inf)
    values = json.loads(json.dumps(verdict.to_json(), allow_nan=False))
    assert values["value"] is None
    assert math.isnan(Verdict.from_json(values).baseline)


def test_a_warning_without_a_reason_is_refused() -> None:
    with pytest.raises(ValueError, match="needs a reason"):
        Verdict(Level.WARN)


def test_a_method_has_to_beat_every_baseline_and_not_the_weakest() -> None:
    better = items(takes=["a"], seconds=12, fitted=0.1, chance=0.4, lifting=0.2, mean_pair=0.3)
    verdict = verdict_on(better)
    assert (verdict.level, verdict.baseline_name, verdict.count) == (Level.PASS, "lifting alone", 12)
    assert figure_words(verdict).endswith("(lifting alone), mean of 12 images")
    worse = items(takes=["a"], seconds=12, fitted=0.25, chance=0.4, lifting=0.2, mean_pair=0.3)
    verdict = verdict_on(worse)
    assert (verdict.level, verdict.baseline_name) == (Level.FAIL, "lifting alone")
    assert verdict.reason == "fitted draws performed worse than lifting alone, by 5 cm (5 to 5, over 12 blocks of 1 s)"


def test_what_may_be_chance_is_a_warning() -> None:
    noise = 0.1 * np.random.default_rng(1).normal(size=12)
    for chance, words in ((noise, "behind by"), (-noise, "ahead by")):
        verdict = verdict_on(items(takes=["a"], seconds=12, fitted=0.2 + chance, lifting=0.21))
        assert verdict.level is Level.WARN
        assert f"about as well as lifting alone, {words}" in verdict.reason


@pytest.mark.parametrize(("fitted", "level"), [(0.0985, "pass"), (0.0995, "warn"), (0.1005, "warn"), (0.1015, "fail")])
def test_a_difference_of_less_than_one_percent_does_not_matter_however_certain(fitted: float, level: str) -> None:
    verdict = verdict_on(items(takes=["a"], seconds=12, fitted=fitted, lifting=0.1))
    assert verdict.level == level
    close = verdict_on(items(takes=["a"], seconds=12, fitted=fitted, lifting=0.1, mean_pair=0.101))
    assert close.level == level
    assert close.baseline_name == in_words("lifting")


@pytest.mark.parametrize(
    ("lifting", "mean_pair", "level", "name"),
    [(1.0, 0.955, Level.WARN, "mean_pair"), (0.9, 0.949, Level.FAIL, "lifting")],
)
def test_the_deciding_baseline_is_named(lifting: float, mean_pair: float, level: Level, name: str) -> None:
    verdict = verdict_on(items(takes=["a"], seconds=12, fitted=0.95, lifting=lifting, mean_pair=mean_pair))
    assert (verdict.level, verdict.baseline_name) == (level, in_words(name))


def test_larger_may_be_better() -> None:
    criterion = replace(CRITERION, is_larger_better=True)
    for fitted, level in ((0.3, Level.PASS), (0.1, Level.FAIL)):
        assert verdict_on(items(takes=["a"], seconds=12, fitted=fitted, lifting=0.2), criterion).level is level


def test_a_bound_is_no_baseline_and_is_never_what_is_judged() -> None:
    known = items(takes=["a"], seconds=12, fitted=0.1, lifting=0.2, real_frames=0.01)
    assert verdict_on(known).level is Level.PASS
    with_truth = replace(known, values={**known.values, "truth": np.zeros(12)})
    unnamed = verdict_on(with_truth, replace(CRITERION, methods=()))
    assert (unnamed.level, unnamed.paired.method) == (Level.PASS, "fitted")


def test_only_items_that_the_method_and_all_baselines_have_are_compared() -> None:
    some = items(takes=["a"], seconds=24, fitted=0.1, lifting=0.2)
    gaps = np.where(np.arange(24) % 2, np.nan, some.values["lifting"])
    sparse = replace(some, values={**some.values, "lifting": gaps})
    for given in (sparse, Items.joined([sparse])):
        verdict = verdict_on(given)
        assert (verdict.level, verdict.count) == (Level.PASS, 12)


@pytest.mark.parametrize(
    ("some", "words"),
    [
        (items(takes=["a"], seconds=9, fitted=0.1, lifting=0.2), "only 9 s of motion or stills to compare; 10 are"),
        (items(takes=["a"], seconds=12, fitted=0.1), "no baseline was scored to compare fitted draws with"),
        (items(takes=["a"], seconds=12, fitted=np.nan, lifting=0.2), "fitted draws has no finite figure"),
        (items(takes=["a"], seconds=12, fitted=np.inf, lifting=0.2), "fitted draws has no finite figure"),
        (Items(), "no data was held out for it"),
        (
            Items.joined([items(takes=["a"], seconds=12, **{method: 0.1}) for method in ("fitted", "lifting")]),
            "no images have figures for both fitted draws and every baseline",
        ),
    ],
)
def test_too_little_is_not_judged_and_never_counts_as_a_pass(some: Items, words: str) -> None:
    verdict = verdict_on(some)
    assert verdict.level is Level.NOT_JUDGED
    assert verdict.reason.startswith(words)
    summary = Summary([], [], {"lifting": verdict, "seeds": Verdict(Level.PASS)})
    assert summary.judgement == "1 not judged, 1 pass"
    assert merge_verdicts([replace(verdict, count=1), Verdict(Level.PASS)]).level is Level.NOT_JUDGED


def test_many_images_of_a_second_are_one_block() -> None:
    some = items(takes=["a"], seconds=12, fitted=0.1, lifting=0.2)
    assert verdict_on(replace(some, times_s=np.linspace(0.0, 8.9, 12))).level is Level.NOT_JUDGED


def test_five_takes_are_drawn_as_wholes_and_fewer_second_by_second() -> None:
    """A method that is better on most takes and worse on one is not sure to be better on the next take."""
    lead = np.repeat([0.1, 0.1, 0.1, 0.1, -0.3], 20)
    five = verdict_on(items(takes=["a", "b", "c", "d", "e"], seconds=20, fitted=0.5 - lead, lifting=0.5))
    assert (five.level, "over 5 takes" in five.reason) == (Level.WARN, True)
    four = verdict_on(items(takes=["a", "b", "c", "d"], seconds=20, fitted=0.5 - lead[:80], lifting=0.5))
    assert (four.level, "over 80 blocks of 1 s" in four.reason) == (Level.PASS, True)


def test_a_part_of_which_nothing_is_held_out_changes_nothing() -> None:
    judged = verdict_on(items(takes=["a"], seconds=12, fitted=0.1, lifting=0.2))
    assert merge_verdicts([verdict_on(Items()), judged, verdict_on(Items())]) == judged


def test_a_limit_is_kept_or_broken() -> None:
    criterion = Criterion("switches", "identity switches a minute", "", "sequences", limit=1.0)
    for value, level in ((1.0, Level.PASS), (1.5, Level.FAIL), (np.nan, Level.NOT_JUDGED)):
        verdict = verdict_on(Items({"followed": np.array([value])}, ["a"], [0.0]), criterion)
        assert (verdict.level, verdict.count) == (level, 1)
        if level is not Level.NOT_JUDGED:
            assert (verdict.value, verdict.baseline) == (value, 1.0)


def test_many_verdicts_become_the_worst_with_its_share_and_the_mean_figure() -> None:
    verdicts = [Verdict(Level.PASS, "", "drift", value, "m", 1.0, "plain", thing="variants") for value in (0.1, 0.2)]
    verdicts.append(Verdict(Level.WARN, "too far", "drift", 0.9, "m", 4.0, "plain", thing="variants"))
    verdict = merge_verdicts(verdicts)
    assert (verdict.level, verdict.reason, verdict.count, verdict.thing) == ("warn", "1 of 3: too far", 3, "variants")
    assert (verdict.value, verdict.baseline) == pytest.approx((0.4, 2.0))
    assert merge_verdicts([]) is None


OF_VARIANTS = [
    Verdict(
        Level.FAIL if at % 5 == 0 else Level.PASS, f"bad {at % 2}" * (at % 5 == 0), "drift", at**2, "m", 2.0 * at, "fk"
    )
    for at in range(11)
]
OF_VARIANTS[3] = Verdict(Level.WARN, "nothing is in contact", "drift", math.nan, "m")
OF_IMAGES = [
    verdict_on(items(takes=[take], seconds=3, fitted=0.1 + 0.05 * at, lifting=0.22))
    for at, take in enumerate(["a", "b", "c", "d", "e", "a", "b"])
]


@pytest.mark.parametrize("every", [OF_VARIANTS, OF_IMAGES], ids=["limits", "compared"])
@pytest.mark.parametrize("size", [1, 2, 4, 100])
def test_a_verdict_does_not_depend_on_how_work_is_cut_into_shards(every: list[Verdict], size: int) -> None:
    whole = merge_verdicts(every)
    shards = [merge_verdicts(every[start : start + size]) for start in range(0, len(every), size)]
    joined = merge_verdicts(reversed(shards))
    assert (joined.value, joined.baseline) == pytest.approx((whole.value, whole.baseline), rel=1e-12)
    plain = [replace(verdict, value=0.0, baseline=0.0, paired=None) for verdict in (joined, whole)]
    assert plain[0] == plain[1]


def test_parts_that_are_too_small_to_be_judged_are_judged_together() -> None:
    parts = [verdict_on(items(takes=[take], seconds=6, fitted=0.1, lifting=0.2)) for take in ("a", "b")]
    assert {part.level for part in parts} == {Level.NOT_JUDGED}
    whole = merge_verdicts(parts)
    assert (whole.level, whole.count) == (Level.PASS, 12)


def test_a_stage_and_its_summary_and_table_say_the_same(store: Store) -> None:
    manifests = []
    for name, value, count in (("0", 0.9, 1), ("1", 0.5, 9)):
        verdict = Verdict(Level.PASS, "", "trust", value, count=count, thing="images")
        shard = Shard("views", 1, "hug", name, Parameters())
        manifests.append(store.manifest(commit(shard, store, tables={}, facts=Facts(), verdict=verdict)))
    whole = stage_verdict(manifests)
    assert (round(whole.value, 6), figure_words(whole)) == (0.54, "trust 0.54, mean of 10 images")
    assert summary_of(manifests).verdicts == {"views": whole}
    assert [judgement.verdict for judgement in judge(manifests)] == [whole]
