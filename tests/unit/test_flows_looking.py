"""What the terminal shows of results: poses in braille, scores with the better value marked, previews."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.console import main
from flows.console import run as run_module
from flows.console.show import braille_lines, pose_lines
from pasdedeux.evaluation.names import better_sign, in_words, meanings
from pasdedeux.evaluation.score_tables import score_table
from pasdedeux.evaluation.scores import Score
from pasdedeux.skeletons import BODY22, PAIR17
from storage_schema import Store
from tasks import ingest
from tasks.stage import StageInputs


def test_every_dot_of_a_cell_can_be_set_and_what_is_outside_is_left_out() -> None:
    dots = np.array([[x, y] for y in range(8) for x in range(6)], dtype=float)
    assert braille_lines(np.stack([dots, dots], axis=1), width=2, height=2) == [chr(0x28FF) * 2] * 2
    assert braille_lines(np.full((3, 2, 2), np.nan), width=3, height=1) == ["   "]
    assert braille_lines(np.zeros((0, 2, 2)), width=1, height=1) == [" "]


def test_a_pose_stands_upright_beside_its_numbers_by_joint() -> None:
    pose = np.full((PAIR17.num_joints, 3), np.nan)
    for name, height in (("pelvis", 1.0), ("spine", 1.2), ("chest", 1.4)):
        pose[PAIR17.index(name)] = [0.25, height, 0.5]
    lines = pose_lines(np.stack([pose, pose + np.array([1.0, 0.0, 0.0])]), "pair17", unit="m")
    row = next(line for line in lines if " spine " in line)
    assert row.split()[-7:] == ["spine", "0.250", "1.200", "0.500", "1.250", "1.200", "0.500"]
    assert next(line for line in lines if " head " in line).split()[-7:] == ["head", *"------"]
    assert "joint (m)" in lines[0]
    drawn = [{at for at, letter in enumerate(line[:26]) if "\u2800" < letter <= "\u28ff"} for line in lines[1:18]]
    assert {len(columns) for columns in drawn} == {0, 2}, "two upright people, a letter wide each"


def test_an_image_keeps_its_axes_and_nobody_gives_an_empty_picture() -> None:
    pixels = np.full((BODY22.num_joints, 2), np.nan)
    assert len(pose_lines(pixels, "body22", unit="px")) == BODY22.num_joints + 1
    pixels[BODY22.index("pelvis")] = [10.0, 90.0]
    row = next(line for line in pose_lines(pixels, "body22", unit="px") if "pelvis" in line)
    assert row.split()[-3:] == ["pelvis", "10.0", "90.0"]


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


def test_a_preview_is_of_a_few_seconds_and_on_record_under_a_name_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    built: list[Any] = []
    monkeypatch.setattr(run_module, "build_and_report", lambda run, *rest, **more: built.append(run.study))
    store = str(tmp_path / "store")
    with pytest.raises(SystemExit) as ended:
        main(["run", "duets", "--preview", "--store", store, "--set", "publish.name=kept"])
    assert ended.value.code == 0
    (chosen,) = built
    assert (chosen.name, chosen.publish) == ("duets-preview", None), "a preview is no version of the dataset"
    assert capsys.readouterr().out == f"all of it: pasdedeux run duets --store {store} --set publish.name=kept\n"
    planned = ingest.plan(StageInputs({}, seed=1), chosen.parameters["ingest"])
    take = next(shard for shard in planned if shard.name == "take")
    made = Store(tmp_path / "made")
    facts = made.manifest(ingest.run_shard(take, made)).facts
    assert facts["num_frames"] / facts["rate_hz"] == run_module.PREVIEW_S
