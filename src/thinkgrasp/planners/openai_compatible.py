"""The planner that asks a vision-language model: GPT-4o as in the paper, and whatever speaks chat.completions.

Whatever the model or its server does, `plan` returns a plan that holds for the scene: the model's own, once mended
where need be, or the offline planner's; `Plan.degraded` says which and why.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

from thinkgrasp.errors import ConfigError, MissingDependency
from thinkgrasp.memory import Memory
from thinkgrasp.planners.offline import OfflinePlanner, Search
from thinkgrasp.planners.parsing import PlanParseError, parse_reply
from thinkgrasp.planners.prompts import Prompt, Style, marks_prompt, paper_prompt, point_prompt, to_frame
from thinkgrasp.planners.vlm.accounting import PriceList, Spending
from thinkgrasp.planners.vlm.cassette import Recording, Replay
from thinkgrasp.planners.vlm.chat import Answer, Chat, Detail, Mute, Question, Unanswered
from thinkgrasp.planners.vlm.patience import Backoff, CircuitBreaker
from thinkgrasp.planners.vlm.support import UnsupportedPlan, check_box, freed, on_scene
from thinkgrasp.selection import middle_cell
from thinkgrasp.types import Degradation, Plan, Scene, Usage

OnBudget = Literal["stop", "offline"]

PAPER_IMAGE_WH = (224, 224)
MARKS_IMAGE_WIDTH = 640
MAX_TOLD_CHARS = 400
"""So much of what is wrong with a reply is told, to the model and in a plan."""


class OpenAIPlanner:
    """Ask a vision-language model what to take, where, and why.

    Args:
        model: Name of the model at its server.
        base_url: Address of a server that speaks chat.completions, up to and with /v1; None = OpenAI.
        key_env: Name of the environment variable with the API key. None = OPENAI_API_KEY for OpenAI, and no key for
            any other server.
        key_file: File that holds the key alone; goes before the environment.
        style: "marks" draws numbers on the proposals and lists them; "paper" sends the plain image, as the paper did;
            "point" does so and asks for the pixel to grasp at, for a segmenter that takes it ("plan_point").
        grid: Cells per side of the target's box.
        image_width: Width of the image sent [px], its height by the frame's shape; None = 640 for marks, and
            224 x 224 for the other styles.
        detail: How closely OpenAI's models look at the image; "auto" is not sent.
        clear_first: In the marks style, take what depth shows to hide or to rest on the model's choice before it.
        request_timeout_s: For each request.
        decision_timeout_s: For all requests and waits of one plan.
        retries: How often a failed request is repeated.
        breaker_failures: After so many failed requests in a row the server is left alone ...
        breaker_rest_s: ... for this long, then tried with one request.
        budget_usd: Once so much is spent by this planner, which is made anew for every episode, the model is asked no
            more; None = no limit.
        on_budget: Then "stop": the plan says so and the episode ends; or "offline": the offline planner goes on.
        prices: TOML file or mapping {model: {input, output}} in dollars per million tokens, over the built-in prices.
        record: Cassette to write every question and answer to.
        replay: Cassette to answer from, without a network or a key.
        fallback: Plan with the offline planner where the model gives no usable plan; else such a plan is not `found`.
        search: Where the fallback looks for a goal that is not seen, as in OfflinePlanner; with "all", a model that
            says that nothing is left is overruled while there is something to clear.
        without_key: "offline" = where no key or server is named and OPENAI_API_KEY is not set, ask no model: every
            plan is the fallback's, and says so.
        search: Where the fallback looks for a goal that is not seen, as in OfflinePlanner.
        temperature: Of the model's sampling; None = the server's own.
        seed: Of the random part of waits.
        clock: Monotonic [s].
        sleep: Waits [s].

    Raises:
        ConfigError: A setting is out of range, the key that is named is not there, or a cassette cannot be used.
        MissingDependency: The openai package is not installed.
    """

    def __init__(
        self,
        *,
        model: str = "gpt-4o",
        base_url: str | None = None,
        key_env: str | None = None,
        key_file: str | Path | None = None,
        style: Style = "marks",
        grid: int = 3,
        image_width: int | None = None,
        detail: Detail = "auto",
        clear_first: bool = True,
        request_timeout_s: float = 30,
        decision_timeout_s: float = 60,
        retries: int = 3,
        breaker_failures: int = 5,
        breaker_rest_s: float = 60,
        budget_usd: float | None = None,
        on_budget: OnBudget = "stop",
        prices: str | Path | Mapping[str, object] | None = None,
        record: str | Path | None = None,
        replay: str | Path | None = None,
        fallback: bool = True,
        without_key: Literal["error", "offline"] = "error",
        search: Search = "piles",
        temperature: float | None = 0,
        seed: int = 0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        _require(isinstance(model, str) and bool(model.strip()), f"model must name a model, got {model!r}")
        _require(style in get_args(Style), f"style must be one of {', '.join(get_args(Style))}, got {style!r}")
        _require(detail in get_args(Detail), f"detail must be one of {', '.join(get_args(Detail))}, got {detail!r}")
        _require(
            on_budget in get_args(OnBudget),
            f"on_budget must be one of {', '.join(get_args(OnBudget))}, got {on_budget!r}",
        )
        _require(without_key in ("error", "offline"), f"without_key must be error or offline, got {without_key!r}")
        _within("grid", grid, 1, 15, whole=True)
        _within("image_width", image_width, 64, 4096, whole=True, optional=True)
        _within("request_timeout_s", request_timeout_s, 0.001, 3600)
        _within("decision_timeout_s", decision_timeout_s, 0.001, 3600)
        _within("retries", retries, 0, 20, whole=True)
        _within("breaker_failures", breaker_failures, 1, 1000, whole=True)
        _within("breaker_rest_s", breaker_rest_s, 0, 3600)
        _within("budget_usd", budget_usd, 0, 1e6, optional=True)
        _within("temperature", temperature, 0, 2, optional=True)
        _require(record is None or replay is None, "record and replay exclude one another; set one of them")
        self.model = model
        self.style: Style = style
        self.grid = grid
        self.image_width = image_width
        self.detail: Detail = detail
        self.clear_first = clear_first
        self.decision_timeout_s = decision_timeout_s
        self.budget_usd = budget_usd
        self.on_budget: OnBudget = on_budget
        self.temperature = temperature
        self.spent = Spending()
        """What this planner spent so far."""
        self._fallback = OfflinePlanner(grid=grid, search=search) if fallback else None
        self._is_told_to_clear = search == "all"
        self._clock = clock
        price_list = PriceList.load(prices)
        self._price = price_list.of(model)
        if budget_usd is not None and self._price is None:
            raise ConfigError(
                f"openai planner: budget_usd is set, but the price of model {model!r} is not known; "
                f"give it in prices, for example {{{model!r}: {{'input': 2.5, 'output': 10}}}}"
            )
        if replay is not None:
            self._chat: Chat = Replay(replay)
            return
        unnamed = base_url is None and key_env is None and key_file is None
        if without_key == "offline" and unnamed and "OPENAI_API_KEY" not in os.environ:
            self._chat = Mute("no model is asked, as the environment variable OPENAI_API_KEY is not set")
            return
        self._chat = _server(
            base_url=base_url,
            key_env=key_env,
            key_file=key_file,
            request_timeout_s=request_timeout_s,
            retries=retries,
            backoff=Backoff(seed=seed),
            breaker=CircuitBreaker(failures=breaker_failures, rest_s=breaker_rest_s, clock=clock),
            clock=clock,
            sleep=sleep,
        )
        if record is not None:
            self._chat = Recording(self._chat, record)

    def close(self) -> None:
        """Close connections and files; they are closed with the object otherwise."""
        self._chat.close()

    def plan(self, scene: Scene, instruction: str, memory: Memory) -> Plan:
        """Return the model's plan, checked against the scene, or the fallback's.

        Raises:
            ConfigError: In replay, the cassette does not hold the request; in recording, it cannot be written.
        """
        prompt, notes = self._prompt(scene, instruction, memory)
        talk = _Talk(notes)
        try:
            plan = self._agree(prompt, scene, instruction, memory, talk)
        except _OutOfBudget as failure:
            if self.on_budget == "stop":
                plan = replace(self._no_plan(failure.reason, "the episode ends"), out_of_budget=True)
            else:
                plan = self._without_model(scene, instruction, memory, failure.reason)
        except Unanswered as failure:
            plan = self._without_model(scene, instruction, memory, failure.reason)
        return replace(plan, degraded=(*talk.notes, *plan.degraded), usage=talk.usage(self.model))

    def _prompt(self, scene: Scene, instruction: str, memory: Memory) -> tuple[Prompt, list[Degradation]]:
        notes: list[Degradation] = []
        if self.style == "marks" and scene.proposals:
            width = self.image_width or MARKS_IMAGE_WIDTH
            return marks_prompt(scene, instruction, memory, grid=self.grid, image_width=width), notes
        if self.style == "marks":
            notes.append(Degradation("plan", "the scene holds no proposals to mark", "the paper's prompt"))
        image_wh = PAPER_IMAGE_WH
        if self.image_width is not None:
            h, w = scene.frame.depth.shape
            image_wh = (self.image_width, max(round(self.image_width * h / w), 1))
        if self.style == "point":
            return point_prompt(scene, instruction, image_wh=image_wh), notes
        return paper_prompt(scene, instruction, memory, grid=self.grid, image_wh=image_wh), notes

    def _agree(self, prompt: Prompt, scene: Scene, instruction: str, memory: Memory, talk: _Talk) -> Plan:
        """Ask, and ask once more where the reply cannot be used; raise Unanswered where that does not help."""
        deadline = self._clock() + self.decision_timeout_s
        question = Question(
            self.model,
            prompt.system,
            prompt.text,
            prompt.image,
            schema=prompt.schema,
            temperature=self.temperature,
            detail=self.detail,
        )
        answer = self._ask(question, deadline, talk)
        try:
            plan = self._usable(answer, prompt, scene, memory)
            if (doubt := self._doubt(plan, scene, instruction, memory)) is None:
                return plan
            problem = _shortened(doubt)
        except (PlanParseError, UnsupportedPlan) as error:
            problem = _shortened(str(error))
        talk.notes.append(Degradation("plan", f"the reply could not be used: {problem}", "asked to mend it"))
        answer = self._ask(question.again(answer.text, problem), deadline, talk)
        try:
            plan = self._usable(answer, prompt, scene, memory)
        except (PlanParseError, UnsupportedPlan) as error:
            raise Unanswered(f"nor could the mended reply be used: {_shortened(str(error))}") from None
        if self._is_told_to_clear and self._doubt(plan, scene, instruction, memory) is not None:
            raise Unanswered("the model says again that nothing is left to take")
        return plan

    def _ask(self, question: Question, deadline: float, talk: _Talk) -> Answer:
        if self.budget_usd is not None and (self.spent.usd is None or self.spent.usd >= self.budget_usd):
            spent = "an unknown sum is" if self.spent.usd is None else f"{self.spent.usd:.4f} USD are"
            raise _OutOfBudget(f"the budget of {self.budget_usd:g} USD allows no more requests: {spent} spent")
        try:
            answer = self._chat.ask(question, deadline)
        except Unanswered as failure:
            self._count(Spending(requests=failure.requests, latency_s=failure.latency_s), talk)
            raise
        self._count(Spending.of(answer, self._price), talk)
        talk.model = answer.model
        talk.notes.extend(answer.notes)
        if self._price is not None and (answer.prompt_tokens is None or answer.completion_tokens is None):
            reason = "the server does not say how many tokens it used"
            talk.notes.append(Degradation("plan", reason, "cost unknown"))
        if answer.refusal is not None:
            raise Unanswered(f"the model refuses: {_shortened(answer.refusal)}")
        return answer

    def _count(self, spending: Spending, talk: _Talk) -> None:
        self.spent += spending
        talk.spent += spending

    def _usable(self, answer: Answer, prompt: Prompt, scene: Scene, memory: Memory) -> Plan:
        """Return the plan of a reply, in the frame's pixels; raise PlanParseError or UnsupportedPlan."""
        image_wh = (prompt.image.shape[1], prompt.image.shape[0])
        plan = parse_reply(answer.text, grid=self.grid, image_wh=image_wh)
        check_box(plan, image_wh)
        if prompt.style == "point" and plan.found and plan.point_px is None:
            raise UnsupportedPlan(f"it names no grasp pixel for {plan.target!r}")
        plan = on_scene(to_frame(plan, prompt), scene, memory)
        return freed(plan, scene, memory) if prompt.style == "marks" and self.clear_first else plan

    def _doubt(self, plan: Plan, scene: Scene, instruction: str, memory: Memory) -> str | None:
        """Return what speaks against a plan that says that nothing is left to take; None where nothing does."""
        if plan.found or self._fallback is None:
            return None
        other = self._fallback.plan(scene, instruction, memory)
        if not other.found:
            return None
        shown = f"mark {other.mark}: {other.rationale}" if self.style == "marks" else other.target
        return f"it takes nothing, but there is something to take, for example {shown}"

    def _no_plan(self, reason: str, instead: str) -> Plan:
        rationale, cell = f"the vision-language model gave no plan: {reason}", middle_cell(self.grid)
        degraded = (Degradation("plan", reason, instead),)
        return Plan("", rationale, grid=self.grid, cell=cell, found=False, degraded=degraded)

    def _without_model(self, scene: Scene, instruction: str, memory: Memory, reason: str) -> Plan:
        if self._fallback is None:
            return self._no_plan(reason, "no plan, as the fallback is off")
        plan = self._fallback.plan(scene, instruction, memory)
        return replace(plan, degraded=(Degradation("plan", reason, "the offline planner"), *plan.degraded))


