"""`fetch`: downloads free motion capture and networks of detectors, and checks each file."""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from flows.console import options
from flows.console.context import app, echo, graph_of, open_store
from flows.console.run import build_and_report
from flows.exports.credits import CREDITS_NAME, add_notice
from flows.machine import WORKER_MEMORY_GB, cluster_settings
from flows.outcomes import Run
from flows.study import load_study
from flows.study_files import read_study_tree
from pasdedeux.errors import InputError
from pasdedeux.formats.asf_amc import read_amc, read_asf
from pasdedeux.plain_text import counted
from tasks.files.downloads import FetchError, download
from tasks.files.user_files import read_file
from tasks.ingest.film.detector_files import KNOWN_DETECTORS, NetworkAddress, check_network, network_address
from tasks.ingest.takes.known_sources import CMU_CREDIT, has_changed, note_fetched

CMU_BASE_URL = "http://mocap.cs.cmu.edu"
_MAX_FILE_BYTES = 200_000_000
_MAX_NETWORK_BYTES = 2_000_000_000
_MB_PER_TAKE = 1.0
"""Size of an AMC file of CMU: 1.3 in the mean over nine files, less for a few steps of walking."""
_MB_PER_S = 1.0
"""Assumed speed of the network."""
_BUILD_S_PER_MB, _BUILT_MB_PER_MB = 1.0, 0.6
"""Time on one core and size in the store: 0.3 and 0.56 for one person, more for two."""

_group = typer.Typer(help="Download freely available motion capture, and networks of detectors.", no_args_is_help=True)
app.add_typer(_group, name="fetch")


@dataclass(frozen=True)
class Fetched:
    """A file with its size, and whether it was there before the download."""

    path: Path
    num_bytes: int
    was_there: bool


@_group.command("cmu")
def cmu(
    out: Annotated[Path, Option(help="Folder for the files.")],
    study: Annotated[str, Option(help="Study whose takes are downloaded if no subjects are given.")] = "everyday",
    subjects: Annotated[str | None, Option(help="Subjects, such as 60,61.")] = None,
    takes: Annotated[
        str | None, Option(help="Takes of these subjects, such as 01,03; default: all that the site lists.")
    ] = None,
    base_url: Annotated[str, Option(help="Address of the site.")] = CMU_BASE_URL,
) -> None:
    """Download ASF/AMC files of the CMU motion capture database: those of a study, or of some subjects."""
    if subjects is None and takes is not None:
        raise InputError("--takes needs --subjects; leave it out for a study, which names its own takes")
    wanted: Mapping[str, Sequence[str] | None] = (
        takes_of_study(study)
        if subjects is None
        else dict.fromkeys(_numbers(subjects, "subjects"), _numbers(takes, "takes") if takes else None)
    )
    items = list(_told(fetch_cmu(wanted, out, base_url=base_url)))
    echo(f"{counted(len(items), 'file')} in {out}\n{_CREDIT.strip()}")


