"""Endpoints of the page's API: bodies checked by pydantic, work in threads, errors in one line, bounded requests."""

from __future__ import annotations

import asyncio
import dataclasses
import html
import inspect
import json
import math
import re
import typing
from collections.abc import Awaitable, Callable, Iterable, Mapping
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from pydantic import TypeAdapter, ValidationError
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route

from estimators.errors import ConfigError, NisusError, nearest, printable, quoted, shown_name

from ..engine.jobs import start_in_thread
from ..result import JsonObject
from .request_threads import in_thread

T = TypeVar("T")
Runner = Callable[[Callable[[], object]], Awaitable[object]]

PAGE = Path(__file__).parent / "page"
"""Folder of the page's HTML, CSS and JavaScript."""

PARSED_BODY = "nisus.body"
"""Key of a request's parsed body, and its bytes, in its scope: for the audit log."""

MAX_BODY_BYTES = 64 * 1024
"""Longest request body, and longest message of a browser on a stream; a command takes a hundred bytes."""

MAX_REASON_CHARACTERS = 500
"""Longest error line; it may quote the request."""

QUEUE_TIMEOUT_S = 15.0
"""Longest wait of a request for the one before it."""

RULES = {
    "float_type": "a number", "float_parsing": "a number", "int_type": "a whole number",
    "int_parsing": "a whole number", "bool_type": "true or false", "bool_parsing": "true or false",
    "string_type": "a text", "list_type": "a list of pairs",
    "tuple_type": "a list of texts", "dict_type": "an object of numbers", "none_required": "null",
    "too_short": "longer", "missing": "longer", "too_long": "shorter",
}  # fmt: skip
"""Types of pydantic's errors in words."""


class Operation(NamedTuple):
    """Endpoint for the API's description: function, fields and their place, status and type of the answer.

    `fields` is None if `body` returns the JSON Schema of the body.
    """

    work: Callable[..., object]
    fields: type | None
    sends_body: bool
    status: int
    body: Callable[[], JsonObject] | None = None
    answer: type | None = None


class ApiRoute(Route):
    """Route with the description of its endpoint."""

    operation: Operation


class Json(JSONResponse):
    """An answer in JSON. A file's name may hold what UTF-8 cannot, so everything that is not ASCII is escaped."""

    def render(self, content: object) -> bytes:
        """Return the bytes of the answer."""
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()


class TooLarge(ConfigError):
    """A request's body has more bytes than any command needs."""


def one_line(text: str) -> str:
    """Return an error text as one printable line."""
    line = printable(text).replace("\n", " ")
    return line if len(line) <= MAX_REASON_CHARACTERS else line[: MAX_REASON_CHARACTERS - 1] + "…"


def page_file(name: str, settings: Mapping[str, object], **parts: str) -> Response:
    """Answer with an HTML file of the page, or at a path, with settings in an attribute of the body and parts by name.

    In an attribute, not in a script: the security policy allows no inline scripts. Scripts and styles of a page behind
    a service are those of its `overview`, so a browser that knows them does not fetch them for each twin.
    """
    text = (PAGE / name).read_text()
    parts |= {"head": (PAGE / "head.html").read_text().rstrip(), "settings": html.escape(json.dumps(dict(settings)))}
    for key, part in parts.items():
        text = text.replace(f"{{{{{key}}}}}", part)
    if settings.get("overview"):
        text = text.replace('="page/', f'="{settings["overview"]}page/')
    return HTMLResponse(text)


def get(
    path: str,
    work: Callable[..., object],
    *,
    method: str = "GET",
    refused: int = 400,
    run: Runner = in_thread,
    answer: type | None = None,
) -> Route:
    """Return a route that calls `work` in a thread and answers with its result as JSON.

    Parameters of `work` come from the path and the query, converted to their annotated types; one that is called
    `request` is the request itself. A `Response` is passed on; a `NisusError` is answered in one line.

    Args:
        path: Path of the route, with parameters in braces.
        work: A plain function; its docstring describes the endpoint.
        method: Method of the request.
        refused: Status code of an error.
        run: Runs a call; by default in one of the threads of requests.
        answer: Model of the answer, for the description of the API.
    """
    kind, takes_request = _parameters(work), "request" in inspect.signature(work).parameters
    names = [item.name for item in dataclasses.fields(kind)]

    async def endpoint(request: Request) -> Response:
        texts = {**request.query_params, **request.path_params}
        given = {name: texts[name] for name in names if name in texts}
        subject = request.url.path.rpartition("/")[2].partition(".")[0]

        def call() -> object:
            fields = vars(parse(kind, given, subject, text=True))
            return work(request, **fields) if takes_request else work(**fields)

        return await _answered(call, run, 200, refused)

    route = ApiRoute(path, endpoint, methods=[method], name=work.__name__)
    route.operation = Operation(work, kind, False, 200, answer=answer)
    return route


