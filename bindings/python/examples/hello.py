"""Two applications of one program: a drive that answers, and a sensor that sends to it and asks.

Run it at a node, with its socket in $SINEW_SOCKET: `python bindings/python/examples/hello.py`
"""

import asyncio

import sinew


# ANCHOR: types
@sinew.payload("demo.joint_angle", class_="stream", expires_after=0.02)
class JointAngle:
    degrees: float


@sinew.payload("demo.get_angle")
class GetAngle:
    pass
# ANCHOR_END: types


# ANCHOR: drive
async def drive(me: sinew.AsyncEndpoint) -> None:
    angle = JointAngle(0.0)
    async for message in me:
        if message.is_kind(JointAngle):
            angle = message.value
        elif message.is_kind(GetAngle):
            await me.reply(message, angle)
        else:
            message.settle(sinew.Outcome.REJECTED_UNKNOWN_KIND)
# ANCHOR_END: drive


# ANCHOR: sensor
async def sensor() -> None:
    # Returns when the drive is ready.
    async with sinew.register("knee.sensor", requires=["knee.drive"]) as me:
        to = await me.resolve("knee.drive")
        assert to is not None, "it was required"
        for number in range(10):
            await me.send(to, JointAngle(number / 2))
            await asyncio.sleep(0.01)  # the period of the stream
        reply = await me.ask(to, GetAngle(), within=1.0)
        print(f"the drive is at {reply.value.degrees} degrees, {reply.age * 1e6:.0f} us ago")
        outcome = await me.send_confirmed(to, "demo.unknown", {})
        print(f"{outcome.name}: {outcome.text}")
# ANCHOR_END: sensor


# ANCHOR: main
async def main() -> None:
    async with sinew.register("knee.drive") as me:
        driving = asyncio.create_task(drive(me))
        await sensor()
        driving.cancel()
        await asyncio.gather(driving, return_exceptions=True)


asyncio.run(main())
# ANCHOR_END: main
