"""Read and write C3D: files of other programs, long takes, gaps, several people, damage."""

import re
import struct

import ezc3d
import numpy as np
import pytest

from pasdedeux.errors import FormatError
from pasdedeux.formats.c3d import C3D, _num_frames, read_c3d, read_points, write_c3d
from pasdedeux.formats.labelled_points import LabelledPoints
from pasdedeux.formats.registry import recognise_format
from pasdedeux.skeletons import BODY22
from tests.builders.source_samples import c3d_points, figure_motion

POSITIONS_M, _ = figure_motion().world()
NAMES = list(BODY22.joint_names)


def made_by_ezc3d(tmp_path, points, labels, *, unit="mm", rate_hz=120.0, gap=None):
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [rate_hz]
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    file["data"]["points"] = np.moveaxis(points, 0, -1).swapaxes(0, 1)
    residuals = np.zeros((1, len(labels), len(points)))
    if gap is not None:
        residuals[0, gap[1], gap[0]] = -1.0
    file["data"]["meta_points"]["residuals"] = residuals
    file.write(str(tmp_path / "made.c3d"))
    return (tmp_path / "made.c3d").read_bytes()


def test_what_another_program_wrote_is_read(tmp_path):
    source = read_c3d(made_by_ezc3d(tmp_path, 1e3 * POSITIONS_M, [f"Anna:{name}" for name in NAMES]))
    assert (source.rate_hz, source.metres_per_unit, source.num_frames) == (120.0, 1e-3, 12)
    found, _ = source.to_motion(metres_per_unit=1e-3, rate_hz=120.0).world()
    np.testing.assert_allclose(found, POSITIONS_M, atol=1e-4)


def test_a_file_of_many_points_and_texts_is_read_by_another_program(tmp_path):
    labels = [f"{letter}:{name}" for letter in "ABCDEFGHIJKLM" for name in NAMES]
    points = np.tile(POSITIONS_M, (1, 13, 1))
    data = write_c3d(points, labels, rate_hz=59.94, facts={"CREDIT": "c" * 300})
    (tmp_path / "own.c3d").write_bytes(data)
    file = ezc3d.c3d(str(tmp_path / "own.c3d"))
    point = file["parameters"]["POINT"]
    assert [*point["LABELS"]["value"], *point["LABELS2"]["value"]] == labels
    assert point["RATE"]["value"][0] == pytest.approx(59.94)
    assert "".join(file["parameters"]["PASDEDEUX"]["CREDIT"]["value"]) == "c" * 300
    np.testing.assert_allclose(file["data"]["points"][:3].transpose(2, 1, 0) / 1e3, points, atol=1e-6)
    found = read_points(data)
    assert found.labels == tuple(labels)
    np.testing.assert_allclose(found.positions / 1e3, points, atol=1e-6)


def test_people_are_told_apart_by_what_stands_before_the_colon():
    data = c3d_points("AB")
    both = [C3D.read_person(number, data).to_motion(metres_per_unit=1e-3, rate_hz=30.0).world()[0] for number in (0, 1)]
    np.testing.assert_allclose(both[1] - both[0] - [1.0, 0.0, 0.0], 0.0, atol=1e-5)
    assert C3D.count_people(data) == 2


def test_integers_are_scaled_as_the_file_says():
    data = bytearray(write_c3d(POSITIONS_M[:1], NAMES, rate_hz=30.0, facts={}))
    (first,) = struct.unpack_from("<H", data, 16)
    struct.pack_into("<f", data, 12, 0.1)
    at = data.index(b"SCALE") + 5
    struct.pack_into("<f", data, at + 4, 0.1)
    whole = np.zeros((22, 4), "<i2")
    whole[:, :3] = np.round(1e4 * POSITIONS_M[0])
    data[(first - 1) * 512 :] = whole.tobytes()
    np.testing.assert_allclose(read_points(bytes(data)).positions[0] / 1e3, POSITIONS_M[0], atol=1e-4)


@pytest.mark.parametrize(
    ("labels", "gap", "sentence"),
    [
        ([f"M{at}" for at in range(22)], None, "no joints of a person (M0, M1, "),
        (["LASI", "RASI", *NAMES[2:]], None, "the point 'pelvis' is missing"),
        (NAMES, (7, 21), "frame 7: the point 'right_wrist' is missing"),
    ],
)
def test_markers_and_gaps_are_refused_in_a_sentence(tmp_path, labels, gap, sentence):
    with pytest.raises(FormatError, match=re.escape(sentence)):
        read_c3d(made_by_ezc3d(tmp_path, 1e3 * POSITIONS_M, labels, gap=gap))


