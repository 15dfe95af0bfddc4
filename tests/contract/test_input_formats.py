"""What every format of files that come in must do: read its good file, know it from the others, refuse mangled ones."""

from __future__ import annotations

import io
import re
import tracemalloc
import zipfile
from collections.abc import Callable

import numpy as np
import pytest
from pydantic import ValidationError

from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import FileFormat, FileStart
from pasdedeux.formats.npz import read_npz
from pasdedeux.formats.poses2d.annotated_frames import check_anatomy
from pasdedeux.formats.registry import ANNOTATION_FORMATS, MOTION_FORMATS, find_format, recognise_format
from pasdedeux.formats.rigs.target_body import read_body
from pasdedeux.interaction.objects import read_objects
from tasks.ingest import IngestParameters
from tests.builders.source_samples import GOOD_ANNOTATIONS, GOOD_MOTIONS

GOOD = {name: data for name, (data, _) in GOOD_MOTIONS.items()} | {
    name: next(iter(files.values())) for name, files in GOOD_ANNOTATIONS.items()
}
JUNK = bytes(range(256)) * 8
FORMATS: dict[str, FileFormat] = {**MOTION_FORMATS, **ANNOTATION_FORMATS}
NUMBER = re.compile(rb"[-+]?\d+(\.\d+)?")


def read(name: str, data: bytes) -> object:
    """Read one file of a format, in the place of the first of its good files."""
    if name in MOTION_FORMATS:
        return MOTION_FORMATS[name].read(data, GOOD_MOTIONS[name][1])
    first, *others = GOOD_ANNOTATIONS[name]
    files = {first: data, **{companion: GOOD_ANNOTATIONS[name][companion] for companion in others}}
    return ANNOTATION_FORMATS[name].read(files, sequence_id="s")


def test_there_is_a_good_file_of_every_format() -> None:
    assert set(GOOD_MOTIONS) == set(MOTION_FORMATS)
    assert set(GOOD_ANNOTATIONS) == set(ANNOTATION_FORMATS)


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_is_known_from_every_other_by_its_content(name: str) -> None:
    assert FORMATS[name].name == name
    start = FileStart(GOOD[name])
    assert [known for known, kind in FORMATS.items() if kind.recognises(start)] == [name]
    assert recognise_format(GOOD[name]) is FORMATS[name]


ZIPPED = io.BytesIO()
with zipfile.ZipFile(ZIPPED, "w") as _archive:
    _archive.writestr("dance/walk.bvh", "HIERARCHY")
FOREIGN = {
    b"Kaydara FBX Binary  \0\x1a\0": "an FBX scene, .*export its armature as BVH",
    b"; FBX 7.4.0 project file\n": "an FBX scene",
    b"version https://git-lfs.github.com/spec/v1\noid sha256:0": "a git-LFS pointer, .*git lfs pull",
    b"\n<!DOCTYPE html><html>": "a web page, .*download the file again",
    ZIPPED.getvalue(): "a zip archive of dance/walk.bvh: unpack it",
    b"\x1f\x8b\x08\0": "a packed archive: unpack it",
    b"\x80\x04\x95": "a pickle, which may run any program",
    b"glTF\x02\0\0\0": "a glTF scene",
    b'<?xml version="1.0"?>\n<COLLADA version="1.4">': "a COLLADA scene",
    b'<?xml version="1.0"?>\n<!-- x -->\n<mvnx version="4">': "an MVNX file of Xsens",
    b"\0\0\0 ftypisom": "a video",
    b"\x89PNG\r\n": "a picture",
    b"\x93NUMPY\x01\0": "a single array without names",
}


@pytest.mark.parametrize(("data", "says"), FOREIGN.items(), ids=FOREIGN.values())
def test_a_file_of_another_kind_is_named_wherever_it_is_opened(data: bytes, says: str) -> None:
    openings: list[Callable[[bytes], object]] = [recognise_format]
    openings += [lambda data, name=name: find_format(ANNOTATION_FORMATS, name, data) for name in ANNOTATION_FORMATS]
    openings += [lambda data, name=name: find_format(MOTION_FORMATS, name, data) for name in MOTION_FORMATS]
    openings += [lambda data: read_body("x", data), lambda data: read("bvh", data), lambda data: read("asf_amc", data)]
    for opening in openings:
        with pytest.raises(FormatError, match=f"this is {says}") as error:
            opening(data)
        assert len(str(error.value)) < 200


