"""Pictures of numbers: the learning curve of a run and the bar charts of the tests."""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # files only: works without a display
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402


def learning_curve(progress: Path, picture: Path) -> None:
    """Draws the run's progress.csv: return, speed against the command, episode length, sigma and KL over steps."""
    with open(progress, newline="") as file:
        rows = [row for row in csv.DictReader(file) if None not in row and None not in row.values()]  # the whole ones
    column = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    steps = column["steps"] / 1e6
    figure, axes = plt.subplots(2, 2, figsize=(9, 5.5), sharex=True, layout="constrained")
    panels = {
        "return of an episode": ["episode_return"],
        "forward speed [m/s]": ["speed", "commanded_speed"],
        "length of an episode [s]": ["episode_seconds"],
        "sigma of the actions, KL of an update": ["sigma", "kl"],
    }
    for axis, (title, names) in zip(axes.flat, panels.items()):
        for name in names:
            known = ~np.isnan(column[name])
            axis.plot(steps[known], column[name][known], linewidth=1.2, label=name.replace("_", " "))
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.3)
        if len(names) > 1:
            axis.legend(fontsize=8, frameon=False)
    for axis in axes[1]:
        axis.set_xlabel("env steps [million]")
    save_figure(figure, picture)


def bar_charts(
    panels: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]], cases: list[str], picture: Path, title: str
) -> None:
    """One panel a quantity, one group of bars a case, one bar a method.

    panels: {axis label: {method: (means, standard deviations), each in the order of `cases`}}.
    """
    figure, axes = plt.subplots(1, len(panels), figsize=(5.2 * len(panels), 3.8), layout="constrained", squeeze=False)
    for axis, (label, methods) in zip(axes[0], panels.items()):
        width = 0.8 / len(methods)
        for i, (method, (mean, deviation)) in enumerate(methods.items()):
            x = np.arange(len(cases)) + (i - (len(methods) - 1) / 2) * width
            axis.bar(x, mean, width, yerr=deviation, capsize=2, label=method, error_kw={"linewidth": 0.8})
        axis.set_xticks(np.arange(len(cases)), [case.replace(" (", "\n(") for case in cases], fontsize=8)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=min(0, axis.get_ylim()[0]))
        axis.grid(axis="y", alpha=0.3)
    if len(methods) > 1:
        axes[0, -1].legend(fontsize=8, frameon=False, loc="lower right")
    else:
        title = f"{title}, {', '.join(methods)}"
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def ratio_bands(rows: list[dict], picture: Path, title: str) -> None:
    """PPO's ratio against the dropout rate, a band for each way to treat the masks, and the share that PPO clips."""
    labels = {
        "stored": "stored masks (consistent dropout)",
        "fresh": "fresh masks (ordinary dropout)",
        "none": "no masks (Roll-Drop)",
    }
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.4, 3.8), layout="constrained")
    for masks, label in labels.items():
        mine = [row for row in rows if row["masks"] == masks]
        columns = ("rate", "low", "median", "high", "clipped")
        rate, low, median, high, clipped = (np.array([row[column] for row in mine]) for column in columns)
        (line,) = left.plot(rate, median, marker="o", markersize=3, label=label)
        left.fill_between(rate, low, high, alpha=0.2, color=line.get_color())
        right.plot(rate, 100 * clipped, marker="o", markersize=3, label=label)
    left.set_yscale("log")
    left.set_ylabel("pi_new / pi_old")
    right.set_ylabel("samples outside the clip range [%]")
    for axis in (left, right):
        axis.set_xscale("log")
        axis.set_xlabel("feature dropout rate")
        axis.grid(alpha=0.3)
    right.legend(fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def gait_diagrams(panels: list[dict], legs: tuple[str, ...], dt: float, columns: int, picture: Path, title: str) -> None:
    """A panel a walk: when each foot was on the ground (a bar), with frames of the robot above.

    panels: "title", "time" (T,) s, a step of `dt` each, "contacts" (T, L) bool, "frames", images from the first step on, one
    each "frame_seconds", or none.
    """
    rows, framed = -(-len(panels) // columns), any(panel["frames"] for panel in panels)
    heights = [0.6, 0.16 * len(legs) + 0.2] if framed else [0.16 * len(legs) + 0.2]  # inches
    size = (6.0 * columns, (sum(heights) + 0.4) * rows + 0.4)
    figure, grid = plt.subplots(
        rows * len(heights), columns, figsize=size, height_ratios=heights * rows, layout="constrained", squeeze=False
    )
    cells = grid.reshape(rows, len(heights), columns).swapaxes(1, 2).reshape(-1, len(heights))  # (panels, 1 or 2)
    for axis in cells[len(panels) :].flat:
        axis.axis("off")
    for axes, panel in zip(cells, panels):
        start, end = panel["time"][0], panel["time"][-1] + dt
        for y, foot in enumerate(panel["contacts"].T):
            axes[-1].broken_barh([(t, dt) for t in panel["time"][foot]], (y - 0.35, 0.7), color=f"C{y}", linewidth=0)
        axes[-1].set_yticks(range(len(legs)), legs, fontsize=7)
        axes[-1].set_ylim(len(legs) - 0.4, -0.6)  # the first leg on top
        axes[-1].tick_params(axis="x", labelsize=7)
        for i in range(len(panel["frames"])):
            axes[-1].axvline(start + i * panel["frame_seconds"], color="black", linewidth=0.5, alpha=0.4)
        if panel["frames"]:  # each begins at the line of its moment
            extent = (start, start + len(panel["frames"]) * panel["frame_seconds"], 0, 1)
            axes[0].imshow(np.concatenate(panel["frames"], axis=1), extent=extent, aspect="auto")
            axes[0].axis("off")
        for axis in axes:
            axis.set_xlim(start, end)
        axes[0].set_title(panel["title"], fontsize=8, loc="left")
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def save_figure(figure, picture: Path) -> None:
    """Writes the picture whole or not at all."""
    temporary = picture.with_name("." + picture.name)
    figure.savefig(temporary, dpi=130, format="png")
    temporary.replace(picture)
    plt.close(figure)
