from __future__ import annotations

import importlib.metadata
from pathlib import Path

import pytest

from storage_schema import provenance


@pytest.fixture(autouse=True)
def _fresh_caches() -> None:
    provenance.source_digest.cache_clear()
    provenance.code_version.cache_clear()


def test_the_source_digest_follows_names_and_bytes_of_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "package_folders", lambda package: [tmp_path / package])

    def digest() -> str:
        provenance.source_digest.cache_clear()
        return provenance.source_digest()

    for package in ("pasdedeux", "storage_schema", "tasks"):
        (tmp_path / package / "inner").mkdir(parents=True)
        (tmp_path / package / "inner" / "a.py").write_text("a = 1\n")
    before = digest()
    (tmp_path / "tasks" / "inner" / "a.pyc").write_text("not a source")
    assert digest() == before
    (tmp_path / "pasdedeux" / "inner" / "a.toml").write_text("a = 1\n")
    assert digest() != before
    before = digest()
    (tmp_path / "tasks" / "inner" / "a.py").write_text("a = 2\n")
    changed = digest()
    assert changed != before
    (tmp_path / "tasks" / "inner" / "a.py").rename(tmp_path / "tasks" / "inner" / "b.py")
    assert digest() not in (before, changed)


def test_the_packages_are_found_without_importing_them() -> None:
    folders = [
        folder for package in ("pasdedeux", "storage_schema", "tasks") for folder in provenance.package_folders(package)
    ]
    assert all((folder / "__init__.py").is_file() for folder in folders)
    assert len(folders) == 3
    assert provenance.package_folders("no_such_package_at_all") == []


def test_a_program_that_is_not_installed_has_an_unknown_version(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", absent)
    assert provenance.code_version() == "unknown"
    provenance.code_version.cache_clear()
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "1.2.3")
    assert provenance.code_version() == "1.2.3"


def test_versions_of_python_and_numpy_are_among_the_packages() -> None:
    versions = provenance.package_versions()
    assert versions["numpy"] == importlib.metadata.version("numpy")
    assert versions["python"].startswith("3.")
