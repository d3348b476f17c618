"""Who may ask the service for what.

Plan: a table of all routes by role, which fails for a route that is not in it; origins, hosts,
tokens, rates, sizes; what the service refuses to be started with.
"""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from index_kit import lab
from serve_kit import HOST, client, settings

from samii_rig.errors import GateError, InputError
from samii_rig.serve import access
from samii_rig.serve.access import GUESS_BURST, Tokens
from samii_rig.serve.app import application
from samii_rig.serve.lease import LASTS, Lease
from samii_rig.serve.rooms import Rooms

NOBODY, VIEWER, OPERATOR = "nobody", "viewer", "operator"
# Route, and the least role that is not turned away. An operator without the lease gets 409 where
# the rig is concerned; that is beyond the guard.
TABLE = {
    ("GET", "/"): NOBODY,
    ("GET", "/page/{name}"): NOBODY,
    ("POST", "/api/login"): NOBODY,
    ("POST", "/api/stop"): NOBODY,
    ("GET", "/api/stop"): NOBODY,
    ("GET", "/api/openapi.json"): VIEWER,
    ("GET", "/api/rig"): VIEWER,
    ("GET", "/api/state"): VIEWER,
    ("GET", "/api/experiments"): VIEWER,
    ("POST", "/api/dry-run"): VIEWER,
    ("GET", "/api/jobs/{id_}"): VIEWER,
    ("GET", "/api/jobs/{id_}/responses"): VIEWER,
    ("GET", "/api/jobs/{id_}/diagnosis"): VIEWER,
    ("GET", "/api/recordings"): VIEWER,
    ("GET", "/api/recordings/words"): VIEWER,
    ("GET", "/api/recordings/{id_}"): VIEWER,
    ("GET", "/api/recordings/{id_}/file"): VIEWER,
    ("GET", "/api/recordings/{id_}/signals"): VIEWER,
    ("GET", "/api/recordings/{id_}/frames"): VIEWER,
    ("GET", "/api/recordings/{id_}/frf"): VIEWER,
    ("GET", "/api/recordings/{id_}/report"): VIEWER,
    ("GET", "/api/compare"): VIEWER,
    ("POST", "/api/runs"): OPERATOR,
    ("DELETE", "/api/queue/{id_}"): OPERATOR,
    ("POST", "/api/queue/resume"): OPERATOR,
    ("POST", "/api/clear-fault"): OPERATOR,
    ("POST", "/api/lease"): OPERATOR,
    ("POST", "/api/lease/beat"): VIEWER,  # wants the lease, which only an operator gets
    ("DELETE", "/api/lease"): VIEWER,
    ("PUT", "/api/recordings/{id_}/tags"): OPERATOR,
    ("POST", "/api/recordings/{id_}/notes"): OPERATOR,
    ("POST", "/api/recordings"): OPERATOR,
}
BODIES: dict[tuple[str, str], Any] = {
    ("POST", "/api/dry-run"): {"experiment": "nonsense"},
    ("POST", "/api/runs"): {"experiment": "nonsense"},
    ("POST", "/api/clear-fault"): {"name": "x", "reason": "y"},
    ("PUT", "/api/recordings/{id_}/tags"): {"tags": []},
    ("POST", "/api/recordings/{id_}/notes"): {"text": "x"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("lab")
    lab(found / "runs")
    return found


@pytest.fixture(scope="module")
def tokens(folder: Path) -> dict[str, str]:
    kept = Tokens(folder / "tokens.json")
    return {r: kept.add(r, r) for r in (VIEWER, OPERATOR)}  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def rooms(folder: Path, tokens: dict[str, str]) -> Iterator[Rooms]:
    made = Rooms(settings(folder / "runs", Tokens(folder / "tokens.json")))
    yield made
    made.desk.close()


@pytest.fixture(scope="module")
def open_rooms(folder: Path) -> Iterator[Rooms]:
    """A service on this machine alone, without tokens."""
    made = Rooms(settings(folder / "runs"))
    yield made
    made.desk.close()


def run(work: Callable[[], Coroutine[Any, Any, Any]]) -> Any:
    return asyncio.run(work())


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


def test_every_route_stands_in_the_table(rooms: Rooms) -> None:
    app = application(rooms)
    listed = {
        (method.upper(), path) for path, item in app.openapi()["paths"].items() for method in item
    }
    # These are no part of the API's description.
    hidden = {("GET", "/"), ("GET", "/page/{name}"), ("GET", "/api/openapi.json")}
    assert listed | hidden == set(TABLE)


@pytest.mark.parametrize("route", sorted(TABLE), ids=lambda r: " ".join(r))
def test_each_route_turns_away_who_is_less_than_it_wants(
    rooms: Rooms, tokens: dict[str, str], route: tuple[str, str]
) -> None:
    method, path = route
    place = path.replace("{id_}", "0" * 16).replace("{name}", "index.html")

    async def ask(headers: dict[str, str]) -> int:
        async with client(rooms, headers) as http:
            body = BODIES.get(route)
            answer = await http.request(method, place, json=body, params={"a": "0", "b": "0"})
            assert answer.status_code < 500, answer.text
            return answer.status_code

    wanted = TABLE[route]
    nobody, wrong = run(lambda: ask({})), run(lambda: ask(bearer("x" * 43)))
    viewer = run(lambda: ask(bearer(tokens[VIEWER])))
    assert (nobody == 401, wrong == 401) == (wanted != NOBODY,) * 2
    # A lease that is not there is refused to everybody, as 409.
    assert (viewer == 403) == (wanted == OPERATOR)
    assert run(lambda: ask(bearer(tokens[OPERATOR]))) not in (401, 403)


def status(rooms: Rooms, path: str = "/api/state", method: str = "GET", **headers: str) -> int:
    async def ask() -> int:
        async with client(rooms) as http:
            named = {k.replace("_", "-"): v for k, v in headers.items()}
            return (await http.request(method, path, headers=named)).status_code

    return int(run(ask))


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        (f"http://{HOST}", 200),
        ("http://evil.example", 403),
        ("http://127.0.0.1:9999", 403),
        ("null", 403),
        (f"http://{HOST}.evil.example", 403),
    ],
)
def test_a_page_of_another_origin_is_refused(open_rooms: Rooms, origin: str, expected: int) -> None:
    assert status(open_rooms, origin=origin) == expected


