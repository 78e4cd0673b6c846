"""Pictures of numbers: the learning curve of a run and the bar charts of the tests."""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # files only: works without a display
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402


def learning_curve(progress: Path, picture: Path) -> None:
    """Draws the run's progress.csv: return, speed against the command, episode length, sigma and KL over steps."""
    rows = []
    with open(progress, newline="") as file:
        for row in csv.DictReader(file):
            try:
                rows.append({name: float(value) for name, value in row.items()})
            except (TypeError, ValueError):  # a torn row
                pass
    if not rows:
        return
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
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
            axis.legend(fontsize=8, frameon=False, loc="upper left")  # "best" takes a second and warns of it
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


def save_figure(figure, picture: Path) -> None:
    """Writes the picture whole or not at all."""
    temporary = picture.with_name("." + picture.name)
    figure.savefig(temporary, dpi=130, format="png")
    temporary.replace(picture)
    plt.close(figure)
