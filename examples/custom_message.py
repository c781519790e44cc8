"""A message type of your own: frozen, packed, and the same bytes as a packed C struct of a firmware module.

typedef struct { uint32_t sec, nsec; uint8_t id; char name[8]; float position[3]; uint8_t raw[16]; } MarkerMsg;
"""

from typing import Annotated

import r2p


class Marker(r2p.Message):
    """Something that the camera has seen."""

    stamp: r2p.Timestamp
    """When: required, because it has no default."""
    id: r2p.u8 = 0
    name: Annotated[str, r2p.Len(8)] = ""
    """At most 8 ASCII characters."""
    position: tuple[r2p.f32, r2p.f32, r2p.f32] = (0.0, 0.0, 0.0)
    """In the robot's frame, m."""
    raw: Annotated[tuple[r2p.u8, ...], r2p.Len(16)] = (0,) * 16


async def camera(node: r2p.Node) -> None:
    # latch: a later subscriber gets the last marker at once
    markers = node.advertise("markers", Marker, latch=True)
    stamp = r2p.Timestamp.from_ns(node.now())
    await markers.publish(Marker(stamp, id=7, name="dock", position=(1.5, 0.0, 0.25)))
    try:
        await markers.publish(Marker(stamp, id=300))
    except r2p.MessageError as error:
        print("refused:", error)
    async for _ in node.every(60.0):
        pass


async def show(node: r2p.Node) -> None:
    async for marker in node.subscribe("markers", Marker):
        print(marker.name, marker.id, marker.position)


if __name__ == "__main__":
    shape = r2p.layout(Marker)
    print(f"{shape.size} bytes, fingerprint {shape.fingerprint.hex()}: {shape.schema}")
    r2p.run(show, camera)
