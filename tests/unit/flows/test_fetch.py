"""Fetching from a loopback server: whole files, faults of the site, and nothing brought twice."""

from __future__ import annotations

import errno
import hashlib
import re
import threading
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from flows.console import fetch as fetch_module
from flows.console.fetch import Fetched, FetchError, fetch_cmu, takes_of_study
from pasdedeux.errors import InputError
from pasdedeux.formats.asf_amc import read_amc, read_asf
from storage_schema import Store
from tasks.files.downloads import PublicRedirects, download, is_public_ip
from tasks.ingest.takes.known_sources import was_fetched
from tests.builders.command_line import CommandLine
from tests.builders.real_study import build_here
from tests.builders.source_samples import AMC, ASF

PAGE = '<a href="subjects/60/60_01.amc">amc</a> <a href="subjects/60/60_02.amc">amc</a> <a href="61_01.amc">x</a>'
TAKE = "/subjects/60/60_01.amc"
FIRST_FRAME = AMC.encode().partition(b"\n2\n")[0] + b"\n"


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@dataclass
class Site:
    """What the loopback server serves and how it misbehaves."""

    files: dict[str, bytes]
    url: str = ""
    requests: list[str] = field(default_factory=list)
    cut_after: dict[str, list[int]] = field(default_factory=dict)
    fail_times: dict[str, int] = field(default_factory=dict)
    is_length_stated: bool = True
    status_line: bytes = b""


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tasks.files.downloads._FIRST_WAIT_S", 0.0)


