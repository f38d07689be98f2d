import asyncio
import sinew


async def main() -> None:
    async with sinew.register("plot", requires=["knee.drive"]) as me:
        await me.join("exo.ticks")  # each drive sends each of its ticks to this group
        async for message in me:
            if message.value["joint"] == 1 and message.age is not None:
                torque = message.value["torque_nm"] or 0.0
                print(f"{torque:6.1f} Nm {'#' * round(25 + torque / 2):50} {message.age * 1e6:5.0f} us")
                await asyncio.sleep(0.1)  # of a stream only the newest value waits


asyncio.run(main())
