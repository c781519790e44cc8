"""Types of actions of ROS 2: those that a program gives, and those of the services and topics made of them.

    class Fibonacci(r2p.ros.Action, name="test_msgs/Fibonacci"):
        class Goal(r2p.Message): ...
        class Result(r2p.Message): ...
        class Feedback(r2p.Message): ...

| topic or service of an action NAME | type |
| --- | --- |
| service `NAME/_action/send_goal` | `test_msgs/action/Fibonacci_SendGoal`: goal_id, goal; accepted, stamp |
| service `NAME/_action/cancel_goal` | `action_msgs/CancelGoal`: goal_info; return_code, goals_canceling |
| service `NAME/_action/get_result` | `test_msgs/action/Fibonacci_GetResult`: goal_id; status, result |
| topic `NAME/_action/feedback` | `test_msgs/action/Fibonacci_FeedbackMessage`: goal_id, feedback |
| topic `NAME/_action/status`, latched | `action_msgs/GoalStatusArray` |
"""

import enum
import functools
from typing import Annotated, Any, ClassVar, Generic, Protocol, TypeVar, get_type_hints

import msgspec

from r2p.errors import Error, MessageError
from r2p.messages import Len, Max, Message, Nested, Timestamp, i8, layout, show
from r2p.messages.definition import TYPE_NAME, MessageMeta
from r2p.messages.layouts import full_name
from r2p.services.definition import Service, name_nested

SEND_GOAL, CANCEL_GOAL, GET_RESULT = "_action/send_goal", "_action/cancel_goal", "_action/get_result"
FEEDBACK, STATUS = "_action/feedback", "_action/status"
"""What follows after the name of an action, and a slash, in the names of its services and topics."""

G = TypeVar("G", bound=Message)
R = TypeVar("R", bound=Message)
F = TypeVar("F", bound=Message)
G_co = TypeVar("G_co", bound=Message, covariant=True)
R_co = TypeVar("R_co", bound=Message, covariant=True)
F_co = TypeVar("F_co", bound=Message, covariant=True)

GOALS_MAX = 256
"""Goals in one message of the status topic, or in the answer to a cancellation."""

_PARTS = ("Goal", "Result", "Feedback")


class Action:
    """The base of classes that name the three types of an action:

        class Dock(r2p.ros.Action, name="dock_msgs/Dock"):
            class Goal(r2p.Message):
                speed: r2p.f32 = 0.1

            class Result(r2p.Message):
                voltage: r2p.f32 = 0.0

            class Feedback(r2p.Message):
                distance: r2p.f32 = 0.0

    The name is the type's in ROS 2, by default package and class. `r2p msg import` makes such a class of a .action
    file.
    """

    _full_name: ClassVar[str]
    """With the kind: `dock_msgs/action/Dock`."""

    def __init_subclass__(cls, name: str = "", **options: Any) -> None:
        """Name the nested classes after the action. Raises MessageError for what is not a full name."""
        super().__init_subclass__(**options)
        name = name.replace("/action/", "/") or full_name(cls)
        if not TYPE_NAME.fullmatch(name) or name.count("/") > 1:
            raise MessageError(f"{cls.__name__}: {name!r} is not the full name of an action, such as dock_msgs/Dock")
        cls._full_name = name.replace("/", "/action/")
        for part in _PARTS:
            name_nested(cls, part, f"{cls._full_name}_{part}")


class ActionType(Protocol[G_co, R_co, F_co]):
    """A class with nested classes Goal, Result and Feedback, as type checkers see it."""

    @property
    def Goal(self) -> type[G_co]:  # noqa: N802 - the name of the nested class
        """The class of goals."""

    @property
    def Result(self) -> type[R_co]:  # noqa: N802
        """The class of results."""

    @property
    def Feedback(self) -> type[F_co]:  # noqa: N802
        """The class of feedback."""


class GoalState(enum.IntEnum):
    """The state of a goal, by its number in ROS 2. The last three are final."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6

    @property
    def is_final(self) -> bool:
        """Return whether the goal has ended."""
        return self >= GoalState.SUCCEEDED


class CancelCode(enum.IntEnum):
    """The answer to a cancellation."""

    NONE = 0
    """Goals are being cancelled."""
    REJECTED = 1
    UNKNOWN_GOAL = 2
    TERMINATED = 3
    """The goal has ended."""


class GoalRejected(Error):
    """A goal that the server rejected; the reason is in the server's log."""


class GoalAborted(Error):
    """A goal that its server has given up: raised by the handler, and by `ClientGoal.wait`.

    `result` is what was reached until then: of the type of results; None stands for one of zeros.
    """

    def __init__(self, text: str, result: Message | None = None) -> None:
        super().__init__(text)
        self.result: Any = result


class GoalCanceled(Error):
    """A goal that was cancelled; `result` is what was reached until then."""

    def __init__(self, text: str, result: Message) -> None:
        super().__init__(text)
        self.result: Any = result


