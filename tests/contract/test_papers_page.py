"""The page on the papers names code and studies that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAPERS = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
STUDY_COLUMN = [
    [cell.strip() for cell in line.strip("|").split("|")][2]
    for line in PAPERS.splitlines()
    if line.startswith("| ") and line.count(" | ") == 3
]


def test_every_module_of_the_page_exists() -> None:
    modules = set(re.findall(r"`((?:pasdedeux|flows|tasks)/[\w/]+\.py)`", PAPERS))
    assert len(modules) > 20
    assert [module for module in sorted(modules) if not (ROOT / module).is_file()] == []


def test_every_study_of_the_page_ships() -> None:
    studies = {name for cell in STUDY_COLUMN for name in re.findall(r"`(\w+)`", cell)}
    assert {"sampling_paper", "projection_paper", "augmentation_paper"} <= studies
    shipped = {path.stem for path in (ROOT / "flows" / "studies").glob("*.toml")}
    assert studies - shipped == set()


@pytest.mark.parametrize(
    ("paper", "count"), [("Yin et al. 2018", 13), ("Yiannakides et al. 2019", 2), ("Li et al. 2024", 8)]
)
def test_every_equation_of_a_paper_has_a_row(paper: str, count: int) -> None:
    section = PAPERS.split("\n## ")[{"Yin et al. 2018": 1, "Yiannakides et al. 2019": 2, "Li et al. 2024": 3}[paper]]
    rows = [line for line in section.splitlines() if line.startswith("| ")]
    named: set[int] = set()
    for row in rows:
        for first, _, second in re.findall(r"\beqs?\. (\d+)( and | to )?(\d+)?", row.split("|")[1]):
            named |= set(range(int(first), int(second or first) + 1))
    assert named == set(range(1, count + 1))
