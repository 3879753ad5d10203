"""A robot's HTTP: bids, its queue, its state, an operator's jobs, the e-stop."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import FastAPI, Path, Query, Response
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from core.errors import Unavailable
from core.history import as_csv
from core.mesh.auth import ROLES, Caller, Verifier
from core.mesh.chassis import IdempotencyKey, allow, body, create_app, serve_direct
from core.mesh.metrics import measure
from core.wire.documents import HistoryEntry
from core.wire.market import Announcement, Award, Bid
from core.wire.robot import Job, JobRequest, Position, QueuedTask, ResumeRequest, RobotState, Stopped, StopRequest
from robot_service.brain import Brain, check_owner, queued
from robot_service.eye import SHOW_EVERY_S
from robot_service.failed import SkillFailed
from robot_service.metrics import RobotReadings

FILM_FRAMES_MAX = 10_000
Id = Annotated[str, Path(max_length=80)]


def make_app(brain: Brain, verifier: Verifier | None, open_reads: bool = True) -> FastAPI:
    app = create_app(
        card=brain.card,
        clock=brain.clock,
        verifier=verifier,
        ready=brain.missing,
        events=brain.events,
        open_reads=open_reads,
    )
    measure(app.state.registry, RobotReadings(brain).read)
    _market(app, brain)
    _readings(app, brain)
    _camera(app, brain)
    _jobs(app, brain)
    _emergency(app, brain)
    return app


def _market(app: FastAPI, brain: Brain) -> None:
    @app.post("/bids", summary="Announcement in, bid out", tags=["market"], response_model=Bid)
    async def bid(caller: Caller = allow("plant", "operator"), asked: Announcement = body(Announcement)) -> Response:
        check_owner(asked, caller)
        return Response((await brain.bid(asked)).model_dump_json(), media_type="application/json")

    serve_direct(app, "POST", "/bids")

    @app.get("/tasks", summary="The queue", tags=["market"])
    async def tasks() -> list[QueuedTask]:
        return [queued(entry) for entry in brain.queue.entries if entry.kind != "job"]

    @app.post("/tasks", summary="Award", tags=["market"], status_code=201)
    async def award(caller: Caller = allow("plant", "operator"), award: Award = body(Award)) -> QueuedTask:
        return brain.award(award, caller)

    @app.get("/tasks/{task_id:path}", summary="One task of the queue", tags=["market"])
    async def task(task_id: Id) -> QueuedTask:
        return queued(brain.queue.get(task_id))

    @app.delete("/tasks/{task_id:path}", summary="Kill task", tags=["market"])
    async def kill(
        task_id: Id,
        caller: Caller = allow("plant", "operator"),
        epoch: Annotated[int | None, Query(ge=0, le=2**53, description="only if it is held under this epoch")] = None,
    ) -> QueuedTask:
        return brain.kill(task_id, caller, epoch)


def _readings(app: FastAPI, brain: Brain) -> None:
    @app.get("/state", summary="Pose, battery, water, job", tags=["robot"])
    async def state() -> RobotState:
        return brain.state()

    @app.get("/position", summary="Cheap, for neighbours", tags=["robot"])
    async def position() -> Position:
        return brain.position()

    async def told(scope: Scope, receive: Receive, send: Send) -> None:
        content = brain.position().model_dump_json()
        await Response(content, media_type="application/json")(scope, receive, send)

    serve_direct(app, "GET", "/position", told)

    @app.get(
        "/history",
        summary="What happened and why",
        tags=["robot"],
        response_model=list[HistoryEntry],
        responses={200: {"content": {"text/csv": {}}}},
    )
    async def history(
        since: Annotated[int, Query(ge=0, le=2**53, description="entries after this id")] = 0,
        format: Annotated[str, Query(pattern="^(json|csv)$")] = "json",
    ) -> object:
        entries = brain.events.since(since)
        return Response(as_csv(entries), media_type="text/csv") if format == "csv" else entries


def _camera(app: FastAPI, brain: Brain) -> None:
    picture: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": {}}}}
    stream: dict[int | str, dict[str, Any]] = {200: {"content": {"multipart/x-mixed-replace": {}}}}

    @app.get("/camera.jpg", summary="What it sees, fruit ringed", tags=["camera"], responses=picture)
    async def camera() -> Response:
        return Response(await shown(), media_type="image/jpeg", headers={"cache-control": "no-store"})

    @app.get("/camera.mjpg", summary="The same as a film", tags=["camera"], responses=stream)
    async def film() -> StreamingResponse:
        first = await shown()
        return StreamingResponse(frames(first), media_type="multipart/x-mixed-replace; boundary=frame")

    async def shown() -> bytes:
        try:
            return await brain.robot.eye.show()
        except SkillFailed as error:
            raise Unavailable(str(error), hint="GET /state tells how the robot is") from error

    async def frames(first: bytes) -> AsyncIterator[bytes]:
        """Ends when the camera does, or after `FILM_FRAMES_MAX`: whoever still watches asks again."""
        data = first
        for _ in range(FILM_FRAMES_MAX):
            yield b"--frame\r\ncontent-type: image/jpeg\r\ncontent-length: %d\r\n\r\n%b\r\n" % (len(data), data)
            await brain.clock.sleep(SHOW_EVERY_S)
            try:
                data = await shown()
            except Unavailable:
                return


def _jobs(app: FastAPI, brain: Brain) -> None:
    @app.post("/jobs", summary="A job from a supervisor", tags=["operator"], status_code=202)
    async def post_job(
        response: Response,
        caller: Caller = allow("operator"),
        wish: JobRequest = body(JobRequest),
        idempotency_key: IdempotencyKey = "",
    ) -> Job:
        job = brain.add_job(wish, caller.subject, idempotency_key)
        response.headers["location"] = f"/jobs/{job.job_id}"
        return job

    @app.get("/jobs", summary="Recent jobs", tags=["operator"])
    async def jobs() -> list[Job]:
        return brain.reporter.all_jobs()

    @app.get("/jobs/{job_id:path}", summary="How a job stands", tags=["operator"])
    async def get_job(job_id: Id) -> Job:
        return brain.reporter.job(job_id)

    @app.delete("/jobs/{job_id:path}", summary="Call a job off", tags=["operator"])
    async def delete_job(job_id: Id, caller: Caller = allow("operator")) -> Job:
        return brain.call_off(job_id, caller)


def _emergency(app: FastAPI, brain: Brain) -> None:
    @app.post("/stop", summary="E-stop: latches", tags=["safety"])
    async def stop(caller: Caller = allow(*ROLES), wish: StopRequest = body(StopRequest)) -> Stopped:
        return await brain.stop(caller, wish.reason)

    named = "GET /state tells the stop_number that is latched; send that"

    @app.post("/resume", summary="Release the e-stop that is named", tags=["safety"])
    async def resume(caller: Caller = allow("operator"), wish: ResumeRequest = body(ResumeRequest, hint=named)) -> Stopped:
        return await brain.resume(caller, wish.stop_number)