@pytest.fixture
def site() -> Iterator[Site]:
    state = Site(
        files={
            "/subjects/60/60.asf": ASF.encode(),
            TAKE: AMC.encode(),
            "/subjects/60/60_02.amc": AMC.encode(),
            "/search.php?subjectnumber=60": PAGE.encode(),
        }
    )

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.requests.append(self.path)
            if state.status_line:
                self.wfile.write(state.status_line)
                return
            if state.fail_times.get(self.path, 0) > 0:
                state.fail_times[self.path] -= 1
                self.send_error(503)
                return
            data = state.files.get(self.path)
            if data is None:
                self.send_error(404)
                return
            self.send_response(200)
            if state.is_length_stated:
                self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            cuts = state.cut_after.get(self.path, [])
            self.wfile.write(data[: cuts.pop(0)] if cuts else data)

        def log_message(self, *_: object) -> None:
            """Stay quiet."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_address[1]}"
    yield state
    server.shutdown()
    thread.join()
    server.server_close()


def fetch(site: Site, folder: Path, *takes: str) -> list[Fetched]:
    """Fetch takes of subject 60, or all that the site lists."""
    return list(fetch_cmu({"60": list(takes) or None}, folder, base_url=site.url))


def test_all_listed_takes_come_with_their_skeleton_and_credit(site: Site, tmp_path: Path) -> None:
    files = fetch(site, tmp_path)
    assert [item.path.name for item in files] == ["60.asf", "60_01.amc", "60_02.amc"]
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()
    assert "mocap.cs.cmu.edu" in (tmp_path / "CREDITS.txt").read_text()
    noted = dict(reversed(line.split()) for line in (tmp_path / "CMU.sha256").read_text().splitlines())
    assert noted == {item.path.name: hashlib.sha256(item.path.read_bytes()).hexdigest() for item in files}


def test_what_is_there_is_not_brought_again(site: Site, tmp_path: Path) -> None:
    fetch(site, tmp_path, "01")
    site.requests.clear()
    assert all(item.was_there for item in fetch(site, tmp_path, "01"))
    assert site.requests == []


@pytest.mark.parametrize("left", [AMC.encode()[:60], FIRST_FRAME])
def test_a_damaged_file_is_fetched_again_even_if_readable(left: bytes, site: Site, tmp_path: Path) -> None:
    fetch(site, tmp_path, "01")
    (tmp_path / "60_01.amc").write_bytes(left)
    assert [item.was_there for item in fetch(site, tmp_path, "01")] == [True, False]
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()


def test_a_file_that_was_cut_off_is_asked_for_again(site: Site, tmp_path: Path) -> None:
    site.cut_after[TAKE] = [50, 20]
    fetch(site, tmp_path, "01")
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()
    assert site.requests.count(TAKE) == 3


def test_a_half_written_file_is_not_kept(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Path.write_bytes
    assert read_amc(FIRST_FRAME, read_asf(ASF)).num_frames == 1

    def broken(path: Path, data: bytes) -> int:
        if ".amc" not in path.name:
            return write(path, data)
        write(path, FIRST_FRAME)
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", broken)
        with pytest.raises(FetchError, match=r"60_01.amc cannot be written: No space"):
            fetch(site, tmp_path, "01")
    assert names_in(tmp_path) == ["60.asf", "CMU.sha256", "CREDITS.txt"]
    fetch(site, tmp_path, "01")
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()


def test_a_killed_fetch_leaves_a_known_file(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = Path.replace

    def killed(path: Path, target: Path) -> Path:
        there = replace(path, target)
        if target.suffix == ".amc":
            raise KeyboardInterrupt
        return there

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            fetch(site, tmp_path, "01")
    *_, motion = fetch(site, tmp_path, "01")
    assert motion.was_there
    assert was_fetched(motion.path, hashlib.sha256(AMC.encode()).hexdigest())


def test_a_site_that_is_busy_is_asked_again(site: Site, tmp_path: Path) -> None:
    site.fail_times["/subjects/60/60.asf"] = 2
    assert len(fetch(site, tmp_path, "01")) == 2


def test_faults_of_the_site_are_named_and_leave_no_file(site: Site, tmp_path: Path) -> None:
    with pytest.raises(FetchError, match=r"60_77.amc: the site answers 404"):
        fetch(site, tmp_path, "77")
    site.files["/subjects/60/60_03.amc"] = b"<html>down for maintenance</html>"
    with pytest.raises(FetchError, match=r"60_03.amc did not send a motion file: this is a web page"):
        fetch(site, tmp_path, "03")
    assert names_in(tmp_path) == ["60.asf", "CMU.sha256", "CREDITS.txt"]
    site.files["/search.php?subjectnumber=60"] = b"nothing"
    with pytest.raises(FetchError, match="lists no takes of subject 60; name them with --takes"):
        fetch(site, tmp_path)
    site.url = "http://127.0.0.1:9"
    with pytest.raises(FetchError, match="the same command goes on from here"):
        fetch(site, tmp_path / "new", "01")


@pytest.mark.parametrize("is_length_stated", [True, False])
def test_a_file_of_more_bytes_than_allowed_is_refused_also_where_no_length_is_stated(
    is_length_stated: bool, site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.is_length_stated = is_length_stated
    size = len(AMC.encode())
    assert download(site.url + TAKE, max_bytes=size) == AMC.encode()
    with pytest.raises(FetchError, match=r"60_01\.amc is larger than"):
        download(site.url + TAKE, max_bytes=size - 1)
    monkeypatch.setattr("flows.console.fetch._MAX_FILE_BYTES", len(ASF.encode()) - 1)
    with pytest.raises(FetchError, match=r"60\.asf is larger than"):
        fetch(site, tmp_path, "01")


def test_no_message_has_words_of_the_answer(site: Site) -> None:
    site.status_line = b"secret-word 200 \x1b]0;title\x07\r\n"
    with pytest.raises(FetchError, match="the answer is not that of a web server") as caught:
        download(site.url, max_bytes=10)
    assert "secret" not in str(caught.value)
    site.status_line = b"HTTP/1.1 403 secret-word\r\nContent-Length: 0\r\n\r\n"
    with pytest.raises(FetchError, match=r"the site answers 403$"):
        download(site.url, max_bytes=10)


@pytest.mark.parametrize(
    ("ip", "is_public"),
    [
        ("8.8.8.8", True),
        ("2606:4700::1111", True),
        ("127.0.0.1", False),
        ("10.1.2.3", False),
        ("169.254.169.254", False),
        ("100.64.0.1", False),
        ("::1", False),
        ("::ffff:10.0.0.1", False),
        ("fe80::1%eth0", False),
        ("224.0.0.1", False),
        ("0.0.0.0", False),
    ],
)
def test_a_name_of_a_private_address_is_refused(ip: str, is_public: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_public_ip(ip) is is_public

    class Line:
        def getpeername(self) -> tuple[str, int]:
            return ip, 443

        def setsockopt(self, *_: object) -> None:
            raise ConnectionResetError("it was to be spoken with")

        def close(self) -> None:
            """Nothing is open."""

    monkeypatch.setattr("socket.create_connection", lambda *_, **__: Line())
    message = "it was to be spoken with" if is_public else "example.org is a host of a private network"
    with pytest.raises(FetchError, match=message):
        download("https://example.org/net.onnx", max_bytes=10, is_public=True)


def test_a_site_that_leads_on_to_another_kind_of_address_is_not_followed(site: Site) -> None:
    request = urllib.request.Request("https://example.org/net.onnx")
    follow = PublicRedirects().redirect_request
    with pytest.raises(FetchError, match="the site leads on to a place that is not https to a public name"):
        follow(request, None, 302, "", Message(), f"{site.url}/secret")
    assert follow(request, None, 302, "", Message(), "https://example.com/net.onnx") is not None


def test_the_command_says_what_it_did(site: Site, tmp_path: Path, invoke: CommandLine) -> None:
    out = invoke("fetch", "cmu", "--subjects", "60", "--out", tmp_path, "--base-url", site.url).out
    for words in ("60_01.amc", "3 files in", "NSF EIA-0196217"):
        assert words in out


def test_the_takes_of_a_study_come_where_no_subjects_are_named(site: Site, tmp_path: Path, invoke: CommandLine) -> None:
    study = tmp_path / "mine.toml"
    study.write_text('[ingest.pairs.a]\nfolder = "cmu"\nsubjects = ["60"]\ntakes = ["02"]\n')
    invoke("fetch", "cmu", "--study", study, "--out", tmp_path / "cmu", "--base-url", site.url)
    assert names_in(tmp_path / "cmu") == ["60.asf", "60_02.amc", "CMU.sha256", "CREDITS.txt"]


def test_what_a_database_takes_is_said_before_it_is_agreed_to_and_done_then(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, invoke: CommandLine
) -> None:
    """A take has a megabyte, which comes in a second, and of which 0.6 MB are built in a second."""
    wanted, done = takes_of_study("everyday"), list[Any]()
    count, out = sum(map(len, wanted.values())), tmp_path / "cmu"
    out.mkdir()
    for subject, takes in list(wanted.items())[:2]:
        (out / f"{subject}_{takes[0]}.amc").touch()

    def note_fetch(takes: Any, folder: Path, *, base_url: str) -> list[Fetched]:
        done.append((takes, folder, base_url))
        return [Fetched(path=out / "02.asf", num_bytes=7, was_there=False)] * 3

    monkeypatch.setattr(fetch_module, "fetch_cmu", note_fetch)
    monkeypatch.setattr(
        fetch_module, "build_and_report", lambda run, where, as_json: done.append((run, where, as_json))
    )
    command = invoke.of("fetch", "database", "--out", out, "--base-url", "http://127.0.0.1:9", "--workers", "1")
    said = command.at(store)().out
    assert f"study everyday: {count} takes of CMU; about {count - 2} MB come into {out}, in" in said
    assert f"in {(count - 2) / 60:.0f} minutes at 1 MB a second" in said
    assert f"in some {count / 60:.0f} minutes of one core and has {0.6 * count:.0f} MB in {store}" in said
    assert done == []
    said = command.at(store)("--yes").out
    assert f"3 files in {out}" in said
    assert said.splitlines()[-1] == (
        f"now: pasdedeux reconstruct DIR --database projections:everyday --store {store} --out out"
    )
    (fetched, (run, where, as_json)) = done
    assert fetched == (wanted, out, "http://127.0.0.1:9")
    assert (run.study.name, run.store, where.num_workers, as_json) == ("everyday", store, 1, False)
    folders = {family["folder"] for family in run.study.resolved()["ingest"]["pairs"].values()}
    assert folders == {str(out.resolve())}


def test_a_database_is_downloaded_and_built_where_that_was_agreed_to(
    site: Site, store: Store, data_dir: Path, tmp_path: Path, invoke: CommandLine
) -> None:
    for subject, take in (("02", "03"), ("20", "11")):  # people with all bones: they become poses of the database
        for name in (f"{subject}.asf", f"{subject}_{take}.amc"):
            site.files[f"/subjects/{subject}/{name}"] = (data_dir / "cmu_asfamc" / name).read_bytes()
    study, out = tmp_path / "mine.toml", tmp_path / 'it\'s "cmu"'
    study.write_text(
        '[study]\nname = "mine"\ntitle = "Mine"\nstages = ["ingest", "projections"]\n'
        "[ingest.virtual_video]\nnum_videos = 0\nnum_random_views = 0\n"
        '[ingest.pairs.a]\nfolder = "cmu"\nsubjects = ["02"]\ntakes = ["03"]\n'
        '[ingest.pairs.b]\nfolder = "cmu"\nsubjects = ["20"]\ntakes = ["11"]\n'
    )
    command = invoke.of("fetch", "database", "--study", study, "--out", out, "--base-url", site.url).at(store)
    said = command().out
    assert (site.requests, out.exists()) == ([], False)
    assert "study mine: 2 takes of CMU; about 2 MB come into" in said
    assert "Free for all uses; the data itself may not be resold" in said
    assert said.splitlines()[-1] == "nothing was done yet; add --yes to start"
    # Built here of the same files first, without Prefect: what the command builds has the same content and is there.
    elsewhere = tmp_path / "elsewhere"
    list(fetch_cmu({"02": ["03"], "20": ["11"]}, elsewhere, base_url=site.url))
    built = build_here(study, store.root, *(f'ingest.pairs.{name}.folder="{elsewhere}"' for name in "ab"))
    assert built == {"ingest": 2, "projections": 2}
    lines = command("--yes").out.splitlines()
    assert sum(line.startswith("fetched") for line in lines) == 4
    assert any("everything is fresh" in line for line in lines)
    assert any(re.search(r"built: 2 takes \(\d+ s, [\d.]+ .B\), [\d,]+ database poses", line) for line in lines)
    assert "--database projections:mine" in lines[-1]
    del site.files["/subjects/20/20_11.amc"]
    (out / "20_11.amc").unlink()
    assert "20_11.amc: the site answers 404" in command("--yes", code=1).err


def test_the_database_that_ships_has_people_with_a_partner_and_alone() -> None:
    wanted = takes_of_study("everyday")
    assert all(wanted[first] == wanted[second] for first, second in (("18", "19"), ("20", "21"), ("22", "23")))
    assert {"02", "07", "13", "60", "61"} <= set(wanted)
    with pytest.raises(InputError, match="names no takes of CMU's subjects"):
        takes_of_study("duets")
