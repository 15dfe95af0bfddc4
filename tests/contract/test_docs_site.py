"""The site of the documentation builds without a warning, and shows the API as a reader needs it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_every_page_is_on_the_site_and_leads_to_pages_that_are(site: Path) -> None:
    for page in DOCS.rglob("*.md"):
        built = site / page.relative_to(DOCS).with_suffix(".html")
        links = re.findall(r'href="([^"#:]+\.html)', built.read_text(encoding="utf-8"))
        assert [link for link in links if not (built.parent / link).exists()] == [], page.name


def test_signatures_are_short_and_the_same_on_every_machine(site: Path) -> None:
    faces = sorted((site / "api").glob("*.html"))
    assert len(faces) > 8
    for face in faces:
        text = re.sub(r"<[^>]+>", "", face.read_text(encoding="utf-8"))
        assert " at 0x" not in text, face.name
        assert "ForwardRef" not in text, face.name
    augmentation = (site / "api" / "augmentation.html").read_text(encoding="utf-8")
    assert "Height of toe joints that stand" in augmentation, "fields of settings are listed with their meaning"