def test_a_name_that_is_not_ours_is_refused(open_rooms: Rooms) -> None:
    assert status(open_rooms, host="evil.example") == 421
    assert status(open_rooms, host="localhost:8340") == 200
    assert status(open_rooms, sec_fetch_site="cross-site") == 403


def test_the_stop_asks_nobody_who_they_are(rooms: Rooms) -> None:
    for headers in ({}, {"host": "x"}, {"origin": "http://x"}, bearer("wrong")):
        for _ in range(5):
            assert status(rooms, "/api/stop", "POST", **headers) == 200


@pytest.fixture
def _slow_to_forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow the machine, no bucket fills up again during a test."""
    monkeypatch.setattr(access, "RATE", 1e-6)
    monkeypatch.setattr(access, "GUESSES", 1e-6)
    monkeypatch.setattr(access, "BURST", 20.0)


@pytest.mark.usefixtures("_slow_to_forget")
def test_who_asks_too_often_waits_but_may_stop(open_rooms: Rooms) -> None:
    async def ask() -> list[int]:
        async with client(open_rooms) as http:
            codes = [(await http.get("/page/none")).status_code for _ in range(25)]
            assert (await http.post("/api/stop")).status_code == 200
            return codes

    assert run(ask) == [404] * 20 + [429] * 5


@pytest.mark.usefixtures("_slow_to_forget")
def test_who_drives_is_heard_whatever_others_ask(
    open_rooms: Rooms, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(open_rooms, "lease", Lease())

    async def ask() -> list[int]:
        async with client(open_rooms) as http:
            lease = {"x-lease": (await http.post("/api/lease")).json()["lease"]}
            for _ in range(25):
                await http.get("/page/none", headers={"x-lease": "guess"})
            codes = [
                (await http.post("/api/lease/beat", headers=headers)).status_code
                for headers in (lease, {"x-lease": "guess"})
            ]
            return [*codes, (await http.delete("/api/lease", headers=lease)).status_code]

    assert run(ask) == [200, 429, 200]


@pytest.mark.usefixtures("_slow_to_forget")
def test_tokens_cannot_be_guessed_at_speed_and_who_has_one_is_not_locked_out(
    rooms: Rooms, tokens: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody at the operator's address tries tokens, and asks for more than their share."""
    monkeypatch.setattr(rooms, "lease", Lease())  # whoever took it before

    async def ask() -> tuple[list[int], list[int]]:
        async with client(rooms) as http:
            wrong = [
                (await http.get("/api/state", headers=bearer(f"{i}"))).status_code
                for i in range(int(GUESS_BURST) + 2)
            ]
            for _ in range(25):
                await http.get("/page/none")
            took = await http.post("/api/lease", headers=bearer(tokens[OPERATOR]))
            lease = {**bearer(tokens[OPERATOR]), "x-lease": took.json()["lease"]}
            right = [
                (await http.post("/api/lease/beat", headers=lease)).status_code for _ in range(3)
            ]
            return wrong, [took.status_code, *right]

    wrong, right = run(ask)
    assert wrong == [401] * int(GUESS_BURST) + [429] * 2
    assert right == [200] * 4


