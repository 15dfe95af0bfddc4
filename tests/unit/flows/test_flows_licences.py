"""Licences and credits are those that the sources have today; a version and its export keep those it was made with."""

from __future__ import annotations

import re
import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from flows.dataset_folder.describing import _licences
from flows.planning import StageSelection
from storage_schema import SourceCredit, Store, list_datasets
from tests.builders.command_line import CommandLine
from tests.builders.own_sources import write_walk
from tests.builders.real_study import graph
from tests.builders.toy_runs import STUDY, computed, run_toys, write_study

pytestmark = pytest.mark.usefixtures("in_this_process")

OPEN, STRICT = "CC0-1.0", "CC-BY-NC-ND-4.0"
STRICTER = ("--set", f"grow.licence={STRICT}")


@pytest.fixture
def study(tmp_path: Path) -> Path:
    return write_study(tmp_path, f'{STUDY}[bend]\nstep = 1\n[publish]\nname = "released"\n')


@pytest.fixture
def toys(store: Store, invoke_toys: CommandLine) -> CommandLine:
    """Return the commands on the store."""
    return invoke_toys.at(store)


def exported(toys: CommandLine, reference: str, folder: Path) -> set[str]:
    """Return the licences in the credits of an export."""
    out = tempfile.mkdtemp(dir=folder)
    toys("export", reference, "--format", "csv", "--out", out)
    return set(re.findall(r"licence: (\S+)", (Path(out) / "CREDITS.txt").read_text()))


def test_another_licence_is_a_new_version_and_reaches_exports(study: Path, toys: CommandLine, tmp_path: Path) -> None:
    toys("run", study)
    assert exported(toys, "models:toy", tmp_path) == {OPEN}
    out = toys("run", study, *STRICTER).out
    assert "released@2 is published" in out
    assert f"from: t0 (licence: {STRICT}); t1 (licence: {STRICT})" in out
    computed = [line.split()[0] for line in out.splitlines() if line.startswith(("bend", "judge")) and " 0  " in line]
    assert computed == ["bend", "judge"], "what was made of the takes is not made again"
    for reference, licence in (("models:toy", STRICT), ("models:released@2", STRICT), ("models:released@1", OPEN)):
        assert exported(toys, reference, tmp_path) == {licence}
    licences = toys("diff", "released@1", "released@2", "--json").json["licences"]
    assert licences["t0"] == {"a": f'"{OPEN}; made for a test"', "b": f'"{STRICT}; made for a test"'}
    assert "released@3 is published" in toys("run", study).out
    assert exported(toys, "models:toy", tmp_path) == {OPEN}, "a licence that is taken back is taken back"


def test_a_part_of_a_run_with_the_same_content_leaves_no_mixture(study: Path, store: Store, toys: CommandLine) -> None:
    toys("run", study)
    toys("run", study, *STRICTER, "--until", "grow")
    toys("dataset", "create", "mine", "--study", "toy", "--stage", "bend")
    (mine,) = (dataset for dataset in list_datasets(store) if dataset.name == "mine")
    assert {source.licence for source in mine.sources} == {STRICT}


def test_a_licence_reaches_results_of_an_equal_older_source(study: Path, toys: CommandLine, tmp_path: Path) -> None:
    """Values are rounded away: takes at another scale give the same models, and no score is computed again."""
    study.write_text(STUDY)
    toys("run", study)
    toys("run", study, "--set", "grow.scale=1.1", *STRICTER)
    assert exported(toys, "scores:toy", tmp_path) == {STRICT}


def test_licences_differ_by_study(study: Path, store: Store, toys: CommandLine, tmp_path: Path) -> None:
    second = study.with_name("other.toml")
    second.write_text(study.read_text().replace('"toy"', '"other"').replace('"released"', '"others"'))
    toys("run", study)
    toys("run", second, *STRICTER)
    for name, licence in (("toy", OPEN), ("other", STRICT)):
        assert exported(toys, f"training_log:{name}", tmp_path) == {licence}
    toys("run", study)
    assert len(list_datasets(store)) == 2, "no version is new for what another study says"
    assert exported(toys, "models:toy", tmp_path) == {OPEN, STRICT}, "what both have is under both licences"


def test_the_newest_dataset_says_the_licence(study: Path, store: Store, toys: CommandLine, tmp_path: Path) -> None:
    """A store into which datasets were pulled has no runs: they alone know of a licence that was said anew."""
    for settings in ((), STRICTER):
        toys("run", study, *settings)
    key = list_datasets(store)[0].refs[-1].key
    shutil.rmtree(store.root / "runs")
    assert exported(toys, f"scores@{key}", tmp_path) == {STRICT}
    assert exported(toys, "scores:released@1", tmp_path) == {OPEN}


def test_a_report_with_an_old_licence_makes_no_dataset(store: Store, tmp_path: Path, invoke: CommandLine) -> None:
    study, create = tmp_path / "own.toml", invoke.of("dataset", "create", "all", "--study", "own").at(store)
    take = f'[[ingest.takes]]\nid = "walk"\nfiles = ["{write_walk(tmp_path)}"]\nrate_hz = 120\nlicence = '
    text = f'[study]\nname = "own"\nstages = ["ingest", "priors", "evaluation"]\n[ingest]\nrate_hz = 12.0\n{take}'
    study.write_text(f'{text}"CC-BY-4.0"')
    run_toys(study, store.root, graph=graph())
    study.write_text(f'{text}"{STRICT}"')
    run_toys(study, store.root, selection=StageSelection(until="ingest"), graph=graph())
    said = create.refusal()
    assert "the report of study 'own' says files given in the study: CC-BY-4.0, which is no" in said
    outcome = run_toys(study, store.root, graph=graph())
    assert computed(outcome) == {"evaluation": 1}
    create()


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
