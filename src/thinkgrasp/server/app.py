"""The web application: which address does what. Reading bodies, deciding and remembering are done elsewhere."""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncGenerator, Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from thinkgrasp import __version__
from thinkgrasp.schema import DecisionModel
from thinkgrasp.server import openapi
from thinkgrasp.server.access import Access
from thinkgrasp.server.decoding import FrameUpload
from thinkgrasp.server.episodes import Episodes
from thinkgrasp.server.gate import Gate
from thinkgrasp.server.jobs import Answer, Decide, Decided, Job, Settings, Verified, Verify
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.logs import log
from thinkgrasp.server.metrics import CONTENT_TYPE, Metrics
from thinkgrasp.server.paper_api import (
    PUBLISHED_CAMERA_WARNING,
    PaperOptions,
    published_pose,
    read_paper_request,
)
from thinkgrasp.server.pool import Pool
from thinkgrasp.server.problems import RequestProblem
from thinkgrasp.server.schema import (
    EpisodeAnswer,
    EpisodeBody,
    ExplainedDecision,
    FrameBody,
    GraspBody,
    Health,
    ObserveBody,
    Options,
    OutcomeBody,
    PaperError,
    PaperPose,
    Readiness,
)
from thinkgrasp.server.static import page_response
from thinkgrasp.server.uploads import linger, read_json, read_model
from thinkgrasp.server.workers import InProcessWorker, ProcessWorker, Recipe
from thinkgrasp.types import Outcome

DISCONNECTED = "http.disconnect"


@dataclass(frozen=True)
class ServerOptions:
    """How a server decides and whom it answers."""

    workers: int = 1
    """Processes that make decisions; 0 = the server's own, where a running stage cannot be ended."""
    limits: Limits = field(default_factory=Limits)
    token: str | None = None
    paper: PaperOptions = field(default_factory=PaperOptions)
    recycle_after: int = 0
    """A worker's process is started anew after so many decisions; 0 = never."""
    debug: bool = False


