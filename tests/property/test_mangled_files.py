"""Mangle files: readers raise only our errors, with a sentence, and whatever they read is finite."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.synthetic import random_pairs
from pasdedeux.errors import InputError
from pasdedeux.formats.bvh import read_bvh, read_bvh_head
from pasdedeux.formats.pair_file import PairFile, read_pair_json, write_pair_json
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, check_anatomy
from pasdedeux.formats.registry import ANNOTATION_FORMATS, MOTION_FORMATS, recognise_format
from pasdedeux.formats.rigs.target_body import read_body
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.humanoid import t_pose
from tests.builders.guesses import guess_motion
from tests.builders.source_samples import (
    BVH_SMALL,
    GOOD_ANNOTATIONS,
    GOOD_MOTIONS,
    image_text,
    landmark_texts,
    result_texts,
)


def reader_of(name: str, files: Mapping[str, bytes]) -> tuple[bytes, Callable[[bytes], object]]:
    """Return the first file of a source of 2D poses, and what reads the source with another file in its place."""
    kind, (first, *_) = ANNOTATION_FORMATS[name], files
    return files[first], lambda data: kind.read({**files, first: data}, sequence_id="s")


def _readers() -> dict[str, tuple[bytes, Callable[[bytes], object]]]:
    """Return a good file and its reader for everything that is registered, and for what lies beside a motion."""
    readers: dict[str, tuple[bytes, Callable[[bytes], object]]] = {
        "recognition": (BVH_SMALL.encode(), recognise_format)
    }
    for name, (motion, companion) in GOOD_MOTIONS.items():
        kind = MOTION_FORMATS[name]
        readers[name] = (motion, lambda data, kind=kind, companion=companion: kind.read(data, companion))
        if companion:
            readers[f"{name} beside"] = (companion, lambda data, kind=kind, motion=motion: kind.read(motion, data))
    readers |= {name: reader_of(name, files) for name, files in GOOD_ANNOTATIONS.items()}
    image = {"w_1.json": image_text("ultralytics").encode()}
    readers["image_results, ultralytics"] = reader_of("image_results", image)
    pair = random_pairs(np.random.default_rng(1), 1)[0]
    readers["pair"] = write_pair_json(PairFile(pair)).encode(), read_pair_json
    rest = np.array([t_pose(joint) for joint in BODY22.joint_names]).tolist()
    body = json.dumps(dict(zip(BODY22.joint_names, rest, strict=True))).encode()
    readers["body"] = body, lambda data: read_body("body", data)
    texts = result_texts() | landmark_texts()
    forms = {"coco": ("mmpose demo", "alphapose"), "points": ("by name", "rows", "columns by name")}
    for name, form in ((name, form) for name, of_name in forms.items() for form in of_name):
        readers[f"{name}, {form}"] = reader_of(name, {"file": texts[form].encode()})
    return readers


READERS = _readers()

TOKENS = [
    b"nan", b"inf", b"-inf", b"1e999", b"1e300", b"-1", b"0", b"999999999", b"99999999999999999999", b"{", b"}", b"[",
    b"]", b'"', b",", b":", b"null", b"true", b"NaN", b"\0", b"\xff\xfe", b"JOINT", b"MOTION", b"begin", b"end",
    b":root", b"1_000", b"1.2.3", b"", b"\n", b"\r", b"Frames: 999999999", b"Frame Time: 1e-300", b"\xe2\x80\xa8",
    b"CHANNELS 6 Xposition", b"CHANNELS 999999", b"#", b"1e5", "é".encode(), b"[[[[[[[[[[[[[[[[[[[[[[[[[[[[",
]  # fmt: skip


@st.composite
def mangled(draw: st.DrawFn, data: bytes) -> bytes:
    """Damage a file a few times: cut, flip, delete, double, insert, on bytes, words and lines."""
    for _ in range(draw(st.integers(1, 3))):
        kind = draw(st.sampled_from(["cut", "flip", "delete", "double", "insert", "word", "line", "swap"]))
        place = draw(st.integers(0, max(len(data) - 1, 0)))
        if kind == "cut":
            data = data[:place]
        elif kind == "flip" and data:
            data = data[:place] + bytes([data[place] ^ (1 << draw(st.integers(0, 7)))]) + data[place + 1 :]
        elif kind == "delete":
            data = data[:place] + data[place + draw(st.integers(1, 40)) :]
        elif kind == "double":
            stop = place + draw(st.integers(1, 200))
            data = data[:stop] + data[place:stop] + data[stop:]
        elif kind == "insert":
            data = data[:place] + b" " + draw(st.sampled_from(TOKENS)) + b" " + data[place:]
        elif kind == "word":
            words = data.split(b" ")
            words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(TOKENS))
            data = b" ".join(words)
        else:
            lines = data.split(b"\n")
            at = draw(st.integers(0, len(lines) - 1))
            if kind == "line":
                del lines[at]
            else:
                lines[at], lines[at - 1] = lines[at - 1], lines[at]
            data = b"\n".join(lines)
    return data


def check(result: object) -> None:
    """Whatever a reader accepts must be finite where it says so and must survive the next step."""
    if isinstance(result, SourceMotion):
        motion = result.to_motion(metres_per_unit=1.0, rate_hz=result.rate_hz or 30.0)
        positions, _ = motion.world()
        assert np.isfinite(positions).all()
        assert np.allclose(np.linalg.norm(motion.local_unitquat, axis=-1), 1.0)
        guess_motion(result)
    if isinstance(result, AnnotatedFrames):
        seen = result.confidence > 0
        assert np.isfinite(result.keypoints_px[seen]).all()
        assert np.isnan(result.keypoints_px[~seen]).all()
        check_anatomy(result)


@pytest.mark.parametrize("name", ["pair", "body"])
@pytest.mark.parametrize("number", [b"9" * 20, b"9" * 400, b"1e999", b"-Infinity"])
def test_numbers_that_no_float_holds_raise_our_error(name: str, number: bytes) -> None:
    sample, read = READERS[name]
    damaged = re.sub(rb"(?<=\[)-?[0-9.]+", number, sample, count=1)
    assert damaged != sample
    with pytest.raises(InputError):
        read(damaged)


@pytest.mark.parametrize("name", ["pair", "body", "coco", "points", "openpose"])
def test_json_that_is_nested_too_deeply_raises_our_error(name: str) -> None:
    with pytest.raises(InputError, match="nested too deeply"):
        READERS[name][1](b"[" * 100_000)


@pytest.mark.parametrize("name", READERS)
def test_the_samples_themselves_are_read(name: str) -> None:
    data, read = READERS[name]
    check(read(data))


def message_of(read: Callable[[], object]) -> str:
    """Return what our error says, or that the file was read."""
    try:
        read()
    except InputError as error:
        return str(error).strip()
    return "read"


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=200, deadline=2000, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(data=st.data())
def test_a_mangled_file_raises_our_error_or_gives_sound_values(name: str, data: st.DataObject) -> None:
    sample, read = READERS[name]
    damaged = data.draw(mangled(sample))
    message = message_of(lambda: check(read(damaged)))
    assert message
    assert "\n" not in message


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=60, deadline=2000)
@given(data=st.binary(max_size=300))
def test_arbitrary_bytes_raise_our_error(name: str, data: bytes) -> None:
    assert message_of(lambda: READERS[name][1](data))


@settings(max_examples=150, deadline=2000)
@given(data=st.data())
def test_the_quick_check_of_a_bvh_file_and_its_reader_agree(data: st.DataObject) -> None:
    damaged = data.draw(mangled(BVH_SMALL.encode()))
    if message_of(lambda: read_bvh(damaged)) == "read":
        read_bvh_head(damaged)
