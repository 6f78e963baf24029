"""Jobs over HTTP: start a declared recipe, show, stop, pause and resume jobs, confirm prompts. The core decides and executes."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from fastapi import FastAPI, Header, HTTPException, Path, Request
from fastapi.responses import JSONResponse, Response

from abbe.service.channel.messages import Answer, Steering
from abbe.service.domain.people import Permission
from abbe.service.domain.progress import JobState
from abbe.service.queries.reader import json_value
from abbe.service.rendering.phrases import phrase
from abbe.service.sequences.recipes.campaigns import named, split_recipe_name
from abbe.service.web.core_link.core_line import CoreLine
from abbe.service.web.formatting import without_commands
from abbe.service.web.frame import current
from abbe.service.web.login.access import needs
from abbe.service.web.login.auth_middleware import Visit
from abbe.service.web.problems import problem
from abbe.service.web.schemas import JobList, NewJob, Problem

STATUS = {"unknown": 404, "busy": 409, "forbidden": 403, "conflict": 409}
NUMBER = Path(pattern="^[0-9a-f]{12}$", description="Number of the job")
PROMPT = Path(ge=1, le=10**6, description="Number of the prompt, from the state of the job")
REFUSALS: dict[int | str, dict[str, object]] = {
    401: {"model": Problem, "description": "No user is logged in"},
    403: {"model": Problem, "description": "The user's role does not allow the request"},
    404: {"model": Problem, "description": "There is no such job"},
    409: {"model": Problem, "description": "The machine is in use; or the job has ended, cannot pause, or waits for another answer"},
    422: {"model": Problem, "description": "There is no such recipe, or the request is not well-formed"},
    429: {"model": Problem, "description": "Too many requests"},
    503: {"model": Problem, "description": "The core or the store does not answer"},
}
ACCEPTED: dict[int | str, dict[str, object]] = {202: {"model": JobState, "description": "Accepted; `Location` is the job"}}


def add_jobs(app: FastAPI, core: CoreLine, recipes: tuple[str, ...], campaigns: tuple[str, ...] = ()) -> None:
    """Add the routes of jobs to the application. ``campaigns``: recipes that end with a proposal."""

    @app.get("/api/v1/jobs", responses=REFUSALS)
    @needs(Permission.READ)
    async def jobs() -> JobList:
        """Jobs since the start of the service, newest first, and the recipes that can be started."""
        return JobList(recipes=recipes, jobs=core.jobs())

    @app.post("/api/v1/jobs", status_code=202, response_model=JobState, responses=ACCEPTED | REFUSALS)
    @needs(Permission.MEASURE)
    async def start(
        request: Request,
        wanted: NewJob,
        key: Annotated[str, Header(alias="Idempotency-Key", max_length=100, description="A repeated key starts no second job")] = "",
    ) -> Response:
        """Run a recipe now; ``identification``, the full campaign, ends with a proposal and also needs the permission ``propose``.

        With ``alarm`` the full campaign also looks for the cause of that alarm: it resumes after the last finished step, or starts anew if
        an earlier search has found an answer. With ``resume`` it keeps the complete runs of an interrupted campaign.
        """
        visit: Visit = request.state.visit
        recipe = named(wanted.recipe, wanted.rate_hz)
        visit.target = f"recipe {recipe}" + (f", alarm {wanted.alarm}" if wanted.alarm else "")
        visit.target += f", resumes {wanted.resume}" if wanted.resume else ""
        # The core knows the role of the user, but not the scopes of a token.
        if split_recipe_name(recipe)[0] in campaigns and Permission.PROPOSE not in visit.principal.permissions:
            return problem(
                403, f"{recipe} ends with a proposal: it needs {Permission.PROPOSE.value!r} as well as {Permission.MEASURE.value!r}"
            )
        answer = await core.start(recipe, key, visit.principal.name, wanted.alarm, wanted.resume)
        if answer.outcome == "unknown":
            return problem(422, answer.text)
        visit.target = f"job {answer.job}, {visit.target}" if answer.job else visit.target
        return answered(core, answer)

    @app.get("/api/v1/jobs/{job}", responses=REFUSALS)
    @needs(Permission.READ)
    async def one(job: Annotated[str, NUMBER]) -> JobState:
        """State of a job."""
        found = _find(core, job)
        if found is None:
            raise HTTPException(404, f"there has been no job {job} since the service started")
        return found

    @app.post("/api/v1/jobs/{job}/prompts/{prompt}/done", status_code=202, response_model=JobState, responses=ACCEPTED | REFUSALS)
    @needs(Permission.MEASURE)
    async def done(request: Request, job: Annotated[str, NUMBER], prompt: Annotated[int, PROMPT]) -> Response:
        """Confirm that a person has carried out a prompt of the job; then the machine moves. Refused (409) if another prompt is open."""
        visit: Visit = request.state.visit
        visit.target = f"job {job}, prompt {prompt}"
        return answered(core, await core.confirm_prompt(job, prompt, visit.principal.name))

    _add_stopping(app, core)


def _add_stopping(app: FastAPI, core: CoreLine) -> None:
    """Add the routes that stop, abort, pause and resume."""

    @app.post("/api/v1/stop", status_code=202, response_model=JobState, responses=ACCEPTED | REFUSALS)
    @needs(Permission.STOP)
    async def stop(request: Request) -> Response:
        """Stop the running job, as ``/api/v1/jobs/{job}/stop`` does. A session that has run out is enough; 409: nothing runs."""
        visit: Visit = request.state.visit
        running = next((job for job in core.jobs() if job.ended_utc is None), None)
        if running is None:
            return problem(409, "no job is running that this service could stop")
        visit.target = f"job {running.id}"
        return answered(core, await core.steer(running.id, "stop", visit.principal.name))

    def add_steering(how: Steering, summary: str) -> None:
        @app.post(
            f"/api/v1/jobs/{{job}}/{how}",
            status_code=202,
            response_model=JobState,
            responses=ACCEPTED | REFUSALS,
            summary=summary,
            operation_id=f"{how}_job",
        )
        @needs(Permission.STOP if how in {"stop", "abort"} else Permission.MEASURE)
        async def steer(request: Request, job: Annotated[str, NUMBER]) -> Response:
            visit: Visit = request.state.visit
            return answered(core, await core.steer(job, how, visit.principal.name))

    add_steering("stop", "Stop at the next safe place; complete runs are kept")
    add_steering("abort", "Stop the axes at once, and end")
    add_steering("pause", "Hold at the next safe place")
    add_steering("resume", "Go on after a pause")


def answered(core: CoreLine, answer: Answer) -> Response:
    """The core's answer as an HTTP response: the state of the job and its address, or a problem."""
    if answer.outcome != "done":
        return problem(STATUS[answer.outcome], answer.text)
    found = _find(core, answer.job)
    if found is None:  # the core keeps the latest jobs only
        return problem(404, f"job {answer.job} is no longer known")
    return JSONResponse(json_value(found), 202, headers={"Location": f"/api/v1/jobs/{answer.job}"})


def _find(core: CoreLine, number: str) -> JobState | None:
    """Return the job with its sentences in the reader's language."""
    found, lang = next((job for job in core.jobs() if job.id == number), None), current().lang
    if found is None:
        return None
    text = phrase(lang, found.text)
    return replace(found, text=without_commands(text) if current().csrf else text, ask=phrase(lang, found.ask))
