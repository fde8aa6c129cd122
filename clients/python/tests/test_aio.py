"""The client for asyncio against `ecaxis serve` on the simulated bus."""

import asyncio
import pathlib
import time

import ecaxis
import ecaxis.aio
import pytest

ROOT = pathlib.Path(__file__).resolve().parents[3]
DEMO = ROOT / "configs/demo.toml"


def test_motions_end_together_and_errors_say_why():
    async def program():
        async with ecaxis.aio.open(DEMO, virtual=True) as machine:
            with pytest.raises(ecaxis.Refused, match="x: move to 10: .*enable"):
                await machine.x.move(10.0)
            await machine.enable()
            await asyncio.gather(machine.x.move(30.0), machine.y.move(-10.0, speed=0.2))
            await machine.sleep(0.2)
            assert abs((await machine.x.state())["position"] - 30.0) < 0.01
            assert abs((await machine["y"].state())["position"] + 10.0) < 0.01
            with pytest.raises(ecaxis.Refused, match="outside the range"):
                await machine.x.move(1000.0)
            with pytest.raises(AttributeError, match="no axis `z`; it has x, y"):
                machine.z
            await machine.x.move_by(-5.0)
            recording = await machine.record(["x.position"], seconds=0.2)
            assert recording.missed == 0 and len(recording.time_ns) >= 199
            with pytest.raises(KeyError):
                await machine.input("x", "none")
            await machine.disable()
            assert not (await machine.x.state())["enabled"]

    asyncio.run(program())


def test_inputs_of_the_simulation_are_switched():
    async def program():
        async with ecaxis.aio.open(ROOT / "configs/pick-and-place.toml", virtual=True) as machine:
            for value in (True, False):
                await machine.set_input("start", value)
                await machine.sleep(0.05)
                assert await machine.input("io", "Input 5") == value
            with pytest.raises(ecaxis.EcaxisError, match="Output 8"):
                await machine.set_input("lamp")

    asyncio.run(program())


def test_a_command_that_replaces_another_ends_it():
    async def program():
        async with ecaxis.aio.open(DEMO, sim=True) as machine:
            await machine.enable()
            first = asyncio.create_task(machine.x.move(50.0, speed=0.1))
            await machine.sleep(0.3)
            await machine.x.move(0.0)
            with pytest.raises(ecaxis.Failed, match="x: move to 50"):
                await first
            events = machine.events()
            await machine.stop()
            with pytest.raises(ecaxis.TimedOut):
                await machine.connection.request("await", bus="down", timeout=0.1)
            await events.aclose()

    asyncio.run(program())


def test_a_blocked_event_loop_loses_the_lease():
    async def program():
        async with ecaxis.aio.open(DEMO, sim=True, lease=0.3) as machine:
            await machine.enable()
            move = asyncio.create_task(machine.x.move(50.0, speed=0.02))
            # While the loop runs, the lease is kept.
            await asyncio.sleep(1.0)
            assert not move.done()
            time.sleep(1.5)
            with pytest.raises(ecaxis.EcaxisError):
                await move
            with pytest.raises(ecaxis.NotOwner):
                await machine.x.move(0.0)
            assert (await machine.x.state())["position"] < 40.0

    asyncio.run(program())


def test_a_server_that_ends_is_reported():
    async def program():
        async with ecaxis.aio.open(DEMO, sim=True) as machine:
            await machine.enable()
            move = asyncio.create_task(machine.x.move(50.0, speed=0.02))
            ended = asyncio.create_task(_until_the_end(machine))
            await asyncio.sleep(0.3)
            async with ecaxis.aio.attach(machine._path, take=False) as other:
                assert (await other.state())["bus"]["state"] == "op"
                other.connection._writer.close()
            machine.connection._writer.close()
            with pytest.raises(ecaxis.ConnectionLost):
                await move
            await asyncio.wait_for(ended, 5)
            with pytest.raises(ecaxis.ConnectionLost):
                await machine.state()
        with pytest.raises(ecaxis.ConnectionLost, match="cannot connect"):
            async with ecaxis.aio.attach("/nowhere.sock"):
                pass
        with pytest.raises(ecaxis.StartFailed, match="cannot read"):
            async with ecaxis.aio.open(ROOT / "none.toml", sim=True):
                pass

    asyncio.run(program())


async def _until_the_end(machine):
    async for _ in machine.events():
        pass
