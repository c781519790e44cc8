"""The server of an action: runs its handler for each goal, in a task of its own.

    send_goal    ->  check  ->  accepted  ->  handler(goal)  ->  its result, which get_result waits for
    cancel_goal  ->  the handler is cancelled, and may clean up

Everything travels by three services and two topics of the node (`r2p.ros.action_types`), over any link of r2p.
"""

import asyncio
import functools
import inspect
import logging
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, Generic, TypeAlias

from r2p.clock import clock_of
from r2p.errors import Error, MessageError
from r2p.log_lines import LineLimit
from r2p.messages import Timestamp, layout
from r2p.ros.action_types import (
    CANCEL_GOAL,
    FEEDBACK,
    GET_RESULT,
    GOALS_MAX,
    SEND_GOAL,
    STATUS,
    UUID,
    ActionType,
    CancelCode,
    CancelGoal,
    F,
    G,
    GoalAborted,
    GoalInfo,
    GoalState,
    GoalStatus,
    GoalStatusArray,
    R,
    action_types,
)
from r2p.runtime.node import Node
from r2p.services.server import HandlerOwner, ServiceServer
from r2p.units import SECOND

LIMIT = 8
"""Goals that run at the same time, by default."""

RESULT_KEPT = 60.0
"""Seconds for which the result of a goal that has ended can be asked for."""

_RESULTS_MAX = 1024  # that are kept, of goals that have ended
_ASKING_MAX = 1024  # requests for results that wait at the same time
_LOG_LINES = 5  # a second about goals that are rejected, or that fail


class ServerGoal(Generic[G, R, F]):
    """A goal that a server has accepted: the argument of the handler."""

    def __init__(
        self, goal_id: bytes, request: G, accepted_at: int, send: Callable[[F], Coroutine[Any, Any, None]]
    ) -> None:
        self.id = goal_id
        """The identifier, 16 bytes that the client made up."""
        self.request = request
        """The goal itself."""
        self.info = GoalInfo(UUID(goal_id), Timestamp.from_ns(accepted_at))
        """The identifier, and when the goal was accepted."""
        self.state = GoalState.ACCEPTED
        self.can_cancel = True
        """False as long as clients may not cancel the goal: the handler sets it."""
        self.ended = asyncio.Event()
        """Set once the goal has ended."""
        self.ended_at = 0  # monotonic ns
        self.result: R | None = None
        """The result, when the goal has ended."""
        self.task: asyncio.Task[None] | None = None
        self.reason = ""
        """The reason why the server itself ends the goal."""
        self._send = send

    async def feedback(self, message: F) -> None:
        """Send feedback to the client. Raises MessageError for a message of another type, and Closed."""
        await self._send(message)


Handler: TypeAlias = Callable[[ServerGoal[G, R, F]], Coroutine[Any, Any, R]]
"""A coroutine function that takes a goal and returns the result."""

Check: TypeAlias = Callable[[G], str | None]
"""Returns None for a goal to accept, else why it is rejected."""


