"""Jobs of dask-jobqueue on this machine, run as on a cluster: by a shell, with their output in a file."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import tempfile
from contextlib import suppress

from dask_jobqueue.local import LocalCluster, LocalJob
from distributed.core import Status

_LOOK_AGAIN_S = 0.1
_QUOTED_BYTES = 2000
"""Length of the end of a job's output that an error quotes."""


class _JobHere(LocalJob):
    """A job.

    Dask-jobqueue's own job runs the words of the script as one command, so a shell prologue fails, and it leaves the
    worker with a pipe that nobody reads.
    """

    async def _submit_job(self, script_filename: str) -> str:
        """Start the script and wait for its worker; RuntimeError with its output where it ends without one."""
        with tempfile.TemporaryFile() as output:
            self._process = subprocess.Popen(
                ["sh", script_filename], stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
            )
            while b"Registered to:" not in _read(output.fileno()):
                code = self._process.poll()
                if code is not None:
                    words = _read(output.fileno())[-_QUOTED_BYTES:].decode(errors="replace")
                    raise RuntimeError(f"a job ended with code {code}; it said: {words}")
                await asyncio.sleep(_LOOK_AGAIN_S)
        return str(self._process.pid)

    async def close(self) -> None:
        """End the job with all its processes."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self.status = Status.closed


class JobsHere(LocalCluster):
    """A Dask cluster whose jobs are processes of this machine."""

    job_cls = _JobHere


def _read(file: int) -> bytes:
    """Return the current content of a file that another process writes."""
    return os.pread(file, os.fstat(file).st_size, 0)
