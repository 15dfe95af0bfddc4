"""Where shards meet workers: the only part of the tasks that talks to a Dask client."""

from tasks.shards.cluster import ClusterSettings, connect, worker_environment
from tasks.shards.errors import ClusterError, ShardError, Stopped, in_one_line, join_failures
from tasks.shards.running import (
    Call,
    ClusterPool,
    HereClient,
    HerePool,
    Pool,
    ShardDone,
    ShardFailed,
    WhereComputed,
    run,
)

__all__ = [
    "Call",
    "ClusterError",
    "ClusterPool",
    "ClusterSettings",
    "HereClient",
    "HerePool",
    "Pool",
    "ShardDone",
    "ShardError",
    "ShardFailed",
    "Stopped",
    "WhereComputed",
    "connect",
    "in_one_line",
    "join_failures",
    "run",
    "worker_environment",
]
