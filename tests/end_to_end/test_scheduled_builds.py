"""A scheduled build for real: Prefect's server and worker on loopback, a run that fires by itself, and the next one."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from prefect.server.events.schemas.automations import EventTrigger as ServerTrigger
from prefect.server.events.schemas.events import ReceivedEvent
from prefect.settings import Settings

from flows.dataset import dataset
from flows.records import describe_runs
from flows.schedules import zombies
from storage_schema import Store, list_datasets
from tests.builders.real_study import call_in_process
from tests.builders.toy_runs import ROOT, wait_until

pytestmark = pytest.mark.slow

EVERY_S = 10


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Start a server with its services; the environment of everything that talks to it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    home = tmp_path_factory.mktemp("prefect")
    environment = {
        **os.environ,
        "PREFECT_HOME": str(home),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_SERVER_UI_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_SERVER_SERVICES_SCHEDULER_DEPLOYMENT_BATCH_SIZE": "10",
        "PREFECT_WORKER_QUERY_SECONDS": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    server = _start(environment, "server", "start", "--host", "127.0.0.1", "--port", str(port), log=home / "server.log")
    try:
        wait_until(lambda: _get(environment, "/health") is True, "Prefect's server", limit_s=180)
        yield environment
    finally:
        _end(server)


def _start(environment: dict[str, str], *arguments: str, log: Path) -> subprocess.Popen[bytes]:
    with log.open("wb") as out:
        return subprocess.Popen(
            [sys.executable, "-m", "prefect", *arguments], env=environment, stdout=out, stderr=out, cwd=log.parent
        )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(timeout=30)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _get(environment: dict[str, str], path: str, body: dict[str, Any] | None = None) -> Any:
    request = urllib.request.Request(
        environment["PREFECT_API_URL"] + path,
        data=None if body is None else json.dumps(body).encode(),
        headers={"Content-Type": "application/json"},
    )
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return json.loads(answer.read())
    except OSError:
        return None


def test_a_schedule_fires_builds_and_the_next_build_finds_everything_fresh(
    environment: dict[str, str], tmp_path: Path
) -> None:
    store = tmp_path / "store"
    settings = ["--set", 'study.stages=["ingest"]', "--set", 'publish.required=["ingest"]']
    options = [str(store), "--every", str(EVERY_S), "--workers", "0", *settings]
    said = _deploy(environment, options, options)  # the second time changes it in place
    assert said.count("pasdedeux-dataset/duets: every 10 s") == 2
    (deployment,) = _get(environment, "/deployments/filter", {"deployments": {"name": {"any_": ["duets"]}}})
    assert [schedule["schedule"]["interval"] for schedule in deployment["schedules"]] == [EVERY_S]
    assert len(_get(environment, "/automations/filter", {})) == 1

    worker = _start(
        environment, "worker", "start", "--pool", "pasdedeux", "--name", "builder", log=tmp_path / "worker.log"
    )
    ended = {"state": {"type": {"any_": ["COMPLETED", "FAILED", "CRASHED"]}}}

    def flow_runs() -> list[dict[str, Any]]:
        body = {"flow_runs": ended, "sort": "START_TIME_ASC", "deployments": {"name": {"any_": ["duets"]}}}
        return _get(environment, "/flow_runs/filter", body) or []

    try:
        wait_until(lambda: len(flow_runs()) >= 2, "two builds", limit_s=300)
    finally:
        _end(worker)
    said = (tmp_path / "worker.log").read_text()
    assert {run["state_type"] for run in flow_runs()} == {"COMPLETED"}, said
    assert all(run["auto_scheduled"] for run in flow_runs())
    artifacts = _get(environment, "/artifacts/filter", {"sort": "CREATED_DESC"})
    tables = [json.loads(artifact["data"]) for artifact in artifacts if artifact["key"] == "pasdedeux-duets"]
    assert all(row["computed"] == row["shards"] > 0 for row in tables[-1]), "the first builds"
    assert all(row["computed"] == 0 for row in tables[0]), "the next finds it fresh"
    assert all(row["reason"] for table in tables for row in table), "also of what passes"
    (built,) = describe_runs(Store(store))
    assert built["status"] == "finished"
    (first,) = [run for run in flow_runs() if run["name"] == built["run_id"]]
    body = {"flow_runs": {"id": {"any_": [first["id"]]}}}
    names = [task_run["name"] for task_run in _get(environment, "/task_runs/filter", body)]
    assert names == ["ingest"], "a task is a stage"
    (shown,) = [json.loads(artifact["data"]) for artifact in artifacts if artifact["key"] == "pasdedeux-stage-ingest"]
    assert sum(row["num_computed"] for row in shown) == sum(row["num_shards"] for row in shown) > 0
    assert len({row["partition"] for row in shown}) == len(shown), "a row is a partition"
    versions = [artifact["data"] for artifact in artifacts if artifact["key"] == "pasdedeux-duets-dataset"][-2:]
    heartbeats = _get(environment, "/events/filter", {"filter": {"event": {"name": ["prefect.flow-run.heartbeat"]}}})
    flows = {(_flow(event), _is_watched(event)) for event in heartbeats["events"]}
    assert (dataset.name, True) in flows
    assert all(is_watched is (name == dataset.name) for name, is_watched in flows), "stages have no end of their own"
    (version,) = list_datasets(Store(store))
    assert versions == [f"{version.label} stays: nothing has changed since", f"{version.label} is published"]


def test_builds_of_one_store_wait_for_each_other_and_builds_of_two_stores_do_not(
    environment: dict[str, str], tmp_path: Path
) -> None:
    stores = {"waltz": "store", "hug": "store", "elsewhere": "another"}
    yearly = ["--cron", "0 0 1 1 *", "--set"]
    _deploy(environment, *([str(tmp_path / store), *yearly, f"study.name='{name}'"] for name, store in stores.items()))
    by_name = {deployment["name"]: deployment for deployment in _get(environment, "/deployments/filter", {})}
    deployments = [by_name[name] for name in stores]
    limits = {queue["name"]: queue["concurrency_limit"] for queue in _get(environment, "/work_queues/filter", {})}
    queues = [deployment["work_queue_name"] for deployment in deployments]
    assert queues[0] == queues[1] != queues[2]
    assert {limits[queue] for queue in queues} == {1}
    for deployment in deployments:
        assert deployment["global_concurrency_limit"]["limit"] == 1
        assert deployment["concurrency_options"]["collision_strategy"] == "CANCEL_NEW", "where a build still runs"


_DEPLOY = """
import json, sys
from flows.console.app import run_command_line
for words in json.loads(sys.argv[1]):
    assert run_command_line(["deploy", "duets", "--store", *words]) == 0