def post(
    path: str,
    work: Callable[..., object],
    *,
    status: int = 200,
    run: Runner = in_thread,
    body_schema: Callable[[], JsonObject] | None = None,
) -> Route:
    """Return a route that calls `work` in a thread with the fields of the request's JSON body; see `get`.

    The body must be an object of exactly the parameters of `work`, or of the fields of its one parameter if that is a
    dataclass; one that is called `body` is the whole body, described by the JSON Schema of `body_schema`.
    """
    hints = [hint for name, hint in typing.get_type_hints(work).items() if name != "return"]
    whole: Any = hints[0] if len(hints) == 1 and dataclasses.is_dataclass(hints[0]) else None
    kind, takes_body = whole or _parameters(work), "body" in inspect.signature(work).parameters

    async def endpoint(request: Request) -> Response:
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return PlainTextResponse("Nisus: Content-Type must be application/json.\n", 415)
        try:
            text = await bounded_body(request)
            body = json.loads(text)
        except TooLarge as error:
            return PlainTextResponse(f"Nisus: {error}.\n", 413)
        except ConfigError as error:
            return refusal(error)
        except (ValueError, RecursionError):
            return Json({"error": "the body is no JSON, or holds a number or a nesting that is too large"}, 400)
        request.scope[PARSED_BODY] = body, len(text)
        subject = request.url.path.removeprefix("/api/")

        def call() -> object:
            if takes_body:
                return work(body)
            given = parse(kind, body, subject)
            return work(given) if whole else work(**vars(given))

        return await _answered(call, run, status, 400)

    route = ApiRoute(path, endpoint, methods=["POST"], name=work.__name__)
    route.operation = Operation(work, None if takes_body else kind, True, status, body_schema)
    return route


async def _answered(call: Callable[[], object], run: Runner, status: int, refused: int) -> Response:
    try:
        found = await run(call)
    except NisusError as error:
        return refusal(error, refused)
    except (ValueError, RecursionError) as error:  # of a body that is nested too deeply, or of a number too long
        return refusal(error)
    return found if isinstance(found, Response) else Json(found, status)


def refusal(error: Exception, status: int = 400) -> Json:
    """Answer with an error in one line."""
    return Json({"error": one_line(str(error))}, status)


async def bounded_body(request: Request, limit: int = MAX_BODY_BYTES) -> bytes:
    """Read the body of a request.

    Raises:
        TooLarge: If it has more than `limit` bytes; the rest is not read.
        ConfigError: If the client disconnects before its end.
    """
    body = bytearray()
    try:
        async for piece in request.stream():
            body += piece
            if len(body) > limit:
                raise TooLarge(f"a request's body may have {limit // 1024} kB; send one command at a time")
    except ClientDisconnect:
        raise ConfigError("the request ended before its body did; send it again") from None
    return bytes(body)


class OneAtATime:
    """Runs calls one after the other, each in a daemon thread.

    A model function that never returns blocks this queue, but neither other requests nor the end of the process.
    """

    def __init__(self, subject: str) -> None:
        self._subject = subject
        self._lock = asyncio.Lock()

    async def __call__(self, work: Callable[[], T]) -> T:
        """Return the result of `work`.

        Raises:
            ConfigError: If the call before it takes too long.
        """
        try:
            await asyncio.wait_for(self._lock.acquire(), QUEUE_TIMEOUT_S)
        except TimeoutError:
            raise ConfigError(f"{self._subject}: another one is under way; ask again") from None
        try:
            return await asyncio.wrap_future(start_in_thread(work, self._subject))
        finally:
            self._lock.release()


# Fields of a request as a dataclass


