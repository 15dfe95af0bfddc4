"""The keys of a study, told from the models of its sections."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.study import load_study
from flows.study_files import StudyError
from flows.study_keys import study_keys
from pasdedeux.sampling.prior import PriorSettings
from tasks.graph import load_graph
from tasks.ingest import IngestParameters

KEYS = {key.name: key for key in study_keys(load_graph())}
ROOT = Path(__file__).resolve().parents[3]


def test_every_key_says_what_it_means() -> None:
    assert [name for name, key in KEYS.items() if not key.meaning] == []


def test_a_study_has_few_keys_and_ingest_at_most_92() -> None:
    leaves = {name for name in KEYS if not any(deeper.startswith(f"{name}.") for deeper in KEYS)}
    assert len(leaves) <= 195
    assert len([name for name in KEYS if name.startswith("ingest.")]) <= 92


def test_keys_that_two_tables_have_from_one_model_are_said_once() -> None:
    assert "yaw_deg" in KEYS["ingest.takes.N.persons.N.*"].meaning
    assert KEYS["ingest.videos.N.*"].type == "as ingest.annotations.N.*"


def test_keys_that_studies_and_documents_set_in_commands_are_keys() -> None:
    pages = [*(ROOT / "flows/studies").glob("*.toml"), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    named = {key for page in pages for key in re.findall(r"--set '?([\w.]+)=", page.read_text(encoding="utf-8"))}
    same = {f"{name[:-1]}{key}" for name in KEYS if name.endswith(".*") for key in KEYS[name].meaning[15:].split(", ")}
    paths = [re.compile(re.escape(key).replace("NAME", r"\w+").replace(r"\.N", r"\.\d+")) for key in {*KEYS, *same}]
    sources = r"ingest\.(annotations|videos)\.N\."  # whose keys `reconstruct` and `annotate` take as they are
    paths += [re.compile(re.sub(sources, "", key)) for key in {*KEYS, *same} if not key.endswith("*")]
    assert len(named) > 10
    assert sorted(key for key in named if not any(path.fullmatch(key) for path in paths)) == []


def test_only_the_keys_of_one_section_are_told_when_it_is_named() -> None:
    assert {key.name.split(".")[0] for key in study_keys(load_graph(), "chains")} == {"chains"}
    assert study_keys(load_graph(), "chain") == []


def test_one_value_of_the_prior_reaches_seeds_and_chains(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text('[study]\nname = "own"\n[physical_prior]\nalpha = 3.0\n')
    study, _ = load_study(str(file), load_graph(), settings=["physical_prior.max_invalid_angles=5"], environment={})
    for stage in ("seeds", "chains"):
        prior = study.parameters[stage].part(PriorSettings)
        assert (prior.alpha, prior.max_invalid_angles) == (3.0, 5)
        assert "alpha" not in study.resolved()[stage]
    assert study.resolved()["physical_prior"]["alpha"] == 3.0
    with pytest.raises(StudyError, match=r"seeds\.alpha: one value serves every stage: say physical_prior\.alpha"):
        load_study(str(file), load_graph(), settings=["seeds.alpha=2"], environment={})
    with pytest.raises(StudyError, match=r"physical_prior\.alpa: .*alpha"):
        load_study(str(file), load_graph(), settings=["physical_prior.alpa=2"], environment={})


def test_every_key_of_ingest_is_in_an_example_of_the_docs_that_a_study_takes() -> None:
    """Keys that tables share count wherever one of them has them."""
    used: set[str] = set()
    for page in sorted((ROOT / "docs").glob("*.md")):
        for block in re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
            section = tomllib.loads(block).get("ingest") if "ingest" in block else None
            if section:
                used |= set(_paths("ingest", section))
            if section and page.name == "studies.md" and "duets" in section:
                IngestParameters.model_validate(section)
    shared = {"takes.N.persons.N.": "takes.N.", "pairs.NAME.": "takes.N.", "videos.N.": "annotations.N."}
    used |= {f"ingest.{key.removeprefix('ingest.').replace(a, b)}" for key in used for a, b in shared.items()}
    leaves = [name for name in KEYS if name.startswith("ingest.") and not name.endswith("*")]
    leaves = [name for name in leaves if not any(deeper.startswith(f"{name}.") for deeper in KEYS)]
    assert [name for name in leaves if not any(key == name or key.startswith(f"{name}.") for key in used)] == []


def _paths(path: str, value: object) -> Iterator[str]:
    """Yield the keys of a table as `study keys` names them."""
    yield path
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _paths(f"{path}.{'NAME' if path == 'ingest.pairs' else name}", inner)
    for inner in value if isinstance(value, list) else ():
        if isinstance(inner, dict):
            yield from _paths(f"{path}.N", inner)
