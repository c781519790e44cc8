"""For the tests of programs that use r2p: a pytest plugin, found by pytest by itself.

Mark a test, a class or a module, and its `async def` tests run under virtual time; nothing else has to be configured:

    @pytest.mark.virtual_time
    async def test_the_lease_ends() -> None:
        ...
        await asyncio.sleep(3600)       # takes no time

`@pytest.mark.virtual_time(seed=7)` gives `r2p.clock.random_of()` another seed. A test that can't go on fails within
about a second with `r2p.Deadlock`, which lists what each task waits for; where nodes wake each other for ever, give it
a `limit=` in seconds of virtual time. An exception that nobody awaits, in a
callback or in a forgotten task, fails the test. Works with hypothesis, and next to the plugins of anyio and of
pytest-asyncio.

The fixture `r2p_network` is an in-memory network (`r2p.testing.network.Network`) for the modules of a robot, with
faults on demand, and with nodes for the test to speak through:

    @pytest.mark.virtual_time
    async def test_blink(r2p_network: Network) -> None:
        r2p_network.loss = 0.05
        async with r2p_network.module("IMU1") as imu, r2p_network.node("PC1") as node:
            leds = node.subscribe("leds", Led)
            imu.start(blink)
            assert (await leds.fetch(timeout=5)).value == 1
"""
