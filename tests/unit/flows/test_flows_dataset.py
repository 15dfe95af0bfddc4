"""The Prefect flow without Prefect: what it builds, shows and returns, and what becomes of its server's errors."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from httpx import ConnectError
from prefect.events.clients import PrefectEventsClient
from prefect.events.worker import EventsWorker
from prefect.settings import PREFECT_API_URL, PREFECT_CLIENT_MAX_RETRIES, PREFECT_FLOWS_HEARTBEAT_FREQUENCY

from flows import dataset as flow_module
from flows.dataset import build_in_flow, dataset
from flows.execution import execute
from flows.outcomes import Outcome, Run
from flows.planning import NothingMadeError, Plan, make_plan
from flows.progress import Listener
from flows.publishing import VerdictError
from flows.study import load_study
from storage_schema import Store
from tasks.shards import HerePool
from tests.builders.toy_runs import STUDY, write_study
from tests.builders.toys import TOYS

NUM_SHARDS = {"aside": 1, "grow": 6, "bend": 6, "judge": 1}


@dataclass
class Page:
    """What the page of a flow run shows."""

    tables: dict[str, list[tuple[str, list[dict[str, Any]]]]] = field(default_factory=dict)
    texts: dict[str, tuple[str, str]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Iterator[Page]:
    """Let the flow build the toys in this process, its tasks in threads, and keep what it shows."""
    shown, threads = Page(), list[threading.Thread]()

    def show_table(rows: list[dict[str, Any]], key: str, description: str) -> None:
        shown.tables.setdefault(key, []).append((description, rows))

    def show_text(words: str, key: str, description: str) -> None:
        shown.texts[key] = words, description

    def start(stage: str, follow: Callable[..., None]) -> None:
        threads.append(threading.Thread(target=flow_module._stage.fn, args=(stage, follow)))
        threads[-1].start()

    monkeypatch.setattr("flows.execution.worker_environment", dict)  # of this process the environment stays
    monkeypatch.setattr(flow_module, "load_graph", lambda: TOYS)
    monkeypatch.setattr(flow_module, "create_table_artifact", show_table)
    monkeypatch.setattr(flow_module, "create_markdown_artifact", show_text)
    monkeypatch.setattr(flow_module, "_name_flow_run", shown.names.append)
    monkeypatch.setattr(flow_module, "_start_task", start)
    yield shown
    for thread in threads:
        thread.join(timeout=20.0)
        assert not thread.is_alive()


def test_the_flow_builds_what_is_missing_and_shows_each_stage_and_partition(tmp_path: Path, page: Page) -> None:
    words = {"study": write_study(tmp_path).name, "store": str(tmp_path / "store"), "workers": 0}
    assert dataset.fn(**words, folder=str(tmp_path), settings=["judge.level=warn"]) == NUM_SHARDS
    ((description, rows),) = page.tables["pasdedeux-toy"]
    assert [row["stage"] for row in rows] == list(NUM_SHARDS)
    assert {row["stage"]: (row["shards"], row["computed"]) for row in rows} == {
        name: (count, count) for name, count in NUM_SHARDS.items()
    }
    assert [(row["verdict"], "made for a test" in row["reason"]) for row in rows if row["stage"] == "judge"] == [
        ("warn", True)
    ]
    assert [(row["verdict"], row["reason"]) for row in rows if row["stage"] == "aside"] == [("", "")]
    (run_id,) = page.names
    assert description.startswith(f"run {run_id}")
    for stage, count in NUM_SHARDS.items():
        description, rows = page.tables[f"pasdedeux-stage-{stage}"][-1]
        assert description == f"partitions of stage {stage}"
        assert sum(row["num_shards"] for row in rows) == sum(row["num_computed"] for row in rows) == count
        assert all(row["seconds"] == round(row["seconds"], 1) for row in rows)
    page.tables.clear()
    again = dataset.fn(**words, folder=str(tmp_path), settings=["judge.level=warn"])
    assert again == dict.fromkeys(NUM_SHARDS, 0)
    assert (list(page.tables), page.names, page.texts) == (["pasdedeux-toy"], [run_id], {})


def test_the_flow_shows_the_published_version_or_fails_on_a_verdict(tmp_path: Path, page: Page) -> None:
    text = f'{STUDY}[publish]\nname = "released"\nrequired = ["judge"]\n'
    words = {"study": str(write_study(tmp_path, text)), "store": str(tmp_path / "store"), "workers": 0}
    dataset.fn(**words)
    shown, description = page.texts["pasdedeux-toy-dataset"]
    assert description.startswith("released@1 is published")
    assert shown.replace("\\", "").startswith("released@1 is published")
    with pytest.raises(VerdictError, match="judge: fail"):
        dataset.fn(**words, settings=["judge.level=fail"])
    shown, description = page.texts["pasdedeux-toy-dataset"]
    assert "\n- " in shown
    assert "judge: fail" in shown.replace("\\", "")
    assert "\n" not in description
    assert len(page.tables["pasdedeux-toy"]) == 2, "what was built is shown all the same"


def test_the_flow_fails_if_a_stage_made_nothing(tmp_path: Path, page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Outcome, "missing", property(lambda _: ("grow made nothing",)))
    with pytest.raises(NothingMadeError, match="grow made nothing"):
        dataset.fn(study=str(write_study(tmp_path)), store=str(tmp_path / "store"), workers=0)
    assert page.tables["pasdedeux-toy"]


class Server:
    """A server of this run that may be asked for its address, and ended."""

    def __init__(self) -> None:
        self.has_ended = False

    def wait(self) -> str:
        """Return its address."""
        return "http://127.0.0.1:1/api"

    def end(self) -> None:
        """End it."""
        self.has_ended = True


@dataclass
class Prefect:
    """Prefect as far as a build in a flow uses it; `error` is raised when the flow has ended."""

    url: str | None = None
    error: Exception | None = None
    is_early: bool = False
    settings: dict[Any, Any] = field(default_factory=dict)
    events_client: object = None
    told: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    checked: list[str] = field(default_factory=list)
    signed_in: list[str] = field(default_factory=list)

    def flow(self, **told: Any) -> Callable[[Callable[..., None]], Callable[..., None]]:
        """Return a decorator that calls the body as it is."""
        self.told = told

        def decorated(body: Callable[..., None]) -> Callable[..., None]:
            def called(**named: str) -> None:
                self.told |= named
                if self.error is not None and self.is_early:
                    raise self.error
                self.events_client = EventsWorker._client_override
                body(**named)
                if self.error is not None:
                    raise self.error

            return called

        return decorated

    def build(self, monkeypatch: pytest.MonkeyPatch, study: Path, server: Server | None, **faults: Any) -> Outcome:
        """Build the toys."""

        @contextmanager
        def temporary_settings(settings: dict[Any, Any]) -> Iterator[None]:
            self.settings = settings
            yield

        @contextmanager
        def signed_in(address: str) -> Iterator[None]:
            self.signed_in.append(address)
            yield

        def run_plan(run: Run, folder: Any, plan: Plan, pool: Any, start: Any) -> Outcome:
            if faults:
                raise faults["error"]
            return execute(run, folder, plan, pool)

        found = SimpleNamespace(api=SimpleNamespace(url=self.url))
        for name, value in {
            "flow": self.flow,
            "get_current_settings": lambda: found,
            "temporary_settings": temporary_settings,
            "check_server": lambda address, note: self.checked.append(address),
            "signed_in": signed_in,
            "execute": run_plan,
        }.items():
            monkeypatch.setattr(flow_module, name, value)
        chosen, stages = load_study(str(study), TOYS, environment={})
        listener = Listener()
        listener.note = self.notes.append  # type: ignore[method-assign]
        run = Run(chosen, stages, Store(study.parent / "store"), listener=listener)
        plan = make_plan(chosen, stages, run.store)
        return build_in_flow(run, plan, HerePool(str(run.store)), server)  # type: ignore[arg-type]


def test_a_run_has_a_server_and_a_flow_without_retries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prefect, server = Prefect(), Server()
    outcome = prefect.build(monkeypatch, write_study(tmp_path), server)
    assert outcome.num_computed == sum(NUM_SHARDS.values())
    assert prefect.settings == {
        PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None,
        PREFECT_CLIENT_MAX_RETRIES: 1,
        PREFECT_API_URL: "http://127.0.0.1:1/api",
    }
    options = {name: prefect.told[name] for name in ("name", "flow_run_name", "retries", "persist_result")}
    assert options == {
        "name": "pasdedeux-dataset",
        "flow_run_name": outcome.run_id,
        "retries": 0,
        "persist_result": False,
    }
    assert (prefect.told["study"], prefect.told["run_id"]) == ("toy", outcome.run_id)
    assert (prefect.signed_in, prefect.checked, server.has_ended) == (["this machine"], [], False)
    assert prefect.events_client == (PrefectEventsClient, (("reconnection_attempts", 1),))
    assert EventsWorker._client_override is None, "another flow of this process has another server"


def test_on_a_users_server_the_one_of_the_run_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    address, server = "http://prefect.example/api", Server()
    prefect = Prefect(address)
    prefect.build(monkeypatch, write_study(tmp_path), server)
    assert (prefect.settings, prefect.signed_in, prefect.checked) == ({}, [address], [address])
    assert prefect.events_client is None
    assert server.has_ended
    assert Prefect(address).build(monkeypatch, tmp_path / "toy.toml", None).num_computed == 0


def test_only_errors_of_the_build_fail_the_flow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study, gone = write_study(tmp_path), ConnectError("gone\nfor good")
    prefect = Prefect(error=gone)
    assert prefect.build(monkeypatch, study, Server()).num_computed > 0
    assert prefect.notes == ["Prefect's server has not recorded the end: gone for good"]
    failed = OSError("the disk is full")
    for prefect in (Prefect(), Prefect(error=gone)):
        with pytest.raises(OSError, match="the disk is full") as caught:
            prefect.build(monkeypatch, study, Server(), error=failed)
        assert caught.value is failed
        assert prefect.notes == []
    with pytest.raises(ConnectError):
        Prefect(error=gone, is_early=True).build(monkeypatch, study, Server())
