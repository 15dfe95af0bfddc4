"""Read takes of ExPI: both people, our order of joints and our axes; contacts and JPD on 18 joints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.expi import EXPI, read_expi
from pasdedeux.interaction.contacts import find_contacts
from pasdedeux.learning.meter import key_contacts, model_errors
from pasdedeux.skeletons import BODY22, EXPI18
from storage_schema import Store
from tests.builders.ingest_runs import planned, run
from tests.builders.source_samples import EXPI_NAMES, expi_people, expi_tsv


def test_leader_and_follower_come_back_at_their_places_in_metres_and_25_hz() -> None:
    people = expi_people()
    data = expi_tsv(people)
    assert (len(EXPI_NAMES), EXPI_NAMES[0], EXPI_NAMES[18], EXPI_NAMES[35]) == (36, "m-fhead", "f-fhead", "f-rtoes")
    for number in range(2):
        source = EXPI.read_person(number, data)
        assert (source.rate_hz, source.metres_per_unit, source.skeleton) == (25.0, 0.001, EXPI18)
        motion = source.to_motion(metres_per_unit=0.001, rate_hz=25.0, up_axis="z")
        found, _ = motion.world()
        np.testing.assert_allclose(found[0], people[0, number], atol=1e-6)
        # Rotations are swings with bones of one length; the made-up person's head alone is no rigid body.
        assert np.median(np.linalg.norm(found - people[:, number], axis=-1)) < 0.005


@pytest.mark.parametrize(
    ("mangle", "message"),
    [
        (lambda text: text.splitlines()[0], "line 1: there is no frame after the line of names"),
        (lambda text: text.rstrip("\n").rpartition(",")[0], "line 41: a frame of two people of 18 joints needs 108"),
        (lambda text: text.replace("\n", ",1\n", 2), "line 2: .* needs 108 numbers, found 109"),
        (lambda text: text.rpartition(",")[0] + ",nan", "line 41: "),
        (lambda text: text.rpartition(",")[0] + ",lost", "line 41: .*'lost'"),
    ],
)
def test_a_mangled_take_is_refused_with_its_line(mangle: Callable[[str], str], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_expi(mangle(expi_tsv().decode()).encode())


def test_a_take_names_the_file_once_for_each_person(tmp_path: Path, store: Store) -> None:
    path = tmp_path / "mocap_cleaned.tsv"
    people = expi_people()
    path.write_bytes(expi_tsv(people))
    take = {"id": "a", "files": [str(path)] * 2, "up_axis": "z"}
    no_video = {"num_videos": 0, "num_random_views": 0}
    (made,) = run(store, planned(takes=[take], rate_hz=25.0, virtual_video=no_video)).values()
    takes, poses = store.read(made.ref, "takes"), store.read(made.ref, "poses")
    assert (set(takes["source_format"]), set(takes["layout"])) == ({"expi"}, {"expi"})
    assert all(takes["is_position_only"])
    body22 = np.asarray(poses["body22_m"], dtype=float).reshape(2, -1, 22, 3)
    floor = body22[0, 0, BODY22.index("left_wrist"), 1] - people[0, 0, EXPI18.index("left_wrist"), 1]
    for joint in ("left_wrist", "right_knee", "left_hip", "right_toe"):
        expected = people[:, :, EXPI18.index(joint)].swapaxes(0, 1) + np.array([0.0, floor, 0.0])
        np.testing.assert_allclose(body22[:, :, BODY22.index(joint)], expected, atol=0.01)
    with pytest.raises(
        InputError, match=r"take a: mocap_cleaned\.tsv: person 2: it holds 2 people; the take names it more often"
    ):
        planned(takes=[take | {"files": [str(path)] * 3}])


def test_contacts_and_jpd_are_found_on_18_joints() -> None:
    people = expi_people()
    people[:, 1] += people[:, 0, None, EXPI18.index("left_wrist")] - people[:, 1, None, EXPI18.index("right_wrist")]
    contacts = find_contacts(people, np.full((2, 18), 0.04), EXPI18, rate_hz=25.0)
    keys = key_contacts(contacts)
    touched = {EXPI18.joint_names[bone % 18] for bone in keys.bones()[0].ravel()}
    assert {"left_wrist", "right_wrist"} <= touched
    moved = people.copy()
    moved[:, 1, :, 0] += 0.1
    errors = model_errors(moved, people, keys, EXPI18)
    assert model_errors(people, people, keys, EXPI18)["JPD"] == 0.0
    assert 0.0 < errors["JPD"] <= 10.0 + 1e-9
    assert errors["E_r"] == pytest.approx(5.0)
