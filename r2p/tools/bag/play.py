"""`r2p bag play`: publish what was recorded, or play CAN frames onto a bus."""

import asyncio
import contextlib
import math
from collections.abc import Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

import r2p
from r2p.tools.bag.times import End, Start, length, span
from r2p.tools.config import Settings, UsageError, settings
from r2p.tools.options import Via, parse_remap, topic_pattern
from r2p.tools.output import notify
from r2p.tools.session import Session, check_urls, wait_until, while_connected
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.recording.frame_player import FramePlayer
    from r2p.recording.player import Player

MODULE: Final = "play"
"""The name of the module that publishes, unless --name gives another one."""

_LOOK_EVERY: Final = 0.5  # s between two looks for other publishers
_SUBSCRIBED: Final = 1.0  # s in which modules that are there subscribe to what is announced
_OTHERS: Final = 0.2  # ... and the others after the first one
_DRAIN: Final = 1.0  # s for messages that wait for room in a link when all are played
_NAMED_MAX: Final = 5  # topics that a message names


Files = Annotated[
    list[Path],
    typer.Argument(metavar="FILE", help="A recording, a directory of its parts, or a pattern.", show_default=False),
]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topics", "-t", metavar="PATTERN", help="Only these: odometry, 'camera/*' (repeatable)."),
]
Exclude = Annotated[
    list[str] | None, typer.Option("--exclude", metavar="PATTERN", help="Leave these topics out (repeatable).")
]
Remap = Annotated[
    list[str] | None,
    typer.Option("--remap", metavar="OLD:=NEW", help="Publish a topic under another name (repeatable)."),
]
Speed = Annotated[
    float, typer.Option("--rate", "-r", metavar="TIMES", help="Times the speed of the recording: 2, 0.5.")
]
WaitFor = Annotated[
    list[str] | None,
    typer.Option("--wait-for", metavar="TOPIC", help="Begin when this topic has a subscriber (repeatable)."),
]
Anyway = Annotated[
    bool, typer.Option("--anyway", help="Play even if other modules publish these topics, or use this bus.")
]


async def play(
    files: Files,
    *,
    via: Via = None,
    topics: Topics = None,
    exclude: Exclude = None,
    remap: Remap = None,
    start: Start = None,
    end: End = None,
    rate: Speed = 1.0,
    loop: Annotated[bool, typer.Option("--loop", "-l", help="Begin again at the end, until Ctrl-C.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Begin with a pause.")] = False,
    wait_for: WaitFor = None,
    clock: Annotated[bool, typer.Option("--clock", help="Publish the time of the recording: /clock for ROS.")] = False,
    frames: Annotated[bool, typer.Option("--frames", help="Play CAN frames onto the bus of --via instead.")] = False,
    bus: Annotated[str | None, typer.Option("--bus", metavar="NAME", help="With --frames: of this bus.")] = None,
    name: Annotated[str, typer.Option("--name", metavar="MODULE", help="The module that publishes.")] = MODULE,
    anyway: Anyway = False,
) -> None:
    """Publish the messages of a recording at their times.

    They have the bytes, publisher classes and distances of then. At a terminal, space pauses and goes on, . or the
    right arrow plays one message, + and - change the rate.
    """
    from r2p.recording.bag import Bag  # only here, as these take a while
    from r2p.recording.pacing import check_rate
    from r2p.recording.player import PlayOptions

    try:
        check_rate(rate)
    except r2p.MessageError as error:
        raise UsageError(f"--rate: {error}") from error
    chosen = _target(via)
    _check_frames(frames=frames, bus=bus, given={"--topics": topics, "--remap": remap, "--clock": clock})
    with Bag(files) as bag:
        first, last = span((bag.start, bag.end), start, end)
        if frames:
            await _play_frames(bag, chosen, (first, last), bus=bus, rate=rate, loop=loop, paused=paused, anyway=anyway)
            return
        options = PlayOptions(
            topics=_patterns(topics, "--topics"),
            exclude=_patterns(exclude, "--exclude"),
            remap=parse_remap(remap or ()),
            start=first,
            end=last,
            rate=rate,
            loop=loop,
            clock=clock,
        )
        await _play_messages(bag, chosen, options, name, wait_for or [], paused=paused, anyway=anyway)


def _target(via: list[str] | None) -> Settings:
    chosen = settings(via, tool=True)
    if not chosen.via:
        raise UsageError("no network to play on: give --via tcp:HOST:PORT or set R2P_VIA")
    check_urls(chosen.via, chosen.via_source)
    return chosen


def _check_frames(*, frames: bool, bus: str | None, given: dict[str, Any]) -> None:
    if bus is not None and not frames:
        raise UsageError("--bus is a bus of CAN frames: add --frames")
    for option in (each for each, value in given.items() if value and frames):
        raise UsageError(f"{option} is for messages, and --frames plays CAN frames: leave out one of them")


def _patterns(given: list[str] | None, option: str) -> tuple[str, ...]:
    return tuple(topic_pattern(each.removeprefix("/"), option) for each in given or ())


# Messages