def parse(kind: type[T], given: object, subject: str, *, text: bool = False) -> T:
    """Return a dataclass (`kind`) of the fields of a JSON object, strictly: no text in place of a number.

    Infinity is written "inf" in place of a number. If all values are `text` of an address, they are converted. An error
    line begins with `subject`.

    Raises:
        ConfigError: If it is no object, or a field is unknown, missing or of another type.
    """
    fields = {item.name: item for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    names = ", ".join(fields)
    if not isinstance(given, dict):
        wanted = f"an object of {names}" if names else "an object"
        raise ConfigError(f"{subject}: the body is {shown(given)}; it must be {wanted}")
    for name in given.keys() - fields:
        remedy = nearest(name, fields) if fields else "it takes no field"
        raise ConfigError(f"{subject}: {shown_name(name)} is not known; {remedy}")
    for name, item in fields.items():
        if name not in given and item.default is item.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{subject}: {name} is missing; it takes {names}")
    adapter = _adapter(typing.cast(Any, kind))
    try:
        if text:
            return typing.cast(T, adapter.validate_python(given))
        hints = typing.get_type_hints(kind)
        checked = {name: _number(f"{subject}: {name}", value, hints[name]) for name, value in given.items()}
        return typing.cast(T, adapter.validate_json(json.dumps(checked), strict=True))
    except ValidationError as error:
        raise ConfigError(_line(error, given, subject)) from None


def _number(where: str, value: object, hint: object) -> object:
    """Return a value as pydantic takes it: infinity as a number, NaN as none; refuse what JSON's readers differ in."""
    if isinstance(value, dict):
        return {key: _number(f"{where}.{shown_name(key)}", item, hint) for key, item in value.items()}
    if isinstance(value, int) and abs(value) >= 2**53:
        raise ConfigError(f"{where} is too large; it must be below 2^53")
    if isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
        raise ConfigError(f"{where} is {shown(value)}; it must be text that can be shown, without half letters")
    if value == "inf" and "float" in str(hint):
        return math.inf
    return "NaN" if isinstance(value, float) and math.isnan(value) else value


def _line(error: ValidationError, given: object, subject: str) -> str:
    problems = error.errors(include_url=False)
    path, value = [], given
    for part in problems[0]["loc"]:  # the rest of a location names members of a union
        if isinstance(value, dict) and part in value or isinstance(value, list) and part in range(len(value)):
            value = value[part]  # type: ignore[index]
            path.append(shown_name(str(part)))
    rules = [
        RULES.get(problem["type"], problem["msg"].removeprefix("Input should be "))
        for problem in problems
        if problem["loc"][:1] == problems[0]["loc"][:1]
    ]
    return f"{subject}: {'.'.join(path)} is {shown(value)}; it must be {' or '.join(dict.fromkeys(rules))}"


def shown(value: object) -> str:
    """Return a value of a request as an error shows it: as JSON, shortened."""
    return quoted(value) if isinstance(value, str) else shown_name(json.dumps(value))


_adapter = cache(TypeAdapter)


def _parameters(work: Callable[..., object]) -> type:
    """Return a dataclass of the parameters of a function, without `request` and `body`."""
    hints = typing.get_type_hints(work, include_extras=True)
    fields: list[tuple] = []
    for name, item in inspect.signature(work).parameters.items():
        if name not in ("request", "body"):
            default = () if item.default is item.empty else (dataclasses.field(default=item.default),)
            fields.append((name, hints[name], *default))
    return dataclasses.make_dataclass(work.__name__, fields)


# The description of the API

MODELS_AT = "#/components/schemas/"


def openapi(routes: Iterable[BaseRoute]) -> JsonObject:
    """Return the OpenAPI document of routes, from the docstrings and parameters of their functions."""
    models: JsonObject = {}
    paths: JsonObject = {}
    for route in routes:
        if not isinstance(route, Route) or not route.path.startswith(("/api/", "/metrics", "/healthz", "/readyz")):
            continue
        path = re.sub(r":\w+}", "}", route.path)
        for method in sorted((route.methods or set()) - {"HEAD"}):
            paths.setdefault(path, {})[method.lower()] = _described(route, method, path, models)
    return {
        "openapi": "3.1.0",
        "info": {"title": "Nisus", "version": version("nisus"), "description": "HTTP interface of a running twin"},
        "security": [{"token": []}],
        "paths": dict(sorted(paths.items())),
        "components": {"schemas": models, "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}}},
    }


def _described(route: Route, method: str, path: str, models: JsonObject) -> JsonObject:
    """Return one operation; the models that it refers to are added to `models`."""
    operation = getattr(route, "operation", None)
    work = route.endpoint if operation is None else operation.work
    lines = (inspect.getdoc(work) or "").split("\n\n")[0].split()
    found: JsonObject = {"operationId": f"{method.lower()} {path}", "summary": " ".join(lines)}
    answer: JsonObject = {"description": "the answer"}
    status = 200
    if operation is not None:
        status = operation.status
        if operation.answer is not None:
            schema = _schema(operation.answer, models)
            answer["content"] = {"application/json": {"schema": schema}}
        if operation.sends_body:
            body = {} if operation.fields is None else _schema(operation.fields, models)
            body = body if operation.body is None else operation.body()
            found["requestBody"] = {"required": True, "content": {"application/json": {"schema": body}}}
        else:
            fields = _schema(operation.fields, models)
            needed = fields.get("required", ())
            found["parameters"] = [
                {
                    "name": name,
                    "in": "path" if f"{{{name}}}" in path else "query",
                    "required": name in needed or f"{{{name}}}" in path,
                    "schema": schema,
                }
                for name, schema in fields.get("properties", {}).items()
            ]
    found["responses"] = {str(status): answer, "400": {"description": "the reason, in one line", "content": ERROR}}
    return found


ERROR = {"application/json": {"schema": {"type": "object", "properties": {"error": {"type": "string"}}}}}


def _schema(kind: Any, models: JsonObject) -> JsonObject:
    """Return the JSON Schema of a type, with references to `models`."""
    schema = TypeAdapter(kind).json_schema(ref_template=f"{MODELS_AT}{{model}}")
    models |= schema.pop("$defs", {})
    return schema
