"""What the terminal shows: progress, poses by joint, scores with the better value marked, previews."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.console import run as run_module
from flows.console.context import say
from flows.console.display import BarListener
from flows.console.show import _short, joint_lines
from flows.console.study_new import write_new_study
from flows.progress import Progress
from flows.study_files import shipped_studies
from pasdedeux.evaluation.names import better_sign, in_words, meanings
from pasdedeux.evaluation.score_tables import score_table
from pasdedeux.evaluation.scores import Score
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.skeletons import PAIR17
from storage_schema import Store
from tasks import ingest
from tasks.stage import Parameters, Shard, StageInputs
from tests.builders.command_line import CommandLine
from tests.builders.ingest_runs import write_figure_pair
from tests.builders.source_samples import figure_motion, pair_csv_text
from tests.builders.storage_rows import commit_rows
from tests.builders.terminals import Screen

LONG = "chains: done in 12 s; warn: prior alone performed about as well as chains, ahead by 2.5 cm (-0.3 to 5.1 cm)"


@pytest.mark.parametrize("width", [80, 100, 120])
def test_the_display_keeps_its_columns_and_lines_break_at_words(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("COLUMNS", str(width)), ("LINES", "40"), ("TERM", "xterm")):
        monkeypatch.setenv(name, value)
    screen = Screen(width)
    monkeypatch.setattr("sys.stderr", screen)
    variants = Shard(
        "augmentation", 1, "waltz", "leader 0.75 to 1.25, frames 0 to 240, a name of any length", Parameters()
    )
    others = [Shard("evaluation", 1, "leave_one_out", f"waltz-camera{number}", Parameters()) for number in range(3)]
    listener = BarListener()
    listener.progressed(Progress(1, 45, others[:1], 0.0, is_all=True))
    listener._live.refresh()
    say([LONG], err=True)
    parts = {("augmentation", "waltz"): (3, 9)}
    listener.progressed(Progress(12, 45, [variants, *others], 200.0, is_all=False, partitions=parts))
    listener._live.refresh()
    said, (bar, *rows) = screen.lines[:-5], screen.lines[-5:]
    assert " ".join(line.strip() for line in said) == LONG, "nothing is drawn twice, and no word is cut"
    assert all(line.startswith("    ") for line in said[1:])
    assert bar.endswith("12/45 0 s more than 3 min 20 s left")
    assert [row.split()[:2] for row in rows[:3]] == [["augmentation", "waltz"], *[["evaluation", "leave_one_out"]] * 2]
    assert "3 of 9 leader" in rows[0]
    assert all(row.endswith(" 0 s") for row in rows[:3])
    assert rows[3] == "  and 1 more"
    listener.close()
    assert [line for line in screen.lines if line] == said


def test_only_terminal_lines_break(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    say([f"  {LONG}"])
    assert capsys.readouterr().out == f"  {LONG}\n"
    monkeypatch.setenv("COLUMNS", "60")
    screen = Screen(200)
    monkeypatch.setattr("sys.stdout", screen)
    say([f"  {LONG}"])
    assert max(map(len, screen.lines)) <= 60
    assert [line[:6].isspace() for line in screen.lines[:-1]] == [False, True]


def test_a_pose_is_a_table_of_joints_and_what_is_not_known_is_a_dash() -> None:
    pose = np.full((PAIR17.num_joints, 3), np.nan)
    pose[PAIR17.index("spine")] = [0.25, 1.2, 0.5]
    lines = joint_lines(np.stack([pose, pose + np.array([1.0, 0.0, 0.0])]), "pair17", unit="m")
    rows = {line.split()[0]: line.split()[1:] for line in lines}
    assert rows["joint"] == ["(m)", *(part for letter in "AB" for axis in "xyz" for part in (letter, axis))]
    assert rows["spine"] == ["0.250", "1.200", "0.500", "1.250", "1.200", "0.500"]
    assert rows["head"] == [*"------"]


def test_the_better_value_of_a_row_is_marked_and_what_nobody_can_know_is_not() -> None:
    values = {"fit": 0.1, "nearest": 0.2, "standing_still": 0.05}
    scores = [Score("error_root_kept", method, value, "m") for method, value in values.items()]
    (row,) = score_table(scores, caption="", has_marks=True).rows
    assert [cell for cell in row if cell.endswith("*")] == ["10 cm *"]
    unknown = [Score("colour", method, value) for method, value in values.items()]
    assert "*" not in "".join(score_table(unknown, caption="", has_marks=True).rows[0])
    assert better_sign("ess_min") == 1
    assert in_words("fit_clean") == "fit to the image, cleaned up"
    assert meanings(["fit_clean", "fit", "colour"]) == (meanings(["fit"])[0],)


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the runs that commands would build."""
    runs: list[Any] = []
    monkeypatch.setattr(run_module, "build_and_report", lambda run, *rest, **more: runs.append(run))
    return runs