async def _play_messages(
    bag: r2p.Bag, chosen: Settings, options: Any, name: str, wait_for: list[str], *, paused: bool, anyway: bool
) -> None:
    from r2p.recording.player import Player

    async with r2p.Module(name, via=chosen.via, aliases=chosen.aliases, watchdog=False) as module:
        player = Player(module, bag, options)
        for topic, why in player.left_out.items():
            notify(f"{topic} is left out: {why}")
        if unknown := [each for each in wait_for if each.removeprefix("/") not in player.topics]:
            raise UsageError(f"--wait-for {unknown[0]}: it is not played; {_named(list(player.topics))} are")
        session = Session(module, chosen)
        if paused:
            player.pacer.pause()
        await while_connected(session, _MessagePlay(session, player, wait_for, anyway=anyway).run())


class _MessagePlay:
    """Plays messages on a network that a user watches."""

    def __init__(self, session: Session, player: "Player", wait_for: list[str], *, anyway: bool) -> None:
        self._session = session
        self._player = player
        self._wait_for = [each.removeprefix("/") for each in wait_for]
        self._anyway = anyway

    async def run(self) -> None:
        from r2p.tools.bag.controls import Controls

        player = self._player
        await self._session.settle()
        self._check_others("is published by", "two publishers of a topic confuse its subscribers")
        async with player:
            await self._wait_for_subscribers()
            controls = Controls(player.pacer, player.start, player.end, player.played.total, "messages")
            began = asyncio.get_running_loop().time()
            try:
                with controls.running():
                    await _first(player.run(), self._watch_others())
                    await wait_until(lambda: not player.waiting, _DRAIN)
            finally:
                self._report(asyncio.get_running_loop().time() - began)

    async def _wait_for_subscribers(self) -> None:
        """Let subscribers find the topics, so that they get the first message; wait for those that the user names."""
        player = self._player
        if await wait_until(lambda: bool(player.subscribed), _SUBSCRIBED):
            await asyncio.sleep(_OTHERS)
        if missing := [each for each in self._wait_for if each not in player.subscribed]:
            with self._session.waiting(f"a subscriber of {_named(missing)}"):
                await wait_until(lambda: set(self._wait_for) <= set(player.subscribed), math.inf)
        elif not player.subscribed:
            notify(
                f"no subscriber of {_named(list(player.topics))} yet: playing anyway; "
                f"--wait-for {next(iter(player.topics))} waits for a subscriber"
            )

    def _check_others(self, verb: str, why: str) -> None:
        others = self._player.other_publishers()
        if not others or self._anyway:
            return
        topic, publishers = next(iter(others.items()))
        more = (
            f", and {len(others) - 1} more topics that are to be played are published as well"
            if len(others) > 1
            else ""
        )
        raise r2p.Error(
            f"{topic} {verb} {', '.join(publishers)}{more}: {why}. Leave it out with --exclude {topic}, publish it "
            f"under another name with --remap {topic}:=recorded/{topic}, or play all the same with --anyway"
        )

    async def _watch_others(self) -> None:
        """End playing when another module begins to publish a topic: it may be what moves the motors."""
        while True:
            await asyncio.sleep(_LOOK_EVERY)
            self._check_others("is now published by", "playing has ended")

    def _report(self, seconds: float) -> None:
        player = self._player
        what = f"{_counted(player.played.total(), 'message')} of {_counted(len(player.played), 'topic')}"
        text = f"played {what} in {length(round(seconds * SECOND))}"
        if player.pacer.put_off:
            text += f", put off by {length(player.pacer.put_off)} as this program or the disk stood still"
        notify(text)
        for topic, reasons in player.missed.items():
            why = ", ".join(f"{number} {reason}" for reason, number in reasons.most_common())
            notify(f"{topic}: not every subscriber got {_counted(reasons.total(), 'message')} ({why})")


def _counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


def _named(topics: list[str]) -> str:
    more = f" and {len(topics) - _NAMED_MAX} more" if len(topics) > _NAMED_MAX else ""
    return ", ".join(topics[:_NAMED_MAX]) + more


async def _first(body: Coroutine[Any, Any, None], guard: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine to its end, or until the other one raises."""
    async with asyncio.TaskGroup() as tasks:
        guarding = tasks.create_task(guard)
        await body
        guarding.cancel()


# CAN frames


async def _play_frames(
    bag: r2p.Bag,
    chosen: Settings,
    window: tuple[int | None, int | None],
    *,
    bus: str | None,
    rate: float,
    loop: bool,
    paused: bool,
    anyway: bool,
) -> None:
    from r2p.recording.frame_player import FramePlayer
    from r2p.recording.pacing import Pacer
    from r2p.tools.bag.controls import Controls

    if len(chosen.via) != 1:
        raise UsageError("--frames plays onto one bus: give one --via, such as rtcan:vcan0")
    start, end = window
    player = FramePlayer(bag, chosen.via[0], bus=bus, start=start, end=end, anyway=anyway)
    pacer = Pacer(asyncio.get_running_loop(), rate=rate)
    if paused:
        pacer.pause()
    last = bag.end if end is None else min(end, bag.end)
    began = asyncio.get_running_loop().time()
    try:
        async with player:
            controls = Controls(pacer, player.start, last, lambda: player.sent, "frames")
            with controls.running():
                await player.run(pacer, loop=loop)
    finally:
        _report_frames(player, asyncio.get_running_loop().time() - began)


def _report_frames(player: "FramePlayer", seconds: float) -> None:
    with contextlib.suppress(r2p.Error):
        notify(f"played {_counted(player.sent, 'frame')} of {player.bus.name} in {length(round(seconds * SECOND))}")
        for reason, number in player.refused.items():
            notify(f"{_counted(number, 'frame')} were not sent: {reason}")
