"""What a deployment tells Prefect's server, without one: pool, queue of the store, automation, and the build itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from storage_schema import Store
from tests.builders.command_line import CommandLine
from tests.builders.toy_runs import write_study

ZOMBIES = "pasdedeux: builds whose process is gone"


class Server:
    """Stands for the client of a server that has some pools, queues and automations; it notes what is made."""

    def __init__(
        self, pools: tuple[str, ...] = (), queues: tuple[tuple[str, str], ...] = (), automations: Any = ()
    ) -> None:
        self.pools, self.queues, self.automations = pools, queues, automations
        self.made: list[tuple[Any, ...]] = []

    def read_work_pool(self, name: str) -> None:
        self._found(name in self.pools)

    def create_work_pool(self, pool: Any) -> None:
        self.made.append(("pool", pool.name, pool.type))

    def read_work_queue_by_name(self, name: str, work_pool_name: str) -> None:
        self._found((work_pool_name, name) in self.queues)

    def create_work_queue(self, name: str, work_pool_name: str, concurrency_limit: int) -> None:
        self.made.append(("queue", work_pool_name, name, concurrency_limit))

    def read_automations_by_name(self, name: str) -> list[Any]:
        return [automation for automation in self.automations if automation.name == name]

    def update_automation(self, number: int, automation: Any) -> None:
        self.made.append(("updated", number, automation.name))

    def create_automation(self, automation: Any) -> None:
        self.made.append(("automation", automation.name))

    @staticmethod
    def _found(is_there: bool) -> None:
        from prefect.exceptions import ObjectNotFound

        if not is_there:
            raise ObjectNotFound(Exception("it is not there"))


def test_a_store_has_one_queue_that_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    from flows import schedules

    applied: list[Any] = []
    monkeypatch.setattr(schedules.RunnerDeployment, "apply", lambda self: applied.append(self))

    def deploy(server: Server, store: str, **when: Any) -> Any:
        @contextmanager
        def client(*, sync_client: bool) -> Iterator[Server]:
            assert sync_client
            yield server

        monkeypatch.setattr(schedules, "get_client", client)
        told = {"study": "duets.toml", "store": store}
        name = schedules.put_deployment("duets", told, **{"cron": None, "every": None, **when}, pool="own")
        assert name == f"{schedules.dataset.name}/duets"
        return applied.pop()

    first = Server()
    made = deploy(first, "/data/one", every=timedelta(hours=1))
    queue = made.work_queue_name
    assert first.made == [("pool", "own", "process"), ("queue", "own", queue, 1), ("automation", ZOMBIES)]
    assert (made.name, made.work_pool_name) == ("duets", "own")
    assert made.parameters == {"study": "duets.toml", "store": "/data/one"}
    assert made.description == "Brings duets.toml up to date in /data/one"
    assert [timed.schedule.interval for timed in made.schedules] == [timedelta(hours=1)]
    assert made.concurrency_limit == 1
    assert made.concurrency_options.collision_strategy.value == "CANCEL_NEW"
    assert made.job_variables["env"] == {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30", "DO_NOT_TRACK": "1"}
    there = SimpleNamespace(id=7, name=ZOMBIES), SimpleNamespace(id=8, name="of somebody else")
    known = Server(("own",), (("own", queue),), there)
    again = deploy(known, "/data/one", cron="0 2 * * *")
    assert known.made == [("updated", 7, ZOMBIES)]
    assert [timed.schedule.cron for timed in again.schedules] == ["0 2 * * *"]
    other = Server(("own",), (("own", queue),))
    assert deploy(other, "/data/two").work_queue_name != queue
    assert [call[0] for call in other.made] == ["queue", "automation"]


def test_builds_are_gone_that_gave_no_sign_of_life_for_two_minutes() -> None:
    from flows.schedules import dataset, zombies

    trigger = zombies().trigger
    assert (trigger.within, trigger.threshold) == (timedelta(seconds=120), 1)
    assert trigger.after == {"prefect.flow-run.heartbeat"}
    ends = {f"prefect.flow-run.{end}" for end in ("Completed", "Failed", "Cancelled", "Crashed")}
    assert trigger.expect == {"prefect.flow-run.heartbeat"} | ends
    names = [resource.root.get("prefect.resource.name") for resource in trigger.match_related]
    assert names == [dataset.name, None], "runs of other flows are not ours"
    (action,) = zombies().actions
    assert action.state.value == "CRASHED"


@pytest.mark.parametrize(
    ("words", "when", "cron", "every"),
    [
        ((), "when it is asked for", None, None),
        (("--every", "90.5"), "every 90.5 s", None, timedelta(seconds=90.5)),
        (("--cron", "0 2 * * *"), "at '0 2 * * *' UTC", "0 2 * * *", None),
    ],
)
def test_a_deployment_has_what_the_command_was_given_with_paths_that_hold_elsewhere(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    invoke_toys: CommandLine,
    words: tuple[str, ...],
    when: str,
    cron: str | None,
    every: timedelta | None,
) -> None:
    checked: list[str] = []
    made: list[tuple[Any, ...]] = []

    def put(name: str, parameters: dict[str, Any], **more: Any) -> str:
        made.append((name, parameters, more))
        return "pasdedeux-dataset/toy"

    address = "http://prefect.example/api"
    found = SimpleNamespace(api=SimpleNamespace(url=address))
    monkeypatch.setattr("prefect.settings.get_current_settings", lambda: found)
    monkeypatch.setattr("flows.console.deploy.check_server", lambda asked, note: checked.append(asked))
    monkeypatch.setattr("flows.schedules.put_deployment", put)
    monkeypatch.chdir(tmp_path)
    study = write_study(tmp_path)
    options = ("--workers", "2", "--set", "grow.num_takes=1", "--pool", "mine")
    deploy = invoke_toys.of("deploy", study.name, *options).at("built")
    said = deploy(*words).out.splitlines()
    ((name, parameters, more),) = made
    assert (name, checked) == ("toy", [address])
    assert parameters == {
        "study": str(study),
        "store": str(Store(tmp_path / "built")),
        "settings": ["grow.num_takes=1"],
        "workers": 2,
        "oversubscribe": False,
        "scheduler": None,
        "cluster": None,
        "folder": str(tmp_path),
    }
    assert more == {"cron": cron, "every": every, "pool": "mine"}
    assert said == [
        f"pasdedeux-dataset/toy: {when}, study {study}, store {parameters['store']}",
        "now, if it is not running yet: prefect worker start --pool mine",
        "at once: prefect deployment run pasdedeux-dataset/toy; to remove it: prefect deployment delete "
        "pasdedeux-dataset/toy",
    ]
    assert "are both schedules; give only one" in deploy.refusal("--every", "5", "--cron", "0 2 * * *")
    assert "--cron 'often' is no schedule" in deploy.refusal("--cron", "often")
    found.api.url = None
    assert "no Prefect server is set" in deploy.refusal()
    assert len(made) == 1
