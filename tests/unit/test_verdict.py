"""Verdicts: one word, one sentence, one figure."""

from __future__ import annotations

import json
import math

import pytest

from pasdedeux.verdict import Level, Verdict, summarise_verdicts


def test_a_verdict_comes_back_from_json_as_it_was() -> None:
    verdict = Verdict(Level.WARN, "drifts", "contact drift", 0.01, "m", 0.2, "plain forward kinematics")
    assert Verdict.from_json(verdict.to_json()) == verdict
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


def test_many_verdicts_become_the_worst_with_its_share_and_the_median_figure() -> None:
    found = [Verdict(Level.PASS, "", "drift", value, "m", 1.0, "plain") for value in (0.1, 0.2)]
    found.append(Verdict(Level.WARN, "too far", "drift", 0.9, "m", 3.0, "plain"))
    verdict = summarise_verdicts(found)
    assert verdict == Verdict(Level.WARN, "1 of 3: too far", "drift", 0.2, "m", 1.0, "plain", count=3)
    assert summarise_verdicts([]) is None


def test_a_summary_of_summaries_says_its_share_once() -> None:
    pair = summarise_verdicts([Verdict(Level.WARN, "does not mix")] * 2)
    assert pair is not None
    assert summarise_verdicts([pair]) == pair, "one summary keeps its share"
    whole = summarise_verdicts([pair, pair])
    assert whole is not None
    assert (whole.reason, whole.count) == ("4 of 4: does not mix", 4)
