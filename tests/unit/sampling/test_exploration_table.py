"""The table of all methods of exploration."""

from __future__ import annotations

from pasdedeux.evaluation.scores import Score
from tasks.evaluation.coverage import exploration_table


def covered(method: str, centimetres: float, *, split: str = "held_out") -> list[Score]:
    return [
        Score("num_draws", method, 50.0, split=split),
        Score("coverage_D_C", method, 0.01 * centimetres, "m", split=split),
        Score("coverage_D_C", method, 0.5, "m", split=split, at=1.0),
        Score("as_good_as_real_frames_D_C", method, 30.0, "frames", split=split),
    ]


def went(method: str, seed: int, share: float) -> Score:
    return Score("acceptance_rate_mean", method, share, item=f"seed {seed}")


def test_the_best_coverage_of_unseen_frames_comes_first_and_chains_are_means_over_seeds() -> None:
    coverage = [*covered("ic", 20.0), *covered("grown_seeds", 6.0), *covered("ic", 1.0, split="annotated")]
    (table,) = exploration_table(coverage, [went("ic", 0, 0.25), went("ic", 1, 0.75)])
    assert [row[:4] for row in table.rows] == [
        ("grown pairs", "50", "6 cm", "30 frames"),
        ("interaction coordinates", "50", "20 cm", "30 frames"),
    ]
    columns = table.headings.index("accepted")
    assert [row[columns] for row in table.rows] == ["", "0.5"]


def test_without_held_out_frames_the_unannotated_ones_count_and_without_chains_there_is_no_table() -> None:
    scores = [*covered("ic", 9.0, split="unannotated"), *covered("ic", 3.0, split="annotated")]
    (table,) = exploration_table(scores, [went("ic", 0, 0.5)])
    assert "other frames of the same takes" in table.caption
    assert table.rows[0][2] == "9 cm"
    assert exploration_table(scores, []) == []
    assert exploration_table([], [went("ic", 0, 0.5)]) == []