def make_app(
    recipe: Recipe, options: ServerOptions, *, on_unloadable: Callable[[str], None] = lambda message: None
) -> Gate:
    """Return the ASGI application.

    Args:
        recipe: What the workers make their pipeline from.
        options: Of the server.
        on_unloadable: Told why the models cannot be loaded, which leaves the server of no use.
    """
    limits, metrics = options.limits, Metrics()
    if options.workers:
        workers = [ProcessWorker(recipe, limits) for _ in range(options.workers)]
    else:
        workers = [InProcessWorker(recipe)]
    pool = Pool(
        workers,
        limits,
        recycle_after=options.recycle_after,
        on_stage=metrics.stage,
        on_restart=metrics.restarted,
        on_unloadable=on_unloadable,
    )
    episodes = Episodes(limits)
    metrics.watch(pool, lambda: len(episodes))

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncGenerator[None, None]:
        pool.start()
        yield
        await pool.close()
        log("stopped")

    app = FastAPI(
        title="ThinkGrasp",
        version=__version__,
        description="An RGB-D frame and a sentence in, a 6-DoF two-finger grasp out.",
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
    )
    gate = Gate(app, access=Access(options.token), metrics=metrics, debug=options.debug)
    counted = _CountedPool(pool, metrics)
    budget_usd = recipe.budget_usd

    def route(
        method: str, path: str, *, status: int = 200, answer: type | None = None, body: dict[str, Any] | None = None
    ) -> Callable[[Callable[[Request], Awaitable[Response]]], Callable[[Request], Awaitable[Response]]]:
        """Register an endpoint whose exceptions become JSON."""

        def register(endpoint: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
            async def answered(request: Request) -> Response:
                try:
                    return await endpoint(request)
                except Exception as error:
                    return gate.answer_error(request, error)

            openapi.add_route(app, method, path, answered, endpoint, status=status, answer=answer, body=body)
            return endpoint

        return register

    @contextlib.asynccontextmanager
    async def place(request: Request) -> AsyncGenerator[None, None]:
        """A place among those that may have a worker; a body that gets none is read away."""
        with contextlib.ExitStack() as held:
            try:
                held.enter_context(pool.admit())
            except Exception:
                await linger(request)
                raise
            yield

    @route("POST", "/v1/grasp", answer=DecisionModel, body=openapi.frame_body(GraspBody))
    async def grasp(request: Request) -> Response:
        """Decide on one frame: the Decision that `thinkgrasp grasp --json` prints."""
        async with place(request):
            body = await read_model(request, GraspBody, limits)
            job = Decide(_files(body), body.instruction, _settings(body.options), budget_usd=budget_usd)
            decided = await counted.decide(request, job)
        return _json(decided.decision)

    @route("POST", "/v1/explain", answer=ExplainedDecision, body=openapi.frame_body(GraspBody))
    async def explain(request: Request) -> Response:
        """Decide on one frame, and return the annotated picture and the 3-D view with the decision."""
        async with place(request):
            body = await read_model(request, GraspBody, limits)
            settings = _settings(body.options)
            job = Decide(_files(body), body.instruction, settings, budget_usd=budget_usd, pictures=True)
            decided = await counted.decide(request, job)
        overlay, view = decided.overlay_png or "", decided.view_html or ""
        return _json(ExplainedDecision(decision=decided.decision, overlay_png=overlay, view_html=view))

    @route("POST", "/v1/episodes", status=201, answer=EpisodeAnswer, body=openapi.json_body(EpisodeBody))
    async def begin(request: Request) -> Response:
        """Open an episode: the closed loop, with the memory of what failed."""
        body = await read_json(request, EpisodeBody, limits)
        return _json(episodes.create(body.instruction, body.step_limit).answer(limits), 201)

    @route("GET", "/v1/episodes/{episode_id}", answer=EpisodeAnswer)
    async def look_up(request: Request) -> Response:
        """Say where an episode stands, with the decision whose outcome is awaited."""
        episode = episodes.get(request.path_params["episode_id"])
        return _json(episode.answer(limits, decision=episode.awaited))

    @route("DELETE", "/v1/episodes/{episode_id}", answer=EpisodeAnswer)
    async def stop(request: Request) -> Response:
        """End an episode and forget it."""
        return _json(episodes.remove(request.path_params["episode_id"]).answer(limits))

    @route("POST", "/v1/episodes/{episode_id}/observe", answer=EpisodeAnswer, body=openapi.frame_body(ObserveBody))
    async def observe(request: Request) -> Response:
        """Decide what to do now, on a frame of what is seen now."""
        async with place(request):
            body = await read_model(request, ObserveBody, limits)
            with episodes.turn(request.path_params["episode_id"], "observe") as episode:
                settings = _settings(body.options)
                job = episode.observe(_files(body), settings, more_views=body.more_views, budget_usd=budget_usd)
                decided = await counted.decide(request, job)
                episode.observed(decided, more_views=body.more_views)
        return _json(episode.answer(limits, decision=decided.decision, undone=decided.undone))

    @route("POST", "/v1/episodes/{episode_id}/outcome", answer=EpisodeAnswer, body=openapi.frame_body(OutcomeBody))
    async def outcome(request: Request) -> Response:
        """Say what became of the grasp that was decided last."""
        async with place(request):
            body = await read_model(request, OutcomeBody, limits)
            with episodes.turn(request.path_params["episode_id"], "act") as episode:
                seen: bool | None = None
                removed = episode.awaits_removal
                if body.success and body.color is not None and removed is not None:
                    seen = await counted.verify(request, Verify(_files(body), removed))
                verified = None if seen is None else not seen
                said = Outcome(body.success, body.reason or ("held" if body.success else "missed"))
                episode.acted(said, delivered=body.delivered, is_verified=verified)
        return _json(episode.answer(limits, undone=verified is False, verified=verified))

    @route("POST", "/grasp_pose", answer=PaperPose, body=openapi.paper_body())
    async def grasp_pose(request: Request) -> Response:
        """Answer as the paper's own server does; errors are {"error": text} with status 400."""
        async with place(request):
            asked = await read_paper_request(request, options.paper, limits)
            job = Decide(asked.frame, asked.instruction, budget_usd=budget_usd, pose=True)
            decided = await counted.decide(request, job)
        headers = {"Warning": PUBLISHED_CAMERA_WARNING} if asked.is_camera_assumed else {}
        if decided.pose is None:
            said = f"{decided.decision.status.replace('_', ' ')}: {decided.decision.plan.rationale}"
            return JSONResponse(PaperError(error=said).model_dump(), 400, headers)
        return JSONResponse(published_pose(decided.pose).model_dump(), headers=headers)

    @route("GET", "/healthz", answer=Health)
    async def healthz(request: Request) -> Response:
        """Say that the server's process answers."""
        return _json(Health(version=__version__))

    @route("GET", "/readyz", answer=Readiness)
    async def readyz(request: Request) -> Response:
        """Say whether the models are loaded: 200 when a decision can start, else 503."""
        ready = pool.ready
        answer = Readiness(ready=ready > 0, workers=options.workers, ready_workers=ready)
        return _json(answer, 200 if ready else 503)

    @route("GET", "/metrics")
    async def metrics_text(request: Request) -> Response:
        """Return the counters in Prometheus' text format."""
        return Response(metrics.text(), media_type=CONTENT_TYPE)

    @route("GET", "/")
    async def page(request: Request) -> Response:
        """Return the page on which a person tries the server."""
        return page_response("index.html")

    @route("GET", "/docs")
    async def docs(request: Request) -> Response:
        """Return the page that shows this interface."""
        return page_response("docs.html")

    @route("GET", "/page/{name}")
    async def page_part(request: Request) -> Response:
        """Return a part of those pages."""
        return page_response(request.path_params["name"])

    async def no_route(request: Request, error: Exception) -> Response:
        return gate.answer_error(request, error)

    app.add_exception_handler(HTTPException, no_route)
    openapi.document(app, needs_token=options.token is not None)
    return gate


class _CountedPool:
    """The pool, with what it decides counted and noted in the log."""

    def __init__(self, pool: Pool, metrics: Metrics) -> None:
        self._pool = pool
        self._metrics = metrics

    async def decide(self, request: Request, job: Decide) -> Decided:
        answer = await self._carry_out(request, job)
        if not isinstance(answer, Decided):
            raise TypeError("a Decide is answered by a Decided")
        self._metrics.decided(answer)
        notes = request.scope["thinkgrasp"]["notes"]
        notes |= {"decision": answer.decision.status, "degraded": len(answer.decision.degraded)}
        return answer

    async def verify(self, request: Request, job: Verify) -> bool | None:
        """Return whether the target is still in its place; None where that is not known."""
        answer = await self._carry_out(request, job)
        if not isinstance(answer, Verified):
            raise TypeError("a Verify is answered by a Verified")
        return answer.still_there

    async def _carry_out(self, request: Request, job: Job) -> Answer:
        return await self._pool.carry_out(job, _left(request))


async def _left(request: Request) -> None:
    """Return when the client has left; its body has been read before."""
    while (await request.receive())["type"] != DISCONNECTED:
        pass


def _files(body: FrameBody | OutcomeBody) -> FrameUpload:
    if body.color is None or body.depth is None or body.camera is None:
        raise RequestProblem(422, "invalid_request", "color, depth and camera are needed")
    workspace = body.workspace if isinstance(body, FrameBody) else None
    camera = json.dumps(body.camera).encode()
    return FrameUpload(body.color, body.depth, camera, workspace, body.options.depth_scale)


def _settings(options: Options) -> Settings:
    return Settings(options.seed, options.n_nearest, options.standoff_m, options.alternatives, options.mask)


def _json(model: Any, status: int = 200) -> Response:
    return Response(model.model_dump_json(by_alias=True), status, media_type="application/json")
