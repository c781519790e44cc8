"""An infrared range finder of Sharp's GP2Y series, and what the proximity module makes of its voltage.

The voltage falls with the distance, but not linearly: far away a centimetre is hardly more than the noise. The
firmware corrects the non-linearity with the sensor's curve (thesis 7.5.2). Nearer than its shortest range the voltage
falls again, so something very close looks further away: mount it a little inside the robot's outline.
"""

import random

import msgspec

NOTHING = 65535
"""The reading in mm when nothing is in range."""

_ADC = 4095  # counts of 12 bits
_REFERENCE = 3.3  # V


class RangeSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Data sheet. Default: about a GP2Y0A21, 100 to 800 mm."""

    shortest: float = 100.0
    """mm."""
    longest: float = 800.0
    """mm."""
    scale: float = 339.0
    """Of the curve `scale / (distance + offset)`, V mm."""
    offset: float = 47.0
    """mm."""
    noise: float = 3.0
    """Of the voltage, one sigma, mV."""

    def voltage(self, distance: float) -> float:
        """Output at this distance (mm), V; under the shortest one it falls to nothing again."""
        peak = self.scale / (self.shortest + self.offset)
        if distance < self.shortest:
            return peak * distance / self.shortest
        return self.scale / (distance + self.offset)


class RangeFinder:
    """One sensor and its input of the A/D converter."""

    def __init__(self, spec: RangeSpec, noise: random.Random) -> None:
        self.spec = spec
        self._noise = noise

    def read(self, distance: float) -> int:
        """Counts of the A/D converter for something at this distance (mm; infinite: nothing)."""
        voltage = self.spec.voltage(distance) + self._noise.gauss(0, self.spec.noise * 1e-3)
        return max(0, min(_ADC, round(voltage / _REFERENCE * _ADC)))

    def millimetres(self, counts: int) -> int:
        """What the firmware makes of them, by the sensor's curve; NOTHING beyond its longest range."""
        voltage = counts * _REFERENCE / _ADC
        spec = self.spec
        if voltage <= spec.scale / (spec.longest + spec.offset):
            return NOTHING
        return max(0, round(spec.scale / voltage - spec.offset))
