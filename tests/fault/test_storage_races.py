"""Many processes that write to one store at the same time leave the store that one process leaves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from storage_schema import Store, list_datasets, verify
from tests.builders.storage_rows import commit_rows

ROOT = Path(__file__).resolve().parents[2]
NUM_PROCESSES = 4


def run_together(script: str, folder: Path) -> list[str]:
    """Run the script in several processes that start when all are ready; gives what each printed."""
    read_end, write_end = os.pipe()
    header = "import os, sys\nfrom pathlib import Path\nfrom storage_schema import *\n"
    header += "from tests.builders.storage_rows import *\n"
    header += f"store, number = Store(sys.argv[1]), int(sys.argv[2])\nos.read({read_end}, 1)\n"
    children = [
        subprocess.Popen(
            [sys.executable, "-c", header + script, str(folder), str(number)],
            cwd=ROOT,
            pass_fds=[read_end],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(NUM_PROCESSES)
    ]
    os.write(write_end, b"g" * NUM_PROCESSES)
    outputs = [child.communicate(timeout=120) for child in children]
    os.close(read_end)
    os.close(write_end)
    assert [child.returncode for child in children] == [0] * NUM_PROCESSES, [error for _, error in outputs]
    return [output for output, _ in outputs]


def test_processes_that_commit_the_same_keys_agree(tmp_path: Path) -> None:
    script = "for i in range(15): print(commit_rows(store, 'poses', 40, stage='ingest', name=str(i)))\n"
    outputs = run_together(script, tmp_path / "store")
    undisturbed = Store(tmp_path / "undisturbed")
    expected = [commit_rows(undisturbed, "poses", 40, stage="ingest", name=str(number)) for number in range(15)]
    assert set(outputs) == {"".join(f"{ref}\n" for ref in expected)}
    store = Store(tmp_path / "store")
    assert sorted(manifest.ref for manifest in store.artifacts()) == sorted(expected)
    assert verify(store).is_ok
    assert list((store.root / "tmp").iterdir()) == []


def test_processes_that_commit_different_keys_do_not_disturb_each_other(tmp_path: Path) -> None:
    script = "for i in range(15): commit_rows(store, 'scores', 40, name=f'{number}-{i}')\n"
    run_together(script, tmp_path)
    store = Store(tmp_path)
    names = {manifest.name for manifest in store.artifacts()}
    assert names == {f"{number}-{i}" for number in range(NUM_PROCESSES) for i in range(15)}
    assert verify(store).is_ok
    assert list((store.root / "tmp").iterdir()) == []


def test_processes_heal_the_same_damaged_artifact_together(tmp_path: Path) -> None:
    store = Store(tmp_path)
    refs = [commit_rows(store, "poses", 40, stage="ingest", name=str(number)) for number in range(8)]
    for ref in refs:
        (store.folder(ref.stage, ref.key) / "poses.parquet").write_bytes(b"PAR1")
    script = "for i in range(8): print(commit_rows(store, 'poses', 40, stage='ingest', name=str(i)))\n"
    assert set(run_together(script, tmp_path)) == {"".join(f"{ref}\n" for ref in refs)}
    assert verify(store).is_ok
    assert list((store.root / "tmp").iterdir()) == []


def test_a_reader_sees_whole_artifacts_while_others_write(tmp_path: Path) -> None:
    script = (
        "if number:\n"
        "    for i in range(25): commit_rows(store, 'poses', 40, stage='ingest', name=f'{number}-{i}')\n"
        "else:\n"
        "    seen = 0\n"
        "    while seen < 75:\n"
        "        found = list(store.artifacts('ingest'))\n"
        "        assert len(found) >= seen\n"
        "        seen = len(found)\n"
        "        for manifest in found[:5]: assert store.read(manifest.ref, 'poses')['pair17_m'].shape == (40, 17, 3)\n"
        "    assert verify(store).is_ok\n"
    )
    run_together(script, tmp_path)


def test_datasets_made_at_the_same_time_get_versions_of_their_own(tmp_path: Path) -> None:
    commit_rows(Store(tmp_path))
    script = "ref = commit_rows(store)\nfor i in range(5): print(create_dataset(store, 'released', [ref]).version)\n"
    outputs = run_together(script, tmp_path)
    versions = sorted(int(line) for output in outputs for line in output.split())
    assert versions == list(range(1, 5 * NUM_PROCESSES + 1))
    assert len(list_datasets(Store(tmp_path))) == 5 * NUM_PROCESSES
