"""Tell frames and videos by the names of images; refuse names that are ambiguous."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pasdedeux.errors import FormatError
from pasdedeux.formats.poses2d.image_names import STILLS_STEP, number_in_name, places_of_names
from pasdedeux.formats.poses2d.openpose import openpose_frame_number

DIGESTS = ("9f8a7c6d", "0b1c2d3e", "12345678", "ab12cd34", "77e0a1b2")
IDENTIFIERS = (
    "3f2504e0-4f89-11d3-9a0c-0305e82c3301",
    "6f9619ff-8b86-d011-b42d-00cf4fc964ff",
    "12345678-1234-1234-1234-123456789012",
)


@pytest.mark.parametrize(
    "template",
    [
        "frame ({}).jpg",
        "vid-{}s.png",
        "frame{}@2x.png",
        "{}.jpg",
        "clip2_720p_{}_v3.jpeg",
        "walk.{:05d}.json",
        "cam1_{:012d}_keypoints.json",
        "GX010042_{}.JPG",
        "2024-01-31 12.30.05 {}.png",
        "frame_{:,}.jpg",
        "frame_{:_}.jpg",
        "image_{}_dance_2024.tiff",
        "a/b3/take 7/{:06d}.webp",
    ],
)
def test_the_number_that_varies_is_the_frame_wherever_it_stands(template: str) -> None:
    frames = [8, 9, 10, 11, 99, 100, 101, 998, 999, 1000, 1001, 12345]
    assert places_of_names(template.format(at) for at in frames) == {template.format(at): ("", at) for at in frames}


@pytest.mark.parametrize(
    ("template", "words"),
    [
        ("frame_{}_jpg.rf.{}.jpg", DIGESTS),
        ("frame_{}_{}.jpg", DIGESTS),
        ("{1}-{0}.png", DIGESTS),
        ("{0:04d}.{1}.json", DIGESTS),
        ("{1}_{0}.png", IDENTIFIERS),
    ],
)
def test_digests_and_unique_identifiers_in_names_count_nothing(template: str, words: tuple[str, ...]) -> None:
    names = {template.format(at, word): ("", at) for at, word in zip((7, 8, 9, 10, 12), words, strict=False)}
    assert places_of_names(names) == names


_TEXT = st.text("abcxyzFG_-. ()@", max_size=6)
_FIXED = st.lists(st.tuples(_TEXT, st.integers(0, 9999)), max_size=2)


@given(before=_FIXED, after=_FIXED, text=_TEXT, end=_TEXT, digits=st.sampled_from((0, 6)), start=st.integers(0, 2000))
def test_any_template_with_a_counter_is_read(
    before: list[tuple[str, int]], after: list[tuple[str, int]], text: str, end: str, digits: int, start: int
) -> None:
    front = "".join(f"{word}_{number}_" for word, number in before) + text
    back = "".join(f"_x{word}{number}" for word, number in after) + "_" + end
    frames = range(start, start + 12, 3)
    names = {f"{front}{at:0{digits}d}{back}.png": ("", at) for at in frames}
    assert places_of_names(names) == names


@pytest.mark.parametrize(
    "places",
    [
        {"cam/GX01_0010.jpg": ("", 10), "cam/GX01_0009.jpg": ("", 9)},
        {f"cam{camera}_{frame:04d}.png": (f"cam{camera}", frame) for camera in (1, 2) for frame in range(3)},
        {f"frame_{frame}_cam{camera}.png": (f"frame_cam{camera}", frame) for camera in (1, 2) for frame in range(3)},
        {f"data/cam{camera}/{frame:05d}.jpg": (f"cam{camera}", frame) for camera in (1, 2) for frame in (3, 4)},
        {f"{day}/{take}_{at}.jpg": (f"{day}/{take}", at) for day in ("mon", "tue") for take in "ab" for at in range(3)},
        {f"{shot}-{frame:04d}.jpg": (str(shot), frame) for shot in (1, 2) for frame in range(2)},
        {f"frame_{frame}_{40 * frame}ms.jpg": ("", frame) for frame in range(9)},
        {f"cam{camera}_000{frame}.json": (f"cam{camera}", frame) for camera, frame in ((1, 1), (1, 2), (1, 3), (2, 2))},
        {"cam10_12_jpg.rf.a1b2c3d4e5f6a7b8.jpg": ("", 12)},
        {"frame12@2x.png": ("", 12)},
        {},
    ],
)
def test_names_tell_cameras_and_frames(places: dict[str, tuple[str, int]]) -> None:
    assert list(places_of_names(places).items()) == list(places.items())


@pytest.mark.parametrize(
    "names",
    [
        ["beach7.jpg", "garden.jpg", "hall3.jpg"],
        ["000000000139.jpg", "000000000285.jpg", "000000000632.jpg"],
        ["IMG_2034.JPG", "IMG_2051.JPG", "IMG_2107.JPG", "IMG_2161.JPG"],
        ["IMG_20240101_120000.jpg", "IMG_20240102_093000.jpg"],
        ["wedding-1.jpg", "party_2.jpg", "dance 12.jpg"],
    ],
)
def test_single_photographs_are_numbered_far_apart(names: list[str]) -> None:
    assert sorted(frame for _, frame in places_of_names(names).values()) == [
        STILLS_STEP * at for at in range(len(names))
    ]
    assert {video for video, _ in places_of_names(names).values()} == {""}


@pytest.mark.parametrize("template", ["dance_{}.jpg", "frame_{}.jpg", "{:04d}.json", "w_{:012d}_keypoints.json"])
@pytest.mark.parametrize("frames", [range(0, 300, 30), (3, 70, 155, 290)])
def test_key_frames_far_apart_are_those_of_a_video(template: str, frames: list[int]) -> None:
    names = {template.format(at): ("", at) for at in frames}
    assert places_of_names(names) == names


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["01_15.jpg", "1_10.jpg"], "'01_15.jpg' and '1_10.jpg' have several numbers"),
        (["1_10.jpg", "2_15.jpg", "3_12.jpg"], "several numbers that may be the frame's"),
        ([f"{a}_{b}.jpg" for a in range(3) for b in range(4)], "several numbers that may be the frame's"),
        ([f"t_{at / 30:.3f}.jpg" for at in range(60)], "have times in their names"),
        ([f"cam7_t{at / 30:.3f}s.jpg" for at in range(90)], "have times in their names"),
        ([f"dance at{at / 25:.2f}.png" for at in range(60)], "have times in their names"),
        (["a_1.jpg", "a_01.jpg", "a_2.jpg"], "'a_1.jpg' and 'a_01.jpg' are both frame 1"),
        (["cover.jpg", *(f"frame_{at}.jpg" for at in range(9))], "'cover.jpg' has no number"),
    ],
)
def test_what_is_ambiguous_is_refused(names: list[str], says: str) -> None:
    with pytest.raises(FormatError, match=says):
        places_of_names(names)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("walk_000000000012_keypoints.json", 12),
        ("7.json", 7),
        ("blaze_walk.00012.json", 12),
        ("frame_12_cam3.json", 12),
        ("notes.json", None),
    ],
)
def test_the_number_of_a_file_alone(name: str, number: int | None) -> None:
    assert openpose_frame_number(name) == number_in_name(name)[1] == number
