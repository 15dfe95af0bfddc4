"""The whole program on a small study: every stage, once with two workers, once with one, and a second time."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from storage_schema import Store, open_table, read_latest
from tests.toy_runs import ROOT

pytestmark = pytest.mark.slow

STUDY = """
[study]
name = "small"
title = "Two short duets"
seed = 3

[ingest]
rate_hz = 15.0
duets = [{ name = "waltz", duration_s = 2.0 }, { name = "hug", duration_s = 2.0 }]
held_out = ["hug"]
virtual_video = { num_random_views = 20 }

[seeds]
num_seeds = 1

[chains]
densities = ["ic", "prior_only"]
num_chains = 2
num_draws = 40
segment_draws = 20
num_candidates = 20
num_views = 4

[augmentation]
scales = [0.75, 0.95, 1.05, 1.25]

[evaluation]
num_truth_pairs = 20
clip_seconds = 1.0
"""
STAGES = {
    "ingest",
    "priors",
    "views",
    "seeds",
    "chains",
    "projections",
    "reconstruction",
    "augmentation",
    "training",
    "evaluation",
}
MOST_CPU_S = 3.0


def command(*arguments: str, prefect_home: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PREFECT_HOME": str(prefect_home)}
    environment.pop("PREFECT_API_URL", None)
    return subprocess.run(
        [sys.executable, "-m", "flows.console", *arguments],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the study, and in `store` what two workers made of it."""
    folder = tmp_path_factory.mktemp("small")
    (folder / "small.toml").write_text(STUDY)
    found = command(
        "run", str(folder / "small.toml"), "--store", str(folder / "store"), "--workers", "2", prefect_home=folder
    )
    assert found.returncode == 0, found.stderr
    assert "report.html" in found.stdout
    return folder


def digests(store: Path) -> dict[str, list[str]]:
    latest = read_latest(Store(store), "small")
    assert latest is not None
    return {stage: [ref.content_digest for ref in latest.refs(stage)] for stage in latest.stages}


def test_every_stage_leaves_something(folder: Path) -> None:
    made = digests(folder / "store")
    assert set(made) == STAGES
    assert all(made.values()), made


def test_the_report_stands_alone_and_the_card_credits_the_sources(folder: Path) -> None:
    report = next((folder / "store" / "runs").glob("*/report/report.html"))
    page = report.read_text(encoding="utf-8")
    assert 'src="http' not in page
    assert 'href="http' not in page.replace('href="https://', "")
    assert "data:image/png;base64," in page
    assert "Apache-2.0" in (report.parent / "card.md").read_text(encoding="utf-8")


def test_tables_open_by_name(folder: Path) -> None:
    draws = open_table("draws:small", folder / "store")
    assert draws["pair17_m"].shape[1:] == (2, 17, 3)
    assert open_table("scores:small", folder / "store").num_rows > 0


def test_a_second_run_is_quick_and_computes_nothing(folder: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = command(
        "run", str(folder / "small.toml"), "--store", str(folder / "store"), "--json", prefect_home=folder / "unused"
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert found.returncode == 0, found.stderr
    assert json.loads(found.stdout)["num_computed"] == 0
    assert not (folder / "unused").exists(), "Prefect was started"
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert spent < MOST_CPU_S, f"{spent:.1f} s of processor time; wall time is as long as other work allows"


def test_one_worker_gives_the_same_bytes_as_two(folder: Path) -> None:
    store = folder / "one"
    found = command("run", str(folder / "small.toml"), "--store", str(store), "--workers", "1", prefect_home=folder)
    assert found.returncode == 0, found.stderr
    assert digests(store) == digests(folder / "store")


def test_one_changed_parameter_rebuilds_what_depends_on_it(folder: Path) -> None:
    arguments = [str(folder / "small.toml"), "--store", str(folder / "store"), "--set", "training.models=['copy']"]
    planned = json.loads(command("plan", *arguments, "--json", prefect_home=folder).stdout)
    assert {stage["stage"] for stage in planned["stages"] if stage["state"] != "fresh"} == {"training", "evaluation"}


def test_motion_goes_out_as_bvh_with_its_credits(folder: Path) -> None:
    for table in ("poses", "variants", "motions"):
        out = folder / "out" / table
        found = command(
            "export",
            f"{table}:small",
            "--format",
            "bvh",
            "--out",
            str(out),
            "--store",
            str(folder / "store"),
            prefect_home=folder,
        )
        assert found.returncode == 0, found.stderr
        assert list(out.glob("*.bvh"))
        assert "Apache-2.0" in (out / "CREDITS.txt").read_text()


def test_the_store_is_as_its_manifests_say(folder: Path) -> None:
    assert command("verify", "--store", str(folder / "store"), prefect_home=folder).returncode == 0
