"""Licences and credits are those that the sources have today; a version and its export keep those it was made with."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from flows.console.app import run_command_line
from flows.dataset_folder.describing import _licences
from flows.planning import StageSelection
from storage_schema import SourceCredit, Store, list_datasets
from tests.builders.own_sources import write_walk
from tests.builders.real_study import graph
from tests.builders.toy_runs import STUDY, run_toys, write_study
from tests.builders.toys import TOYS

pytestmark = pytest.mark.usefixtures("in_this_process")

STRICTER = ("--set", "grow.licence=CC-BY-NC-ND-4.0")


@pytest.fixture
def study(tmp_path: Path) -> Path:
    return write_study(tmp_path, f'{STUDY}[bend]\nstep = 1\n[publish]\nname = "released"\n')


def call(study: Path, command: str, *arguments: str) -> int:
    return run_command_line([command, *arguments, "--store", str(study.parent / "store")], graph=TOYS)


def exported(study: Path, reference: str) -> str:
    out = Path(tempfile.mkdtemp(dir=study.parent))
    assert call(study, "export", reference, "--format", "csv", "--out", str(out)) == 0
    return (out / "CREDITS.txt").read_text()


def test_another_licence_is_a_new_version_and_reaches_exports_without_computing_what_is_after(
    study: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(study, "run", str(study)) == 0
    assert "licence: CC0-1.0" in exported(study, "models:toy")
    capsys.readouterr()
    assert call(study, "run", str(study), *STRICTER) == 0
    out = capsys.readouterr().out
    assert "released@2 is published" in out
    assert "from: t0 (licence: CC-BY-NC-ND-4.0); t1 (licence: CC-BY-NC-ND-4.0)" in out
    computed = [line.split()[0] for line in out.splitlines() if line.startswith(("bend", "judge")) and " 0  " in line]
    assert computed == ["bend", "judge"], "what was made of the takes is not made again"
    for reference in ("models:toy", "models:released@2"):
        text = exported(study, reference)
        assert "licence: CC-BY-NC-ND-4.0" in text
        assert "CC0-1.0" not in text
    text = exported(study, "models:released@1")
    assert "licence: CC0-1.0" in text
    assert "CC-BY-NC-ND-4.0" not in text
    capsys.readouterr()
    assert call(study, "diff", "released@1", "released@2", "--json") == 0
    licences = json.loads(capsys.readouterr().out)["licences"]
    assert licences["t0"] == {"a": '"CC0-1.0; made for a test"', "b": '"CC-BY-NC-ND-4.0; made for a test"'}


def test_a_licence_that_is_taken_back_is_taken_back(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for settings in ((), STRICTER, ()):
        assert call(study, "run", str(study), *settings) == 0
    assert "released@3 is published" in capsys.readouterr().out
    assert "CC-BY-NC-ND-4.0" not in exported(study, "models:toy")


def test_a_part_of_a_run_with_the_same_content_leaves_no_mixture(study: Path) -> None:
    assert call(study, "run", str(study)) == 0
    assert call(study, "run", str(study), *STRICTER, "--until", "grow") == 0
    assert call(study, "dataset", "create", "mine", "--study", "toy", "--stage", "bend") == 0
    (made,) = (one for one in list_datasets(Store(study.parent / "store")) if one.name == "mine")
    assert {source.licence for source in made.sources} == {"CC-BY-NC-ND-4.0"}


def test_a_licence_reaches_what_is_still_there_of_an_older_source_as_it_would_be_the_same_of_the_new_one(
    study: Path,
) -> None:
    """Values are rounded away: takes at another scale give the same models, and no score is computed again."""
    study.write_text(STUDY)
    assert call(study, "run", str(study)) == 0
    assert call(study, "run", str(study), "--set", "grow.scale=1.1", *STRICTER) == 0
    text = exported(study, "scores:toy")
    assert "licence: CC-BY-NC-ND-4.0" in text
    assert "CC0-1.0" not in text


def test_studies_that_say_different_licences_of_the_same_files_have_their_own_each(study: Path) -> None:
    other = study.with_name("other.toml")
    other.write_text(study.read_text().replace('"toy"', '"other"').replace('"released"', '"others"'))
    assert call(study, "run", str(study)) == 0
    assert call(study, "run", str(other), *STRICTER) == 0
    for name, licence in (("toy", "CC0-1.0"), ("other", "CC-BY-NC-ND-4.0")):
        said = [line for line in exported(study, f"training_log:{name}").splitlines() if "licence:" in line]
        assert {line.split()[-1] for line in said} == {licence}
    assert call(study, "run", str(study)) == 0
    assert len(list_datasets(Store(study.parent / "store"))) == 2, "no version is new for what another study says"
    assert "CC0-1.0" in exported(study, "models:toy"), "what both have is under the licences that both say"
    assert "CC-BY-NC-ND-4.0" in exported(study, "models:toy")


def test_what_came_with_a_dataset_has_the_licence_that_the_newest_says(study: Path) -> None:
    """A store into which datasets were pulled has no runs: they alone know of a licence that was said anew."""
    for settings in ((), STRICTER):
        assert call(study, "run", str(study), *settings) == 0
    store = Store(study.parent / "store")
    key = list_datasets(store)[0].refs[-1].key
    shutil.rmtree(store.root / "runs")
    text = exported(study, f"scores@{key}")
    assert "licence: CC-BY-NC-ND-4.0" in text
    assert "CC0-1.0" not in text
    assert "licence: CC0-1.0" in exported(study, "scores:released@1")


def test_no_dataset_is_made_of_a_report_that_says_an_old_licence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study, store = tmp_path / "own.toml", tmp_path / "store"
    take = f'[[ingest.takes]]\nid = "walk"\nfiles = ["{write_walk(tmp_path)}"]\nrate_hz = 120\nlicence = '
    text = f'[study]\nname = "own"\nstages = ["ingest", "priors", "evaluation"]\n[ingest]\nrate_hz = 12.0\n{take}'
    create = ("dataset", "create", "all", "--study", "own", "--store", str(store))
    study.write_text(f'{text}"CC-BY-4.0"')
    run_toys(study, store, graph=graph())
    study.write_text(f'{text}"CC-BY-NC-ND-4.0"')
    run_toys(study, store, selection=StageSelection(until="ingest"), graph=graph())
    assert run_command_line(create, graph=graph()) == 2
    assert "the report of study 'own' says files given in the study: CC-BY-4.0, which is no" in capsys.readouterr().err
    outcome = run_toys(study, store, graph=graph())
    assert {one.name: one.num_computed for one in outcome.stages if one.num_computed} == {"evaluation": 1}
    assert run_command_line(create, graph=graph()) == 0


@pytest.mark.parametrize(
    ("licence", "name"),
    [
        ("CC-BY-4.0", "CC-BY-4.0"),
        ("x" * 40, "x" * 40),
        ("x" * 41, f"LicenseRef-{'x' * 41}"),
        ("Free for (all) uses!", "LicenseRef-free-for-all-uses"),
        ("A" * 99, f"LicenseRef-{'a' * 60}"),
        ("\u00a9 \u00a9", "LicenseRef-unnamed"),
    ],
)
def test_the_licence_of_a_source_is_a_file_whose_name_every_system_takes(licence: str, name: str) -> None:
    dataset = SimpleNamespace(sources=[SourceCredit("a", licence, "by A"), SourceCredit("b", "CC0-1.0", "by B")])
    files = _licences(dataset)  # type: ignore[arg-type]
    assert list(files) == [f"LICENSES/{name}.txt", "LICENSES/CC0-1.0.txt"]
    assert files[f"LICENSES/{name}.txt"].decode() == f"{licence}\n\nLicence of:\n\na\n  by A\n"
