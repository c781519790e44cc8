"""A lead battery: its voltage falls with its charge and with the current that is drawn."""

import msgspec


class BatterySpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet. Default: two 12 V, 7.2 Ah batteries in series."""

    capacity: float = 7.2
    """Ah."""
    full: float = 25.6
    """Voltage at rest when it is full, V."""
    empty: float = 23.2
    """Voltage at rest when it is empty, V."""
    resistance: float = 60.0
    """Inside, milliohm."""


class Battery:
    """Charge goes out as current flows; negative current charges it."""

    def __init__(self, spec: BatterySpec | None = None, *, charge: float = 1.0) -> None:
        """`charge` from 0 (empty) to 1 (full)."""
        self.spec = spec or BatterySpec()
        self.charge = charge
        self.current = 0.0
        """That flows out of it now, A."""

    @property
    def voltage(self) -> float:
        """At its terminals, V."""
        spec = self.spec
        rest = spec.empty + (spec.full - spec.empty) * self.charge
        return rest - self.current * spec.resistance * 1e-3

    def step(self, dt: float) -> None:
        """Move on by `dt` seconds at the present current."""
        self.charge = max(0.0, min(1.0, self.charge - self.current * dt / 3600 / self.spec.capacity))