class ActionServer(HandlerOwner, Generic[G, R, F]):
    """Serves an action: `handler(goal)`, a coroutine function, works on a goal and returns its result.

        async def dock(goal: ServerGoal[Dock.Goal, Dock.Result, Dock.Feedback]) -> Dock.Result:
            while (distance := measure()) > 0:
                await goal.feedback(Dock.Feedback(distance))
                await drive(goal.request.speed)
            return Dock.Result(voltage=12.6)

        ActionServer(node, "dock", Dock, dock)
        await node.spin()

    A goal that its client cancels has its handler cancelled: it may clean up, and return a result nevertheless, for a
    client that asks. What the handler raises aborts the goal: a GoalAborted is a line of the log, anything else a
    traceback. With the end of its node, each goal is aborted.

    `check(request)` returns None, or a text that says why a goal is rejected. At most `limit` goals run at the same
    time. One more is rejected; with `preempt` it aborts the oldest one, and starts when that one has cleaned up.

    Raises InvalidName or NameTooLong for the name, MessageError for a type or limit that is not valid, TypeMismatch if
    a topic has another type, Error if the handler is not a coroutine function or the module serves the action already,
    and Closed once the node has ended.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        action: type[ActionType[G, R, F]],
        handler: Handler[G, R, F],
        *,
        check: Check[G] | None = None,
        limit: int = LIMIT,
        preempt: bool = False,
    ) -> None:
        self.name = node.resolve(name)
        """The name of the action, after remapping."""
        self.types = action_types(action)
        self.limit = _check_limit(self.name, limit)
        """Goals that run at the same time, at most."""
        self.goals: dict[bytes, ServerGoal[G, R, F]] = {}
        """The goals that run, or have ended lately, by their identifier, in order."""
        self._node = node
        self._handler = _check_handler(self.name, handler)
        self._check = check
        self._preempt = preempt
        self._loop = asyncio.get_running_loop()
        self._clock = clock_of(self._loop)
        self._waiting: deque[ServerGoal[G, R, F]] = deque()
        self._ending = ""
        self._closed = False
        self._log_limit = LineLimit(_LOG_LINES)
        node.services[self] = None  # before its services: it ends before them
        self._feedback = node.advertise(f"{self.name}/{FEEDBACK}", self.types.feedback_message)
        self._status = node.advertise(f"{self.name}/{STATUS}", GoalStatusArray, latch=True)
        self._services: list[ServiceServer[Any, Any]] = []
        try:
            self._serve()
        except BaseException:
            self.close()
            raise

    def _serve(self) -> None:
        serve, types, name = self._node.serve, self.types, self.name
        self._services.append(serve(f"{name}/{GET_RESULT}", types.get_result, self._get_result, limit=_ASKING_MAX))
        self._services.append(serve(f"{name}/{CANCEL_GOAL}", CancelGoal, self._cancel_goal))
        self._services.append(serve(f"{name}/{SEND_GOAL}", types.send_goal, self._send_goal))

    @property
    def running(self) -> list[ServerGoal[G, R, F]]:
        """The goals whose handler runs, in order."""
        return [each for each in self.goals.values() if each.task is not None and not each.ended.is_set()]

    def stop(self, reason: str) -> list[asyncio.Task[None]]:
        self._ending = self._ending or reason
        for goal in list(self._waiting):
            self._abort(goal, reason)
        running = self.running
        for goal in running:
            self._abort(goal, reason)
        return [goal.task for goal in running if goal.task is not None]

    def close(self) -> None:
        """End the action: abort running goals, and stop answering requests."""
        if self._closed:
            return
        self.stop("its server was closed")
        self._closed = True
        for service in self._services:
            service.close()
        self._feedback.close()
        self._status.close()
        self._node.forget(self)

    # Goals

    async def _send_goal(self, request: Any) -> Any:
        """Accept or reject a goal."""
        goal_id, now = request.goal_id.uuid, self._node.now()
        refusal = self._refusal(goal_id, request.goal)
        if refusal:
            self._log(logging.WARNING, "rejected", f"goal rejected: {refusal}")
            return self.types.send_goal.Response(accepted=False, stamp=Timestamp.from_ns(now))
        goal: ServerGoal[G, R, F] = ServerGoal(goal_id, request.goal, now, self._sender(request.goal_id))
        self._forget_old()
        self.goals[goal_id] = goal
        self._waiting.append(goal)
        self._publish_status()
        present = [each for each in self.goals.values() if not each.ended.is_set() and not each.reason]
        if len(present) > self.limit:
            self._abort(present[0], "another goal takes its place")
        self._start_next()
        return self.types.send_goal.Response(accepted=True, stamp=goal.info.stamp)

    def _refusal(self, goal_id: bytes, request: G) -> str | None:
        """Return why a goal is rejected; None or empty if it is not."""
        if self._ending:
            return self._ending
        if goal_id in self.goals:
            return f"there is already a goal {goal_id.hex()}"
        if self._check is not None:
            try:
                reason = self._check(request)
            except Exception as error:  # noqa: BLE001 - the user's code may raise anything
                self._log(logging.ERROR, "check", f"check failed: {error!r}", error)
                return f"its check failed: {error!r}"
            if reason:
                return reason
        if len(self.running) >= self.limit and not self._preempt:
            return (
                f"{self.limit} goals run already: raise limit=, or let a goal take the place of another by preempt=True"
            )
        return None

    def _sender(self, goal_id: UUID) -> Callable[[F], Coroutine[Any, Any, None]]:
        """Return the function that sends feedback of a goal."""
        types, publisher = self.types, self._feedback

        async def send(message: F) -> None:
            if message.__class__ is not types.feedback:
                wanted = types.feedback.__name__
                raise MessageError(f"action {self.name}: feedback is a {wanted}, not {type(message).__name__}")
            await publisher.publish(types.feedback_message(goal_id=goal_id, feedback=message))

        return send

    def _start_next(self) -> None:
        while self._waiting and len(self.running) < self.limit:
            goal = self._waiting.popleft()
            name = f"{self._node.module}/{self._node.name} {self.name}"
            goal.task = self._loop.create_task(self._run(goal), name=name)
            goal.task.add_done_callback(functools.partial(self._never_begun, goal))

    def _never_begun(self, goal: ServerGoal[G, R, F], _task: "asyncio.Task[None]") -> None:
        """End a goal whose task was cancelled before its first step."""
        if not goal.ended.is_set():
            self._end(goal, self._state_of_cancelled(goal), None)

    async def _run(self, goal: ServerGoal[G, R, F]) -> None:
        """Run the handler of a goal to its end."""
        state, result = GoalState.ABORTED, None
        try:
            self._set_state(goal, GoalState.EXECUTING)
            result = await self._handler(goal)
            self._check_result(result)
            state = self._state_of_cancelled(goal) if self._is_cancelled(goal) else GoalState.SUCCEEDED
        except asyncio.CancelledError:
            state = self._state_of_cancelled(goal)
            if not self._is_cancelled(goal):
                self._log(logging.ERROR, "failed", "goal aborted: something that its handler awaited was cancelled")
        except GoalAborted as error:
            result = error.result
            self._log(logging.WARNING, "failed", f"goal aborted: {error}")
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            result = None
            self._log(logging.ERROR, "failed", f"goal aborted: {type(error).__name__}: {error}", error)
        self._end(goal, state, result)

    def _is_cancelled(self, goal: ServerGoal[G, R, F]) -> bool:
        return bool(goal.reason) or goal.state is GoalState.CANCELING

    def _state_of_cancelled(self, goal: ServerGoal[G, R, F]) -> GoalState:
        """Return the state in which a goal ends that was cancelled: by its client, or by the server itself."""
        return GoalState.CANCELED if goal.state is GoalState.CANCELING and not goal.reason else GoalState.ABORTED

    def _check_result(self, result: object) -> None:
        if result.__class__ is not self.types.result:
            wanted = self.types.result.__name__
            raise MessageError(f"the handler returned {type(result).__name__}, not {wanted}")
        self.types.get_result.Response(status=0, result=result).encode()  # raises for what can't be sent

    def _set_state(self, goal: ServerGoal[G, R, F], state: GoalState) -> None:
        goal.state = state
        self._publish_status()

    def _end(self, goal: ServerGoal[G, R, F], state: GoalState, result: Any) -> None:
        kind = self.types.result
        goal.result = result if result.__class__ is kind else layout(kind).zero
        goal.ended_at = self._clock.monotonic()
        goal.ended.set()
        self._set_state(goal, state)
        if goal in self._waiting:
            self._waiting.remove(goal)
        if not self._ending:
            self._start_next()

    def _abort(self, goal: ServerGoal[G, R, F], reason: str) -> None:
        """End a goal for a reason of the server's own."""
        if not goal.reason:
            goal.reason = reason
            self._log(logging.INFO, "aborted", f"goal aborted: {reason}")
            self._end_handler(goal)

    def _end_handler(self, goal: ServerGoal[G, R, F]) -> None:
        """Cancel the handler of a goal; one that waits for its turn ends at once."""
        if goal.task is not None:
            goal.task.cancel()
        else:
            self._end(goal, self._state_of_cancelled(goal), None)

    def _forget_old(self) -> None:
        """Forget goals that ended long ago, or too many of them."""
        now, ended = self._clock.monotonic(), [each for each in self.goals.values() if each.ended.is_set()]
        for place, goal in enumerate(reversed(ended)):
            if place >= _RESULTS_MAX or now - goal.ended_at > RESULT_KEPT * SECOND:
                del self.goals[goal.id]

    # Cancellation and results

    async def _cancel_goal(self, request: CancelGoal.Request) -> CancelGoal.Response:
        """Cancel one goal, those accepted up to an instant, or all."""
        code, chosen = self._chosen(request.goal_info.goal_id.uuid, request.goal_info.stamp.ns)
        cancelled = [each for each in chosen if each.can_cancel]
        if chosen and not cancelled:
            code = CancelCode.REJECTED
        for goal in cancelled:
            self._set_state(goal, GoalState.CANCELING)
            self._end_handler(goal)
        return CancelGoal.Response(code, tuple(each.info for each in cancelled[:GOALS_MAX]))

    def _chosen(self, goal_id: bytes, before: int) -> tuple[CancelCode, list[ServerGoal[G, R, F]]]:
        """Return the goals that a cancellation is for: by identifier, or accepted up to an instant, or both; else all.

        Without a goal of that identifier that can still be cancelled, return why.
        """
        active = [each for each in self.goals.values() if not each.ended.is_set() and not self._is_cancelled(each)]
        if not any(goal_id):
            return CancelCode.NONE, [each for each in active if not before or each.info.stamp.ns <= before]
        chosen = [each for each in active if each.id == goal_id or each.info.stamp.ns <= before]
        if any(each.id == goal_id for each in chosen):
            return CancelCode.NONE, chosen
        return CancelCode.TERMINATED if goal_id in self.goals else CancelCode.UNKNOWN_GOAL, chosen

    async def _get_result(self, request: Any) -> Any:
        """Wait for the end of a goal; return state UNKNOWN for an unknown one."""
        goal, response = self.goals.get(request.goal_id.uuid), self.types.get_result.Response
        if goal is None:
            return response(status=GoalState.UNKNOWN, result=layout(self.types.result).zero)
        try:
            await goal.ended.wait()
        except asyncio.CancelledError:
            if not self._ending:
                raise
            await goal.ended.wait()  # the node ends, and its goals have yet to clean up
        return response(status=goal.state, result=goal.result)

    # Reports

    def _publish_status(self) -> None:
        if self._closed:
            return
        latest = list(self.goals.values())[-GOALS_MAX:]
        self._status.publish_nowait(GoalStatusArray(tuple(GoalStatus(each.info, each.state) for each in latest)))

    def _log(self, level: int, kind: str, text: str, error: Exception | None = None) -> None:
        """Log what any client can cause any number of times a second."""
        suffix = self._log_limit.suffix(kind, self._clock.monotonic())
        if suffix is not None:
            self._node.log.log(level, "action %s: %s%s", self.name, text, suffix, exc_info=error)


def _check_handler(name: str, handler: Handler[G, R, F]) -> Handler[G, R, F]:
    """Return the handler. Raises Error unless it is a coroutine function."""
    if not (inspect.iscoroutinefunction(handler) or inspect.iscoroutinefunction(getattr(handler, "__call__", None))):  # noqa: B004 - looked into, not called
        shown = getattr(handler, "__name__", None) or repr(handler)
        raise Error(f"action {name}: the handler {shown} is not a coroutine function: write `async def`")
    return handler


def _check_limit(name: str, limit: int) -> int:
    if limit.__class__ is not int or limit < 1:
        raise MessageError(f"action {name}: limit is a number of goals, 1 or more, not {limit!r}")
    return limit
