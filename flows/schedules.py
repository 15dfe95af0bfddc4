"""Scheduled builds: deploys the dataset flow for a study, to be run by a worker of Prefect.

Importing this module imports Prefect. Before, switch telemetry off and set `PREFECT_API_URL` (or a profile).
"""

from __future__ import annotations

import hashlib
from datetime import timedelta
from typing import Any

from prefect.automations import AutomationCore, EventTrigger, Posture
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.client.schemas.objects import ConcurrencyLimitConfig, ConcurrencyLimitStrategy, StateType
from prefect.deployments.runner import RunnerDeployment
from prefect.events.actions import ChangeFlowRunState
from prefect.events.schemas.events import ResourceSpecification
from prefect.exceptions import ObjectNotFound
from prefect.types.entrypoint import EntrypointType
from prefect.workers.process import ProcessWorker

from flows.dataset import dataset

_HEARTBEAT_S = 30
_ZOMBIE_AFTER = timedelta(seconds=4 * _HEARTBEAT_S)
_ZOMBIES = "pasdedeux: builds whose process is gone"


def put_deployment(
    name: str, parameters: dict[str, Any], *, cron: str | None, every: timedelta | None, pool: str
) -> str:
    """Create or replace a deployment of the dataset flow on Prefect's server, and return its full name.

    Each store has its own work queue, which runs one build at a time; a build is not started while one of the same
    study waits or runs. An automation marks builds whose process has vanished as crashed.

    Args:
        name: Name of the deployment, which is the study's.
        parameters: Arguments of `flows.dataset.dataset`.
        cron: When, in UTC; None for no such schedule.
        every: Time between builds; None for no such schedule.
        pool: The work pool, created if it is missing.
    """
    queue = "store-" + hashlib.sha256(parameters["store"].encode()).hexdigest()[:12]
    with get_client(sync_client=True) as client:
        _ensure_pool(client, pool)
        _ensure_queue(client, pool, queue)
        _ensure_automation(client)
    deployment = RunnerDeployment.from_flow(
        dataset,
        name=name,
        parameters=parameters,
        cron=cron,
        interval=every,
        description=f"Brings {parameters['study']} up to date in {parameters['store']}",
        concurrency_limit=ConcurrencyLimitConfig(limit=1, collision_strategy=ConcurrencyLimitStrategy.CANCEL_NEW),
        work_pool_name=pool,
        work_queue_name=queue,
        # The process that runs it imports Prefect before our code.
        job_variables={"env": {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": str(_HEARTBEAT_S), "DO_NOT_TRACK": "1"}},
        entrypoint_type=EntrypointType.MODULE_PATH,
    )
    deployment.apply()
    return f"{dataset.name}/{name}"


def _ensure_pool(client: SyncPrefectClient, pool: str) -> None:
    try:
        client.read_work_pool(pool)
    except ObjectNotFound:
        template = ProcessWorker.get_default_base_job_template()
        client.create_work_pool(WorkPoolCreate(name=pool, type="process", base_job_template=template))


def _ensure_queue(client: SyncPrefectClient, pool: str, queue: str) -> None:
    try:
        client.read_work_queue_by_name(queue, work_pool_name=pool)
    except ObjectNotFound:
        client.create_work_queue(queue, work_pool_name=pool, concurrency_limit=1)


def _ensure_automation(client: SyncPrefectClient) -> None:
    """Create or update the automation for builds whose heartbeats stopped before they ended."""
    there = client.read_automations_by_name(_ZOMBIES)
    for automation in there:
        client.update_automation(automation.id, zombies())
    if not there:
        client.create_automation(zombies())


def zombies() -> AutomationCore:
    """Return the automation that marks builds as crashed, only those of our deployments."""
    ends = [f"prefect.flow-run.{end}" for end in ("Completed", "Failed", "Cancelled", "Crashed")]
    trigger = EventTrigger(
        match=ResourceSpecification({"prefect.resource.id": "prefect.flow-run.*"}),
        match_related=[
            ResourceSpecification({"prefect.resource.role": "flow", "prefect.resource.name": dataset.name}),
            ResourceSpecification({"prefect.resource.role": "deployment"}),
        ],
        for_each={"prefect.resource.id"},
        after={"prefect.flow-run.heartbeat"},
        expect={"prefect.flow-run.heartbeat", *ends},
        posture=Posture.Proactive,
        threshold=1,
        within=_ZOMBIE_AFTER,
    )
    action = ChangeFlowRunState(state=StateType.CRASHED, message="its process gave no sign of life any more")
    return AutomationCore(name=_ZOMBIES, trigger=trigger, actions=[action])
