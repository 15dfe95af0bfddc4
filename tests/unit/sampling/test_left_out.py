"""Annotations that are left out, distances of draws to them, and the map of annotations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.synthetic import random_pairs
from pasdedeux.cameras.frames import project_pair
from pasdedeux.errors import InputError
from pasdedeux.sampling.annotations import is_left_out
from tasks.evaluation.leave_one_out import (
    annotation_map_figure,
    nearest_curve,
    nearest_draw_figure,
    nearest_draw_scores,
)

PAIRS = random_pairs(np.random.default_rng(0), 60, spread_rad=0.3)
VIEWS = np.array([[0.0, 0.2, 1.0], [0.8, 0.1, 0.6]])
IMAGES = [project_pair(pair, VIEWS[1]) for pair in PAIRS[:6]]


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 400)), min_size=1, max_size=60),
    st.integers(0, 6),
    st.booleans(),
)
def test_every_nth_moment_is_left_out_as_a_whole(rows: list[tuple[str, int]], every: int, has_stills: bool) -> None:
    names, frames = [name for name, _ in rows], np.array([frame for _, frame in rows])
    left = is_left_out(names, frames, every, {"a"} if has_stills else ())
    moments = [(name, frame if has_stills and name == "a" else frame // 30) for name, frame in rows]
    fate = dict(zip(moments, left.tolist(), strict=True))
    assert [fate[moment] for moment in moments] == left.tolist()
    assert sum(fate.values()) == (len(range(every // 2, len(fate), every)) if every else 0)


def test_an_image_of_a_draw_is_at_no_distance_once_the_draw_is_among_them() -> None:
    draws = np.concatenate([PAIRS[20:], PAIRS[:6]])
    curve = nearest_curve(IMAGES, [VIEWS] * 6, draws)
    assert list(curve) == [10, 46]
    assert (curve[46] <= curve[10]).all()
    assert curve[10].min() > 0.01
    np.testing.assert_allclose(curve[46], 0.0, atol=1e-4)  # draws are kept in single precision


def test_scores_hold_the_curve_and_its_end_and_pictures_are_drawn() -> None:
    draws = {"ic": PAIRS, "prior_only": PAIRS[6:30]}
    curves = {name: nearest_curve(IMAGES, [VIEWS] * 6, pairs) for name, pairs in draws.items()}
    scores = nearest_draw_scores(curves, split="leave_one_out")
    ends = {(score.method, score.metric): score for score in scores if np.isnan(score.at)}
    assert ends["ic", "leave_one_out_d_I_mean"].value < ends["prior_only", "leave_one_out_d_I_mean"].value
    assert [score.at for score in scores if score.method == "ic" and not np.isnan(score.at)] == [10.0, 60.0]
    pictures = (
        nearest_draw_figure({"leave_one_out": curves}),
        annotation_map_figure(
            np.stack(IMAGES), {"ic": np.stack([IMAGES[0], IMAGES[0], IMAGES[3]])}, np.stack(IMAGES[:2])
        ),
    )
    for picture in pictures:
        assert picture.count(b"<path") > 20, "an empty picture"
        assert len(picture) < 60_000


def test_a_map_of_two_annotations_is_refused() -> None:
    with pytest.raises(InputError, match="at least 3"):
        annotation_map_figure(np.stack(IMAGES[:2]), {}, np.zeros((0, 2, 17, 2)))