@pytest.mark.parametrize(
    ("study", "more", "until"),
    [
        ("60_01.bvh 61_01.bvh", (), "augmentation"),
        ("60_01.bvh 61_01.bvh pair.csv", (), "augmentation"),
        ("60_01.bvh 61_01.bvh", ("--until", "chains"), "chains"),
        ("pair.csv", (), None),
        ("", (), "augmentation"),
        ("duets", (), "augmentation"),
        ("sampling_paper_duets", (), None),
    ],
)
def test_a_preview_of_takes_ends_at_their_variants_and_one_of_2d_poses_goes_on(
    tmp_path: Path, invoke: CommandLine, built: list[Any], study: str, more: tuple[str, ...], until: str | None
) -> None:
    if study not in shipped_studies():
        paths = [tmp_path / name for name in study.split()]
        write_figure_pair(tmp_path)
        (tmp_path / "pair.csv").write_text(pair_csv_text())
        study = str(tmp_path / "mine.toml")
        write_new_study(Path(study), paths)
    invoke("run", study, "--preview", *more, "--store", tmp_path / "store")
    assert [run.selection.until for run in built] == [until]


def test_a_preview_shows_when_people_are_nearest(tmp_path: Path, invoke: CommandLine, built: list[Any]) -> None:
    """Or a high five that first touches at 6.3 s has ten variants with nothing to keep."""
    still, files = figure_motion(1, rate_hz=60.0), [tmp_path / f"walk_{letter}.bvh" for letter in "AB"]
    away_m = np.abs(np.arange(600) - 500) / 100.0  # nearest in frame 500, at 8.3 s
    for path, path_m in zip(files, (0.0 * away_m, 0.3 + away_m), strict=True):
        walking = replace(
            still,
            root_translation_m=still.root_translation_m + np.outer(path_m, [1.0, 0.0, 0.0]),
            local_unitquat=np.repeat(still.local_unitquat, len(path_m), axis=0),
        )
        path.write_text(write_bvh(walking))
    study = tmp_path / "mine.toml"
    write_new_study(study, files)
    invoke("run", study, "--preview", "--store", tmp_path / "store")
    section = built[0].study.parameters["ingest"]
    start, stop = section.takes[0].frames
    assert stop - start == 240
    assert start <= 500 < stop
    planned = ingest.plan(StageInputs({}, seed=1), section)
    assert planned[0].parameters.persons[0].num_frames == 240


def test_a_preview_is_short_and_recorded_by_its_own_name(store: Store, invoke: CommandLine, built: list[Any]) -> None:
    words = f"run duets --store {store} --set publish.name=kept"
    assert invoke(*words.split(), "--preview").out == f"for the whole study: pasdedeux {words}\n"
    study = built[0].study
    assert (study.name, study.publish) == ("duets-preview", None), "a preview is no version of the dataset"
    planned = ingest.plan(StageInputs({}, seed=1), study.parameters["ingest"])
    take = next(shard for shard in planned if shard.name == "take")
    facts = store.manifest(ingest.run_shard(take, store)).facts
    assert facts["num_frames"] / facts["rate_hz"] == run_module.PREVIEW_S


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (np.float32(0.5), 0.5),
        (0.1234567891, 0.123457),
        (np.float64(-0.1234567891), -0.123457),
        (7, 7),
        ("waltz", "waltz"),
        (np.arange(4) / 3.0, [0.0, 0.3333, 0.6667, 1.0]),
        (np.zeros((2, 3)), "array[2, 3]"),
    ],
)
def test_values_of_a_row_are_rounded_and_long_arrays_are_their_shapes(value: object, shown: object) -> None:
    assert _short(value) == shown


def test_the_lineage_of_a_row_is_shown_with_its_files(tmp_path: Path, invoke: CommandLine) -> None:
    store = Store(tmp_path / "store")
    first = commit_rows(store, "takes", 2, stage="ingest", partition="waltz", files=(("film.avi", "ab" * 32),))
    draws = commit_rows(store, "draws", 3, stage="chains", partition="ic", name="seed0", inputs=(first,))
    lines = invoke("show", f"draws@{draws.key[:16]}", "--store", store.root, "--rows", "0").out.splitlines()
    assert lines[1] == "3 rows in 1 artifact"
    at = lines.index("comes from:")
    assert lines[at + 1 : at + 4] == [
        f"  chains@{draws.key[:12]} ic seed0",
        f"    ingest@{first.key[:12]} waltz 0",
        "  file film.avi (sha256 abababababab, read by ingest)",
    ]
    assert "first rows:" not in lines