@pytest.mark.parametrize(("data", "holds"), [(b"hello", "text that begins with 'hello'"), (JUNK, "binary data")])
def test_a_file_of_no_format_is_told_so_in_a_sentence(data: bytes, holds: str) -> None:
    with pytest.raises(FormatError, match=f"none of the known formats, it holds {holds}; motions are read") as found:
        recognise_format(data)
    assert len(str(found.value)) < 300


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"])
@pytest.mark.parametrize("name", ["bvh", "asf_amc", "trc", "rotation_rows", "expi"])
def test_texts_are_read_in_any_unicode(name: str, encoding: str) -> None:
    data, companion = GOOD_MOTIONS[name]
    again = data.decode().encode(encoding)
    assert recognise_format(again) is MOTION_FORMATS[name]
    found, wanted = (MOTION_FORMATS[name].read(text, companion) for text in (again, data))
    np.testing.assert_array_equal(found.local_unitquat, wanted.local_unitquat)


@pytest.mark.parametrize("name", MOTION_FORMATS)
def test_the_people_of_a_file_are_counted_and_no_more_are_read(name: str) -> None:
    data, companion = GOOD_MOTIONS[name]
    kind = MOTION_FORMATS[name]
    count = kind.count_people(data)
    for number in range(count):
        assert kind.read_head(data, companion, number=number).num_frames > 1
    if kind.read_other is not None:
        with pytest.raises(FormatError, match=f"person {count}: it holds {count} pe"):
            kind.read_person(count, data, companion)


def test_a_motion_is_no_source_of_2d_poses_and_the_other_way_round() -> None:
    with pytest.raises(FormatError, match="'bvh', not one of 2D poses"):
        find_format(ANNOTATION_FORMATS, "auto", GOOD["bvh"])
    with pytest.raises(FormatError, match="'coco', not a motion of one person"):
        find_format(MOTION_FORMATS, "auto", GOOD["coco"])


@pytest.mark.parametrize("name", MOTION_FORMATS)
def test_the_good_file_of_a_motion_is_read_and_its_head_agrees(name: str) -> None:
    data, companion = GOOD_MOTIONS[name]
    kind = MOTION_FORMATS[name]
    source, head = kind.read(data, companion), kind.read_head(data, companion)
    assert source.num_frames == head.num_frames > 1
    assert head.rest.num_frames == 1
    assert head.rest.skeleton == source.skeleton
    assert (head.rest.rate_hz, head.rest.metres_per_unit) == (source.rate_hz, source.metres_per_unit)
    np.testing.assert_array_equal(head.rest.rest_offsets, source.rest_offsets)
    positions, _ = source.to_motion(metres_per_unit=1.0, rate_hz=30.0).world()
    assert np.isfinite(positions).all()
    assert bool(kind.companion) == bool(kind.companion_names(f"60_01{kind.suffixes[0] if kind.suffixes else ''}"))


@pytest.mark.parametrize("name", ANNOTATION_FORMATS)
def test_the_good_files_of_2d_poses_are_read_and_are_people(name: str) -> None:
    kind = ANNOTATION_FORMATS[name]
    frames = kind.read(GOOD_ANNOTATIONS[name], sequence_id="s")
    check_anatomy(frames)
    is_seen = frames.confidence > 0
    assert is_seen.mean() > 0.8
    np.testing.assert_array_equal(np.isfinite(frames.keypoints_px).all(axis=-1), is_seen)
    numbers = kind.frame_numbers(list(GOOD_ANNOTATIONS[name]))
    assert numbers == (sorted(set(frames.frame.tolist())) if kind.is_file_per_frame else [])


