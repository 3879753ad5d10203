"""The HTTP side of a pot and of a station (DESIGN, section 5)."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import FastAPI, Header, Path, Query
from starlette.responses import PlainTextResponse, Response
from starlette.types import Receive, Scope, Send

from core.errors import Forbidden
from core.growth.stages import DAY_S
from core.history import as_csv
from core.mesh.auth import Caller
from core.mesh.chassis import IdempotencyKey, allow, body, raw, serve_direct, serve_ready
from core.mesh.guard import header
from core.wire.documents import HistoryEntry
from core.wire.fruit import Colour, Forecast, Fruit, Inventory, LedgerLine, NewFruit, Scan
from core.wire.market import (
    Permit,
    PermitRequest,
    Report,
    ReportAnswer,
    Reservation,
    ReservationRequest,
    Task,
    TaskRequest,
)
from core.wire.plant import (
    DockState,
    PlantState,
    Settings,
    SettingsPatch,
    StationState,
    TapGrant,
    TapRequest,
)
from plant_service.journal import Journal
from plant_service.ledger import Ledger, When
from plant_service.ledger import as_csv as as_lines
from plant_service.pot import Pot
from plant_service.station import Station

Id = Annotated[str, Path(max_length=80)]
JSON = "application/json"


def speaks_for(caller: Caller, robot_id: str) -> None:
    """A robot may only act in its own name; raises Forbidden."""
    if caller.role == "robot" and caller.subject != robot_id:
        raise Forbidden(f"{caller.subject} cannot speak for {robot_id}", hint="send your own robot_id")


def add_pot(app: FastAPI, pot: Pot) -> None:
    """All routes of a pot."""
    _state_routes(app, pot)
    _inventory_routes(app, pot)
    _ledger_routes(app, pot.tending.ledger)
    _task_routes(app, pot)
    _robot_routes(app, pot)
    _dock_routes(app, pot)
    _history_route(app, pot.journal)


def add_station(app: FastAPI, station: Station) -> None:
    """All routes of a station."""

    @app.get("/state", tags=["station"], summary="Docks and tap")
    async def state() -> StationState:
        return station.state()

    @app.get("/dock", tags=["docks"], summary="Every dock and who holds it")
    async def docks() -> list[DockState]:
        return station.dock_states()

    @app.post("/tap", tags=["station"], summary="Open the tap for a while")
    async def tap(caller: Caller = allow("robot"), request: TapRequest = body(TapRequest)) -> TapGrant:
        speaks_for(caller, request.robot_id)
        return await station.tap(request)

    _reservation_routes(app, station)
    _history_route(app, station.journal)


def _state_routes(app: FastAPI, pot: Pot) -> None:
    @app.get("/state", tags=["plant"], summary="Soil, thirst, settings, and why nothing happens")
    async def state() -> PlantState:
        return pot.state()

    @app.patch("/settings", tags=["plant"], summary="Change thresholds, dose, caps")
    async def settings(caller: Caller = allow("operator"), patch: SettingsPatch = body(SettingsPatch)) -> Settings:
        return await pot.set_care(patch, caller.subject)


def _inventory_routes(app: FastAPI, pot: Pot) -> None:
    @app.get("/inventory", tags=["inventory"], summary="Fruits; with an ETag", response_model=Inventory)
    async def inventory(
        colour: Colour | None = None, if_none_match: Annotated[str, Header(max_length=200)] = ""
    ) -> Response:
        return pot.tending.shelf.answer(colour, if_none_match)

    @app.post("/inventory/fruits", tags=["inventory"], summary="Add one fruit", status_code=201, response_model=Fruit)
    async def add(caller: Caller = allow("robot", "operator"), fruit: NewFruit = body(NewFruit)) -> Response:
        return await pot.tending.shelf.add(fruit)

    @app.post("/inventory/scans", tags=["inventory"], summary="Merge what a scan saw", response_model=Inventory)
    async def scan(caller: Caller = allow("robot", "operator"), seen: Scan = body(Scan)) -> Response:
        speaks_for(caller, seen.robot_id or caller.subject)
        return await pot.tending.scan(seen, caller.subject if caller.role == "robot" else "")

    @app.delete("/inventory/fruits/{fruit_id}", tags=["inventory"], summary="A fruit is gone", status_code=204)
    async def remove(
        fruit_id: Id,
        if_match: Annotated[str, Header(max_length=200)] = "",
        caller: Caller = allow("robot", "operator"),
    ) -> Response:
        now = await pot.tending.shelf.remove(fruit_id, if_match)
        return Response(status_code=204, headers={"etag": now})

    async def whole(scope: Scope, receive: Receive, send: Send) -> None:
        known = header(scope["headers"], b"if-none-match")[:200]
        await pot.tending.shelf.answer(None, known)(scope, receive, send)

    serve_direct(app, "GET", "/inventory", whole)
    serve_direct(app, "POST", "/inventory/fruits")
    serve_direct(app, "POST", "/inventory/scans")
    serve_ready(app, "/inventory", pot.tending.shelf.whole)

    @app.get("/forecast", tags=["inventory"], summary="Ripe fruit some time ahead, with an interval")
    async def forecast(
        ahead_s: Annotated[float, Query(ge=0, le=30 * DAY_S, allow_inf_nan=False, description="a day if not given")] = DAY_S,
    ) -> Forecast:
        return pot.tending.forecast(ahead_s)


def _ledger_routes(app: FastAPI, book: Ledger) -> None:
    @app.get(
        "/ledger",
        tags=["ledger"],
        summary="Every pick: who asked, who bid, who picked, how it ended",
        response_model=list[LedgerLine],
        responses={200: {"content": {"text/csv": {}}}},
    )
    async def lines(format: Literal["json", "csv"] = "json") -> Response | list[LedgerLine]:
        known = book.lines()
        return PlainTextResponse(as_lines(known), media_type="text/csv") if format == "csv" else known

    @app.get(
        "/ledger/{line_id}/{when}.jpg",
        tags=["ledger"],
        summary="The picture before or after a pick",
        response_class=Response,
        responses={200: {"content": {"image/jpeg": {}}}},
    )
    async def picture(line_id: Id, when: When) -> Response:
        return await book.picture(line_id, when)

    @app.put("/ledger/{line_id}/{when}.jpg", tags=["ledger"], summary="Keep a picture of a pick", status_code=204)
    async def keep(line_id: Id, when: When, caller: Caller = allow("robot"), jpeg: bytes = raw("image/jpeg")) -> Response:
        await book.keep(line_id, when, jpeg, caller.subject)
        return Response(status_code=204)


def _task_routes(app: FastAPI, pot: Pot) -> None:
    @app.get("/tasks", tags=["tasks"], summary="Open and lately finished tasks")
    async def tasks() -> list[Task]:
        return pot.place.market.tasks()

    @app.post("/tasks", tags=["tasks"], summary="Ask for water, a scan or ripe fruit", status_code=201)
    async def ask(
        response: Response,
        caller: Caller = allow("operator"),
        request: TaskRequest = body(TaskRequest),
        idempotency_key: IdempotencyKey = "",
    ) -> Task:
        task = await pot.ask(request, caller.subject, idempotency_key)
        response.headers["location"] = f"/tasks/{task.task_id}"
        return task

    @app.get("/tasks/{task_id}", tags=["tasks"], summary="Who bid what, who won, why")
    async def task(task_id: Id) -> Task:
        return pot.place.market.task(task_id)

    @app.delete("/tasks/{task_id}", tags=["tasks"], summary="Cancel a task")
    async def cancel(task_id: Id, caller: Caller = allow("operator")) -> Task:
        return await pot.place.change(lambda m, now_s: m.cancel(task_id, caller.subject, "", now_s))


def _robot_routes(app: FastAPI, pot: Pot) -> None:
    @app.post("/tasks/{task_id}/reports", tags=["tasks"], summary="A robot's progress; renews its lease")
    async def report(task_id: Id, caller: Caller = allow("robot"), told: Report = body(Report)) -> ReportAnswer:
        speaks_for(caller, told.robot_id)
        return await pot.tending.report(task_id, told)

    @app.post("/tasks/{task_id}/permits", tags=["tasks"], summary="A one-shot permit for the irreversible act")
    async def permit(
        task_id: Id,
        caller: Caller = allow("robot"),
        request: PermitRequest = body(PermitRequest),
        idempotency_key: IdempotencyKey = "",
        *,
        response: Response,
    ) -> Permit:
        speaks_for(caller, request.robot_id)
        # What is left of a permit's time is another thing each time it is asked for.
        response.headers["cache-control"] = "no-store"
        return await pot.tending.permit(task_id, request, idempotency_key)


def _dock_routes(app: FastAPI, pot: Pot) -> None:
    @app.get("/dock", tags=["docks"], summary="The dock and who holds it")
    async def dock() -> list[DockState]:
        return pot.dock_states()

    _reservation_routes(app, pot)


def _reservation_routes(app: FastAPI, owner: Pot | Station) -> None:
    @app.post("/dock/reservations", tags=["docks"], summary="Reserve a dock, or renew")
    async def reserve(
        caller: Caller = allow("robot"), request: ReservationRequest = body(ReservationRequest)
    ) -> Reservation:
        speaks_for(caller, request.robot_id)
        return await owner.reserve(request)

    @app.delete("/dock/reservations/{reservation_id}", tags=["docks"], summary="Give a dock back", status_code=204)
    async def release(reservation_id: Id, caller: Caller = allow("robot", "operator")) -> Response:
        await owner.release(reservation_id, caller.subject if caller.role == "robot" else "")
        return Response(status_code=204)


def _history_route(app: FastAPI, journal: Journal) -> None:
    @app.get(
        "/history",
        tags=["node"],
        summary="What happened, and why",
        response_model=list[HistoryEntry],
        responses={200: {"content": {"text/csv": {}}}},
    )
    async def history(
        since: Annotated[int, Query(ge=0, le=2**53, description="entries after this id")] = 0,
        since_s: Annotated[float | None, Query(ge=0, le=1e12, allow_inf_nan=False)] = None,
        kind: Annotated[str, Query(max_length=40)] = "",
        task_id: Annotated[str, Query(max_length=80)] = "",
        limit: Annotated[int, Query(ge=1, le=5000)] = 500,
        format: Literal["json", "csv"] = "json",
    ) -> Response | list[HistoryEntry]:
        entries = journal.history.query(since_id=since, since_s=since_s, kind=kind, task_id=task_id, limit=limit)
        return PlainTextResponse(as_csv(entries), media_type="text/csv") if format == "csv" else entries