@pytest.mark.parametrize(
    ("proxies", "told", "found"),
    [
        ((), "10.0.0.7", "127.0.0.1"),  # anybody can write that
        (("127.0.0.1",), "10.0.0.7", "10.0.0.7"),
        (("127.0.0.1",), "6.6.6.6, 10.0.0.7", "10.0.0.7"),
        (("127.0.0.1", "10.0.0.1"), "10.0.0.7, 10.0.0.1", "10.0.0.7"),
        (("127.0.0.1",), "", "127.0.0.1"),
        (("10.0.0.1",), "10.0.0.7", "127.0.0.1"),
    ],
)
def test_only_a_proxy_of_ours_says_who_asks(
    open_rooms: Rooms, proxies: tuple[str, ...], told: str, found: str
) -> None:
    async def ask() -> str:
        http = client(open_rooms, {"x-name": "Zo%C3%AB", "x-forwarded-for": told})
        guard = http._transport.app  # type: ignore[attr-defined]
        guard._proxies = frozenset(proxies)
        async with http:
            note = {"text": ""}  # refused, once it is known who asks
            await http.post(f"/api/recordings/{'0' * 16}/notes", json=note)
        return str(asked[0].signed)

    asked: list[access.Person] = []
    claimed = access.claimed
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(access, "claimed", lambda *a: asked.append(claimed(*a)) or asked[-1])
        assert run(ask) == f"Zoë at {found}"


