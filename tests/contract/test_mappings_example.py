"""Joint mappings of a study, as the docs show them: an entry of a known layout changed, a layout written in full."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.skeletons import BODY22, OP14, PAIR17
from pasdedeux.skeletons.layouts.recognising import NEEDED
from storage_schema import Store
from tests.builders.ingest_runs import ingest_take, judged
from tests.builders.rigs import RIGS
from tests.builders.source_samples import bvh_text

CHANGED = """
[mappings.body22.pair17]
head = { head = 0.5, neck = 0.5 }
"""
HIPS = "{ j_left_hip = 0.5, j_right_hip = 0.5 }"
SHOULDERS = "{ j_left_shoulder = 0.5, j_right_shoulder = 0.5 }"
NOT_OF_BODY22 = {"spine": '"j_spine1"', "chest": '"j_spine3"'}


def table(skeleton: str, joints: tuple[str, ...], **others: str) -> str:
    """Return a full table: each joint is the one of its name with j_ in front, but for the others."""
    entries = {joint: f'"j_{joint}"' for joint in joints} | others
    return "\n".join([f"[mappings.rig.{skeleton}]", *(f"{joint} = {entry}" for joint, entry in entries.items())])


WRITTEN = "\n\n".join(
    [
        table("pair17", PAIR17.joint_names, pelvis=HIPS, **NOT_OF_BODY22),
        table("op14", OP14.joint_names, neck=SHOULDERS),
        table("body22", BODY22.joint_names),
    ]
)

_LIMBS = ("Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot")


def poses_of(folder: Path, bvh: str, mappings: str, **options: Any) -> Any:
    """Ingest one take and return its poses."""
    path = folder / "a.bvh"
    path.write_text(bvh)
    store = Store(folder / "store")
    made = ingest_take(store, {"id": "dance", "files": [path], **options}, **tomllib.loads(mappings))
    return store.read(made.ref, "poses")


def rig_text() -> str:
    """Return the figure with names that no layout knows."""
    return bvh_text().replace("ROOT ", "ROOT j_").replace("JOINT ", "JOINT j_")


def test_an_entry_of_a_known_layout_is_changed_and_the_rest_stays(tmp_path: Path) -> None:
    poses = poses_of(tmp_path, bvh_text(), CHANGED)
    body22, pair17 = np.asarray(poses["body22_m"]), np.asarray(poses["pair17_m"])
    middle = body22[:, BODY22.indices(["head", "neck"])].mean(axis=1)
    np.testing.assert_allclose(pair17[:, PAIR17.index("head")], middle, atol=1e-6)
    plain = poses_of(tmp_path, bvh_text(), "")
    others = [joint for joint in range(PAIR17.num_joints) if joint != PAIR17.index("head")]
    np.testing.assert_array_equal(pair17[:, others], np.asarray(plain["pair17_m"])[:, others])
    np.testing.assert_array_equal(poses["op14_m"], plain["op14_m"])


def test_a_layout_that_is_written_in_full_reads_joints_of_any_name(tmp_path: Path) -> None:
    poses = poses_of(tmp_path, rig_text(), WRITTEN, layout="rig")
    plain = poses_of(tmp_path, bvh_text(), "")
    np.testing.assert_array_equal(poses["body22_m"], plain["body22_m"])
    hips = np.asarray(plain["body22_m"])[:, BODY22.indices(["left_hip", "right_hip"])].mean(axis=1)
    np.testing.assert_allclose(np.asarray(poses["pair17_m"])[:, PAIR17.index("pelvis")], hips, atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('"j_spine1"', '"j_spine9"', "'j_spine9'"),
        ('[mappings.rig.op14]\nhead = "j_head"\n', "[mappings.rig.op14]\n", "head"),
        ("j_left_hip = 0.5", "j_left_hip = 0.7", "pelvis"),
    ],
)
def test_a_mapping_that_is_wrong_is_refused_with_the_name(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert old in WRITTEN
    with pytest.raises(InputError, match=rf"take dance: a.bvh: .*{sentence}"):
        poses_of(tmp_path, rig_text(), WRITTEN.replace(old, new, 1), layout="rig")


def test_what_a_mapping_says_of_left_and_right_decides_whether_a_file_is_mirrored(store: Store, tmp_path: Path) -> None:
    """A file exchanges the names of left and right; a mapping puts that right, so that nothing is left to doubt."""
    rig = RIGS[0]
    parts = {part: rig.names[part] for part in (*NEEDED, "left_toe", "right_toe", "neck")}
    exchanging = {"Left": "Right", "Right": "Left"}

    def exchanged(text: str) -> str:
        return re.sub("Left|Right", lambda side: exchanging[side[0]], text)

    path = tmp_path / "a.bvh"
    path.write_text(exchanged(rig.bvh()))
    mapped = {"layout": "mine"}, {"mine": {"parts": {part: exchanged(name) for part, name in parts.items()}}}
    for (options, mappings), is_doubted in ((mapped, False), (({}, {}), True)):
        take = {"id": "dance", "files": [path], "metres_per_unit": 0.01, **options}
        made = ingest_take(store, take, mappings=mappings)
        assert ("left and right of a.bvh seem exchanged" in judged(made).reason) == is_doubted


def test_what_a_mapping_says_of_head_and_feet_decides_which_axis_is_up(store: Store, tmp_path: Path) -> None:
    """By the names of a file its body hangs head down; its mapping says which joints are head and feet."""
    rig = replace(RIGS[0], axes="+x +z -y")
    pairs = [("Neck", "LeftToeBase")]
    pairs += [(side + arm, side + leg) for side in ("Left", "Right") for arm, leg in zip(*_LIMBS, strict=True)]
    exchanging = dict(pairs) | {second: first for first, second in pairs}
    path = tmp_path / "a.bvh"
    path.write_text(re.sub(rf"\b({'|'.join(exchanging)})\b", lambda name: exchanging[name[0]], rig.bvh()))
    parts = {part: exchanging[rig.names[part]] for part in (*NEEDED, "neck")}
    take = {"id": "dance", "files": [path], "metres_per_unit": 0.01, "layout": "mine", "floor": "keep"}
    made = ingest_take(store, take, mappings={"mine": {"parts": parts}})
    assert list(store.read(made.ref, "takes")["up_axis"]) == ["z"]
