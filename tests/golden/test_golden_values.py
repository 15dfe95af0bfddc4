"""Values that must not change unnoticed: built-in duets, artifact keys, versions of stages, keys of a study, options.

When one changes on purpose, `python -m tests.golden.test_golden_values` writes the files anew; commit them with the
change, and say why.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import typer

from flows.console.app import COMMANDS
from flows.console.context import app
from flows.study_keys import study_keys
from pasdedeux.choreography.duets import DUETS, make_duet
from pasdedeux.skeletons import BODY22
from storage_schema import artifact_key
from tasks.graph import load_graph

_FILE = Path(__file__).with_name("golden_values.json")
_KEYS_FILE = Path(__file__).with_name("study_keys.txt")
_OPTIONS_FILE = Path(__file__).with_name("options.txt")
_JOINTS = BODY22.indices(("pelvis", "head", "left_wrist", "right_wrist", "left_toe"))
_FRAMES = (0, 137, 300, 599)
_TOLERANCE_M = 1e-6
"""Far above rounding on any machine, far below anything that shows."""


def _duet_values() -> dict[str, list]:
    values = {}
    for name in sorted(DUETS):
        positions = make_duet(name).positions_m()[list(_FRAMES)][:, :, _JOINTS]
        values[name] = np.round(positions, 9).tolist()
    return values


def _key() -> str:
    return artifact_key(
        stage="chains", version=1, parameters={"b": [1, 2.5, None], "a": {"x": True}}, input_digests=["0" * 64], seed=7
    )


def _study_keys() -> list[str]:
    """Return each key of a study with its range, its unit, and its default as an empty section has it."""
    graph = load_graph()
    made = {stage.name: stage.parameters.model_validate({}).model_dump(mode="json") for stage in graph.stages}
    lines = []
    for key in study_keys(graph):
        section, _, name = key.name.partition(".")
        default = made.get(section, {}).get(name, key.default)
        value = "needed" if key.is_needed else json.dumps(default, sort_keys=True)
        lines.append(f"{key.name}: {' '.join(filter(None, (key.type, key.unit)))} = {value}")
    return lines


def test_the_built_in_duets_move_as_they_always_did() -> None:
    golden = json.loads(_FILE.read_text())["duets"]
    found = _duet_values()
    assert sorted(found) == sorted(golden)
    for name, values in found.items():
        assert np.abs(np.array(values) - np.array(golden[name])).max() < _TOLERANCE_M, name


def test_the_same_work_has_the_key_it_always_had() -> None:
    assert json.loads(_FILE.read_text())["key"] == _key()


def _versions() -> dict[str, int]:
    return {stage.name: stage.version for stage in load_graph().stages}


def test_no_stage_computes_anew_what_it_has_made_unless_its_version_is_raised_on_purpose() -> None:
    assert json.loads(_FILE.read_text())["versions"] == _versions()


def test_the_keys_of_a_study_have_the_ranges_and_the_defaults_they_always_had() -> None:
    assert _study_keys() == _KEYS_FILE.read_text(encoding="utf-8").splitlines()


def _options(command: Any, path: str) -> Iterator[str]:
    """Yield each argument and option of a command and of those below it, with its range and its default."""
    for option in command.params:
        names = "/".join((*option.opts, *option.secondary_opts)) if option.param_type_name == "option" else option.name
        limits = [f"{sign} {limit}" for sign, limit in ((">=", option.min), ("<=", option.max)) if limit is not None]
        said = (
            ("needed", option.required),
            ("many", option.multiple or option.nargs != 1),
            ("hidden", option.hidden),
        )
        words = ", ".join((*limits, *(word for word, is_so in said if is_so)))
        yield f"{path} {names}: {words}{' = ' if words else '= '}{option.default}".rstrip()
    for name, below in sorted(getattr(command, "commands", {}).items()):
        yield from _options(below, f"{path} {name}")


def _command_options() -> list[str]:
    for name in COMMANDS:
        importlib.import_module(f"flows.console.{name}")
    return list(_options(typer.main.get_group(app), "pasdedeux"))


def test_commands_have_the_options_ranges_and_defaults_they_always_had() -> None:
    assert _command_options() == _OPTIONS_FILE.read_text(encoding="utf-8").splitlines()


if __name__ == "__main__":
    _OPTIONS_FILE.write_text("\n".join([*_command_options(), ""]), encoding="utf-8")
    _KEYS_FILE.write_text("\n".join([*_study_keys(), ""]), encoding="utf-8")
    _FILE.write_text(json.dumps({"duets": _duet_values(), "key": _key(), "versions": _versions()}, indent=1) + "\n")
