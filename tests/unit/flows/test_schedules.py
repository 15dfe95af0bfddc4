"""What a deployment tells Prefect's server, without one: the build, its schedule, and builds that are gone."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from storage_schema import Store
from tests.builders.command_line import CommandLine
from tests.builders.toy_runs import write_study


def test_a_build_gives_signs_of_life_and_sends_no_telemetry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where pool, queue and automation are there already; how they are made is tested on a real server."""
    from flows import schedules

    applied: list[Any] = []
    server = MagicMock()
    client = server.__enter__.return_value
    client.read_automations_by_name.return_value = [SimpleNamespace(id=7)]
    monkeypatch.setattr(schedules, "get_client", lambda **_: server)
    monkeypatch.setattr(schedules.RunnerDeployment, "apply", lambda self: applied.append(self))
    parameters = {"study": "duets.toml", "store": "/data/one"}
    schedules.put_deployment("duets", parameters, cron="0 2 * * *", every=None, pool="own")
    (deployment,) = applied
    assert (deployment.name, deployment.work_pool_name, deployment.parameters) == ("duets", "own", parameters)
    assert deployment.description == "Brings duets.toml up to date in /data/one"
    assert [timed.schedule.cron for timed in deployment.schedules] == ["0 2 * * *"]
    assert deployment.job_variables["env"] == {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": "30", "DO_NOT_TRACK": "1"}
    ((number, automation), _) = client.update_automation.call_args
    assert (number, automation.name) == (7, schedules.zombies().name), "what an earlier release made is renewed"
    client.create_automation.assert_not_called()


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
    calls: list[tuple[Any, ...]] = []

    def put(name: str, parameters: dict[str, Any], **more: Any) -> str:
        calls.append((name, parameters, more))
        return "pasdedeux-dataset/toy"

    address = "http://prefect.example/api"
    settings = SimpleNamespace(api=SimpleNamespace(url=address))
    monkeypatch.setattr("prefect.settings.get_current_settings", lambda: settings)
    monkeypatch.setattr("flows.console.deploy.check_server", lambda asked, note: checked.append(asked))
    monkeypatch.setattr("flows.schedules.put_deployment", put)
    monkeypatch.chdir(tmp_path)
    study = write_study(tmp_path)
    options = ("--workers", "2", "--set", "grow.num_takes=1", "--pool", "mine")
    deploy = invoke_toys.of("deploy", study.name, *options).at("built")
    said = deploy(*words).out.splitlines()
    ((name, parameters, more),) = calls
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