@_group.command("database")
def database(
    context: typer.Context,
    out: Annotated[Path, Option(help="Folder for the files.")] = Path("cmu"),
    study: Annotated[str, Option(help="Study of CMU takes to build.")] = "everyday",
    store: options.Store = Path("store"),
    workers: options.Workers = None,
    is_agreed: Annotated[
        bool, Option("--yes", help="Start; without it, only size, time and licence are printed.")
    ] = False,
    base_url: Annotated[str, Option(help="Address of the site.")] = CMU_BASE_URL,
) -> None:
    """Download the takes of a study and build its projection database, for `reconstruct`.

    What is there already is neither downloaded nor built again, so the same command goes on after an interruption.
    """
    wanted = takes_of_study(study)
    folders = [f"ingest.pairs.{name}.folder={json.dumps(str(out.resolve()))}" for name in _families(study)]
    chosen, graph = load_study(study, graph_of(context), settings=folders)
    names = [f"{subject}_{take}.amc" for subject, takes in wanted.items() for take in takes]
    to_come_mb, all_mb = (_MB_PER_TAKE * number for number in (sum(not (out / n).exists() for n in names), len(names)))
    echo(
        f"study {chosen.name}: {counted(len(names), 'take')} of CMU; about {to_come_mb:.0f} MB come into {out}, in "
        f"{to_come_mb / _MB_PER_S / 60:.0f} minutes at {_MB_PER_S:g} MB a second; the database is built of them in "
        f"some {all_mb * _BUILD_S_PER_MB / 60:.0f} minutes of one core and has {all_mb * _BUILT_MB_PER_MB:.0f} MB in "
        f"{store}\n{_CREDIT.strip()}"
    )
    if not is_agreed:
        echo("nothing was done yet; add --yes to start")
        return
    items = list(_told(fetch_cmu(wanted, out, base_url=base_url)))
    echo(f"{counted(len(items), 'file')} in {out}")
    where = cluster_settings(workers, WORKER_MEMORY_GB, None)
    build_and_report(Run(chosen, graph, open_store(store)), where, as_json=False)
    echo(f"now: pasdedeux reconstruct DIR --database projections:{chosen.name} --store {store} --out out")


@_group.command("detector")
def detector(
    address: Annotated[
        str, typer.Argument(metavar="NAME_OR_ADDRESS", help="rtmo-m, or https://HOST/FILE.onnx#sha256=DIGEST.")
    ],
    is_agreed: Annotated[bool, Option("--yes", help="Download without asking.")] = False,
) -> None:
    """Download the network of a detector, once, for the studies and commands that state its name or address."""
    known = KNOWN_DETECTORS.get(address)
    network = known.address if known else network_address(address)
    if known and not network.kept.exists():
        echo(f"{address}: {known.meaning}; {known.num_bytes / 1e6:.0f} MB, licence {known.licence}, from {network.url}")
        is_agreed = is_agreed or (sys.stdin.isatty() and typer.confirm("download it?"))
        if not is_agreed:
            echo("nothing was done yet; add --yes to start")
            return
    if not network.kept.exists():
        echo(f"{network.url} is fetched, {_MAX_NETWORK_BYTES / 1e6:.0f} MB at most")
        fetch_network(network)
    check_network(network)
    echo(f"{network.kept}: its digest is as stated")


def fetch_network(network: NetworkAddress) -> None:
    """Download the file of a network to its place in the cache.

    Raises:
        FetchError: The download fails, or is another file.
        InputError: The address is not public, or redirects to one that is not.
    """
    data = download(network.url, max_bytes=_MAX_NETWORK_BYTES, is_public=True)
    if hashlib.sha256(data).hexdigest() != network.sha256:
        raise FetchError(f"{network.url}: the digest of the downloaded file differs from the stated one")
    coming = network.kept.with_suffix(f".{os.getpid()}")
    try:
        coming.parent.mkdir(parents=True, exist_ok=True)
        coming.write_bytes(data)
        coming.replace(network.kept)
    except OSError as error:
        raise FetchError(f"{network.kept} cannot be written: {error.strerror}") from None


def _told(items: Iterable[Fetched]) -> Iterator[Fetched]:
    """Yield files, and print a line for each."""
    for item in items:
        state = "was there" if item.was_there else "fetched"
        echo(f"{state:<10}{item.path.name:<14}{item.num_bytes / 1e6:8.2f} MB")
        yield item


