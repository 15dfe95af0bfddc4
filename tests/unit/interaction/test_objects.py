"""Read objects and stated contacts, find contacts with objects, and keep them in variants."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.augmentation import Augmenter, Source, UserContact, uniform_variations
from pasdedeux.augmentation.source import points_of, reference_motion
from pasdedeux.augmentation.support import floor_weights, stance_weights
from pasdedeux.choreography.duets import make_duet
from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.interaction.contacts import stated_contacts
from pasdedeux.interaction.known_contacts import read_contacts
from pasdedeux.interaction.objects import MovingObjects, read_objects
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import Manifest, Store
from tasks.rows.contacts import ContactRows
from tasks.rows.takes import read_take
from tasks.stage import Shard
from tasks.stage.facts import TakeFacts
from tests.builders.body_models import npz
from tests.builders.ingest_runs import judged, planned, run
from tests.builders.moving_pairs import swaying_pair, swaying_people

FRAMES = 16
WRISTS = BODY22.indices(["left_wrist", "right_wrist"])


def carried_bar(count: int = 1) -> Source:
    """Return people who sway, A with both wrists on a bar as thick as a broom, 2 cm off it."""
    people = swaying_people(count, FRAMES)
    wrists = people[:, 0, WRISTS]
    source = Source(people, 30.0)
    out_m = 0.02 + 0.015 + source.radii_m[0, WRISTS[0]]
    ends_m = (wrists + np.array([0.0, 0.0, out_m]))[:, None]
    return replace(source, objects=MovingObjects(("bar",), ends_m, np.array([0.015])))


def table_of(objects: MovingObjects) -> str:
    text = io.StringIO()
    rows = csv.writer(text)
    ends = [f"{axis}_{end}_m" for end in ("start", "end") for axis in "xyz"]
    rows.writerow(["frame", "name", *ends, "radius_m"])
    for frame, capsules in enumerate(objects.ends_m):
        for name, capsule, radius in zip(objects.names, capsules, objects.radii_m, strict=True):
            rows.writerow([frame, name, *capsule.ravel().tolist(), radius])
    return text.getvalue()


def test_table_and_archive_say_the_same() -> None:
    ends = np.random.default_rng(0).normal(size=(5, 3, 2, 3))
    objects = MovingObjects(("box", "lid", "ball"), ends, np.array([0.1, 0.02, 0.11]))
    archive = npz(names=objects.names, ends_m=ends, radii_m=objects.radii_m)
    for found in map(read_objects, (table_of(objects).encode(), archive)):
        assert found.names == objects.names
        np.testing.assert_array_equal(found.ends_m, objects.ends_m)
        np.testing.assert_array_equal(found.radii_m, objects.radii_m)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("radius_m", "radius", "line 1: column 'radius_m' is missing; needed: frame, name"),
        ("\n2,bar", "\n1,bar", "line 4: frame 1 of 'bar' is there twice"),
        ("\n2,bar", "\n99,bar", "frame 2 of 'bar' is missing; needed are all from 0 to 99"),
        ("\n2,bar", "\n999999999,bar", "frame 2 of 'bar' is missing; needed are all from 0 to 999999999"),
        ("\n2,bar,11.5", "\n2,bar,11,5", "line 4: 10 values where 9 are needed"),
        ("\n2,bar", '\n2,"bar', "line 4: this is not valid CSV"),
        ("\n2,bar", "\n-2,bar", "line 4: frame is -2; allowed: 0 to"),
        ("\n2,bar,", "\n2,bar,much", "line 4: x_start_m: 'much"),
        ("\n2,bar,", "\n2,bar,2", "frame 2: 'bar' is not finite or further than 100 m"),
        ("bar", "floor", "no capsule may be called floor"),
        ("0.015", "-1.0", "the radius of 'bar' is -1"),
    ],
)
def test_tables_of_objects_that_are_none_are_refused_in_words(old: str, new: str, sentence: str) -> None:
    ends = np.full((FRAMES, 1, 2, 3), 11.5)
    text = table_of(MovingObjects(("bar",), ends, np.array([0.015]))).replace("\r\n", "\n")
    assert old in text
    with pytest.raises(FormatError, match=re.escape(sentence)):
        read_objects(text.replace(old, new, 1 if "2,bar" in old or old == "radius_m" else -1).encode())


def test_hands_on_an_object_are_found_wherever_the_take_lies() -> None:
    source = carried_bar(2)
    found = source.contacts()
    on_bar = found.is_held & (found.objects == 0)
    assert on_bar.any(axis=1).all()
    assert set(found.points[on_bar][:, 1]) >= set(WRISTS)
    assert (found.shares[on_bar][:, 2:] == 0.0).all()
    turn, shift = yaw_rotmat(0.7), np.array([1.0, 0.0, -2.0])
    moved = MovingObjects(("bar",), source.objects.ends_m @ turn.T + shift, source.objects.radii_m)
    again = Source(source.positions_m @ turn.T + shift, 30.0, objects=moved).contacts()
    np.testing.assert_allclose(found.weights, again.weights, atol=1e-9)
    lengths = np.linalg.norm(found.vectors(points_of(source.positions_m)), axis=-1)
    elsewhere = np.linalg.norm(again.vectors(points_of(source.positions_m @ turn.T + shift)), axis=-1)
    np.testing.assert_allclose(lengths, elsewhere, atol=1e-9)
    alone = Source(source.positions_m, 30.0).contacts()
    assert (alone.objects == -1).all()


def test_contacts_lie_in_another_motion_where_its_bodies_are() -> None:
    """B steps back by 5 cm: contacts with A open by as much along their line; those with the bar stay."""
    people = swaying_pair(6, apart_m=0.3)
    bar = np.repeat(people[:, 0, [20, 21]][:, None], 1, axis=1)
    source = Source(people, 30.0, objects=MovingObjects(("bar",), bar, np.array([0.015])))
    found = ContactRows.of(source)
    assert {-1, 0, 1} <= set(found.person.ravel().tolist())
    again = found.held_in(source)
    np.testing.assert_allclose(again.points_m, found.points_m, atol=1e-12)
    np.testing.assert_allclose(again.gap_m, found.gap_m, atol=1e-12)
    step = np.array([0.0, 0.0, 0.05])
    moved = people.copy()
    moved[:, 1] += step
    held = found.held_in(replace(source, positions_m=moved))
    np.testing.assert_allclose(held.points_m, found.points_m + (found.person == 1)[..., None] * step, atol=1e-12)
    of_bar = (found.person == (0, -1)).all(axis=1)
    np.testing.assert_allclose(held.gap_m[of_bar], found.gap_m[of_bar], atol=1e-12)
    np.testing.assert_allclose(held.distance_m - held.gap_m, found.distance_m - found.gap_m, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2])
def test_a_bar_stays_in_the_hands_at_every_size(count: int) -> None:
    source = carried_bar(count)
    contacts = source.contacts()
    held = contacts.is_held & (contacts.objects == 0)
    before = np.linalg.norm(contacts.vectors(points_of(source.positions_m)), axis=-1)[held]
    for variant in Augmenter(source).solve(uniform_variations([0.8, 1.2], ["A"], count)):
        after = np.linalg.norm(contacts.vectors(points_of(variant.positions_m)), axis=-1)[held]
        plain = points_of(reference_motion(source, variant.bone_scale[None])[0])
        assert np.percentile(np.abs(after - before), 95) < 0.005
        assert np.percentile(np.abs(np.linalg.norm(contacts.vectors(plain), axis=-1)[held] - before), 95) > 0.03
    (follow,) = Augmenter(source).solve(uniform_variations([1.0], ["A"], count))
    np.testing.assert_allclose(follow.positions_m, source.positions_m, atol=1e-5)


def test_a_hand_that_is_said_to_lie_on_the_floor_lies_there() -> None:
    source = Source(swaying_people(1, FRAMES), 30.0)
    stated = [UserContact(joint_a="left_wrist", object="floor", stop_frame=FRAMES)]
    wrist = WRISTS[0]
    assert stance_weights(source)[:, 0, wrist].max() < 0.01
    for weights in (stance_weights(source, stated), floor_weights(source, stated)):
        np.testing.assert_allclose(weights[:, 0, wrist], 1.0)
    (free,), (lying,) = (
        Augmenter(source, user_contacts=contacts).solve(uniform_variations([0.8], ["A"], 1))
        for contacts in ((), stated)
    )
    away = [np.abs(v.positions_m - source.positions_m)[:, 0, wrist, 1].max() for v in (free, lying)]
    assert away[1] < 0.01 < away[0]
    assert not stated_contacts(stated, FRAMES, BODY22).weights.size


@pytest.mark.parametrize(
    ("stated", "sentence"),
    [
        ({"joint_b": "head", "person_b": "C"}, "contact of A's head and C's head, but the people are A, B"),
        ({"object": "box"}, "contact of A's head and box, but what there is to be touched is bar, floor"),
        ({"object": "bar", "stop_frame": 99}, "over frames 0 to 99; allowed are frames within 0 to 16"),
    ],
)
def test_contacts_of_what_is_not_there_are_refused(stated: dict[str, Any], sentence: str) -> None:
    contact = UserContact(**{"joint_a": "head", "stop_frame": 5, **stated})
    with pytest.raises(InputError, match=sentence):
        Augmenter(carried_bar(2), user_contacts=[contact])


def test_objects_of_another_length_are_refused() -> None:
    source = carried_bar()
    with pytest.raises(InputError, match="its objects have 15 frames, the people 16"):
        Source(source.positions_m, 30.0, objects=source.objects.at(slice(1, None)))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("joint_a,joint_c,stop_frame\nhead,head,3\n", "line 1: column 'joint_c' is unknown or double; known: joint_a"),
        ("joint_a,joint_b,stop_frame\nhead,head,3\nnose,head,3\n", "line 3: joint_a: joint 'nose' is not in body22"),
        ("joint_a,joint_b,stop_frame\nhead,,3\n", "line 2: joint_b or object is needed, and not both"),
        ("joint_a,joint_b,start_frame,stop_frame\nhead,head,3,3\n", "line 2: frames 3 to 3 are none"),
        ("joint_a,object,stop_frame,share_a\nhead,floor,3,2\n", "line 2: share_a: Input should be less than"),
        ("joint_a,joint_b,person_b,stop_frame\nhead,head,A,3\n", "line 2: A's head touches nothing but itself"),
        ('joint_a,joint_b,stop_frame\n"head,head,3\n', "line 2: this is not valid CSV"),
    ],
)
def test_tables_of_contacts_that_are_none_are_refused_in_words(text: str, sentence: str) -> None:
    with pytest.raises(FormatError, match=re.escape(sentence)):
        read_contacts(text.encode())


def test_tables_may_have_any_line_ends() -> None:
    rows = ["joint_a,joint_b,stop_frame", "head,neck,3", "neck,head,4"]
    read = [read_contacts(end.join([*rows, ""]).encode()) for end in ("\n", "\r\n", "\r")]
    assert read[0] == read[1] == read[2]
    assert [contact.stop_frame for contact in read[0]] == [3, 4]


def test_an_object_without_a_name_is_no_object() -> None:
    with pytest.raises(ValidationError, match="at least 1 character"):
        UserContact(joint_a="head", object="", stop_frame=3)


def trio_files(folder: Path) -> dict[str, Any]:
    """Write a trio at 60 Hz, a hoop in the middle and a table of contacts; return the options of the take."""
    trio = make_duet("trio", duration_s=1.0)
    files = []
    for letter, motion in zip("ABC", trio.motions, strict=True):
        files.append(folder / f"{letter}_1.bvh")
        files[-1].write_text(write_bvh(motion))
    ends = np.repeat(np.array([[[0.0, 1.0, 0.0], [0.2, 1.0, 0.0]]])[None], 60, axis=0)
    ends[:, :, :, 1] += np.linspace(0.0, 1.0, 60)[:, None, None]
    (folder / "hoop.csv").write_text(table_of(MovingObjects(("hoop",), ends, np.array([0.05]))))
    (folder / "contacts.csv").write_text(
        "joint_a,share_a,person_a,joint_b,person_b,object,start_frame,stop_frame\n"
        "left_wrist,,B,right_wrist,C,,20,50\n"
        "head,0.5,C,,,hoop,0,20\n"
    )
    return {
        "id": "ring",
        "files": [str(file) for file in files],
        "objects": str(folder / "hoop.csv"),
        "contacts": str(folder / "contacts.csv"),
        "metres_per_unit": 0.01,
        "frames": [10, 60],
    }


def planned_take(take: dict[str, Any], rate_hz: float = 30.0) -> list[Shard]:
    return planned(takes=[take], rate_hz=rate_hz, virtual_video={"num_videos": 0, "num_random_views": 0})


def ingested(store: Store, take: dict[str, Any], rate_hz: float = 30.0) -> tuple[Manifest, Source]:
    """Return the manifest of a take, and the people and objects in it."""
    (manifest,) = run(store, planned_take(take, rate_hz)).values()
    return manifest, read_take(store, manifest.ref).source


def test_three_files_objects_and_contacts_make_a_take(tmp_path: Path, store: Store) -> None:
    manifest, source = ingested(store, trio_files(tmp_path))
    assert (manifest.facts["num_persons"], source.num_people, source.num_frames) == (3, 3, 25)
    assert source.objects.names == ("hoop",)
    np.testing.assert_allclose(source.objects.ends_m[:, 0, 0, 1], 1.0 + np.arange(10, 60, 2) / 59.0, atol=1e-6)
    np.testing.assert_allclose(source.objects.radii_m, [0.05])
    first, second = TakeFacts.of(manifest).contacts
    assert (first.person_a, first.person_b, first.start_frame, first.stop_frame) == ("B", "C", 5, 20)
    assert (first.share_a, first.weight) == (1.0, 1.0)
    assert (second.object, second.start_frame, second.stop_frame) == ("hoop", 0, 5)


@pytest.mark.parametrize("rate_hz", [29.97, 75.0, 119.0])
def test_a_contact_over_all_frames_of_a_file_lasts_as_long_as_the_take(
    tmp_path: Path, store: Store, rate_hz: float
) -> None:
    take = trio_files(tmp_path)
    (tmp_path / "contacts.csv").write_text("joint_a,joint_b,stop_frame\nhead,head,60\n")
    manifest, source = ingested(store, take, rate_hz)
    (contact,) = TakeFacts.of(manifest).contacts
    assert (contact.start_frame, contact.stop_frame) == (0, source.num_frames)
    assert source.objects is not None
    Augmenter(source, user_contacts=[contact])


@pytest.mark.parametrize("is_mirrored", [False, True])
@pytest.mark.parametrize("up_axis", ["x", "y", "z"])
def test_what_is_in_a_hand_is_in_it_wherever_the_take_is_put(
    tmp_path: Path, store: Store, up_axis: str, is_mirrored: bool
) -> None:
    take = trio_files(tmp_path)
    wrists = make_duet("trio", duration_s=1.0).positions_m()[:, 0, WRISTS]
    (tmp_path / "hoop.csv").write_text(table_of(MovingObjects(("hoop",), wrists[:, None], np.array([0.05]))))
    moved = {"up_axis": up_axis, "translation_m": [1.0, 2.0, -3.0], "yaw_deg": 40.0, "mirrored": is_mirrored}
    _, source = ingested(store, {**take, "contacts": None, "persons": [moved] * 3, "floor": "auto"})
    np.testing.assert_allclose(source.objects.ends_m[:, 0], source.positions_m[:, 0, WRISTS], atol=1e-4)


def test_objects_that_nobody_comes_near_are_doubted_and_rows_come_by_name(tmp_path: Path, store: Store) -> None:
    take = trio_files(tmp_path)
    ends = np.zeros((60, 2, 2, 3))
    ends[:, 1, :, 1] = 95.0, 96.0
    objects = MovingObjects(("pole", "box"), ends, np.array([0.05, 0.1]))
    (tmp_path / "hoop.csv").write_text(table_of(objects))
    manifest, source = ingested(store, {**take, "contacts": None})
    verdict = judged(manifest)
    assert verdict.level is Level.WARN
    assert "nobody comes nearer than 93." in verdict.reason
    assert "'box': are these metres" in verdict.reason
    assert "'pole'" not in verdict.reason
    assert store.read(manifest.ref, "objects")["object"].tolist() == ["box"] * 25 + ["pole"] * 25
    assert source.objects.names == ("box", "pole")
    np.testing.assert_allclose(source.objects.ends_m[:, 1], 0.0, atol=1e-6)
    np.testing.assert_allclose(source.objects.radii_m, [0.1, 0.05])


def test_things_that_do_not_fit_the_take_are_refused_while_planning(tmp_path: Path) -> None:
    take = trio_files(tmp_path)
    (tmp_path / "long.csv").write_text(table_of(MovingObjects(("hoop",), np.zeros((61, 1, 2, 3)), np.array([0.05]))))
    (tmp_path / "four.csv").write_text("joint_a,joint_b,person_b,stop_frame\nhead,head,D,3\n")
    for change, sentence in (
        ({"objects": str(tmp_path / "long.csv")}, "take ring: long.csv has 61 frames, but A_1.bvh has 60"),
        ({"contacts": str(tmp_path / "four.csv")}, "take ring: four.csv: contact of A's head and D's head, but the"),
        ({"objects": None}, "contact of C's head and hoop, but what there is to be touched is floor"),
    ):
        with pytest.raises(InputError, match=re.escape(sentence)):
            planned_take({**take, **change})
