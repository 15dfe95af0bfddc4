"""Prints every package that this machine installs, with its version and sha256, for `pip install --require-hashes`.

Wheels differ by platform and index - torch is another file for each - so a list of hashes holds where it was made, and
none comes with the program.  Run it once on the kind of machine that the list is for, in the repository's root::

    python deploy/lock.py > locked.txt
    pip install --require-hashes --no-deps --requirement locked.txt
    pip install --no-deps .

Further arguments go to pip, such as `dask-jobqueue`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any


def locked(report: dict[str, Any]) -> list[str]:
    """Return the lines of a list of hashes, by pip's report of the packages to install; the program itself has none."""
    lines = []
    for item in report["install"]:
        archive = item["download_info"].get("archive_info")
        if archive is not None:
            name, version = item["metadata"]["name"].lower(), item["metadata"]["version"]
            lines.append(f"{name}=={version} --hash=sha256:{archive['hashes']['sha256']}")
    return sorted(lines)


if __name__ == "__main__":
    root = Path(__file__).parents[1]
    made = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--report", "-"),
            *("--constraint", str(root / "deploy" / "constraints.txt"), str(root), *sys.argv[1:]),
        ],
        stdout=subprocess.PIPE,
        check=False,
    )
    if made.returncode:
        sys.exit(made.returncode)
    sys.stdout.write("\n".join(locked(json.loads(made.stdout))) + "\n")
