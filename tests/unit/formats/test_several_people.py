"""Read each person of files of several people: TRC, npz, and studies of one such file."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from flows.console.study_new import write_new_study
from pasdedeux.errors import FormatError
from pasdedeux.formats.positions_npz import POSITIONS_NPZ
from pasdedeux.formats.trc import TRC, read_points, write_trc
from pasdedeux.skeletons import BODY22
from storage_schema import Store
from tests.builders.body_models import npz
from tests.builders.bvh_rigs import body_nodes, bvh_of, bvh_of_several
from tests.builders.ingest_runs import judged, planned, run
from tests.builders.source_samples import c3d_points, figure_motion, trc_text

POSITIONS_M = figure_motion(num_frames=40).world()[0]
PEOPLE_M = np.stack([POSITIONS_M, POSITIONS_M + np.array([1.0, 0.0, 0.0])], axis=1)


def people_npz(positions_m: np.ndarray) -> bytes:
    return npz(positions_m=positions_m, joint_names=BODY22.joint_names, rate_hz=30.0003)


def test_joints_of_body22_need_no_parents_in_any_order() -> None:
    order = np.random.default_rng(0).permutation(len(BODY22.joint_names))
    data = npz(positions_m=POSITIONS_M[:, order], joint_names=np.array(BODY22.joint_names)[order])
    positions, _ = POSITIONS_NPZ.read(data, b"").to_motion(metres_per_unit=1.0, rate_hz=30.0).world()
    np.testing.assert_allclose(positions, POSITIONS_M, atol=1e-7)


@pytest.mark.parametrize("axes", [(0, 1, 2, 3), (1, 0, 2, 3)], ids=["frames first", "people first"])
def test_the_people_of_an_npz_are_read_whichever_axis_is_theirs(axes: tuple[int, ...]) -> None:
    data = people_npz(PEOPLE_M.transpose(axes))
    assert POSITIONS_NPZ.count_people(data) == 2
    for number in (0, 1):
        source = POSITIONS_NPZ.read_person(number, data)
        found, _ = source.to_motion(metres_per_unit=1.0, rate_hz=30.0).world()
        np.testing.assert_allclose(found, PEOPLE_M[:, number], atol=1e-7)
        assert source.rate_hz == 30.0


def test_a_crowd_in_an_npz_is_refused() -> None:
    with pytest.raises(FormatError, match="the number of people of array 'positions_m' is 30"):
        POSITIONS_NPZ.read(people_npz(np.tile(POSITIONS_M[:, None], (1, 30, 1, 1))), b"")


def test_what_is_written_as_trc_is_read() -> None:
    text = trc_text("AB")
    assert TRC.count_people(text.encode()) == 2
    wanted = figure_motion().world()[0]
    for number in (0, 1):
        source = TRC.read_person(number, text.encode())
        assert (source.rate_hz, source.metres_per_unit, source.notes) == (30.0, 1.0, ())
        found, _ = source.to_motion(metres_per_unit=1.0, rate_hz=30.0).world()
        np.testing.assert_allclose(found - [number, 0, 0], wanted, atol=2e-6)


def test_gaps_and_counts_of_a_trc_are_told() -> None:
    text = write_trc(POSITIONS_M, BODY22.joint_names, rate_hz=30.0, name="a.trc")
    *head, row = text.rstrip("\n").split("\n")
    gap = "\n".join([*head, "\t".join([*row.split("\t")[:-3], "", "", ""])])
    assert np.isnan(read_points(gap).positions[-1, -1]).all()
    with pytest.raises(FormatError, match="frame 39: the point 'right_wrist' is missing"):
        read_points(gap).source()
    assert read_points("\n".join(head)).source().notes == ("it states 40 frames and holds 39, which are read",)
    with pytest.raises(FormatError, match="line 20: the file ends after 14 of 40 frames"):
        read_points("\n".join(head[:20]))
    with pytest.raises(FormatError, match="line 46: 65 values where 66 are needed"):
        read_points("\n".join([*head, row.rpartition("\t")[0]]))


def bvh_of_two() -> bytes:
    """Return two people who stand beside each other, and a frame more than `Frames:` states."""
    rng, files = np.random.default_rng(0), []
    for prefix, x_cm in (("A:", 0.0), ("B:", 90.0)):
        nodes = body_nodes(above=[], kinds=(3,), rng=rng, prefix=prefix)
        places = {"Xposition": x_cm, "Yposition": 95.0}
        row = [places.get(channel, 0.0) for node in nodes for channel in node.channels]
        files.append(bvh_of(nodes, np.tile(row, (4, 1))))
    text = bvh_of_several(files, has_common_root=True)
    return text.replace("Frames: 4", "Frames: 3").replace("0.008333", "0.033").encode()


PAIRS = {
    "pair.c3d": c3d_points("AB"),
    "pair.trc": trc_text("AB").encode(),
    "pair.npz": people_npz(PEOPLE_M),
    "pair.bvh": bvh_of_two(),
}


@pytest.mark.parametrize("name", PAIRS)
def test_a_new_study_of_one_file_has_both_of_its_people(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(PAIRS[name])
    said = write_new_study(tmp_path / "mine.toml", [tmp_path / name])
    study = tomllib.loads((tmp_path / "mine.toml").read_text())
    (take,) = study["ingest"]["takes"]
    assert take["files"] == [name, name]
    assert len(take["persons"]) == 2
    assert sum(line.startswith(f"found {name}") for line in said) == 2
    notes = [line for line in said if line.startswith(f"note: {name}: ")]
    assert [note.partition(".bvh: ")[2] for note in notes] == ([] if name != "pair.bvh" else [
        "it states 3 frames and holds 4, which are read",
        "its frame time 0.033 is rounded: 30 Hz is taken, not 30.3",
        "the file holds 2 people, this is the one of 'A:Hips'",
        "the file holds 2 people, this is the one of 'B:Hips'",
    ])  # fmt: skip


def test_what_a_reader_assumed_is_in_the_verdict_of_the_take(tmp_path: Path, store: Store) -> None:
    (tmp_path / "pair.bvh").write_bytes(bvh_of_two())
    take = {"id": "a", "files": [str(tmp_path / "pair.bvh")] * 2}
    made, *_ = run(store, planned(takes=[take], rate_hz=30.0)[:1]).values()
    reason = judged(made).reason
    assert "pair.bvh: it states 3 frames and holds 4, which are read" in reason
    assert "pair.bvh: its frame time 0.033 is rounded: 30 Hz is taken, not 30.3" in reason
    body22 = np.asarray(store.read(made.ref, "poses")["body22_m"]).reshape(2, 4, 22, 3)
    np.testing.assert_allclose(body22[1] - body22[0], np.broadcast_to([0.9, 0.0, 0.0], body22[0].shape), atol=1e-6)
