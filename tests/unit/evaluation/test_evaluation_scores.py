"""Scores of views, coverage, variants, reconstructions and models."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.synthetic import random_pairs
from pasdedeux.augmentation import AugmentationSettings, Source
from pasdedeux.augmentation.variations import Variation
from pasdedeux.evaluation.score_tables import format_value, mean_table, score_table
from pasdedeux.evaluation.scores import Score, bootstrap_interval
from pasdedeux.evaluation.verdicts import Criterion
from pasdedeux.interaction.coverage import CoverageCurve
from pasdedeux.kinematics.rotations import normalise
from tasks.evaluation import reconstruction
from tasks.evaluation.augmentation import QUALITY_COLUMNS, contact_drifts, contact_scores, gap_scores, quality_scores
from tasks.evaluation.coverage import as_good_as_real_frames, coverage_scores, real_frame_levels
from tasks.evaluation.model_tables import model_tables
from tasks.evaluation.models import best_model, fall_scores, learning_curves, model_figure, model_scores, share_scores
from tasks.evaluation.reconstruction import Reconstructed, pair_scores, reconstruction_items, reconstruction_scores
from tasks.evaluation.views import view_errors
from tests.builders.moving_pairs import swaying_pair


def _by_method(scores: list[Score], metric: str) -> dict[str, float]:
    return {score.method: score.value for score in scores if score.metric == metric and np.isnan(score.at)}


def test_view_errors_are_of_the_heaviest_hypothesis_and_of_the_best_one() -> None:
    truth = normalise(np.random.default_rng(0).normal(size=(50, 3)))
    hypotheses = [(np.stack([-view, view]), np.array([0.7, 0.3])) for view in truth]
    errors = view_errors(hypotheses, truth)
    np.testing.assert_allclose(errors["heaviest_hypothesis"], 180.0)
    np.testing.assert_allclose(errors["best_hypothesis"], 0.0, atol=1e-5)


def _pairs(count: int, seed: int) -> np.ndarray:
    return random_pairs(np.random.default_rng(seed), count)


def test_real_frames_cover_better_the_more_there_are() -> None:
    levels = real_frame_levels(_pairs(12, 0), _pairs(40, 1), np.random.default_rng(2))
    assert levels.num_draws.tolist() == [1, 3, 10, 30]
    assert (np.diff(levels.cartesian_m) <= 0).all()


def test_a_set_of_real_frames_is_as_good_as_itself() -> None:
    levels, counts = np.array([0.3, 0.2, 0.1]), np.array([1, 10, 100])
    assert as_good_as_real_frames(0.2, levels, counts) == pytest.approx(10.0)
    assert as_good_as_real_frames(0.15, levels, counts) == pytest.approx(np.sqrt(1000.0))
    assert as_good_as_real_frames(0.31, levels, counts) == 0.0
    assert as_good_as_real_frames(0.01, levels, counts) == pytest.approx(100.0)


def test_coverage_scores_hold_the_curve_and_its_end_for_every_method() -> None:
    curve = CoverageCurve(np.array([1, 5]), np.array([0.5, 0.4]), np.array([0.2, 0.1]), np.array([0.6, 0.5]))
    scores = coverage_scores({"ic": curve, "prior_only": curve}, curve, split="held_out")
    assert _by_method(scores, "coverage_D_C") == {"ic": 0.1, "prior_only": 0.1, "real_frames": 0.1}
    assert sum(not np.isnan(s.at) for s in scores) == 2 * 3 * 3


def test_quality_scores_show_contact_drift_beside_plain_forward_kinematics() -> None:
    columns = {name: np.array([0.01, np.nan, 0.03]) for name in QUALITY_COLUMNS}
    columns |= {"contact_drift_fk_m": np.array([0.1, 0.2, 0.3]), "verdict": np.array(["pass"] * 2 + ["fail"])}
    scores = quality_scores(columns, item="waltz")
    assert _by_method(scores, "contact_drift_mean") == pytest.approx({"interaction_mesh": 0.02, "naive_fk": 0.2})
    assert _by_method(scores, "jerk_ratio_worst") == {"interaction_mesh": 0.03}
    assert {s.metric: s.value for s in scores if s.metric.startswith("variants_")} == {
        "variants_pass": 2.0,
        "variants_warn": 0.0,
        "variants_fail": 1.0,
    }


def test_a_perfect_reconstruction_scores_zero_and_standing_still_does_not() -> None:
    truth = np.random.default_rng(3).normal(size=(20, 14, 3))
    person = Reconstructed("s person 0", truth, {"viterbi": truth + np.array([1.0, 2.0, 3.0])}, np.arange(20))
    errors = _by_method(reconstruction_scores(person, split="held_out"), "error_root_kept")
    assert errors["viterbi"] == pytest.approx(0.0, abs=1e-12)
    assert errors["standing_still"] > 0.5


def test_a_reconstruction_has_to_beat_retrieval_and_not_the_mean_pose_that_nobody_knows() -> None:
    truth = np.random.default_rng(3).normal(size=(360, 14, 3))
    still = np.broadcast_to(truth.mean(axis=0), truth.shape)
    found = {"nearest": 1.2 * truth, "fit_clean": 1.1 * truth, "standing_still": still}
    times_s = np.arange(360) / 30.0
    person = Reconstructed("s person 0", truth, found, np.arange(360), 0, ["hug"] * 360, times_s)
    (criterion,) = reconstruction.TOPIC.criteria
    verdict = criterion.verdict(reconstruction_items([person, person]), reconstruction.BASELINES)
    assert verdict is not None
    assert (verdict.level, verdict.baseline_name, verdict.count) == ("pass", "nearest pose", 720)
    scores = reconstruction_scores(person, split="held_out")
    assert verdict.value == pytest.approx(_by_method(scores, "error_root_kept")["fit_clean"])
    assert verdict.baseline == pytest.approx(_by_method(scores, "error_root_kept")["nearest"])


def test_items_of_a_part_that_has_a_figure_over_all_of_them_do_not_count_twice() -> None:
    """Otherwise a picture shows 2.5 where the table has 1: `hug at 1.25` is in `hug`, and both are in `all`."""
    values = {"all": 1.0, "hug": 3.0, "hug at 1.25": 3.5}
    scores = [
        Score("E_r", method, factor * value, "m", method == "copy", split="random", item=item)
        for method, factor in (("ridge", 1.0), ("copy", 10.0))
        for item, value in values.items()
    ]
    scores += [Score("E_r", method, 2.0, "m", method == "copy", split="b", item="x") for method in ("ridge", "copy")]
    drawn = Criterion("E_r", "error", "cm", "variants").picture(scores)
    assert drawn is not None
    assert b">150<" in drawn[0]
    assert "mean over 2 parts of the data" in drawn[1]
    held_out = [Score("E_r", name, 7.0, "m", name == "copy", split="held_out") for name in ("ridge", "copy")]
    alone = Criterion("E_r", "error", "cm", "variants").picture([*scores, *held_out])
    assert alone is not None
    assert b">150<" not in alone[0], "what was learned from is never in one mean with what was held out"


def test_pair_scores_measure_the_depth_between_two_people_in_the_frames_that_have_both() -> None:
    truth = np.random.default_rng(4).normal(size=(10, 14, 3))
    partner = truth + np.array([3.0, 0.0, 4.0])
    here = Reconstructed("s person 0", truth, {"fit": truth + 7.0}, np.arange(10))
    there = Reconstructed("s person 1", partner[4:], {"fit": partner[4:] + 7.0}, np.arange(4, 10))
    scores = pair_scores(here, there, split="held_out", item="s")
    assert {score.count for score in scores} == {6}
    assert _by_method(scores, "pair_place_error") == pytest.approx({"fit": 0.0, "equal_depth": 4.0})
    assert _by_method(scores, "pair_depth_error") == pytest.approx({"fit": 0.0, "equal_depth": 4.0})
    assert _by_method(scores, "pair_distance_error") == pytest.approx({"fit": 0.0, "equal_depth": 2.0})
    apart = Reconstructed("s person 1", partner, {"fit": partner}, np.arange(20, 30))
    assert pair_scores(here, apart, split="held_out", item="s") == []


def test_model_scores_leave_out_a_distance_that_no_take_has_and_say_how_sure_they_are() -> None:
    known = ({"E_r": 1.0, "E_b": 2.0, "PWD": 5.0}, {"E_r": 3.0, "E_b": 4.0, "PWD": 7.0})
    errors = {"copy": [{**figures, "JPD": np.nan} for figures in known]}
    scores = model_scores(errors, split="cross_scale test", item="all")
    assert {s.metric: s.value for s in scores} == {"E_r": 2.0, "E_b": 3.0, "PWD": 6.0}
    assert {(s.low, s.high) for s in scores if s.metric == "E_r"} == {(1.0, 3.0)}
    assert model_figure([0.75, 1.25], errors, baselines=("copy",), split="cross_scale")


def test_a_bootstrap_interval_holds_the_mean_of_what_was_drawn_from_in_19_of_20_cases() -> None:
    generator = np.random.default_rng(0)
    intervals = np.array([bootstrap_interval(generator.exponential(size=40)) for _ in range(300)])
    share = ((intervals[:, 0] < 1.0) & (intervals[:, 1] > 1.0)).mean()
    # Bootstrap percentiles of 40 skewed values hold it in about 92 %; three deviations of 300 cases are 4.7 %.
    assert 0.87 < share < 0.98
    assert np.isnan(bootstrap_interval(np.array([1.0]))).all()


def test_an_interval_over_takes_is_of_takes_however_many_variants_each_has() -> None:
    of_takes = np.random.default_rng(0).exponential(size=12)
    wanted, values = bootstrap_interval(of_takes), np.repeat(of_takes, 20)
    takes = [f"take {number:02d}" for number in range(12) for _ in range(20)]
    np.testing.assert_allclose(bootstrap_interval(values, units=takes), wanted)
    low, high = bootstrap_interval(values)
    assert high - low < 0.4 * (wanted[1] - wanted[0])
    for few in (1, 4):
        assert np.isnan(bootstrap_interval(values[: 20 * few], units=takes[: 20 * few])).all()
    errors = {name: [{"E_r": factor * value} for value in values] for name, factor in (("copy", 1.0), ("ridge", 0.5))}
    score = model_scores(errors, item="all", split="s", takes=takes)[0]
    np.testing.assert_allclose((score.low, score.high), wanted)
    (share,) = share_scores(errors, rivals=("copy",), split="s", takes=takes)
    np.testing.assert_allclose((share.low, share.value, share.high), 50.0)


def test_the_share_of_the_best_baselines_error_is_surer_than_either_error_where_they_go_together() -> None:
    generator = np.random.default_rng(0)
    hard = generator.exponential(size=60)
    values = {"copy": 2.0 * hard, "naive_fk": 3.0 * hard, "ridge": hard * generator.uniform(0.9, 1.1, 60)}
    errors = {name: [{"E_r": value} for value in of_method] for name, of_method in values.items()}
    (score,) = share_scores(errors, rivals=("copy", "naive_fk"), split="random test")
    assert score.method == "ridge"
    assert score.value == pytest.approx(50.0, abs=3.0)
    assert score.low < score.value < score.high
    low, high = bootstrap_interval(hard)
    assert (score.high - score.low) / score.value < 0.2 * (high - low) / hard.mean()
    assert share_scores({"ridge": errors["ridge"]}, rivals=("copy",), split="s") == []


def test_a_table_shows_the_interval_of_a_figure_and_a_mean_over_items_has_none() -> None:
    scores = [Score("E_r", "copy", 2.0, "cm", item=item, low=1.5, high=2.5) for item in ("a", "b")]
    assert score_table(scores, caption="c").rows[0][-1] == "2 cm (1.5 to 2.5)"
    means = mean_table(scores, caption="c")
    assert means is not None
    assert means.rows[0][-1] == "2 cm"


def test_every_model_and_the_solver_stand_in_the_tables_of_models_and_cases_are_of_the_best() -> None:
    errors = {
        "copy": [{"E_r": 4.0, "E_b": 9.0, "JPD": 3.0, "PWD": 1.0}] * 2,
        "ridge": [{"E_r": 0.5, "E_b": 0.1, "JPD": 0.2, "PWD": 0.1}] * 2,
        "solver": [{"contact_error": 0.4}] * 2,
    }
    twice = {name: [{metric: 2.0 * value for metric, value in of[0].items()}] * 2 for name, of in errors.items()}
    scores = [
        score
        for split in ("random test", "cross_scale test")
        for item, of_item in (("all", errors), ("hug", errors), ("hug at 1.25", twice))
        for score in model_scores(of_item, split=split, item=item)
    ]
    whole, contacts, motions, largest = model_tables(scores)
    assert [row[1:] for row in contacts.rows] == [("- / 3.00",) * 2, ("- / 0.20",) * 2]
    assert whole.headings == ("model", "random", "cross_scale")
    assert [row[:2] for row in whole.rows] == [
        ("copy of the source", "4 (4 to 4) / 1 (1 to 1)"),
        ("ridge", "0.5 (0.5 to 0.5) / 0.1 (0.1 to 0.1)"),
    ]
    splits = ("random", "cross_scale")
    assert motions.rows == tuple(("hug", split, "4.00 / 9.00 / 3.00", "0.50 / 0.10 / 0.20") for split in splits)
    assert largest.rows == tuple(("hug", split, "8.00 / 18.00 / 6.00", "1.00 / 0.20 / 0.40") for split in splits)
    assert best_model(scores, split="random test", baselines=("copy",)) == "ridge"
    assert best_model(scores, split="random test", baselines=("copy", "ridge")) == "ridge"
    assert model_tables([]) == []


def test_a_model_whose_validation_still_fell_in_its_last_segment_is_marked_on_that_split_alone() -> None:
    errors = {name: [{"E_r": 4.0, "PWD": 1.0}] for name in ("copy", "falling", "still")}
    splits = ("random test", "cross_scale test")
    scores = [score for split in splits for score in model_scores(errors, split=split, item="all")]
    log = {"quantity": np.array(["train_loss", "validation_fall", "num_train"])}
    logs = {"falling": log | {"value": np.array([5.0, 1.5, 9.0])}, "still": log | {"value": np.array([5.0, 0.5, 9.0])}}
    (table,) = model_tables([*scores, *fall_scores(logs, "random test")])
    marked = {(row[0], at) for row in table.rows for at, cell in enumerate(row) if "still fell" in cell}
    assert marked == {("falling", table.headings.index("random"))}


def test_networks_trained_with_several_seeds_stand_together_and_their_segments_make_a_curve() -> None:
    values = {"copy": 4.0, "net": 1.0, "net_seed1": 1.5, "net_seed2": 2.0}
    errors = {name: [{"E_r": value, "PWD": 1.0, "JPD": value}] for name, value in values.items()}
    _, seeds, contacts = model_tables(model_scores(errors, split="random test", item="all"))
    assert seeds.rows == (("net", "1.50 (1.00 to 2.00, 3 seeds)"),)
    assert [row[1] for row in contacts.rows] == [f"- / {value:.2f}" for value in (4.0, 2.0, 1.5, 1.0)]
    quantities = np.array(["validation_error_cm", "validation_copy_error_cm", "train_loss"])
    logs = [
        {"model": np.array(["net"] * 3), "step": np.full(3, step), "quantity": quantities, "value": np.array(found)}
        for step, found in ((20, [1.0, 4.0, 0.1]), (10, [2.0, 4.0, 0.2]))
    ]
    curves = {name: [axis.tolist() for axis in curve] for name, curve in learning_curves(logs).items()}
    assert curves == {"net": [[10.0, 20.0], [2.0, 1.0]], "copy": [[10.0, 20.0], [4.0, 4.0]]}


def test_tables_put_methods_side_by_side_and_baselines_last() -> None:
    scores = [
        Score("E_r", "copy", 2.0, "cm", is_baseline=True),
        Score("E_r", "ridge", 1.0, "cm"),
        Score("E_r", "ridge", 0.5, "cm", at=3.0),
    ]
    table = score_table(scores, caption="c")
    assert table.headings == ("figure", "ridge", "copy of the source (baseline)")
    assert table.rows == (("joint error E_r", "1 cm", "2 cm"),)


def test_a_table_of_one_method_has_a_row_for_each_item() -> None:
    scores = [Score(m, "capture", v, "m", item=i) for i in ("hug", "waltz") for m, v in (("a", 0.1), ("b", 0.2))]
    table = score_table(scores, caption="c")
    assert table.headings == ("item", "a", "b")
    assert table.rows == (("hug", "10 cm", "20 cm"), ("waltz", "10 cm", "20 cm"))


def test_items_come_in_natural_order_and_clean_before_other_conditions() -> None:
    scores = [
        Score("e", method, 0.1, "m", split=split, item=item)
        for method in ("fit", "nearest")
        for split in ("30 % missing", "clean")
        for item in ("clip_10", "clip_2", "all")
    ]
    rows = [row[1:3] for row in score_table(scores, caption="c").rows]
    assert rows[:3] == [("clean", "all"), ("clean", "clip_2"), ("clean", "clip_10")]
    assert [split for split, _ in rows[3:]] == ["30 % missing"] * 3


def test_means_count_every_item_once_and_leave_out_methods_that_not_all_have() -> None:
    scores = [
        Score("e", "fit", value, "m", item=item)
        for item, value in (("a at 0", 0.1), ("a, mean of views", 0.2), ("b at 0", 0.5), ("b, mean of views", 0.4))
    ]
    scores += [Score("e", "window", 0.1, "m", item="a, mean of views"), Score("x", "fit", 1.0, "m", at=2.0)]
    table = mean_table(scores, caption="c")
    assert table is not None
    assert table.rows == (("mean of 2", "30 cm"),)
    assert mean_table(scores[:1], caption="c") is None


def test_lengths_are_shown_in_centimetres_and_what_is_not_a_number_as_a_dash() -> None:
    assert format_value(0.0123, "m") == "1.23 cm"
    assert format_value(-7e-13, "m") == "0 cm"
    assert format_value(float("nan"), "m") == "-"
    assert format_value(12345.6, "frames") == "12,346 frames"


def test_contacts_are_scored_by_class_beside_plain_fk_and_the_source_itself_keeps_them() -> None:
    source = Source(swaying_pair(8), 30.0)
    scale = np.ones((2, 22))
    still = contact_scores(contact_drifts(source.contacts(), source, [(scale, source.positions_m)]), item="x")
    assert max(score.value for score in still) < 1e-9
    scale[0] = 0.8
    scores = contact_scores(contact_drifts(source.contacts(), source, [(scale, source.positions_m)]), item="x")
    assert {score.metric for score in scores} == {f"hand_contact_drift_{name}" for name in ("median", "p95", "worst")}
    drift = _by_method(scores, "hand_contact_drift_p95")
    assert drift["naive_fk"] > 0.05
    assert drift["interaction_mesh"] == pytest.approx(0.0, abs=1e-12)


def test_a_take_without_contacts_has_no_drifts() -> None:
    source = Source(swaying_pair(8, apart_m=5.0), 30.0)
    drifts = contact_drifts(source.contacts(), source, [(np.ones((2, 22)), source.positions_m)])
    assert {method: found.shape for method, found in drifts.found_m.items()} == {
        "interaction_mesh": (1, 0),
        "naive_fk": (1, 0),
    }
    assert contact_scores(drifts, item="x") == []


def test_the_gap_is_that_of_the_first_and_last_variant_in_the_middle_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bulk solver ends 2 and 6 cm away from the other solver, with 20 % and 50 % more energy."""
    solved: list[tuple[str, int, list[str]]] = []

    class Solver:
        def __init__(self, sample: Source, settings: AugmentationSettings, user_contacts: object) -> None:
            self.sample, self.solver = sample, settings.solver

        def solve(self, variations: list[Variation]) -> list[SimpleNamespace]:
            solved.append((self.solver, self.sample.num_frames, [variation.variant_id for variation in variations]))
            is_bulk, people = self.solver == "bulk", self.sample.positions_m
            away, energy = ([0.02, 0.06], [1.2, 1.5]) if is_bulk else ([0.0, 0.0], [1.0, 1.0])
            estimated = [0.03, None] if is_bulk else [None, None]
            return [
                SimpleNamespace(positions_m=np.add(people, [0.0, far, 0.0]), energy=cost, estimated_gap_m=guess)
                for far, cost, guess in zip(away, energy, estimated, strict=True)
            ]

    monkeypatch.setattr("tasks.evaluation.augmentation.Augmenter", Solver)
    source = Source(swaying_pair(100), 20.0)
    scores = gap_scores(source, np.ones((5, 2, 22)), AugmentationSettings(), item="waltz")
    assert solved == [("bulk", 20, ["0", "4"]), ("polished", 20, ["0", "4"])]
    found = {score.metric: (score.value, score.unit, score.item, score.count) for score in scores}
    wanted = {"sample_gap_mean": 0.04, "sample_gap_worst": 0.06, "sample_estimated_gap_mean": 0.015}
    wanted |= {"sample_estimated_gap_worst": 0.03}
    for metric, value in wanted.items():
        assert found[metric] == (pytest.approx(value), "m", "waltz", 2)
    assert found["sample_energy_excess_worst"] == (pytest.approx(0.5), "", "waltz", 2)
