"""Two generators at two buses with loads of constant power, for a benchmark and the gallery.

Swing equations of the angles and speeds, and algebraic equations of the angles and voltages of the
buses, which balance the flows of active and reactive power. All is per unit.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any


def equations(
    x: list[Any], z: list[Any], u: list[Any], of: ModuleType
) -> tuple[list[Any], list[Any], list[Any]]:
    """Rates, algebraic residuals and outputs, by the sines and cosines of NumPy or CasADi."""
    first, speed, second, other = x
    angle, voltage, far_angle, far_voltage = z
    inner, far = first - angle, second - far_angle
    generated = 1.1 * voltage / 0.3 * of.sin(inner), 1.05 * far_voltage / 0.25 * of.sin(far)
    reactive = (
        (1.1 * voltage * of.cos(inner) - voltage**2) / 0.3,
        (1.05 * far_voltage * of.cos(far) - far_voltage**2) / 0.25,
    )
    both = voltage * far_voltage / 0.5
    sent, kept = both * of.sin(angle - far_angle), both * of.cos(angle - far_angle)
    return (
        [speed, (u[0] - generated[0] - 0.5 * speed) / 0.1,
         other, (u[1] - generated[1] - 0.5 * other) / 0.1],
        [generated[0] - sent - 0.6, reactive[0] - (voltage**2 / 0.5 - kept) - 0.2,
         generated[1] + sent - 0.8, reactive[1] - (far_voltage**2 / 0.5 - kept) - 0.3],
        [voltage, far_angle - angle, speed],
    )
