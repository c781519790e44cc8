"""The client of an action: sends goals, and follows each to its end.

    send  ->  send_goal  ->  ClientGoal: its feedback, the states of the status topic, and its result by get_result

One task of the client reads the feedback of all its goals, one the states, and one for each goal waits for its result.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine
from types import TracebackType
from typing import Any, Generic, Self

from r2p.clock import check_timeout, random_of
from r2p.errors import Closed, Error, MessageError, NoServer, ServiceBusy, ServiceError
from r2p.messages import Timestamp
from r2p.ros.action_types import (
    CANCEL_GOAL,
    FEEDBACK,
    GET_RESULT,
    SEND_GOAL,
    STATUS,
    UUID,
    ActionType,
    CancelCode,
    CancelGoal,
    F,
    G,
    GoalAborted,
    GoalCanceled,
    GoalInfo,
    GoalRejected,
    GoalState,
    GoalStatusArray,
    R,
    action_types,
)
from r2p.runtime.node import Node
from r2p.services.server import HandlerOwner

FEEDBACK_MAX = 64
"""Feedback of a goal that waits to be read; with one more, the oldest is lost, and counted."""

_CONNECTED_WITHIN = 1.0  # seconds that the feedback may be found later than the services
_CALL = 1800.0  # seconds that one call for a result waits; then it is called again
_LOOK = 1.0  # seconds between two looks whether the server is still there
_GONE_AFTER = 10  # looks without it in a row
_CANCEL_TIMEOUT = 1.0  # seconds for the cancellation of a goal that nothing waits for any more


class ClientGoal(Generic[G, R, F]):
    """A goal that the server has accepted. Made by `ActionClient.send`.

        async for feedback in goal:      # until the goal has ended
            print(feedback.distance)
        result = await goal.wait()

    With `async with goal:`, the goal is cancelled at the end of the block unless it has ended.
    """

    def __init__(self, client: "ActionClient[G, R, F]", goal_id: bytes, request: G) -> None:
        self.id = goal_id
        """The identifier, 16 bytes."""
        self.request = request
        """The goal itself."""
        self.state = GoalState.UNKNOWN
        """The last state that is known."""
        self.accepted_at = 0
        """When the server accepted the goal, in ns of UTC by its clock."""
        self.lost = 0
        """Feedback that was lost, as nothing read it."""
        self._client = client
        self._feedback: deque[F] = deque()
        self._came = asyncio.Event()
        self._ended: asyncio.Future[tuple[GoalState, R]] = asyncio.get_running_loop().create_future()
        self._ended.add_done_callback(lambda _: self._came.set())

    @property
    def has_ended(self) -> bool:
        """Return whether the goal has ended, or its outcome will stay unknown."""
        return self._ended.done()

    async def __aiter__(self) -> AsyncIterator[F]:
        while True:
            while self._feedback:
                yield self._feedback.popleft()
            if self._ended.done():
                return
            self._came.clear()
            await self._came.wait()

    async def wait(self, timeout: float | None = None) -> R:
        """Wait for the end of the goal, and return its result.

        Raises GoalAborted and GoalCanceled with the server's result, NoServer if the server is gone, ServiceError if it
        does not know the goal any more, Closed if the client is, and TimeoutError after `timeout` seconds: the goal
        goes on then, and `cancel` ends it.
        """
        name = self._client.name
        check_timeout(f"action {name}: the time-out", timeout)
        try:
            async with asyncio.timeout(timeout):
                state, result = await asyncio.shield(self._ended)
        except TimeoutError:
            raise TimeoutError(f"action {name}: the goal has not ended within {timeout:g} s") from None
        if state is GoalState.CANCELED:
            raise GoalCanceled(f"action {name}: the goal was cancelled", result)
        if state is not GoalState.SUCCEEDED:
            raise GoalAborted(f"action {name}: the server has aborted the goal; its log says why", result)
        return result

    async def cancel(self, timeout: float = 1.0) -> bool:
        """Ask the server to cancel the goal; return whether it accepts. `wait` then returns how the goal has ended.

        Raises what calls raise: TimeoutError without an answer, NoServer, ServiceError.
        """
        info = GoalInfo(UUID(self.id), Timestamp())
        return bool(await self._client.cancel_goals(info, timeout))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self.has_ended:
            await self._client.cancel_quietly(self.id)

    # For the client

    def add(self, feedback: F) -> None:
        """Enter feedback for the reader."""
        if len(self._feedback) >= FEEDBACK_MAX:
            self._feedback.popleft()
            self.lost += 1
        self._feedback.append(feedback)
        self._came.set()

    def end(self, state: GoalState, result: R) -> None:
        """Enter the end of the goal."""
        if not self._ended.done():
            self.state = state
            self._ended.set_result((state, result))

    def fail(self, error: Error) -> None:
        """Enter the reason why the outcome of the goal will stay unknown."""
        if not self._ended.done():
            self._ended.set_exception(error)
            self._ended.exception()  # it need not be waited for


class ActionClient(HandlerOwner, Generic[G, R, F]):
    """Sends goals to the server of an action, and follows them. Closed by `close()`, or when its node ends.

        client = ActionClient(node, "dock", Dock)
        result = await client.call(Dock.Goal(speed=0.1), timeout=60.0)

    Several goals may run at the same time. Raises as ActionServer does.
    """

    def __init__(self, node: Node, name: str, action: type[ActionType[G, R, F]]) -> None:
        self.name = node.resolve(name)
        """The name of the action, after remapping."""
        self.types = action_types(action)
        self.goals: dict[bytes, ClientGoal[G, R, F]] = {}
        """The goals that have not ended, by their identifier."""
        self._node = node
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False
        types, name = self.types, self.name
        self._send = node.client(f"{name}/{SEND_GOAL}", types.send_goal)
        self._cancel = node.client(f"{name}/{CANCEL_GOAL}", CancelGoal)
        self._get_result = node.client(f"{name}/{GET_RESULT}", types.get_result)
        self._feedback = node.subscribe(f"{name}/{FEEDBACK}", types.feedback_message, queue=FEEDBACK_MAX, lossy=True)
        self._status = node.subscribe(f"{name}/{STATUS}", GoalStatusArray, lossy=True)
        self._begin(self._read_feedback())
        self._begin(self._read_status())
        node.services[self] = None

    @property
    def servers(self) -> list[str]:
        """The modules that serve the action, as far as they are known."""
        return self._send.servers

    async def ready(self, timeout: float | None = None) -> None:
        """Wait until there is a server, whose feedback comes. Raises TimeoutError after `timeout` seconds, and Closed.

        A server that does not show that it sends feedback is waited for no longer than a second.
        """
        check_timeout(f"action {self.name}: the time-out of ready", timeout)
        try:
            async with asyncio.timeout(timeout):
                for each in (self._send, self._cancel, self._get_result):
                    await each.ready()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._feedback.wait_publisher(), _CONNECTED_WITHIN)
        except TimeoutError:
            raise TimeoutError(f"action {self.name} has no server within {timeout:g} s") from None

    async def send(self, goal: G, timeout: float = 1.0) -> ClientGoal[G, R, F]:
        """Send a goal, and return it once the server has accepted it; it may run for any time after that.

        Raises GoalRejected, NoServer if there is no server, TimeoutError without an answer within `timeout` seconds,
        ServiceError and ServiceBusy, MessageError for a goal or a time-out that is not valid, and Closed. A goal
        that is given up while it is sent is cancelled.
        """
        if self._closed:
            raise self._is_closed()
        if goal.__class__ is not self.types.goal:
            raise MessageError(f"action {self.name} takes {self.types.goal.__name__}, not {type(goal).__name__}")
        goal_id = random_of(self._loop).randbytes(16)
        made = self.goals[goal_id] = ClientGoal(self, goal_id, goal)  # before its first feedback
        request = self.types.send_goal.Request(goal_id=UUID(goal_id), goal=goal)
        try:
            response = await self._send.call(request, timeout=timeout)
        except BaseException as error:
            self.goals.pop(goal_id, None)
            if isinstance(error, TimeoutError | asyncio.CancelledError):  # the server may have it
                await self.cancel_quietly(goal_id)
            if isinstance(error, NoServer):
                raise NoServer(f"action {self.name} has no server: {error}") from None
            raise
        if not response.accepted:
            self.goals.pop(goal_id, None)
            raise GoalRejected(f"action {self.name}: the server has rejected the goal; its log says why")
        made.accepted_at, made.state = response.stamp.ns, max(made.state, GoalState.ACCEPTED)
        self._begin(self._follow(made))
        return made

    async def call(self, goal: G, timeout: float | None = None, on_feedback: Callable[[F], object] | None = None) -> R:
        """Send a goal, and return its result; call `on_feedback(feedback)` meanwhile.

        The end of the time-out (seconds), or of the calling task, cancels the goal. Raises what `send` and
        `ClientGoal.wait` raise.
        """
        check_timeout(f"action {self.name}: the time-out", timeout)
        try:
            async with asyncio.timeout(timeout) as limit, await self.send(goal) as made:
                async for feedback in made:
                    if on_feedback is not None:
                        on_feedback(feedback)
                return await made.wait()
        except TimeoutError:
            if limit.expired():
                raise TimeoutError(
                    f"action {self.name}: the goal has not ended within {timeout:g} s: cancelled"
                ) from None
            raise

    async def cancel_all(self, timeout: float = 1.0) -> int:
        """Cancel all goals of the server, also those of other clients; return how many it cancels."""
        return await self.cancel_goals(GoalInfo(), timeout)

    async def cancel_goals(self, info: GoalInfo, timeout: float) -> int:
        """Cancel the goal with this identifier, those accepted up to this instant, or both; return how many."""
        response = await self._cancel.call(CancelGoal.Request(info), timeout=timeout)
        return len(response.goals_canceling) if response.return_code == CancelCode.NONE else 0

    def stop(self, reason: str) -> list[asyncio.Task[None]]:
        return []  # until the node is closed, its clean-up may cancel goals, and wait for their end

    def close(self) -> None:
        """End the client. Waiting calls raise Closed. The goals themselves go on: cancel them first to end them."""
        if self._closed:
            return
        self._closed = True
        for goal in self.goals.values():
            goal.fail(self._is_closed())
        self.goals.clear()
        for task in self._tasks:
            task.cancel()
        for each in (self._send, self._cancel, self._get_result, self._feedback, self._status):
            each.close()
        self._node.forget(self)

    async def cancel_quietly(self, goal_id: bytes) -> None:
        """Cancel a goal without a waiting caller, once; a failure is only logged."""
        try:
            await self.cancel_goals(GoalInfo(UUID(goal_id)), _CANCEL_TIMEOUT)
        except (TimeoutError, Error) as error:
            self._node.log.warning("action %s: a goal may go on, as it was not cancelled: %s", self.name, error)

    # Tasks

    def _begin(self, body: Coroutine[Any, Any, None]) -> None:
        task = self._loop.create_task(body, name=f"{self._node.module}/{self._node.name} {self.name}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _read_feedback(self) -> None:
        async for message in self._feedback:
            goal = self.goals.get(message.goal_id.uuid)
            if goal is not None:
                goal.add(message.feedback)

    async def _read_status(self) -> None:
        async for message in self._status:
            for each in message.status_list:
                goal = self.goals.get(each.goal_info.goal_id.uuid)
                if goal is not None:
                    goal.state = max(goal.state, _state(each.status))

    async def _follow(self, goal: ClientGoal[G, R, F]) -> None:
        """Wait for the end of a goal."""
        try:
            response = await self._result_of(goal)
            state = _state(response.status)
            if state.is_final:
                goal.end(state, response.result)
            else:
                goal.fail(ServiceError(f"action {self.name}: the server does not know the goal any more"))
        except Error as error:
            goal.fail(error)
        finally:
            self.goals.pop(goal.id, None)

    async def _result_of(self, goal: ClientGoal[G, R, F]) -> Any:
        """Ask for the result of a goal until it is there. Raises NoServer once the server is gone for a while."""
        request = self.types.get_result.Request(goal_id=UUID(goal.id))
        while True:
            call = self._loop.create_task(self._get_result.call(request, timeout=_CALL))
            try:
                await self._until_done(call)
                return call.result()
            except ServiceBusy:
                await asyncio.sleep(_LOOK)
            except TimeoutError:
                pass  # the goal takes longer than one call may
            finally:
                call.cancel()

    async def _until_done(self, call: "asyncio.Task[Any]") -> None:
        missing = 0
        while not call.done():
            await asyncio.wait({call}, timeout=_LOOK)
            missing = 0 if self.servers else missing + 1
            if missing >= _GONE_AFTER and not call.done():
                raise NoServer(
                    f"action {self.name}: its server is gone for {_GONE_AFTER} s; what became of the goal is unknown"
                )

    def _is_closed(self) -> Closed:
        return Closed(f"the client of action {self.name} is closed: make a new one")


def _state(number: int) -> GoalState:
    """Return a state that came from a wire."""
    return GoalState(number) if 0 <= number <= max(GoalState) else GoalState.UNKNOWN