class UUID(Message, name="unique_identifier_msgs/UUID"):
    """The identifier of a goal, which its client makes up; of zeros: all goals."""

    uuid: Annotated[bytes, Len(16)] = bytes(16)


class GoalInfo(Message, name="action_msgs/GoalInfo"):
    """A goal, and when it was accepted; in a cancellation: all goals accepted up to then."""

    goal_id: UUID = UUID()
    stamp: Timestamp = Timestamp()


class GoalStatus(Message, name="action_msgs/GoalStatus"):
    """A goal and its state, a GoalState."""

    goal_info: GoalInfo = GoalInfo()
    status: i8 = 0


class GoalStatusArray(Message, name="action_msgs/GoalStatusArray"):
    """The states of all goals of a server that run, or have ended lately."""

    status_list: Annotated[tuple[GoalStatus, ...], Max(GOALS_MAX)] = ()


class CancelGoal(Service, name="action_msgs/CancelGoal"):
    """Cancels goals of an action."""

    class Request(Message):
        """Which goals; zeros in both: all."""

        goal_info: GoalInfo = GoalInfo()

    class Response(Message):
        """What is being cancelled now; `return_code` is a CancelCode."""

        return_code: i8 = 0
        goals_canceling: Annotated[tuple[GoalInfo, ...], Max(GOALS_MAX)] = ()


class ActionTypes(msgspec.Struct, Generic[G, R, F], frozen=True, eq=False):
    """The types of an action: the given ones, those of its two services, and the message with feedback."""

    name: str
    goal: type[G]
    result: type[R]
    feedback: type[F]
    send_goal: Any
    get_result: Any
    feedback_message: Any


@functools.lru_cache(maxsize=256)
def action_types(action: type[ActionType[G, R, F]]) -> ActionTypes[G, R, F]:
    """Return the types of an action. Raises MessageError if a nested class is missing."""
    goal, result, feedback = (_nested(action, part) for part in _PARTS)
    name: str = getattr(action, "_full_name", None) or full_name(action).replace("/", "/action/")
    send_goal = _service(f"{name}_SendGoal", {"goal_id": UUID, "goal": goal}, {"accepted": bool, "stamp": Timestamp})
    get_result = _service(f"{name}_GetResult", {"goal_id": UUID}, {"status": i8, "result": result})
    message = _message(f"{name}_FeedbackMessage", {"goal_id": UUID, "feedback": feedback})
    return ActionTypes(name.replace("/action/", "/"), goal, result, feedback, send_goal, get_result, message)


def with_names(cls: type[Message], name: str = "") -> type[Message]:
    """Return a class with ROS's names for the types in it, if it is a part of an action that was learnt by its fields.

    These name no types. `name` is the full name of the class, if it was learnt as a part of another one.
    """
    name = name or layout(cls).name
    for known in (GoalStatusArray, CancelGoal.Request, CancelGoal.Response):
        if layout(known).name == name and layout(known).schema == layout(cls).schema:
            return known
    action, _, part = name.rpartition("_")
    action = action.removesuffix("_SendGoal").removesuffix("_GetResult")
    nested = {"goal": "Goal", "result": "Result", "feedback": "Feedback"}
    if "/action/" not in name or part not in ("Request", "Response", "FeedbackMessage"):
        return cls
    hints: dict[str, Any] = {}
    for field in layout(cls).fields:
        inner = field.shape.layout.cls if isinstance(field.shape, Nested) else None
        if field.name == "goal_id" and inner is not None and layout(inner).schema == layout(UUID).schema:
            hints[field.name] = UUID
        elif field.name in nested and inner is not None and "/action/" not in layout(inner).name:
            hints[field.name] = _renamed(inner, f"{action}_{nested[field.name]}")
    return _renamed(cls, name, hints) if hints else cls


def _renamed(cls: type[Message], name: str, hints: dict[str, Any] = {}) -> Any:  # noqa: B006 - not changed
    """Return a class with these fields under another name; `hints` are other types of some of them."""
    return _message(name, get_type_hints(cls, include_extras=True) | hints)


def _nested(action: Any, part: str) -> Any:
    found = getattr(action, part, None)
    if isinstance(found, type) and issubclass(found, Message):
        return found
    shown = action.__name__ if isinstance(action, type) else show(action)
    raise MessageError(f"action {shown} lacks a message class {part}: nest `class {part}(r2p.Message)` in it")


def _service(name: str, request: dict[str, Any], response: dict[str, Any]) -> Any:
    parts = {"Request": _message(f"{name}_Request", request), "Response": _message(f"{name}_Response", response)}
    return type(name.rpartition("/")[2], (Service,), parts)


def _message(name: str, fields: dict[str, Any]) -> Any:
    members = {"__annotations__": fields, "__module__": __name__}
    return MessageMeta(name.rpartition("/")[2], (Message,), members, name=name)
