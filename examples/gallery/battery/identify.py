"""Identify the cell's open-circuit voltage and its two-RC equivalent circuit.

Run ``python -m examples.gallery.battery.identify --data DIR``. It reads the C/20 test and the HPPC
test and writes ``samsung_30t.json``; it never sees a drive cycle.

1. OCV(SOC) is the C/20 discharge, plus what the current of 0.15 A takes from it, by the resistances
   found below. Charge is left out: the cell has hysteresis, it rests 10 to 20 mV lower where it was
   discharged, and this is the side on which a car uses it. (The counter also finds 3 % more on
   charge.)
2. With tau_j given, the voltage of the circuit

       v_j' = (R_j(SOC) I - v_j) / tau_j,    V = OCV + v1 + v2 + R0(SOC) I

   is linear in the tables R0, R1 and R2. They follow from least squares over the HPPC record in
   steps of 1 s, with R >= 0 and a small weight on second differences.
3. The counters of the two tests do not agree: the SOC of the HPPC record is taken as
   1 + kappa Ah / Q. kappa, and tau_1 and tau_2 on a logarithmic grid, leave the smallest misfit.
   kappa is a nuisance; what is shipped refers to the capacity of the C/20 discharge.
"""

import argparse
import datetime
import json
import sys
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import lsq_linear, minimize_scalar
from scipy.signal import lfilter

from ..command import DataError
from .measurements import C20, DOI, HPPC, Array, load, resample

KNOTS = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
GRID = np.linspace(0.0, 1.0, 1001)
POINTS = 101  # of OCV(SOC) in the file
FAST, SLOW = np.geomspace(3.0, 30.0, 7), np.geomspace(150.0, 1500.0, 7)  # s
TARGET = Path(__file__).with_name("samsung_30t.json")
# A second difference of 5 mOhm weighs as much as ten minutes at 5 mV.
ROUGHNESS = np.sqrt(600.0)
ROUNDS = 3  # kappa, time constants and OCV in turn


class Fit(NamedTuple):
    """Tables (rows R0, R1, R2 in Ohm), residuals (T,) in V and their weighted RMS."""

    tables: Array
    residuals: Array
    misfit: float


def c20_discharge(folder: Path) -> tuple[float, Array, Array]:
    """The capacity (A h), and voltage (V) and current (A) on `GRID`."""
    raw = load(folder, C20)
    discharging = raw.current < -0.01
    charge, voltage = raw.charge[discharging], raw.voltage[discharging]
    order = np.argsort(charge, kind="stable")
    soc = (charge[order] - charge.min()) / np.ptp(charge)
    # Smoothed over 0.5 % SOC, a few of the file's samples, for a slope without their noise;
    # the odd continuation keeps the slopes at both ends.
    padded = np.pad(np.interp(GRID, soc, voltage[order]), 50, mode="reflect", reflect_type="odd")
    smooth = gaussian_filter1d(padded, 5.0)[50:-50]
    return float(-charge.min()), smooth, np.full(GRID.size, np.median(raw.current[discharging]))


class Pulses:
    """The discharging part of the HPPC record in steps of 1 s.

    Parameters
    ----------
    folder : Path
        Where the data are.
    capacity : float
        A h.
    """

    def __init__(self, folder: Path, capacity: float) -> None:
        raw = load(folder, HPPC)
        empty = int(np.argmin(raw.charge)) + 1  # behind it the cell is charged again
        record = resample(type(raw)(*(x[:empty] for x in raw)), 1.0)
        self.current = record.current[:, 0]
        self._used = 0.5 * (record.charge[1:] + record.charge[:-1]) / capacity
        self.scale(1.0)
        self.voltage = record.voltage[:, 0]
        # An hour of rest tells no more than its beginning, pulses of 12C are beyond what a
        # car does often, and the last ones, below the lowest knot, are left out.
        active = np.convolve(np.abs(self.current) > 0.1, np.ones(301))[: self.soc.size] > 0.5
        weight = np.where(active, 1.0, 0.1) * np.where(np.abs(self.current) > 30.0, 0.3, 1.0)
        self.weight = np.where(self.soc > KNOTS[0], weight, 0.0)

    def scale(self, kappa: float) -> None:
        """Take the counted charge times kappa."""
        self.soc = 1.0 + kappa * self._used
        self.hats = np.array([np.interp(self.soc, KNOTS, row) for row in np.eye(KNOTS.size)]).T

    def fit(self, tau: tuple[float, float], ocv: Array) -> Fit:
        """Tables and misfit with these time constants (s) and this OCV (V, on `GRID`)."""
        drop = self.voltage - np.interp(self.soc, GRID, ocv)
        driven = self.hats * self.current[:, None]
        columns = [driven]
        for decay in np.exp(-1.0 / np.array(tau)):
            # The mean over the step of what v_j' does under a constant current.
            held = (1.0 - decay) / -np.log(decay)
            columns.append(held * lfilter([0.0, 1.0 - decay], [1.0, -decay], driven, axis=0)
                           + (1.0 - held) * driven)
        X = np.hstack(columns)
        root = np.sqrt(self.weight)[:, None]
        bend = np.diff(np.eye(KNOTS.size), 2, axis=0) * ROUGHNESS
        smooth = np.kron(np.eye(3), bend)
        # Triangular factors of the tall matrix: the bounded problem then has few rows.
        tall = np.hstack([X, drop[:, None]]) * root
        triangle = np.asarray(np.linalg.qr(tall, mode="r"))
        A = np.vstack([triangle[:, :-1], smooth])
        b = np.concatenate([triangle[:, -1], np.zeros(len(smooth))])
        found = lsq_linear(A, b, (0.0, np.inf)).x
        residuals = drop - X @ found
        misfit = np.sqrt(np.average(residuals**2, weights=self.weight))
        return Fit(found.reshape(3, -1), residuals, float(misfit))


