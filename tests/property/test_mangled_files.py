"""Mangled files raise our errors with a sentence, and nothing else; what is read is finite."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pasdedeux.errors import InputError
from pasdedeux.formats import (
    AnnotatedFrames,
    OpenPoseFrame,
    SourceMotion,
    check_anatomy,
    guess_motion,
    join_openpose_frames,
    read_amc,
    read_annotation_csv,
    read_annotation_npz,
    read_asf,
    read_bvh,
    read_bvh_header,
    read_coco,
    read_openpose_frame,
    read_positions_npz,
    read_rotation_rows,
    recognise_format,
)
from tests.builders.annotation_files import write_annotation_npz
from tests.builders.source_samples import AMC, ASF, BVH_SMALL, coco_text, csv_text, openpose_text, positions_npz

ROWS = "0 0 0 1 2 3 4 5 6\n10 20 30 0 0 0 7 8 9\n"
TEMPLATE = """HIERARCHY
ROOT A
{
OFFSET 0 1 0
CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT B
{
OFFSET 0 1 0
CHANNELS 3 Zrotation Xrotation Yrotation
JOINT C
{
OFFSET 0 1 0
CHANNELS 3 Zrotation Xrotation Yrotation
End Site
{
OFFSET 0 0 0
}
}
}
}
"""

READERS: dict[str, tuple[bytes, Callable[[bytes], object]]] = {
    "bvh": (BVH_SMALL.encode(), read_bvh),
    "asf": (ASF.encode(), read_asf),
    "amc": (AMC.encode(), lambda data: read_amc(data, read_asf(ASF))),
    "amc over a mangled asf": (ASF.encode(), lambda data: read_amc(AMC, read_asf(data))),
    "rotation rows": (ROWS.encode(), lambda data: read_rotation_rows(data, TEMPLATE)),
    "openpose": (openpose_text("body25", people=2).encode(), read_openpose_frame),
    "coco": (coco_text().encode(), lambda data: read_coco(data, sequence_id="s")),
    "annotation csv": (csv_text().encode(), read_annotation_csv),
    "annotation npz": (write_annotation_npz(read_annotation_csv(csv_text())), read_annotation_npz),
    "positions npz": (positions_npz(), read_positions_npz),
    "guess": (BVH_SMALL.encode(), recognise_format),
}

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
    if isinstance(result, OpenPoseFrame) and result.layout:
        join_openpose_frames([(0, result)], sequence_id="s")


@pytest.mark.parametrize("name", READERS)
def test_the_samples_themselves_are_read(name: str) -> None:
    data, read = READERS[name]
    check(read(data))


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=200, deadline=2000, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(data=st.data())
def test_a_mangled_file_raises_our_error_or_gives_sound_values(name: str, data: st.DataObject) -> None:
    sample, read = READERS[name]
    damaged = data.draw(mangled(sample))
    message = "read"
    try:
        check(read(damaged))
    except InputError as error:
        message = str(error).strip()
    assert message
    assert "\n" not in message


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=60, deadline=2000)
@given(data=st.binary(max_size=300))
def test_arbitrary_bytes_raise_our_error(name: str, data: bytes) -> None:
    message = "read"
    try:
        READERS[name][1](data)
    except InputError as error:
        message = str(error).strip()
    assert message


@settings(max_examples=150, deadline=2000)
@given(data=st.data())
def test_the_quick_check_of_a_bvh_file_and_its_reader_agree(data: st.DataObject) -> None:
    damaged = data.draw(mangled(BVH_SMALL.encode()))
    try:
        read_bvh(damaged)
        is_read = True
    except InputError:
        is_read = False
    try:
        read_bvh_header(damaged)
    except InputError:
        assert not is_read
