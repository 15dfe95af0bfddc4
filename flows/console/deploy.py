"""`deploy`: creates a scheduled build of a study on Prefect's server."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from flows.console import options
from flows.console.context import app, echo, graph_of, open_store
from flows.machine import cluster_settings
from flows.planning import PlanError, make_plan
from flows.prefect_server import check_server, signed_in, telemetry_off
from flows.study import load_study


@app.command()
def deploy(
    context: typer.Context,
    study: options.Study = "duets",
    settings: options.Settings = None,
    store: options.Store = Path("store"),
    cron: Annotated[str | None, Option(metavar="EXPRESSION", help="When, in UTC: '0 2 * * *' is at 2:00.")] = None,
    every: Annotated[float | None, Option(min=1, metavar="SECONDS", help="Time between builds.")] = None,
    workers: options.Workers = None,
    oversubscribe: options.Oversubscribe = False,
    scheduler: options.Scheduler = None,
    cluster: options.Cluster = None,
    pool: Annotated[str, Option(help="Work pool; created if missing.")] = "pasdedeux",
) -> None:
    """Deploy a study to a Prefect server, as a build that runs on a schedule or on request.

    \b
      export DO_NOT_TRACK=1 PREFECT_SERVER_ANALYTICS_ENABLED=false
      export PREFECT_API_URL=http://127.0.0.1:4200/api
      prefect server start --background
      pasdedeux deploy duets --store /data/store --cron "0 2 * * *"
      prefect worker start --pool pasdedeux

    A build in which nothing changed ends after seconds and leaves the store as it was.  A store has one build at a
    time.  The same command again changes the deployment in place.
    """
    cluster_settings(workers, scheduler=scheduler, cluster=cluster, oversubscribe=oversubscribe)
    graph = graph_of(context)
    chosen, known = load_study(study, graph, settings=settings or ())
    opened = open_store(store)
    make_plan(chosen, known, opened)
    if cron is not None and every is not None:
        raise PlanError("--cron and --every are both schedules; give only one")
    telemetry_off()
    from prefect.client.schemas.schedules import CronSchedule
    from prefect.settings import get_current_settings

    if cron is not None:
        try:
            CronSchedule(cron=cron)
        except ValueError:
            raise PlanError(
                f"--cron '{cron}' is no schedule; allowed are minute, hour, day, month and weekday: '0 2 * * *'"
            ) from None
    address = get_current_settings().api.url
    if address is None:
        raise PlanError(
            "no Prefect server is set: start one (PREFECT_SERVER_ANALYTICS_ENABLED=false prefect server "
            "start --background) and set PREFECT_API_URL, for example to http://127.0.0.1:4200/api"
        )
    check_server(address, lambda text: echo(text, err=True))
    from flows.schedules import put_deployment

    path = Path(study)
    parameters = {
        "study": str(path.resolve()) if path.is_file() else study,
        "store": str(opened),
        "settings": list(settings or ()),
        "workers": workers,
        "oversubscribe": oversubscribe,
        "scheduler": scheduler,
        "cluster": None if cluster is None else str(cluster.resolve()),
        "folder": str(Path.cwd()),
    }
    interval = None if every is None else timedelta(seconds=every)
    with signed_in(address):
        name = put_deployment(chosen.name, parameters, cron=cron, every=interval, pool=pool)
    when = f"at '{cron}' UTC" if cron else f"every {every:g} s" if every else "when it is asked for"
    echo(f"{name}: {when}, study {parameters['study']}, store {parameters['store']}")
    echo(f"now, if it is not running yet: prefect worker start --pool {pool}")
    echo(f"at once: prefect deployment run {name}; to remove it: prefect deployment delete {name}")
