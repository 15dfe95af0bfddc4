"""Where shards meet workers: the only part of the tasks that talks to a Dask client."""

from tasks.shards.cluster import ClusterSettings, connect, peak_memory_bytes, worker_environment
from tasks.shards.errors import ClusterError, ShardError, Stopped, joined
from tasks.shards.running import ShardDone, run, run_on_cluster, run_serially

__all__ = [
    "ClusterError",
    "ClusterSettings",
    "ShardDone",
    "ShardError",
    "Stopped",
    "connect",
    "joined",
    "peak_memory_bytes",
    "run",
    "run_on_cluster",
    "run_serially",
    "worker_environment",
]