def identify(folder: Path) -> dict[str, Any]:
    """The contents of the parameter file.

    Parameters
    ----------
    folder : Path
        Where the data are.

    Raises
    ------
    DataError
        If they are not, or not what they should be.
    """
    capacity, voltage, current = c20_discharge(folder)
    pulses = Pulses(folder, capacity)
    taus = [(float(fast), float(slow)) for fast, slow in product(FAST, SLOW)]
    ocv, best, kappa = voltage, taus[len(taus) // 2], 1.0

    def misfit(factor: float) -> float:
        pulses.scale(factor)
        return pulses.fit(best, ocv).misfit

    for _ in range(ROUNDS):
        kappa = float(minimize_scalar(
            misfit, bounds=(0.95, 1.05), method="bounded", options={"xatol": 1e-4}
        ).x)
        pulses.scale(kappa)
        fits = {tau: pulses.fit(tau, ocv) for tau in taus}
        best = min(taus, key=lambda tau: fits[tau].misfit)
        fit = fits[best]
        ocv = voltage - current * np.interp(GRID, KNOTS, fit.tables.sum(axis=0))
    shipped = np.interp(np.linspace(0.0, 1.0, POINTS), GRID, ocv)
    return {
        "cell": "Samsung INR21700-30T, 3 Ah, 25 degC",
        "provenance": {
            "data": "P. Kollmeyer, M. Skells, Samsung INR21700 30T 3Ah Li-ion Battery Data, "
                    "McMaster University, Mendeley Data",
            "doi": DOI,
            "files": [C20, HPPC],
            "script": "examples/gallery/battery/identify.py",
            "date": datetime.date.today().isoformat(),
        },
        "capacity_Ah": round(capacity, 4),
        "ocv": {"soc": [0.0, 1.0], "V": shipped.round(4).tolist()},
        "circuit": {
            "soc": KNOTS.tolist(),
            "R0_Ohm": fit.tables[0].round(5).tolist(),
            "R1_Ohm": fit.tables[1].round(5).tolist(),
            "R2_Ohm": fit.tables[2].round(5).tolist(),
            "tau_s": [round(best[0], 2), round(best[1], 1)],
        },
        "hppc_charge_factor": round(kappa, 4),
        "misfit_V": {
            "weighted_rms": round(fit.misfit, 5),
            **{f"rms_{drawn}A": round(rms(pulses, fit, drawn), 5) for drawn in (3, 6, 18, 36)},
        },
    }


def rms(pulses: Pulses, fit: Fit, amperes: float) -> float:
    """The misfit (V) while this current is drawn."""
    drawn = (np.abs(pulses.current + amperes) < 0.1) & (pulses.weight > 0.0)
    return float(np.sqrt(np.mean(fit.residuals[drawn] ** 2)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the .mat files")
    parser.add_argument("--out", type=Path, default=TARGET, help="the parameter file")
    arguments = parser.parse_args()
    try:
        found = identify(arguments.data)
    except DataError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    text = json.dumps(found, indent=1)
    arguments.out.write_text(text + "\n", encoding="utf-8")
    print(f"tau {found['circuit']['tau_s']} s, misfit {found['misfit_V']}\n{arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
