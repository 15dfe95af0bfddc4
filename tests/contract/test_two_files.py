"""Two files are two files: each person has his own rate, layout, unit and up axis, and both come to stand together."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.console.app import run_command_line
from flows.console.inputs import find_take
from flows.console.study_new import write_new_study
from pasdedeux.choreography.duets import make_duet
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.formats.source_motion import upright_from_file
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import conjugate, multiply, rotate
from pasdedeux.skeletons.layouts import LAYOUTS
from storage_schema import Store
from tasks.files.user_files import read_file
from tasks.ingest.takes.parameters import TakeParameters
from tests.builders.ingest_runs import ingest_take, judged, planned, run
from tests.builders.rigs import RIGS

DURATION_S = 2.0
NEAR_M = 1e-3


@cache
def waltz(rate_hz: float) -> tuple[Motion, ...]:
    """Return the two of a waltz, a function of time, at a rate."""
    return tuple(make_duet("waltz", duration_s=DURATION_S, rate_hz=rate_hz).motions)


def truth_m(times_s: np.ndarray, person: int) -> np.ndarray:
    """Return body22 (frame, 22, 3) of a person at times that are frames of 600 Hz."""
    places = derive_working_poses(waltz(600.0)[person], LAYOUTS["body22"]).body22_m
    return np.asarray(places[np.round(times_s * 600.0).astype(int)])


def body22_of(store: Store, ref: Any) -> np.ndarray:
    """Return body22 (frame, person, 22, 3) of a take."""
    poses = store.read(ref, "poses")
    places, person = np.stack(list(poses["body22_m"])).reshape(-1, 22, 3), np.asarray(poses["person"])
    return np.stack([places[person == number] for number in np.unique(person)], axis=1)


def write_two(folder: Path, *rates_hz: float) -> list[Path]:
    paths = [folder / f"{name}.bvh" for name in "ab"[: len(rates_hz)]]
    for person, (path, rate_hz) in enumerate(zip(paths, rates_hz, strict=True)):
        path.write_text(write_bvh(waltz(rate_hz)[person]))
    return paths


def turned_to(motion: Motion, axis: str) -> Motion:
    """Return a motion in axes of which this one points up, as a file may have them."""
    turn = conjugate(upright_from_file(axis))

    def turned(vectors: np.ndarray) -> np.ndarray:
        return rotate(np.broadcast_to(turn, (*vectors.shape[:-1], 4)), vectors)

    local = motion.local_unitquat
    back = np.broadcast_to(conjugate(turn), local.shape)
    return replace(
        motion,
        rest_offsets_m=turned(motion.rest_offsets_m),
        root_translation_m=turned(motion.root_translation_m),
        local_unitquat=multiply(np.broadcast_to(turn, local.shape), multiply(local, back)),
    )


@pytest.mark.parametrize("rates_hz", [(30.0, 60.0), (120.0, 50.0), (60.0, 60.006), (60.0, 59.94)])
def test_files_of_two_rates_are_brought_together_by_time(
    store: Store, tmp_path: Path, rates_hz: tuple[float, float]
) -> None:
    take = {"id": "waltz", "files": write_two(tmp_path, *rates_hz), "floor": "keep"}
    places = body22_of(store, ingest_take(store, take, rate_hz=60.0).ref)
    times_s = np.arange(len(places)) / 60.0
    assert times_s[-1] > DURATION_S - 0.1
    for person in (0, 1):
        worst = np.abs(places[:, person] - truth_m(times_s, person)).max()
        assert worst < 3 * NEAR_M if 30.0 in rates_hz or 50.0 in rates_hz else worst < NEAR_M


def test_the_same_is_so_without_a_study(tmp_path: Path) -> None:
    files = list(map(str, write_two(tmp_path, 30.0, 60.0)))
    with find_take(files, tmp_path, (), None) as (store, ref):
        places = body22_of(store, ref)
    times_s = np.arange(len(places)) / 30.0
    expected = np.stack([truth_m(times_s, person) for person in (0, 1)], axis=1)
    expected[..., 1] += (places - expected)[..., 1].mean()  # it may be put on the floor
    assert np.abs(places - expected).max() < NEAR_M


@pytest.mark.parametrize(("units_m", "scale"), [((), 0.8), ((0.01,), 1.0)])
def test_without_a_study_the_npz_of_an_export_states_the_unit(
    tmp_path: Path, units_m: tuple[float, ...], scale: float
) -> None:
    files = write_two(tmp_path, 30.0, 30.0)
    for path in files:
        np.savez(path.with_suffix(".npz"), bvh_metres_per_unit=0.008)
    with find_take([str(path) for path in files], tmp_path / "store", units_m, None) as (store, ref):
        people_m = body22_of(store, ref)
    assert np.ptp(people_m[0, 0, :, 1]) == pytest.approx(scale * np.ptp(truth_m(np.zeros(1), 0)[0, :, 1]), rel=1e-3)


@pytest.mark.parametrize("offset_s", [0.25, 0.26, -0.255])
def test_a_file_that_began_earlier_is_shifted_in_time(store: Store, tmp_path: Path, offset_s: float) -> None:
    take = {"id": "waltz", "files": write_two(tmp_path, 120.0, 60.0), "floor": "keep"}
    take["persons"] = [{}, {"offset_s": offset_s}]
    places = body22_of(store, ingest_take(store, take, rate_hz=30.0).ref)
    assert len(places) == pytest.approx((DURATION_S - abs(offset_s)) * 30.0, abs=1.5)
    for person, late_s in enumerate((max(-offset_s, 0.0), max(offset_s, 0.0))):
        times_s = late_s + np.arange(len(places)) / 30.0
        assert np.abs(places[:, person] - truth_m(times_s, person)).max() < NEAR_M


def test_files_of_two_rates_and_lengths_are_refused_in_seconds(tmp_path: Path) -> None:
    files = write_two(tmp_path, 30.0, 60.0)
    short = waltz(60.0)[1].first_frames(60)
    files[1].write_text(write_bvh(short))
    with pytest.raises(InputError, match=r"unequal lengths \(a.bvh 2.0\d and b.bvh 1.00 seconds\).*on_unequal"):
        planned(takes=[{"id": "waltz", "files": files}])
    assert planned(takes=[{"id": "waltz", "files": files, "on_unequal": "trim"}])


@pytest.mark.parametrize("axis", ["z", "x"])
def test_a_partner_in_other_axes_does_not_float(store: Store, tmp_path: Path, axis: str) -> None:
    files = write_two(tmp_path, 60.0, 60.0)
    files[1].write_text(write_bvh(turned_to(waltz(60.0)[1], axis)))
    made = ingest_take(store, {"id": "waltz", "files": files}, rate_hz=60.0)
    assert list(store.read(made.ref, "takes")["up_axis"]) == ["y", axis]
    heads = body22_of(store, made.ref)[:, :, 15, 1].mean(axis=0)
    assert np.ptp(heads) < 0.3


def test_people_of_two_rigs_are_one_take(tmp_path: Path) -> None:
    rigs = {rig.name: rig for rig in RIGS}
    files: list[Path] = []
    for name in ("mixamo with a namespace", "lafan1", "xsens"):
        files.append(tmp_path / f"{len(files)}.bvh")
        files[-1].write_text(rigs[name].bvh())
    shard, *_ = planned(takes=[{"id": "three", "files": files}])
    assert [person.layout for person in shard.options(TakeParameters).persons] == ["mixamo", "lafan", "xsens"]


def test_a_shard_reads_each_file_once(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = write_two(tmp_path, 30.0, 30.0)
    take, *_ = planned(takes=[{"id": "waltz", "files": files}])
    opened: list[Path] = []

    def read(path: Path) -> bytes:
        opened.append(path)
        return read_file(path)

    monkeypatch.setattr("tasks.ingest.files.read_file", read)
    run(store, [take])
    assert sorted(opened) == files


def test_two_people_on_one_rig_are_no_error_and_need_no_split_before_training(store: Store, tmp_path: Path) -> None:
    first = make_duet("waltz", duration_s=DURATION_S, rate_hz=30.0).motions
    files = [tmp_path / "a.bvh", tmp_path / "b.bvh"]
    for path, motion in zip(files, first, strict=True):
        path.write_text(write_bvh(replace(motion, rest_offsets_m=first[0].rest_offsets_m)))
    assert "betas" not in judged(ingest_take(store, {"id": "w", "files": files})).reason
    study = tmp_path / "mine.toml"
    write_new_study(study, files)
    study.write_text(f"{study.read_text()}\n[augmentation]\nscales = [0.75, 1.25]\n")
    asked = ["plan", str(study), "--store", str(tmp_path / "other")]
    assert run_command_line([*asked, "--until", "augmentation"]) == 0
    assert run_command_line(asked) == 2


def test_a_study_file_says_of_a_take_to_retarget_what_its_files_do_not(tmp_path: Path) -> None:
    """A drafted mapping serves `retarget` as it serves a study; without it the message names the way."""
    rig = RIGS[0].bvh()
    for number, name in enumerate(dict.fromkeys(re.findall(r"(?:ROOT|JOINT) (\S+)", rig))):
        rig = re.sub(rf"\b{name}\b", f"bone{number}", rig)
    file, study = tmp_path / "odd.bvh", tmp_path / "take.toml"
    file.write_text(rig)
    with (
        pytest.raises(InputError, match=r"ingest.mappings.*study new take.toml --from FILE"),
        find_take([str(file)], tmp_path, (), None),
    ):
        pass
    write_new_study(study, [file])
    with find_take([str(study)], tmp_path, (), None) as (store, ref):
        assert body22_of(store, ref).shape[1:] == (1, 22, 3)


def test_a_partner_whose_names_are_exchanged_is_no_mirror_image(tmp_path: Path) -> None:
    """Where the partner is right the scene is: names are put in order, and nobody moves."""
    rig = RIGS[0]
    exchanging = {"Left": "Right", "Right": "Left"}
    files = [tmp_path / "a.bvh", tmp_path / "b.bvh"]
    files[0].write_text(rig.bvh())
    take = {"id": "walk", "metres_per_unit": 0.01, "files": files}
    moved: dict[str, Any] = {"translation_m": [1.0, 0.0, 0.5]}

    def made(name: str, **second: Any) -> tuple[np.ndarray, str]:
        store = Store(tmp_path / name)
        built = ingest_take(store, take | {"persons": [{}, moved | second]}, rate_hz=30.0)
        return body22_of(store, built.ref), judged(built).reason

    files[1].write_text(f"{rig.bvh()}\n")
    right, _ = made("right")
    files[1].write_text(re.sub("Left|Right", lambda side: exchanging[side[0]], rig.bvh()))
    study = tmp_path / "mine.toml"
    said = write_new_study(study, files)
    assert any(line.startswith('in doubt: mirrored = "names": b.bvh: toes and knees') for line in said)
    persons = tomllib.loads(study.read_text())["ingest"]["takes"][0]["persons"]
    assert [person["mirrored"] for person in persons if "mirrored" in person] == ["names"]
    wrong, reason = made("wrong")
    assert 'left and right of b.bvh seem exchanged; look, and set mirrored = "names", because others' in reason
    mended, reason = made("mended", mirrored="names")
    assert "exchanged" not in reason
    np.testing.assert_allclose(mended, right, atol=1e-6)
    assert np.abs(wrong - right).max() > 0.1


def test_of_one_person_both_ways_to_mend_left_and_right_are_said(tmp_path: Path) -> None:
    file = tmp_path / "a.bvh"
    source = RIGS[0].source().mirrored()
    file.write_text(write_bvh(source.to_motion(metres_per_unit=1.0, rate_hz=30.0), units_per_metre=1.0))
    said = write_new_study(tmp_path / "mine.toml", [file])
    assert any("in doubt: mirrored = true: a.bvh: toes and knees" in line and '"names" where' in line for line in said)
