"""Draw time-indices.svg, the picture of how-to/delay-and-time-indices.md, beside this file."""

from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

INK, FAINT, BLUE, ORANGE, GREEN = "0.3", "0.75", "#0072B2", "#D55E00", "#009E73"
MEASUREMENT, STATE, TIME = 2.0, 1.0, 0.0
# Positions of t+1-N, t+2-N, (dots), t-2, t-1, t, t+1.
TICKS = {0: "t+1-N", 1: "t+2-N", 3: "t-2", 4: "t-1", 5: "t", 6: "t+1"}

with rc_context({"font.size": 10.0, "text.color": INK, "svg.hashsalt": "qpmhe"}):
    figure = Figure(figsize=(7.6, 3.6), layout="constrained")
    panel = figure.subplots()
    panel.set_axis_off()
    panel.set_xlim(-1.75, 7.0)
    panel.set_ylim(-0.55, 2.85)

    panel.plot([-0.4, 6.6], [TIME, TIME], color=FAINT, linewidth=0.8, zorder=1)
    for k, label in TICKS.items():
        panel.plot([k, k], [TIME, MEASUREMENT], color="0.9", linewidth=0.8, zorder=0)
        panel.plot([k, k], [TIME - 0.06, TIME + 0.06], color=INK, linewidth=0.8)
        panel.text(k, TIME - 0.14, label, ha="center", va="top")
    for row in (MEASUREMENT, STATE, TIME - 0.22):
        panel.text(2, row, "···", ha="center", va="center", color="0.5")

    known = [k for k in TICKS if k < 6]
    panel.plot(known, [MEASUREMENT] * len(known), "s", color=INK, markersize=7)
    panel.plot(6, MEASUREMENT, "s", color="white", markeredgecolor=FAINT, markersize=7)
    panel.text(6, MEASUREMENT + 0.15, "not yet", ha="center", va="bottom", color="0.5")
    panel.text(5, MEASUREMENT + 0.15, "newest: y(t)", ha="center", va="bottom")

    arrow = {"arrowstyle": "-|>", "color": FAINT, "shrinkA": 6, "shrinkB": 6, "linewidth": 0.9}
    for k in range(6):
        panel.annotate("", (k + 1, STATE), (k, STATE), arrowprops=arrow, zorder=1)
    for k in known:
        panel.annotate("", (k, STATE), (k, MEASUREMENT), arrowprops=arrow, zorder=1)
    panel.plot([0, 1], [STATE] * 2, "o", color=INK, markersize=8)
    panel.plot(4, STATE, "o", color=INK, markersize=8)
    for k, color, label in (
        (3, GREEN, "trajectory[-4]"), (5, BLUE, "filtered"), (6, ORANGE, "state"),
    ):
        panel.plot(k, STATE, "o", color=color, markersize=10, zorder=3)
        panel.text(k + 0.05, STATE - 0.17, label, ha="left", va="top", color=color)
    panel.text(-0.07, STATE - 0.17, "prior z(t+1-N)\nacts here", ha="right", va="top", color="0.5")

    for row, label in (
        (MEASUREMENT, "measurements"), (STATE, "trajectory"), (TIME, "time index"),
    ):
        panel.text(-0.55, row, label, ha="right", va="center")
    panel.text(
        2.9, 2.7, "after update(y(t)), with a full window of N samples", ha="center", va="center"
    )

    out = Path(__file__).with_name("time-indices.svg")
    figure.savefig(out, metadata={"Date": None})
print("wrote", out.name)
