"""Among modules of 2014, which know nothing of sync, claims or leases."""

import asyncio
from typing import Annotated

import pytest

import r2p
from r2p.codecs import management, rtcan
from r2p.msg import PWM2, Led, Velocity3
from r2p.protocols.discovery.events import Mismatched
from r2p.protocols.rtcan.events import Profile
from tests.transports.rtcan.firmware import MESSAGE, Firmware, recorded_data
from tests.transports.rtcan.networks import Lab, until

pytestmark = [pytest.mark.virtual_time, pytest.mark.golden]


async def test_its_topics_arrive_under_the_id_that_it_answers() -> None:
    made = Lab()
    async with Firmware(made.can) as firmware, made.module("PC1") as node:
        samples = node.subscribe("leds", Led).samples()
        data = [(await anext(samples)).data for _ in range(4)]
        assert made.link("PC1").engine.profile is Profile.FIRMWARE
        wanted = [frame.data for frame in recorded_data()]
        assert data in (wanted[:4], wanted[1:5])
        sample = await anext(samples)
        assert sample.source == r2p.Source("IMU1", "", "sim:")
        assert sample.publisher_class is r2p.PublisherClass.SPORADIC
        filters = made.link("PC1").engine.filters()
        assert [each for each in filters if each[1] == rtcan.MESSAGE_MASK] == [rtcan.message_filter(MESSAGE)]
        assert any(isinstance(each, management.SubscribeRequest) for each in firmware.received)
        assert not made.link("PC1").losses


async def test_it_gets_what_it_asks_for_the_latched_value_too() -> None:
    made = Lab()
    async with Firmware(made.can) as firmware, made.module("PC1") as node:
        publisher = node.advertise("cmd", Velocity3, r2p.Sporadic(0.010), latch=True)
        await publisher.publish(Velocity3(x=1.0))
        await until(lambda: firmware.commands)
        await publisher.publish(Velocity3(x=2.0))
        await asyncio.sleep(0.01)
        id8 = made.link("PC1").engine.id8
        assert {rtcan.id8_of(message) for message, _ in firmware.commands} == {id8}
        assert [Velocity3(x=1.0), Velocity3(x=2.0)] == [
            r2p.layout(Velocity3).decode(data) for _, data in firmware.commands
        ]
        assert not made.sent(lambda found: found.laxity == rtcan.HRT)


async def test_management_waits_for_silence() -> None:
    """Each message begins 33 ms after the last frame of management on the bus."""
    made = Lab()
    async with Firmware(made.can), made.module("PC1") as node:
        for number in range(10):
            node.advertise(f"topic{number}", Led)
        await asyncio.sleep(5.0)
        frames = made.sent(lambda found: found.message_id == rtcan.FIRMWARE_MANAGEMENT)
        firsts = [at for at, each in enumerate(frames) if rtcan.decode_identifier(each.frame.id).left == 3]
        ours = [at for at in firsts if frames[at].senders == ("PC1",)]
        assert len(ours) > 20
        assert all(frames[at].start - frames[at - 1].end >= 33_000_000 for at in ours)
        assert not made.sent(lambda found: rtcan.high_byte(found.message_id) == rtcan.MANAGEMENT)


async def test_subscriptions_of_firmware_never_expire_and_those_of_r2p_do() -> None:
    """Both send management with one id: r2p marks its own."""
    made = Lab()
    async with Firmware(made.can, repeats=False) as firmware, made.module("PC1") as alice:
        command, leds = alice.advertise("cmd", Velocity3), alice.advertise("other", PWM2)
        await command.wait_subscriber()
        async with made.module("PC2") as bob:
            subscriber = bob.subscribe("other", PWM2)
            await leds.wait_subscriber()
            await asyncio.sleep(1.0)
            await leds.publish(PWM2(pwm1=5))
            assert await subscriber.fetch(timeout=1.0) == PWM2(pwm1=5)
            made.can.port("PC2").power_off()
            await asyncio.sleep(60.0)
            assert not leds.subscribers
            assert command.subscribers
            await command.publish(Velocity3(w=1.0))
            await asyncio.sleep(0.01)
            assert firmware.commands


async def test_periodic_topics_are_best_effort_and_say_why() -> None:
    made = Lab()
    async with Firmware(made.can), made.module("PC1") as node:
        await asyncio.sleep(2.0)
        publisher = node.advertise("pwm", PWM2, r2p.Periodic(0.010, PWM2))
        await publisher.ready(1.0)
        assert publisher.guarantees["sim:"].startswith("best effort: firmware of 2014 keeps no cycle; soft real-time")
        with pytest.raises(r2p.TransportError, match="firmware"):
            node.advertise("pwm2", PWM2, r2p.Periodic(0.010, PWM2), strict=True)


async def test_stop_of_a_firmware_module_is_what_it_expects() -> None:
    made = Lab()
    async with Firmware(made.can) as firmware, made.module("PC1"):
        await asyncio.sleep(2.0)
        made.host("PC1").command(r2p.Command.STOP, "IMU1")
        await asyncio.sleep(0.2)
        assert management.Stop("IMU1") in firmware.received


class Words(r2p.Message):
    text: Annotated[str, r2p.Max(8)] = ""


async def test_topics_of_variable_length_are_none_for_firmware_and_r2p_says_why() -> None:
    made = Lab()
    async with Firmware(made.can) as firmware, made.module("PC1") as node:
        publisher, subscriber = node.advertise("cmd", Words), node.subscribe("leds", Words)
        events = node.events()
        reasons: dict[str, str] = {}
        while len(reasons) < 2:
            event = await anext(events)
            if isinstance(event, Mismatched):
                reasons[event.topic] = event.describe()
        await publisher.publish(Words(text="twelve"))
        await asyncio.sleep(2.0)
        assert reasons == {
            topic: f"others {what} messages of {size} bytes, here their length varies, which firmware can't send or "
            "receive; use one message type on both sides, or another topic"
            for topic, what, size in (("cmd", "subscribe to", 12), ("leds", "publish", 5))
        }
        announced = management.Advertise | management.SubscribeRequest | management.SubscribeResponse
        assert {each.topic for each in firmware.received if isinstance(each, announced)} <= {"log"}
        assert (firmware.commands, len(subscriber.queue), publisher.subscribers) == ([], 0, 0)
