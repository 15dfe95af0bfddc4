"""Registration of data streams for torch's `DataLoader`."""

from __future__ import annotations

from torch.utils.data import IterableDataset, get_worker_info


def register_stream(kind: type) -> None:
    """Let `DataLoader` treat objects of a class, which has `__iter__`, as streams."""
    IterableDataset.register(kind)


def this_worker() -> tuple[int, int]:
    """Return the number of this worker of a `DataLoader` and of all of them; (0, 1) outside of one."""
    info = get_worker_info()
    return (0, 1) if info is None else (info.id, info.num_workers)