def test_a_file_of_analog_data_alone_is_refused():
    data = bytearray(c3d_points())
    at = data.index(b"USED") + 8
    data[at : at + 2] = bytes(2)
    with pytest.raises(FormatError, match="holds analog data only"):
        read_c3d(bytes(data))


@pytest.mark.parametrize(("name", "kind"), [("LABELS", 1), ("UNITS", 1), ("RATE", -1), ("SCALE", -1), ("USED", -1)])
def test_a_parameter_of_another_type_is_damage(name, kind):
    data = bytearray(c3d_points())
    struct.pack_into("<b", data, data.index(name.encode()) + len(name) + 2, kind)
    with pytest.raises(FormatError, match="this is a damaged C3D file"):
        read_c3d(bytes(data))


def test_a_parameter_that_states_endless_texts_is_refused_at_once():
    data = bytearray(c3d_points())
    at = data.index(b"LABELS") + 8
    assert data[at : at + 2] == b"\xff\x02"  # texts of two axes
    data[at + 1] = 200
    with pytest.raises(FormatError, match="its parameter 'LABELS' is longer than the file"):
        read_c3d(bytes(data))


@pytest.mark.parametrize("labels", [["A_pelvis", "B_pelvis"], ["anna.pelvis", "anna.head"], ["a:LASI", "b:RASI"]])
def test_points_that_are_no_whole_bodies_are_nobody(labels):
    assert LabelledPoints("file", tuple(labels), np.zeros((1, 2, 3)), 30.0, "m").people == []


@pytest.mark.parametrize("form", ["{}:{}", "{}_{}", "{}.{}", "sub-{}|{}", "{} {}"])
def test_a_person_who_lacks_a_joint_stays_that_person(form):
    labels = [form.format(who, joint) for who in "AB" for joint in NAMES]
    labels[NAMES.index("left_knee")] = "marker 7"
    points = LabelledPoints("C3D file", tuple(labels), np.tile(POSITIONS_M, (1, 2, 1)), 30.0003, "mm")
    assert points.num_people == 2
    with pytest.raises(FormatError, match=re.escape(f"the point '{form.format('A', 'left_knee')}' is missing")):
        points.source(0)
    assert (points.source(1).num_frames, points.source(1).rate_hz) == (12, 30.0)


def _long(data, header=None):
    """Return a file of 70,000 frames as programs write it that know only the 16 bits of the header."""
    data = bytearray(data.replace(b"LONG_FRAMES", b"SOME_OTHERS"))
    struct.pack_into("<H", data, 8, 0xFFFF if header is None else header)
    return bytes(data)


@pytest.mark.parametrize(
    "spoil",
    [bytes, _long, lambda data: _long(data, 70_000 & 0xFFFF)],
    ids=["a parameter says it", "the header is full", "the header wraps around"],
)
@pytest.mark.parametrize("num_points", [1, 3, 22])
def test_seventy_thousand_frames_are_seventy_thousand(spoil, num_points):
    points = np.random.default_rng(0).normal(size=(70_000, num_points, 3))
    data = write_c3d(points, [f"p{at}" for at in range(num_points)], rate_hz=120.0, facts={})
    found = read_points(spoil(data)).positions
    assert found.shape == points.shape
    np.testing.assert_allclose(found[-1], 1e3 * points[-1], rtol=1e-5)


def test_frames_that_another_program_counts_in_a_trial_are_read():
    fields = {"START": [1, 0], "END": [65_600 - 65_536, 1]}
    parameters = {f"TRIAL:ACTUAL_{which}_FIELD": np.array(words, "<i2") for which, words in fields.items()}
    assert _num_frames(parameters, 1, 0xFFFF, b"", 16) == 65_600
    assert _num_frames(parameters | {"TRIAL:ACTUAL_END_FIELD": np.array([70, 0], "<i2")}, 1, 70, b"", 16) == 70


def test_the_message_about_a_gltf_scene_says_what_to_export():
    for scene in (b"glTF\x02\0\0\0", b'{"asset": {"version": "2.0"}, "nodes": []}'):
        with pytest.raises(FormatError, match=r"this is a glTF scene.*export its armature as BVH"):
            recognise_format(scene)
