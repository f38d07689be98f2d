"""A drive that its node starts and restarts: `sinew-node bindings/python/examples/drive.toml`."""

import asyncio
import os

import sinew


# ANCHOR: drive
@sinew.payload("demo.joint_angle", class_="stream", expires_after=0.02)
class JointAngle:
    degrees: float


async def main() -> None:
    # The node sets SINEW_SOCKET and SINEW_NAME. Nobody else can register this name.
    async with sinew.register(os.environ["SINEW_NAME"], handles=[JointAngle]) as me:
        print("the drive is homed")  # a line of the node's log
        await me.ready()
        async for message in me:
            if message.is_kind(JointAngle):
                print(f"{message.value.degrees} degrees")
            else:
                message.settle(sinew.Outcome.REJECTED_UNKNOWN_KIND)


asyncio.run(main())
# ANCHOR_END: drive
