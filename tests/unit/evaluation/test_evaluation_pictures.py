"""Moving people, figures, the page and the card."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pasdedeux.evaluation.names import known_methods
from pasdedeux.evaluation.pictures import (
    PERSON_COLOURS,
    CurvePanel,
    Picture,
    _draw_panel,
    curve_figure,
    image_panel,
    new_figure,
    pack_player,
    people_panel,
    rgb,
    shown_frames,
    times_shown,
)
from pasdedeux.evaluation.report import Report, Section, render
from pasdedeux.evaluation.score_tables import TextTable
from pasdedeux.evaluation.scores import Score, columns_of, summarise
from pasdedeux.evaluation.styles import COLOURS, method_style
from pasdedeux.evaluation.summary import Credit, Made, Summary
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.skeletons import BODY22, OP14
from pasdedeux.verdict import Level, Verdict
from storage_schema.tables import TABLES
from tasks.evaluation import report as report_task
from tasks.evaluation.report import DatasetCard, card_tables
from tasks.evaluation.takes import take_scores
from tests.builders.browser import in_browser
from tests.builders.pages import Page


def _people(frames: int, persons: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.normal(size=(frames, persons, 22, 3)) * 0.3 + [0, 1, 0]


def test_a_player_keeps_positions_to_half_a_millimetre_and_says_who_is_not_there() -> None:
    people = _people(5, 2)
    people[2, 1] = np.nan
    links = np.full((5, 3, 2, 3), 0.25)
    packed = pack_player([people_panel("waltz", BODY22, people, links)], rate_hz=12.5)
    assert packed == pack_player([people_panel("waltz", BODY22, people, links)], rate_hz=12.5)
    scene = json.loads(packed)
    values = np.frombuffer(base64.b64decode(scene["data"]), "<i2").reshape(scene["num_frames"], scene["num_points"], 3)
    (panel,) = scene["panels"]
    for person, figure in enumerate(panel["figures"]):
        found = values[:, figure["start"] : figure["start"] + figure["num_points"]] * scene["unit_m"]
        is_there = np.isfinite(people[:, person])
        np.testing.assert_allclose(found[is_there], people[:, person][is_there], atol=0.0005 + 1e-9)
        assert (values[2, figure["start"]] == -32768).all() == (person == 1)
    (lines,) = panel["lines"]
    np.testing.assert_array_equal(values[:, lines["start"] : lines["start"] + 2 * lines["num_lines"]], 250)
    assert [len(skeleton["bones"]) for skeleton in scene["skeletons"]] == [len(BODY22.bones)]


@pytest.mark.parametrize("shape", [(0, 2), (1, 1), (40, 3)])
def test_players_of_no_frame_one_person_or_three_are_whole(shape: tuple[int, int]) -> None:
    scene = json.loads(pack_player([people_panel("x", BODY22, _people(*shape))], rate_hz=30.0))
    colours = [figure["colour"] for figure in scene["panels"][0]["figures"]]
    assert colours == list(PERSON_COLOURS[: shape[1]])
    assert (scene["num_frames"], scene["num_points"]) == (shape[0], 22 * shape[1])


def test_people_far_away_are_kept_coarser_and_not_cut_off() -> None:
    scene = json.loads(pack_player([people_panel("x", BODY22, _people(2, 1) + 100.0)], rate_hz=30.0))
    values = np.frombuffer(base64.b64decode(scene["data"]), "<i2").reshape(2, 22, 3) * scene["unit_m"]
    np.testing.assert_allclose(values, _people(2, 1)[:, 0] + 100.0, atol=0.002)


def test_left_limbs_are_drawn_darker_than_right_ones() -> None:
    (skeleton,) = json.loads(pack_player([people_panel("", BODY22, _people(1, 1))], rate_hz=1.0))["skeletons"]
    shade = {BODY22.joint_names[child]: factor for _, child, factor in skeleton["bones"]}
    assert all(shade[name] < shade[name.replace("left_", "right_")] for name in shade if name.startswith("left_"))


@pytest.mark.parametrize(("num_frames", "rate_hz"), [(1, 30.0), (40, 12.0), (3000, 120.0), (7200, 29.97)])
def test_what_is_shown_of_a_motion_is_five_seconds_at_a_low_rate(num_frames: int, rate_hz: float) -> None:
    frames, shown_hz = shown_frames(num_frames, rate_hz)
    assert 0 <= frames[0] <= frames[-1] < num_frames
    assert len(frames) <= 5.0 * shown_hz + 1
    assert shown_hz <= 17.0
    assert (np.diff(frames) == round(rate_hz / shown_hz)).all()
    times = times_shown(frames, num_frames, rate_hz)
    assert (times == []) == (num_frames / rate_hz <= 5.0)
    for frame, time in zip(frames if times else (), times, strict=True):
        assert np.abs(np.float64(time.removesuffix(" s").split(" of ")) * rate_hz - [frame, num_frames]).max() <= 6.0


def test_the_image_axes_of_a_panel_are_right_and_up_about_its_middle() -> None:
    keypoints = np.full((1, 1, 14, 2), np.nan)
    keypoints[0, 0, 0] = [480.0, 0.0]
    panel = image_panel("", OP14, keypoints, (480, 270))
    np.testing.assert_allclose(panel.figures[0].positions_m[0, 0], [240 / 270, 0.5, 0.0])
    assert panel.is_flat
    assert panel.objects_m is not None
    np.testing.assert_allclose(np.abs(panel.objects_m[0, :, 0, 1]), 0.5)


def _curve(title: str) -> bytes:
    curves = {"a": (np.arange(3.0), np.ones(3))}
    return curve_figure([CurvePanel("y", curves)], title=title, x_label="x")


def test_a_figure_gives_the_same_svg_twice_and_its_text_stays_text() -> None:
    (svg,) = {_curve("views of <all>") for _ in range(2)}
    assert b"views of &lt;all&gt;" in svg


SUMMARY = Summary(
    made=[Made("takes", 1, 75.0, 2_000_000), Made("draws", 4000, float("nan"), 100_000)],
    sources=[Credit("CMU", "free for all uses", "mocap.cs.cmu.edu")],
    verdicts={"chains": Verdict(Level.WARN, "chains do not mix", "effective sample size", 1.4, "", 500.0, "kept")},
)


def _page() -> str:
    moving = pack_player(
        [people_panel("</script><b>", BODY22, _people(20, 2)), people_panel("b", BODY22, _people(20, 2))], rate_hz=10.0
    )
    pictures = [Picture(f"{n}.player.json", f"person {n} & <co>", moving) for n in range(5)]
    pictures.append(Picture("v.svg", "views", _curve("views")))
    values = (10, 9, 1000, *range(2, 9), *range(11, 14))
    rows = tuple((f"row <{n}>", str(value)) for n, value in enumerate(values))
    tables = TextTable("<scores>", ("method", "value"), rows), TextTable("short", ("method", "value"), rows[:12])
    sections = [Section("Takes & <all>", ("text",), tables, tuple(pictures)), Section("Nothing")]
    hero = Picture("hero.player.json", "what moves first", moving).of_panels(1)
    return render("report.html", report=Report("A <study>", "made from <duets>", SUMMARY, sections, hero))


def test_the_page_needs_no_other_file_and_names_everything_and_escapes_what_it_shows() -> None:
    page = Page(_page())
    assert not page.problems
    assert not page.outside
    assert not page.unnamed
    assert {link.removeprefix("#") for link in page.links} <= page.ids
    assert [level for level, _ in page.headings] == [1, 2, 2, 2, 2]
    assert page.headings[0][1] == "A <study>"
    assert page.cells[:2] == ["row <0>", "10"]
    assert [len(scene["panels"]) for scene in page.scenes] == [1] + [2] * 5
    assert page.scenes[0]["panels"][0]["title"] == "</script><b>"
    assert "what moves first Shown: the first 1 of 2 panels" in _page()


_PROBE = """
const [hero, ...figures] = [...document.querySelectorAll("figure.player")];
const folded = [...document.querySelectorAll("main details")].every((one) => !one.open || one.matches(".topic *"));
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
for (let tries = 0; tries < 200 && !players.get(hero)?.isPlaying; tries++) await wait(50);
const opening = { plays: players.get(hero)?.isPlaying, bottom: hero.getBoundingClientRect().bottom };
window.requestAnimationFrame = (act) => setTimeout(() => act(performance.now()), 20);  // no screen, hardly a frame
document.querySelectorAll("details").forEach((one) => { one.open = true; });
const seen = (canvas) => {
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let sum = 0;
  for (let at = 0; at < data.length; at++) sum = (sum * 31 + data[at]) % 1000003;
  return sum;
};
const shown = figures.map(ready), first = figures[0], canvas = first.querySelector("canvas");
await wait(200);
const drawn = [seen(canvas)];
const slider = first.querySelector("input");
slider.value = 3;
slider.dispatchEvent(new Event("input"));
drawn.push(seen(canvas));
canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" }));
drawn.push(seen(canvas));
canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "+" }));
drawn.push(seen(canvas));
first.querySelector("button.home").click();
drawn.push(seen(canvas));
first.scrollIntoView();
await wait(100);
const before = shown[0].frame;
first.querySelector("button.play").click();
for (let tries = 0; tries < 20 && shown[0].frame === before; tries++) await wait(150);
first.querySelector("button.play").click();
const table = document.querySelector("table");
const column = () => [...table.tBodies[0].rows].map((row) => row.cells[1].textContent);
const sort = table.querySelectorAll("th button")[1];
sort.click();
const rising = column();
sort.click();
const filter = document.querySelector("details.table input");
filter.value = "1000";
filter.dispatchEvent(new Event("input"));
const left = [...table.tBodies[0].rows].filter((row) => !row.hidden).length;
const filters = [...document.querySelectorAll("details.table")].map((one) => one.querySelectorAll("input").length);
return { drawn, moved: shown[0].frame !== before, rising, falling: column(), left, filters, opening, folded,
         wide: document.documentElement.scrollWidth <= innerWidth, num: shown.length };