def test_a_bucket_fills_up_again(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(access.time, "monotonic", lambda: now[0])
    bucket = access.Buckets(rate=2.0, burst=3.0)
    assert [bucket.take("a") for _ in range(4)] == [True, True, True, False]
    assert bucket.take("b")
    now[0] = 1.0
    assert [bucket.take("a") for _ in range(3)] == [True, True, False]


def test_a_token_is_kept_as_its_hash_alone(tmp_path: Path) -> None:
    kept = Tokens(tmp_path / "t.json")
    token = kept.add("Ada", "operator")
    assert token not in (tmp_path / "t.json").read_text()
    assert (tmp_path / "t.json").stat().st_mode & 0o077 == 0
    found = Tokens(tmp_path / "t.json").person(token)
    assert found is not None
    assert (found.name, found.role) == ("Ada", "operator")
    assert Tokens(tmp_path / "t.json").person(token[:-1]) is None


def test_a_login_keeps_the_token_where_no_script_reads_it(
    rooms: Rooms, tokens: dict[str, str]
) -> None:
    async def ask() -> tuple[httpx.Response, int]:
        async with client(rooms) as http:
            answer = await http.post("/api/login", headers=bearer(tokens[VIEWER]))
            return answer, (await http.get("/api/state")).status_code

    answer, after = run(ask)
    assert answer.json() == {"name": VIEWER, "role": VIEWER}
    assert "HttpOnly" in answer.headers["set-cookie"]
    assert "samesite=strict" in answer.headers["set-cookie"].lower()
    assert after == 200


def test_a_body_that_is_too_large_is_refused(open_rooms: Rooms) -> None:
    async def ask(content: Any) -> int:
        async with client(open_rooms) as http:
            return (await http.post("/api/dry-run", content=content)).status_code

    async def endless() -> Any:
        for _ in range(40):
            yield b"x" * 4096

    assert run(lambda: ask(b"x" * 100_000)) == 413
    assert run(lambda: ask(endless())) in (400, 413, 422)


@pytest.mark.parametrize(
    "id_", ["../../etc/passwd", "..%2f..%2fetc%2fpasswd", "a.mcap", "%00", "x" * 3000]
)
def test_no_name_of_a_file_gets_to_the_disk(open_rooms: Rooms, id_: str) -> None:
    for end in ("", "/file", "/frf", "/signals"):
        assert status(open_rooms, f"/api/recordings/{id_}{end}") in (400, 404, 405)
    assert status(open_rooms, f"/page/{id_}") in (404, 405)


def test_one_drives_and_silence_ends_it() -> None:
    now = [0.0]
    lease = Lease(lambda: now[0])
    secret = lease.take("Ada")
    with pytest.raises(GateError, match="Ada drives"):
        lease.take("Bo")
    with pytest.raises(GateError, match="not your lease"):
        lease.beat("guess")
    now[0] = 0.9 * LASTS
    lease.beat(secret)
    now[0] = 1.8 * LASTS
    assert lease.lost() == ""
    lease.check(secret)
    now[0] = 2.0 * LASTS
    with pytest.raises(GateError, match="nobody drives"):
        lease.beat(secret)
    assert lease.lost() == "Ada"
    assert lease.lost() == ""
    other = lease.take("Bo")
    lease.give_back(other)
    assert not lease.alive
    assert lease.lost() == ""


def test_strangers_are_let_near_with_tls_and_tokens_only(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--tls-cert and --tls-key"):
        settings(tmp_path, host="0.0.0.0").check()
    with pytest.raises(InputError, match="at least one token"):
        settings(tmp_path, names=("lab.example",)).check()
    kept = Tokens(tmp_path / "t.json")
    kept.add("Ada", "operator")
    missing = (tmp_path / "cert.pem", tmp_path / "key.pem")
    with pytest.raises(InputError, match="a certificate and its key"):
        settings(tmp_path, kept, host="0.0.0.0", tls=missing).check()
    settings(tmp_path, kept, names=("lab.example",)).check()


def test_a_port_that_is_taken_is_one_clear_line(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        asked = settings(tmp_path, port=other.getsockname()[1])
        port = asked.port
        with pytest.raises(InputError, match=f"--port is {port}; expected a free port of 127"):
            asked.bound()
    with pytest.raises(InputError, match=r"--host is '192\.0\.2\.1'; expected an address"):
        settings(tmp_path, host="192.0.2.1").bound()


def test_a_folder_is_worked_on_by_one_service(tmp_path: Path) -> None:
    first, second = settings(tmp_path), settings(tmp_path)
    said = f"--folder .*; expected a folder that no other service works on.*process {os.getpid()} "
    with first.alone():
        for _ in range(2):
            with pytest.raises(InputError, match=said), second.alone():
                raise AssertionError("two at once")
    with second.alone():
        pass


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--rig", "nowhere"], "--rig is 'nowhere'"),
        (["--folder", "/proc/runs"], "a folder that can be written"),
        (["--host", "0.0.0.0"], "--tls-cert"),
        (["--port", "99999"], "0 to 65535"),
        (["--stop-port", "99999"], "--stop-port is 99999; expected 0 to 65535"),
        (["--proxy", "proxy.lab"], "--proxy is 'proxy.lab'; expected the address of a proxy"),
        (["--tokens", "/proc/version"], "a file that --new-token made"),
        (["--new-token", "Ada"], "the file that keeps its hash"),
    ],
)
def test_a_start_that_cannot_be_ends_with_one_line_and_code_2(
    tmp_path: Path, options: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from unittest.mock import patch

    from samii_rig.cli import main

    arguments = ["samii-rig", "serve", "--folder", str(tmp_path), *options]
    with patch("sys.argv", arguments), pytest.raises(SystemExit) as ended:
        main()
    err = capsys.readouterr().err
    assert ended.value.code == 2
    assert said in err
    assert err.count("\n") == 1


def test_tls_is_served(tmp_path: Path) -> None:
    from shutil import which

    from serve_kit import Service

    if which("openssl") is None:
        pytest.skip("no openssl to make a certificate with")
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    made = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost"]
    name = ["-addext", "subjectAltName=IP:127.0.0.1"]
    files = ["-keyout", str(key), "-out", str(cert)]
    subprocess.run(["openssl", *made, *name, *files], check=True, capture_output=True)
    token = Tokens(tmp_path / "t.json").add("Ada", "viewer")
    options = ["--tls-cert", str(cert), "--tls-key", str(key), "--tokens", str(tmp_path / "t.json")]
    with Service(tmp_path / "runs", *options, trust=str(cert), token=token) as service:
        assert service.url.startswith("https://")
        assert service.state()["you"] == {"name": "Ada", "role": "viewer"}
        assert service.http.post(service.stop_url).json() == {"stopped": False, "moving": False}
