"""What is known of CMU's files better than they say themselves."""

from __future__ import annotations

import pytest

from tasks.ingest.known_sources import KnownSource, known_source


@pytest.mark.parametrize(
    ("name", "layout", "expected"),
    [
        ("60_01.bvh", "cmu_daz", KnownSource(60.0, 1.263)),
        ("61_12.BVH", "cmu_daz", KnownSource(60.0, 1.191)),
        ("60_01.amc", "cmu_asf", KnownSource(60.0, None)),
        ("01_13.amc", "cmu_asf", KnownSource(120.0, None)),
        ("60_01.bvh", "cmu_cgspeed", KnownSource()),
        ("02_01.bvh", "cmu_daz", KnownSource()),
        ("dance.amc", "cmu_asf", KnownSource()),
    ],
)
def test_only_files_that_are_known_to_lie_are_put_right(name: str, layout: str, expected: KnownSource) -> None:
    assert known_source(name, layout) == expected