def fetch_cmu(
    wanted: Mapping[str, Sequence[str] | None], out: Path, *, base_url: str = CMU_BASE_URL
) -> Iterator[Fetched]:
    """Download skeleton and takes of each subject into a folder, one file at a time.

    An existing file that is readable and unchanged stays. A new one is written only after it is complete and parsed.

    Args:
        wanted: Numbers of subjects, such as "60", each with the numbers of its takes; None: those listed on the site.
        out: Folder, created if necessary.
        base_url: Address of the site.

    Raises:
        FetchError: The site cannot be reached, lacks a file, or sends no motion file.
    """
    base = base_url.rstrip("/")
    try:
        out.mkdir(parents=True, exist_ok=True)
        add_notice(out / CREDITS_NAME, _CREDIT)
    except OSError as error:
        raise FetchError(f"folder {out} cannot be written: {error.strerror}") from None
    for subject, takes in wanted.items():
        folder = f"{base}/subjects/{subject}"
        skeleton = out / f"{subject}.asf"
        yield _fetch_file(f"{folder}/{subject}.asf", skeleton, None)
        for take in _listed_takes(base, subject) if takes is None else takes:
            name = f"{subject}_{take}.amc"
            yield _fetch_file(f"{folder}/{name}", out / name, skeleton)


def takes_of_study(name_or_path: str) -> dict[str, list[str]]:
    """Return the takes that a study names in `ingest.pairs`, by CMU's numbers of subjects.

    Raises:
        StudyError: There is no such study.
        InputError: It names no takes of numbered subjects.
    """
    wanted: dict[str, list[str]] = {}
    for family in _families(name_or_path).values():
        for subject in family["subjects"]:
            wanted.setdefault(str(subject), []).extend(family["takes"])
    if not wanted:
        raise InputError(f"study {name_or_path} names no takes of CMU's subjects in [ingest.pairs]; name --subjects")
    return wanted


def _families(study: str) -> dict[str, dict[str, Any]]:
    """Return the families of a study's `ingest.pairs` that have takes and numbered subjects."""
    families = read_study_tree(study, Path.cwd()).values.get("ingest", {}).get("pairs", {})
    return {
        name: family
        for name, family in families.items()
        if family.get("takes") and all(str(subject).isdigit() for subject in family.get("subjects", ()))
    }


_CREDIT = f"{CMU_CREDIT.credit}\n{CMU_CREDIT.licence}.\n"


def _numbers(text: str, what: str) -> list[str]:
    """Return the numbers of a list such as 1,60,61 as the site writes them, with at least two digits."""
    numbers = [item.strip() for item in text.split(",") if item.strip()]
    for number in numbers:
        if not re.fullmatch(r"\d{1,3}", number):
            raise InputError(f"{what}: '{number}' is not a number of at most three digits, such as 60")
    if not numbers:
        raise InputError(f"{what}: at least one number is needed")
    return [number.zfill(2) for number in numbers]


def _listed_takes(base: str, subject: str) -> list[str]:
    url = f"{base}/search.php?subjectnumber={int(subject)}"
    page = download(url, max_bytes=_MAX_FILE_BYTES)
    takes = sorted(set(re.findall(rf"\b{subject}_(\d{{2,3}})\.amc".encode(), page)))
    if not takes:
        raise FetchError(f"{url} lists no takes of subject {subject}; name them with --takes")
    return [take.decode() for take in takes]


def _fetch_file(url: str, path: Path, skeleton: Path | None) -> Fetched:
    if path.exists() and not has_changed(path, there := read_file(path)) and _fault(there, skeleton) is None:
        return Fetched(path=path, num_bytes=len(there), was_there=True)
    data = download(url, max_bytes=_MAX_FILE_BYTES)
    fault = _fault(data, skeleton)
    if fault is not None:
        raise FetchError(f"{url} did not send a motion file: {fault}")
    coming = path.with_name(f"{path.name}.part")  # an AMC file that is cut between two frames looks complete
    try:
        coming.write_bytes(data)
        note_fetched(path, data)
        coming.replace(path)
    except OSError as error:
        raise FetchError(f"{path} cannot be written: {error.strerror}") from None
    finally:
        with suppress(OSError):  # there is none in a folder that cannot be written
            coming.unlink()
    return Fetched(path=path, num_bytes=len(data), was_there=False)


def _fault(data: bytes, skeleton: Path | None) -> str | None:
    """Return why a file cannot be read; None if it can."""
    try:
        if skeleton is None:
            read_asf(data)
        else:
            read_amc(data, read_asf(read_file(skeleton)))
    except InputError as error:
        return str(error)
    return None