"""


@pytest.mark.parametrize("width", [1100, 500])
def test_players_move_and_turn_and_tables_sort_in_a_browser(tmp_path: Path, width: int) -> None:
    answer = in_browser(_page(), _PROBE, tmp_path, width=width)
    assert answer["errors"] == []
    found = answer["found"]
    first, scrubbed, turned, zoomed, home = found["drawn"]
    assert first != scrubbed != turned != zoomed
    assert home == scrubbed
    assert found["moved"]
    assert found["num"] == 5
    assert found["rising"] == [str(n) for n in (*range(2, 9), *range(9, 14), 1000)] == found["falling"][::-1]
    assert found["left"] == 1
    assert found["filters"] == [1, 0], "twelve rows need no filter"
    assert found["opening"]["plays"]
    assert found["opening"]["bottom"] < 900, "what moves is on the first screen"
    assert found["folded"]
    assert found["wide"], "the page is wider than the screen"


def test_a_criterion_is_drawn_with_what_has_to_be_beaten_and_only_where_all_were_scored() -> None:
    scores = [
        Score("error", method, value, "m", item=item, is_baseline=method == "naive_fk")
        for method, value in (("interaction_mesh", 0.01), ("naive_fk", 0.2), ("truth", 0.0))
        for item in ("a", "b")
    ]
    criterion = Criterion("error", "drift", "m", "variants")
    drawn = criterion.picture([*scores, Score("error", "sometimes", 0.1, "m", item="a")])
    assert drawn is not None
    svg, caption = drawn
    assert b"interaction mesh" in svg
    assert b"plain forward kinematics" in svg
    assert b"sometimes" not in svg
    assert b"ground truth" not in svg, "a bound is no baseline"
    assert b">20<" in svg
    assert "shorter bars are better" in caption
    assert "value to beat (plain forward kinematics)" in caption
    assert criterion.picture(scores[:1]) is None
    more = [Score("error", "interaction_mesh", 0.3, "m", item=item) for item in "cde"]
    said = "what has to be beaten is there, also where others were scored in more places"
    assert criterion.picture([*scores, *more]) == criterion.picture(scores), said


def test_the_card_names_every_source_with_its_licence() -> None:
    card = DatasetCard("Duets", "d", SUMMARY, {"poses": 1200}, {"hug": True, "waltz": False}, ["synthetic"])
    text = render("card.md", card=card)
    shown = [row for table in card_tables(card) for row in table.rows]
    for part, row in (
        ("**CMU** - free for all uses. mocap.cs.cmu.edu", ("CMU", "free for all uses", "mocap.cs.cmu.edu")),
        ("- hug (held out for evaluation)", ("hug", "held out for evaluation")),
        ("| poses | 1,200 |", ("poses", "1,200")),
        ("synthetic", ("synthetic",)),
    ):
        assert part in text
        assert row in shown


def test_page_card_and_console_give_the_same_answers_in_the_same_order_and_the_worst_first() -> None:
    worse, better = (
        Verdict(level, f"{level} indeed", "error", 0.2, "m", 0.1, "nearest") for level in (Level.FAIL, Level.PASS)
    )
    judged = {
        "seeds": better,
        "evaluation: lifting": better,
        "evaluation: lifting frames between": worse,
        "evaluation: lifting frames between lifted pairs": better,
        "evaluation: leave one out": worse,
        "views": worse,
        "evaluation: coverage draws of chains alone": better,
    }
    summary = replace(SUMMARY, verdicts={**judged, **SUMMARY.verdicts})
    lines = summary.lines()
    assert lines[:3] == [
        "built: 1 take (1 min 15 s, 2.0 MB), 4,000 draws (0.1 MB)",
        "from: CMU (licence: free for all uses)",
        "is it good: 3 fail, 4 pass, 1 warn",
    ]
    draws = "match left-out images worse than nearest pose; not independent; cover real pairs better than nearest pose"
    products = [
        f"draws: fail: {draws}",
        "frames between: fail: worse than nearest pose; between lifted pairs better than nearest pose",
        "lifted pairs: pass: better than nearest pose",
    ]
    assert lines[3:6] == products
    assert [re.split(": (?:fail|warn|pass): ", line)[0] for line in lines[6:]] == [
        "evaluation: leave one out",
        "evaluation: lifting frames between",
        "views",
        "chains",
        "evaluation: coverage draws of chains alone",
        "evaluation: lifting frames between lifted pairs",
        "evaluation: lifting",
        "seeds",
    ]
    card = render("card.md", card=DatasetCard("Duets", "d", summary, {}, {}, []))
    said = [line.removeprefix("- ") for line in card.splitlines() if line.startswith("- ")]
    assert said[: len(lines) - 1] == [*lines[:2], *lines[3:]]
    page = render("report.html", report=Report("Duets", "d", summary, []))
    shown = [page.index("</b>: ".join(line.split(": fail: " if ": fail" in line else ": pass: "))) for line in products]
    assert shown == sorted(shown)
    assert shown[-1] < page.index("What was built"), "products are on the first screen"


def test_a_product_that_is_not_judged_is_to_be_looked_at_and_the_others_get_their_advice() -> None:
    short = Verdict(Level.NOT_JUDGED, "only 2 s")
    summary = Summary([], [], {"evaluation: reconstruction": short, "ingest": Verdict(Level.PASS)})
    sentence = "ook at the reconstruction yourself, which could not be judged."
    assert summary.advice == f"Use the takes; l{sentence}"
    assert "reconstruction: not judged: not judged" in summary.headlines()
    assert Summary([], [], {"evaluation: reconstruction": short}).advice == f"L{sentence}"
    kept = {"evaluation: augmentation": short, "augmentation": Verdict(Level.PASS)}
    assert "variants: not judged: contacts not compared; usable" in Summary([], [], kept).headlines()


def test_scores_have_the_columns_of_their_table_and_a_stable_order() -> None:
    scores = [Score("b", "m", 1.0), Score("a", "m", 2.0, at=3.0), Score("a", "m", 2.0)]
    columns = columns_of("takes", scores)
    assert list(columns) == [column.name for column in TABLES["scores"].columns]
    assert columns == columns_of("takes", reversed(scores))
    assert columns_of("takes", scores, {"m"})["is_baseline"] == [True] * 3
    assert columns["is_baseline"] == [False] * 3


def test_a_summary_leaves_out_what_is_not_finite() -> None:
    found = summarise({"m": np.array([1.0, 3.0, np.nan])}, "e", "m")
    assert {s.metric: (s.value, s.count) for s in found}["e_mean"] == (2.0, 2)
    assert summarise({"m": np.array([np.nan])}, "e", "m") == []


def test_take_scores_have_the_share_of_frames_with_people_close() -> None:
    people = np.zeros((10, 2, 22, 3))
    people[:, 1, :, 0] = 1.0
    people[5:, 1, :, 0] = 0.1
    assert {s.metric: s.value for s in take_scores("t", people, 10.0)}["share_closer_than_15_cm"] == 0.5


_DEFICIENT = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}
"""What people see who lack one kind of cones, in linear RGB (Machado et al. 2009, severity 1)."""


def _lab(colours: Sequence[str], seen_by: str) -> np.ndarray:
    """Return colours (n, 3) in CIELAB, as they are seen."""
    srgb = np.array([rgb(colour) for colour in colours]) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.transpose(_DEFICIENT[seen_by]), 0.0, 1.0)
    xyz = seen @ np.transpose([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = np.cbrt(np.maximum(xyz / [0.9505, 1.0, 1.089], 1e-9)).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


@pytest.mark.parametrize("seen_by", _DEFICIENT)
@pytest.mark.parametrize(("colours", "least"), [(COLOURS, 15.0), (PERSON_COLOURS, 11.0), (PERSON_COLOURS[:2], 60.0)])
def test_colours_are_told_apart_by_colour_blind_people(colours: Sequence[str], least: float, seen_by: str) -> None:
    """A difference of 2.3 in CIELAB is just noticeable; all colours differ by several times that."""
    places = _lab(colours, seen_by)
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)[np.triu_indices(len(places), 1)]
    assert apart.min() > least


def test_a_method_has_one_style_and_neighbours_differ_in_colour_and_marker() -> None:
    methods = known_methods()
    for at, method in enumerate(methods):
        for neighbour in methods[at + 1 : at + len(COLOURS)]:
            assert method_style(method).colour != method_style(neighbour).colour
            assert method_style(method).marker != method_style(neighbour).marker
    for together in (
        ("ic", "prior_only", "grown_seeds", "filled_seeds", "repaired"),
        ("over_time", "fitted", "neighbours", "nearest_draw", "mean_pair"),
        ("fit", "nearest", "viterbi", "window", "published", "live"),
        ("ridge_scale", "copy", "naive_fk"),
    ):
        assert len({method_style(method).colour for method in together}) == len(together)
    assert method_style("cartesian_repaired").colour == method_style("cartesian").colour
    assert method_style("cartesian_repaired").marker != method_style("cartesian").marker
    (axis,) = new_figure(3.0, 3.0)[1][0]
    _draw_panel(axis, CurvePanel("y", {name: (np.arange(2.0), np.arange(2.0)) for name in methods[:3]}), "x")
    assert [(line.get_color(), line.get_marker()) for line in axis.lines] == [*map(method_style, methods[:3])]


def test_bars_say_what_the_verdict_says_and_leave_out_what_was_scored_on_other_items() -> None:
    """A bar once showed 0.0295 cm, a mean over takes, beside a verdict of 0.0187 cm, a mean over contacts."""
    takes, seconds = ["a"] * 30 + ["b"] * 10, np.arange(40.0)
    values = {"fit": np.r_[np.full(30, 0.1), np.full(10, 0.5)], "nearest": np.full(40, 0.4)}
    criterion = Criterion("error", "joint error", "m", "poses", ("fit",))
    verdict = criterion.verdict(Items(values, takes, seconds), ["nearest"])
    scores = [
        Score("error", method, float(values[method][part].mean()), "m", method == "nearest", item=take, count=count)
        for method in values
        for take, part, count in (("a", slice(0, 30), 30), ("b", slice(30, 40), 10))
    ]
    elsewhere = [Score("error", "viterbi", value, "m", item=item, count=20) for item, value in (("a", 0.2), ("b", 0.3))]
    drawn = criterion.picture([*scores, *elsewhere], verdict)
    assert drawn is not None
    assert b">20<" in drawn[0], "0.2 m, 30 frames of 0.1 and 10 of 0.5"
    assert b"best path" in drawn[0]
    drawn = criterion.picture([*(replace(score, count=1) for score in scores), *elsewhere], verdict)
    assert drawn is not None
    assert b">20<" in drawn[0]
    assert b"best path" not in drawn[0]


def test_the_card_counts_rows_over_artifacts_and_warns_of_the_tables_that_are_there() -> None:
    inputs = [SimpleNamespace(tables={"draws": SimpleNamespace(rows=count)}) for count in (3, 4)]
    topic = SimpleNamespace(cautions=[("draws", "depend on each other"), ("variants", "of a solver")])
    card = report_task._card(report_task.PageSettings(), [cast(Any, topic)], cast(Any, inputs), SUMMARY)
    assert (card.rows, card.is_held_out, card.cautions) == ({"draws": 7}, {}, ("depend on each other",))
