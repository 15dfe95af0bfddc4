"""What `deploy/` ships fits together: composed services, pods, jobs, units; closed, limited, and without a secret."""

from __future__ import annotations

import configparser
import re
import runpy
import tomllib
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from flows.console import deploy
from flows.dataset import dataset
from tasks.shards.profiles import ClusterProfile, cluster_class, read_profile
from tests.builders.toy_runs import ROOT

DEPLOY = ROOT / "deploy"
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
KUBERNETES = "1.30"


@pytest.mark.parametrize("name", COMPOSE["services"])
def test_a_composed_service_is_limited_watched_and_open_to_this_machine_at_most(name: str) -> None:
    service = COMPOSE["services"][name]
    limits = service["deploy"]["resources"]["limits"]
    assert set(limits) == {"cpus", "memory"}
    assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ()))
    assert service["restart"] == "unless-stopped"
    needed = service.get("depends_on", {})
    for neighbour, condition in needed.items():
        assert condition == {"condition": "service_healthy"}
        assert "healthcheck" in COMPOSE["services"][neighbour]
        assert set(service["networks"]) & set(COMPOSE["services"][neighbour]["networks"]), (
            f"{name} cannot reach {neighbour}"
        )
    for volume in service.get("volumes", ()):
        source = volume.split(":")[0]
        assert source.startswith("..") or source in COMPOSE["volumes"]
    for key, value in service.get("environment", {}).items():
        if re.search("PASSWORD|AUTH|CONNECTION", key):
            assert re.search(r"\$\{PASDEDEUX_\w+[:}]", value), f"{key} must come from the environment"


def test_the_image_is_locked_and_runs_as_nobody_in_particular() -> None:
    lines = (DEPLOY / "Dockerfile").read_text().splitlines()
    assert any("pip install --constraint deploy/constraints.txt" in line for line in lines)
    assert [line for line in lines if line.startswith("USER ")] == ["USER builder"]
    for line in lines:
        if line.startswith("COPY "):
            assert all((ROOT / source).exists() for source in line.split()[1:-1]), line


def test_images_can_be_given_by_digest() -> None:
    digest = re.compile(r"\$\{PASDEDEUX_\w+_IMAGE:-[\w.:-]+\}")
    images = {service["image"] for service in COMPOSE["services"].values()} - {"pasdedeux"}
    images |= {service["build"]["args"]["BASE"] for service in COMPOSE["services"].values() if "build" in service}
    assert images
    assert all(digest.fullmatch(image) for image in images), images
    assert [line for line in (DEPLOY / "Dockerfile").read_text().splitlines() if line.startswith("FROM")] == [
        "FROM ${BASE}"
    ]


def test_a_list_of_hashes_has_every_package_but_the_program() -> None:
    def item(name: str, version: str, **info: Any) -> dict[str, Any]:
        return {"metadata": {"name": name, "version": version}, "download_info": info}

    files = [item(name, "1.0", archive_info={"hashes": {"sha256": name[0] * 64}}) for name in ("Torch", "attrs")]
    report = {"install": [item("pasdedeux", "0.2.0", dir_info={}), *files]}
    module = runpy.run_path(str(DEPLOY / "lock.py"))
    assert module["locked"](report) == [f"attrs==1.0 --hash=sha256:{'a' * 64}", f"torch==1.0 --hash=sha256:{'T' * 64}"]


def test_the_composed_builder_asks_for_what_a_deployment_knows() -> None:
    command = COMPOSE["services"]["builder"]["command"]
    options = {option.removeprefix("--") for option in re.findall(r"--[a-z]+", command)}
    assert options - {"cron", "pool"} <= set(dataset.fn.__annotations__)


@pytest.mark.parametrize("path", sorted((DEPLOY / "clusters").glob("*.toml")), ids=lambda path: path.stem)
def test_a_profile_is_one(path: Path) -> None:
    profile = read_profile(path)
    assert isinstance(profile, ClusterProfile)
    assert profile.min_workers <= profile.max_workers
    spec = profile.options.get("custom_cluster_spec")
    assert spec is None or (ROOT / Path(spec).relative_to("/opt/pasdedeux")).is_file()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("slurm", ("#SBATCH --cpus-per-task=8", "#SBATCH --mem=16G", "#SBATCH -t 04:00:00")),
        ("pbs", ("#PBS -l select=1:ncpus=8:mem=16GB", "#PBS -l walltime=04:00:00")),
    ],
)
def test_jobs_of_a_profile_have_one_thread_a_worker_and_its_memory(name: str, words: tuple[str, ...]) -> None:
    profile = tomllib.loads((DEPLOY / "clusters" / f"{name}.toml").read_text())
    options = profile["options"]
    for elsewhere in ("interface", "security", "shared_temp_directory"):
        options.pop(elsewhere)  # of the cluster's machines
    assert options["scheduler_options"]["dashboard_address"].startswith("127.0.0.1:")
    options["scheduler_options"]["host"] = "127.0.0.1"
    with cluster_class(profile["cluster"])(**options) as cluster:
        script = cluster.job_script()
    for line in (*words, "--nthreads 1 ", "--nworkers 8 ", "--memory-limit 2.00GiB", "export OMP_NUM_THREADS=1 "):
        assert line in script


