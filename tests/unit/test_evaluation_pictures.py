"""Pictures, clips, report and card."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pasdedeux.evaluation.card import CardSource, DatasetCard, card_tables, render_card
from pasdedeux.evaluation.drawing import PERSON_COLOURS, pair_panel, skeleton_sheet
from pasdedeux.evaluation.overlay import overlay_clip
from pasdedeux.evaluation.report import Picture, Report, Section, TextTable, render_report
from pasdedeux.evaluation.scores import Score, columns_of, summarise
from pasdedeux.evaluation.takes import take_scores, take_sheet
from pasdedeux.skeletons import BODY22, OP14
from storage_schema.tables import TABLES


def _people(frames: int, persons: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.normal(size=(frames, persons, 22, 3)) * 0.3 + [0, 1, 0]


def test_the_same_sheet_gives_the_same_bytes() -> None:
    panels = [pair_panel("0 s", BODY22, _people(1, 2)[0])]
    assert skeleton_sheet(panels) == skeleton_sheet(panels)


def test_a_sheet_of_no_moments_is_still_a_picture() -> None:
    picture = cv2.imdecode(np.frombuffer(skeleton_sheet([]), np.uint8), cv2.IMREAD_COLOR)
    assert min(picture.shape[:2]) > 50
    assert (picture == 255).all()


@pytest.mark.parametrize("persons", [1, 2, 3])
@pytest.mark.parametrize("frames", [1, 40])
def test_a_take_is_drawn_with_everybody_in_it(persons: int, frames: int) -> None:
    picture = take_sheet("waltz", _people(frames, persons), 30.0)
    assert cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR).shape[0] > 300


def test_everybody_has_a_colour_and_objects_are_grey() -> None:
    people, hoop = _people(1, 3)[0], np.array([[[-0.5, 1.5, 0.0], [0.5, 1.5, 0.0]]])
    ball = np.full((1, 2, 3), [0.4, 1.9, 0.4])
    sheets = [
        skeleton_sheet([pair_panel("", BODY22, people[:count], None, objects)])
        for count, objects in ((2, None), (3, None), (3, hoop), (3, ball))
    ]
    counts = []
    for sheet in sheets:
        picture = cv2.imdecode(np.frombuffer(sheet, np.uint8), cv2.IMREAD_COLOR).reshape(-1, 3)
        third = np.array([int(PERSON_COLOURS[2][i : i + 2], 16) for i in (5, 3, 1)])
        counts.append([int((picture == colour).all(axis=1).sum()) for colour in (third, np.full(3, 0x77))])
    assert counts[0][0] == 0 < counts[1][0]
    assert counts[1][1] < 0.1 * counts[2][1]
    assert sheets[3] != sheets[1]


def test_left_limbs_are_drawn_darker_than_right_ones() -> None:
    left_only, right_only = np.full((2, 2, 22, 3), np.nan)
    for side, target in (("left_", left_only), ("right_", right_only)):
        for joint, height in (("hip", 1.0), ("knee", 0.5), ("ankle", 0.0)):
            target[0, BODY22.index(side + joint)] = [0.0, height, 0.0]
    dark, bright = (
        cv2.imdecode(
            np.frombuffer(skeleton_sheet([pair_panel("", BODY22, pair)], yaws_rad=(0.0,)), np.uint8), cv2.IMREAD_COLOR
        ).astype(float)
        for pair in (left_only, right_only)
    )
    saturation = [image.max(axis=2) * (image.max(axis=2) - image.min(axis=2) > 60) for image in (dark, bright)]
    assert 0 < saturation[0].max() < saturation[1].max()


def _decode(clip: bytes) -> list[np.ndarray]:
    is_read, animation = cv2.imdecodeanimation(np.frombuffer(clip, np.uint8))
    assert is_read
    return list(animation.frames)


def test_a_clip_has_every_frame_and_leaves_out_missing_joints() -> None:
    keypoints = np.full((5, 1, 14, 2), np.nan)
    keypoints[1:, 0, :2] = [[320.0, 100.0], [320.0, 200.0]]
    keypoints[:, 0, :2] += np.arange(5)[:, None, None] * 20.0  # equal neighbours would be merged into one frame
    frames = _decode(overlay_clip(OP14, keypoints, image_size_px=(640, 360), rate_hz=10.0))
    assert len(frames) == 5
    assert frames[0].shape[:2] == (270, 480)
    spread = [int(frame[..., :3].max()) - int(frame[..., :3].min()) for frame in frames]
    assert spread[0] < 40 < spread[3]


def test_the_image_axes_of_a_clip_are_right_and_down() -> None:
    keypoints = np.full((1, 1, 14, 2), np.nan)
    keypoints[0, 0, 0] = [400.0, 60.0]
    image = _decode(overlay_clip(OP14, keypoints, image_size_px=(480, 270), rate_hz=10.0))[0][..., :3].astype(int)
    rows, columns = np.nonzero(image.max(axis=-1) - image.min(axis=-1) > 60)
    assert abs(rows.mean() - 60) < 2
    assert abs(columns.mean() - 400) < 2


def test_a_clip_gives_the_same_bytes_twice_and_survives_points_far_outside() -> None:
    keypoints = np.random.default_rng(1).normal(size=(4, 2, 14, 2)) * 1e7
    clips = {overlay_clip(OP14, keypoints, image_size_px=(640, 480), rate_hz=25.0) for _ in range(2)}
    assert len(clips) == 1


def test_the_report_needs_no_other_file_and_escapes_what_it_shows() -> None:
    picture = Picture(name="a.png", caption="a picture", content=skeleton_sheet([]))
    table = TextTable(caption="<scores>", headings=("method", "value"), rows=(("copy", "1"),), levels=("warn",))
    page = render_report(
        Report("A study", ("made from duets",), [Section("Takes & all", ("text",), (table,), (picture,))])
    )
    assert "http" not in page
    assert "&lt;scores&gt;" in page
    assert '<tr class="warn"><td>copy</td>' in page
    assert 'href="#takes---all"' in page
    assert "data:image/png;base64," in page


def test_the_card_names_every_source_with_its_licence() -> None:
    card = DatasetCard(
        title="Duets",
        description="d",
        rows={"poses": 1200},
        takes=["waltz", "hug"],
        held_out=["hug"],
        sources=[CardSource("CMU", "free for all uses", "mocap.cs.cmu.edu")],
        skipped=[],
        cautions=["synthetic"],
    )
    text = render_card(card)
    for part in (
        "| poses | 1,200 |",
        "- hug (held out for evaluation)",
        "**CMU** - free for all uses. mocap.cs.cmu.edu",
    ):
        assert part in text
    shown = [row for table in card_tables(card) for row in table.rows]
    for row in (
        ("CMU", "free for all uses", "mocap.cs.cmu.edu"),
        ("hug", "held out for evaluation"),
        ("poses", "1,200"),
        ("synthetic",),
    ):
        assert row in shown


def test_scores_have_the_columns_of_their_table_and_a_stable_order() -> None:
    scores = [Score("b", "m", 1.0), Score("a", "m", 2.0, at=3.0), Score("a", "m", 2.0)]
    columns = columns_of("takes", scores)
    assert list(columns) == [column.name for column in TABLES["scores"].columns]
    assert columns == columns_of("takes", reversed(scores))


def test_a_summary_leaves_out_what_is_not_finite() -> None:
    found = summarise(np.array([1.0, 3.0, np.nan]), metric="e", method="m", unit="m")
    assert {s.metric: (s.value, s.count) for s in found}["e_mean"] == (2.0, 2)
    assert summarise(np.array([np.nan]), metric="e", method="m", unit="m") == []


def test_take_scores_know_how_close_people_are() -> None:
    people = np.zeros((10, 2, 22, 3))
    people[:, 1, :, 0] = 1.0
    people[5:, 1, :, 0] = 0.1
    assert {s.metric: s.value for s in take_scores("t", people, 10.0)}["share_closer_than_15_cm"] == 0.5
