"""Whatever is asked, the answer is one: no request makes the service fail.

Requests are drawn from the API's own description, with values that fit it and values that do not.
What is known to take seconds or to start a run is asked with what is refused at once.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi import FastAPI
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from index_kit import lab
from serve_kit import HOST, client
from serve_kit import settings as service_settings

from samii_rig.serve.access import STOP
from samii_rig.serve.app import application, guarded
from samii_rig.serve.rooms import Rooms

# They spawn processes; their own tests ask them.
SLOW = {"/api/rig", "/api/dry-run", "/api/compare"}
SLOW_ENDS = ("/signals", "/frf")


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rooms]:
    folder = tmp_path_factory.mktemp("lab")
    lab(folder)
    made = Rooms(service_settings(folder))
    yield made
    made.desk.close()


@pytest.fixture(scope="module")
def routes(rooms: Rooms) -> FastAPI:
    return application(rooms)


@pytest.fixture(scope="module")
def api(routes: FastAPI) -> dict[str, Any]:
    return routes.openapi()


def operations(api: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    paths = api["paths"]
    return [
        (method.upper(), path, item)
        for path, items in paths.items()
        if path not in SLOW and not path.endswith(SLOW_ENDS)
        for method, item in items.items()
    ]


texts = st.one_of(
    st.text(max_size=30),
    st.text(
        st.characters(categories=["Cs", "Cc", "L"]), max_size=8
    ),  # surrogates and control characters too
    st.sampled_from(["", "..", "../../etc/passwd", "\x00", "%", "'", "NaN", "-1", "1e999", "💥"]),
)
values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), texts),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(texts, inner, max_size=4)),
    max_leaves=8,
)


def fits(schema: dict[str, Any], parts: dict[str, Any]) -> st.SearchStrategy[Any]:
    """What fits a part of the description, or nearly."""
    if "$ref" in schema:
        return fits(parts[schema["$ref"].rpartition("/")[2]], parts)
    if schema.get("type") == "object":
        fields = {k: st.one_of(fits(v, parts), values) for k, v in schema["properties"].items()}
        required = {k: v for k, v in fields.items() if k in schema.get("required", ())}
        optional = {k: v for k, v in fields.items() if k not in required}
        return st.fixed_dictionaries(required, optional=optional)
    if schema.get("type") == "array":
        return st.lists(fits(schema["items"], parts), max_size=5)
    return {"integer": st.integers(), "number": st.floats(), "boolean": st.booleans()}.get(
        schema.get("type", ""), texts
    )


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_request_makes_the_service_fail(
    rooms: Rooms, api: dict[str, Any], data: st.DataObject
) -> None:
    method, path, item = data.draw(st.sampled_from(operations(api)))
    parts = api["components"]["schemas"]
    ids = [e["id"] for e in _ask(rooms, "GET", "/api/recordings", {}, None)[1]["recordings"]]
    params = {}
    for p in item.get("parameters", ()):
        if p["in"] == "path":
            path = path.replace(
                f"{{{p['name']}}}", data.draw(st.sampled_from([*ids, "0" * 16, "x"]))
            )
        elif data.draw(st.booleans()):
            params[p["name"]] = data.draw(st.one_of(fits(p["schema"], parts), texts))
    body: Any = None
    if "requestBody" in item:
        schema = item["requestBody"]["content"]["application/json"]["schema"]
        drawn = data.draw(st.one_of(fits(schema, parts), values))
        body = json.dumps(drawn).encode()
    elif data.draw(st.booleans()):
        body = data.draw(st.binary(max_size=100))
    status, _ = _ask(rooms, method, path, params, body)
    assert status < 500


def _ask(
    rooms: Rooms, method: str, path: str, params: dict[str, Any], body: Any
) -> tuple[int, Any]:
    encodable = {
        k: str(v).encode("utf-8", "surrogatepass").decode("latin-1") for k, v in params.items()
    }

    async def ask() -> tuple[int, Any]:
        headers = {"content-type": "application/json"}
        async with client(rooms, headers) as http:
            answer = await http.request(method, path, params=encodable, content=body)
            is_json = answer.headers.get("content-type", "").startswith("application/json")
            return answer.status_code, answer.json() if is_json else None

    return asyncio.run(ask())


@settings(max_examples=100, suppress_health_check=list(HealthCheck))
@given(
    headers=st.lists(
        st.tuples(
            st.sampled_from(
                ["authorization", "cookie", "origin", "x-lease", "range", "content-length"]
            ),
            st.text(st.characters(max_codepoint=255, min_codepoint=33), max_size=40),
        ),
        max_size=4,
        unique_by=lambda h: h[0],
    ),
    path=st.sampled_from(["/api/state", "/api/recordings", "/api/lease/beat", STOP]),
)
def test_no_head_makes_the_service_fail(
    rooms: Rooms, routes: FastAPI, headers: list[tuple[str, str]], path: str
) -> None:
    app = guarded(rooms, 8340, routes)
    sent: list[Any] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        sent.append(message)

    raw = [(k.encode(), v.encode("latin-1")) for k, v in headers]
    scope = {
        "type": "http",
        "http_version": "1.1",
        "method": "POST" if path in (STOP, "/api/lease/beat") else "GET",
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"",
        "root_path": "",
        "scheme": "http",
        "headers": [(b"host", HOST.encode()), *raw],
        "client": ("127.0.0.1", 1),
        "server": ("127.0.0.1", 8340),
    }
    asyncio.run(app(scope, receive, send))  # type: ignore[arg-type]
    assert sent[0]["status"] < 500
