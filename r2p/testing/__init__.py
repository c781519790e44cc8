"""Test programs that use r2p: a pytest plugin, which pytest finds by itself.

Mark a test, a class or a module, and its `async def` tests run under virtual time, without further configuration:

    @pytest.mark.virtual_time
    async def test_the_lease_ends() -> None:
        ...
        await asyncio.sleep(3600)       # takes no time

`@pytest.mark.virtual_time(seed=7)` sets the seed of `r2p.clock.random_of()`. A test that can't make progress fails
within about a second with `r2p.Deadlock`, which lists what each task waits for; if nodes wake each other forever, set a
`limit=` in seconds of virtual time. An unhandled exception in a callback, or in a task that is not awaited, fails the
test. The plugin works with hypothesis, and next to the plugins of anyio and pytest-asyncio.

The fixture `r2p_network` is an in-memory network (`r2p.testing.network.Network`) for the modules of a robot, with
faults on demand, and with nodes for the test itself:

    @pytest.mark.virtual_time
    async def test_blink(r2p_network: Network) -> None:
        r2p_network.loss = 0.05
        async with r2p_network.module("IMU1") as imu, r2p_network.node("PC1") as node:
            leds = node.subscribe("leds", Led)
            imu.start(blink)
            assert (await leds.fetch(timeout=5)).value == 1

The fixture `exact_bus` is a CAN bus in software, exact to the bit (`r2p.testing.exact_bus.ExactBus`), for programs that
use python-can: with arbitration, error frames, and faults on demand. It works in ordinary tests, too, in real time:

    def test_a_disturbed_frame_is_sent_again(exact_bus: ExactBus) -> None:
        motor, panel = exact_bus.open("motor"), exact_bus.open("panel")
        exact_bus.disturb_next(sender=motor)
        motor.send(can.Message(arbitration_id=0x123))
        assert panel.recv(1.0).arbitration_id == 0x123
        assert len(exact_bus.errors) == 1

`r2p.testing.play` plays a recording to nodes, under virtual time and by the clock of the recording:

    @pytest.mark.virtual_time
    async def test_odometry() -> None:
        playback = await r2p.testing.play("drive.mcap", forward_kinematics)
        assert playback.outputs["odometry"] == playback.recorded["odometry"]
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from r2p.testing.playback import Playback as Playback
    from r2p.testing.playback import play as play


def __getattr__(name: str) -> Any:
    """Import what plays recordings when it is used: pytest loads this package in every session."""
    if name not in ("Playback", "play"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import r2p

    getattr(r2p, "Bag")  # noqa: B009 - raises BagError where the extra is not installed
    from r2p.testing import playback

    return getattr(playback, name)
