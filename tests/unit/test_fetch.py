"""Fetching from a loopback server: whole files, resuming, faults of the site, and nothing brought twice."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flows.console.fetch import FetchError, app, fetch_cmu
from tests.builders.source_samples import AMC, ASF

PAGE = '<a href="subjects/60/60_01.amc">amc</a> <a href="subjects/60/60_02.amc">amc</a> <a href="61_01.amc">x</a>'


@dataclass
class Site:
    """What the loopback server serves and how it misbehaves."""

    files: dict[str, bytes]
    url: str = ""
    requests: list[tuple[str, str | None]] = field(default_factory=list)
    cut_after: dict[str, list[int]] = field(default_factory=dict)
    fail_times: dict[str, int] = field(default_factory=dict)
    knows_ranges: bool = True


@pytest.fixture
def site() -> Iterator[Site]:
    state = Site(
        files={
            "/subjects/60/60.asf": ASF.encode(),
            "/subjects/60/60_01.amc": AMC.encode(),
            "/subjects/60/60_02.amc": AMC.encode() * 1,
            "/search.php?subjectnumber=60": PAGE.encode(),
        }
    )

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range")
            state.requests.append((self.path, wanted))
            if state.fail_times.get(self.path, 0) > 0:
                state.fail_times[self.path] -= 1
                self.send_error(503)
                return
            data = state.files.get(self.path)
            if data is None:
                self.send_error(404)
                return
            start = int(wanted.removeprefix("bytes=").removesuffix("-")) if wanted and state.knows_ranges else 0
            if start >= len(data):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(data)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}")
            self.send_header("Content-Length", str(len(data) - start))
            self.end_headers()
            cuts = state.cut_after.get(self.path, [])
            body = data[start:]
            self.wfile.write(body[: cuts.pop(0)] if cuts else body)

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


def test_all_listed_takes_come_with_their_skeleton_and_credit(site: Site, tmp_path: Path) -> None:
    found = list(fetch_cmu(["60"], tmp_path, base_url=site.url, wait_s=0.0))
    assert [item.path.name for item in found] == ["60.asf", "60_01.amc", "60_02.amc"]
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()
    assert "mocap.cs.cmu.edu" in (tmp_path / "CREDITS.txt").read_text()
    assert not list(tmp_path.glob("*.part"))


def test_what_is_there_is_not_brought_again(site: Site, tmp_path: Path) -> None:
    list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))
    site.requests.clear()
    again = list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))
    assert all(item.was_there for item in again)
    assert site.requests == []


def test_a_damaged_file_that_is_there_is_brought_again(site: Site, tmp_path: Path) -> None:
    list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))
    (tmp_path / "60_01.amc").write_bytes(AMC.encode()[:60])
    again = list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))
    assert [item.was_there for item in again] == [True, False]
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()


def test_a_connection_that_breaks_goes_on_from_where_it_was(site: Site, tmp_path: Path) -> None:
    path = "/subjects/60/60_01.amc"
    site.cut_after[path] = [50, 20]
    list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()
    assert [wanted for asked, wanted in site.requests if asked == path] == [None, "bytes=50-", "bytes=70-"]


def test_a_part_of_an_earlier_run_is_continued(site: Site, tmp_path: Path) -> None:
    tmp_path.joinpath("60_01.amc.part").write_bytes(AMC.encode()[:33])
    list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))
    assert ("/subjects/60/60_01.amc", "bytes=33-") in site.requests
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()


@pytest.mark.parametrize("part", [AMC.encode(), AMC.encode() + b"more than there is"])
def test_a_part_that_is_whole_or_too_long_ends_as_the_file(site: Site, tmp_path: Path, part: bytes) -> None:
    tmp_path.joinpath("60_01.amc.part").write_bytes(part)
    list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()


def test_a_site_without_ranges_sends_the_whole_file_again(site: Site, tmp_path: Path) -> None:
    site.knows_ranges = False
    tmp_path.joinpath("60_01.amc.part").write_bytes(b"something else entirely")
    list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))
    assert (tmp_path / "60_01.amc").read_bytes() == AMC.encode()


def test_a_site_that_is_busy_is_asked_again(site: Site, tmp_path: Path) -> None:
    site.fail_times["/subjects/60/60.asf"] = 2
    assert len(list(fetch_cmu(["60"], tmp_path, takes=["01"], base_url=site.url, wait_s=0.0))) == 2


def test_faults_of_the_site_are_named_and_leave_no_file(site: Site, tmp_path: Path) -> None:
    with pytest.raises(FetchError, match=r"60_77.amc: the site answers 404"):
        list(fetch_cmu(["60"], tmp_path, takes=["77"], base_url=site.url, wait_s=0.0))
    site.files["/subjects/60/60_03.amc"] = b"<html>down for maintenance</html>"
    with pytest.raises(FetchError, match=r"60_03.amc did not send a motion file: line 1"):
        list(fetch_cmu(["60"], tmp_path, takes=["03"], base_url=site.url, wait_s=0.0))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["60.asf", "CREDITS.txt"]
    site.files["/search.php?subjectnumber=60"] = b"nothing"
    with pytest.raises(FetchError, match="lists no takes of subject 60; name them with --takes"):
        list(fetch_cmu(["60"], tmp_path, base_url=site.url, wait_s=0.0))
    with pytest.raises(FetchError, match="the same command goes on from here"):
        list(fetch_cmu(["60"], tmp_path / "new", takes=["01"], base_url="http://127.0.0.1:9", wait_s=0.0))


def test_the_command_says_what_it_did(site: Site, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["cmu", "--subjects", "60", "--out", str(tmp_path), "--base-url", site.url])
    assert result.exit_code == 0, result.output
    assert "60_01.amc" in result.output
    assert "3 files in" in result.output
    assert "NSF EIA-0196217" in result.output