"""


def _deploy(environment: dict[str, str], *options: list[str]) -> str:
    """Deploy the duets to a store with options, several times in one process; return what is said."""
    command = [sys.executable, "-c", _DEPLOY, json.dumps(options)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _flow(event: dict[str, Any]) -> str:
    (flow,) = [related for related in event["related"] if related["prefect.resource.role"] == "flow"]
    return str(flow["prefect.resource.name"])


def _is_watched(event: dict[str, Any]) -> bool:
    """Tell whether the automation for builds that vanished minds an event, by the rule of Prefect's server."""
    trigger = ServerTrigger.model_validate(zombies().trigger.model_dump(mode="json"))
    return trigger.covers(ReceivedEvent.model_validate(event))


@pytest.mark.parametrize(
    ("flow", "deployment", "is_watched"),
    [(dataset.name, True, True), (dataset.name, False, False), ("payroll", True, False)],
)
def test_only_runs_of_our_deployments_are_marked_as_crashed(flow: str, deployment: bool, is_watched: bool) -> None:
    related = [
        {"prefect.resource.id": "prefect.flow.1", "prefect.resource.role": "flow", "prefect.resource.name": flow}
    ]
    if deployment:
        related.append({"prefect.resource.id": "prefect.deployment.2", "prefect.resource.role": "deployment"})
    for name in ("heartbeat", "Completed"):
        event = {
            "id": str(uuid4()),
            "occurred": "2030-01-01T00:00:00Z",
            "event": f"prefect.flow-run.{name}",
            "resource": {"prefect.resource.id": "prefect.flow-run.3", "prefect.resource.name": "quiet-owl"},
            "related": related,
        }
        assert _is_watched(event) is is_watched


def test_a_schedule_without_a_server_and_one_that_is_none_are_refused_with_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    monkeypatch.setattr("prefect.settings.get_current_settings", Settings)
    for more, words in (
        ([], "no Prefect server is set"),
        (["--cron", "0 2 * * *", "--every", "60"], "both schedules; give only one"),
        (["--cron", "61 * * * *"], "--cron '61 * * * *' is no schedule; allowed are minute,"),
    ):
        answer = call_in_process(capsys, "deploy", "duets", "--store", tmp_path / "store", *more)
        assert answer.code == 2
        assert words in answer.err