def test_manifests_of_kubernetes_follow_its_schemas_and_their_containers_are_limited() -> None:
    claim, build = yaml.safe_load_all((DEPLOY / "kubernetes" / "build.yaml").read_text())
    for manifest in (claim, build):
        kubernetes_validate.validate(manifest, KUBERNETES, strict=True)
    cluster = yaml.safe_load((DEPLOY / "kubernetes" / "cluster.yaml").read_text())
    assert cluster["kind"] == "DaskCluster"
    parts = [cluster["spec"][part]["spec"] for part in ("worker", "scheduler")]
    for spec in parts:  # the operator makes pods of these
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "pod"}, "spec": spec}
        kubernetes_validate.validate(pod, KUBERNETES, strict=True)
    job = build["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    assert job["securityContext"]["runAsNonRoot"] is True
    for spec in (*parts, job):
        for container in spec["containers"]:
            assert set(container["resources"]["limits"]) == {"cpu", "memory"}
            assert container["securityContext"]["allowPrivilegeEscalation"] is False
        for volume in spec.get("volumes", ()):
            assert volume["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]
    command = job["containers"][0]["command"]
    profile = Path(command[command.index("--cluster") + 1]).relative_to("/opt/pasdedeux")
    assert (ROOT / profile).is_file()


@pytest.mark.parametrize("path", sorted((DEPLOY / "systemd").glob("*.service")), ids=lambda path: path.stem)
def test_a_unit_is_closed_and_its_secrets_are_in_a_file_of_its_own(path: Path) -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[method-assign,assignment]
    unit.read_string(path.read_text())
    service = unit["Service"]
    assert service["User"] == "pasdedeux"
    assert service["NoNewPrivileges"] == "true"
    assert service["EnvironmentFile"] == "/etc/pasdedeux.env"
    assert "AUTH" not in service["Environment"]
    assert "--host 127.0.0.1" in service["ExecStart"] or " worker start " in service["ExecStart"]
    for name in unit["Unit"].get("Requires", "").split():
        assert (path.parent / name).is_file()


TELEMETRY_OFF = ("DO_NOT_TRACK=1", "PREFECT_SERVER_ANALYTICS_ENABLED=false")


def test_prefects_telemetry_is_off_wherever_a_server_is_started() -> None:
    image = (DEPLOY / "Dockerfile").read_text().split("\nWORKDIR")[0]
    assert all(word in image for word in TELEMETRY_OFF)
    assert COMPOSE["services"]["prefect"]["build"] == COMPOSE["services"]["builder"]["build"]
    assert all("DO_NOT_TRACK=1" in path.read_text() for path in (DEPLOY / "systemd").glob("*.service"))
    shown = re.findall(r"```sh\n(.*?)```", (DEPLOY / "README.md").read_text(), re.DOTALL)
    files = [(DEPLOY / "systemd" / "prefect-server.service").read_text(), str(deploy.deploy.__doc__), *shown]
    starting = [text for text in files if "server start" in text]
    assert len(starting) == 3
    for text in starting:
        assert all(word in text.split("server start")[0] for word in TELEMETRY_OFF)


SHOWN = [*DEPLOY.rglob("*.*"), ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "flows").rglob("*.py")]
PREFECT_COMMANDS = sorted(
    {words for path in SHOWN for words in re.findall(r"\bprefect ((?!import)[a-z-]+(?: [a-z]+)+)", path.read_text())}
)


@pytest.mark.parametrize("words", ["deployment schedule pause", "server start", *PREFECT_COMMANDS])
def test_a_command_of_prefect_that_is_shown_exists_in_the_pinned_version(words: str) -> None:
    import prefect.cli  # noqa: F401 - it registers the commands
    from prefect.cli._app import _app

    assert words in PREFECT_COMMANDS
    assert _app.parse_commands(words.split())[2] == []