def cut_off(data: bytes) -> bytes:
    """Cut a file in the middle of a line (or of its only one) after more than half of it."""
    start = data.rfind(b"\n", 0, int(0.7 * len(data))) + 1
    stop = data.find(b"\n", start)
    return data[: start + ((stop if stop > 0 else len(data)) - start) // 2]


def with_last_number(data: bytes, word: str) -> bytes:
    """Put a word in the place of a file's last number."""
    if data[1:2] == b"P" and data[0] < ord(" "):  # a C3D file, whose last number is a float before zeros
        bare = data.rstrip(b"\0")
        number = np.float32(np.nan).tobytes() if word == "nan" else word.encode()
        return bare[:-4] + number + data[len(bare) :]
    if data[:2] != b"PK":
        *_, last = NUMBER.finditer(data)
        return data[: last.start()] + word.encode() + data[last.end() :]
    arrays = dict(np.load(io.BytesIO(data)))
    *_, name = (key for key, array in arrays.items() if array.ndim > 1)
    if word == "nan":
        arrays[name] = arrays[name].copy()
        arrays[name].flat[-1] = np.nan
    else:
        arrays[name] = np.full(arrays[name].shape, word)
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


MANGLED: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "binary": lambda data: JUNK,
    "cut off": cut_off,
    "not a number": lambda data: with_last_number(data, "nan"),
    "a word": lambda data: with_last_number(data, "left"),
}
PLACE = re.compile(r"line \d+|frame \d+|person \d+|annotation \d+|array '\w+'|damaged|is empty|zero byte")


@pytest.mark.parametrize("how", MANGLED)
@pytest.mark.parametrize("name", FORMATS)
def test_a_mangled_file_is_refused_with_the_place_of_the_fault(name: str, how: str) -> None:
    with pytest.raises(FormatError) as found:
        read(name, MANGLED[how](GOOD[name]))
    assert PLACE.search(str(found.value)), found.value
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("how", ["empty", "binary", "cut off"])
@pytest.mark.parametrize("name", [name for name, kind in MOTION_FORMATS.items() if kind.companion])
def test_a_mangled_companion_is_refused(name: str, how: str) -> None:
    (data, companion), kind = GOOD_MOTIONS[name], MOTION_FORMATS[name]
    kind.check_companion(companion)
    with pytest.raises(FormatError):
        kind.read_head(data, MANGLED[how](companion))
    with pytest.raises(FormatError):
        kind.check_companion(MANGLED[how](companion))


@pytest.mark.parametrize(
    ("section", "names"),
    [
        ({"takes": [{"id": "a", "files": ["x"], "format": "bhv"}]}, MOTION_FORMATS),
        ({"annotations": [{"id": "a", "path": "x", "format": "cocoa"}]}, ANNOTATION_FORMATS),
    ],
)
def test_a_study_that_names_an_unknown_format_is_told_all_of_them(
    section: dict[str, object], names: dict[str, FileFormat]
) -> None:
    with pytest.raises(ValidationError, match="should be one of auto, " + ", ".join(names)):
        IngestParameters.model_validate(section)


def npz_bomb(array: str, megabytes: int) -> bytes:
    """Return a small archive whose array has so many megabytes of zeros."""
    out = io.BytesIO()
    np.savez_compressed(out, **{array: np.zeros((megabytes * 2**20 // 24, 1, 3))})
    return out.getvalue()


@pytest.mark.parametrize(
    ("array", "reading"),
    [
        ("positions_m", recognise_format),
        ("keypoints_px", recognise_format),
        ("positions_m", MOTION_FORMATS["positions_npz"].read),
        ("keypoints_px", lambda data: ANNOTATION_FORMATS["annotation_npz"].read({"a.npz": data}, sequence_id="s")),
        ("ends_m", read_objects),
        ("positions_m", lambda data: read_body("a.npz", data)),
    ],
)
def test_an_archive_that_unpacks_to_a_thousand_times_its_size_is_refused_before_that(
    array: str, reading: Callable[[bytes], object]
) -> None:
    data = npz_bomb(array, 64)
    assert len(data) < 100_000
    tracemalloc.start()
    try:
        with pytest.raises(FormatError, match=r"of 0\.1 MB states 67 MB of arrays, more than the 17 MB that are read"):
            reading(data)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


def test_an_archive_of_real_size_is_read_also_where_most_of_it_is_zero() -> None:
    values = np.zeros((400_000, 1, 3))
    values[::50] = np.random.default_rng(0).normal(size=(8000, 1, 3))
    out = io.BytesIO()
    np.savez_compressed(out, positions_m=values)
    assert out.tell() < values.nbytes / 30
    assert np.array_equal(read_npz(out.getvalue(), "archive")["positions_m"], values)