class _OutOfBudget(Unanswered):
    """Nothing more may be spent."""


class _Talk:
    """What one plan took, and what went wrong on the way."""

    def __init__(self, notes: list[Degradation]) -> None:
        self.notes = notes
        self.spent = Spending()
        self.model: str | None = None

    def usage(self, asked: str) -> Usage:
        return self.spent.usage(self.model or asked)


def _server(
    *,
    base_url: str | None,
    key_env: str | None,
    key_file: str | Path | None,
    request_timeout_s: float,
    retries: int,
    backoff: Backoff,
    breaker: CircuitBreaker,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> Chat:
    try:
        from thinkgrasp.planners.vlm.endpoint import Endpoint, read_key
        from thinkgrasp.planners.vlm.server import ChatServer
    except ModuleNotFoundError as error:
        if error.name not in ("openai", "httpx2"):
            raise
        raise MissingDependency("openai", "vlm", "the openai planner") from None
    return ChatServer(
        Endpoint(base_url=base_url, key=read_key(key_env=key_env, key_file=key_file, base_url=base_url)),
        request_timeout_s=request_timeout_s,
        retries=retries,
        backoff=backoff,
        breaker=breaker,
        clock=clock,
        sleep=sleep,
    )


def _require(holds: bool, rule: str) -> None:
    if not holds:
        raise ConfigError(f"openai planner: {rule}")


def _within(
    name: str, value: object, least: float, most: float, *, whole: bool = False, optional: bool = False
) -> None:
    kind = int if whole else int | float
    in_range = isinstance(value, kind) and not isinstance(value, bool) and least <= value <= most
    number = "a whole number" if whole else "a number"
    _require(
        in_range or (optional and value is None), f"{name} must be {number} within {least:g}..{most:g}, got {value!r}"
    )


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_TOLD_CHARS else text[: MAX_TOLD_CHARS - 3] + "..."
