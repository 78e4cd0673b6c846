"""Charts of numbers, written whole or not at all. Poses are drawn in watch.py."""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # files only: works without a display
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

Panels = dict[str, dict[str, tuple]]  # {axis label: {method: (means, deviations), one number a case each}}


def save_figure(figure, picture: Path) -> None:
    temporary = picture.with_name("." + picture.name)
    figure.savefig(temporary, dpi=120, format="png")
    temporary.replace(picture)
    plt.close(figure)


def learning_curve(progress: Path, picture: Path) -> None:
    """Draws a run's progress.csv: return, speed against the command, episode length, std and KL
    over steps."""
    with open(progress, newline="") as file:
        rows = list(csv.DictReader(file))
    column = {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}
    figure, axes = plt.subplots(2, 2, figsize=(9, 5.5), sharex=True, layout="constrained")
    panels = {
        "return of an episode": ["episode_return"],
        "forward speed [m/s]": ["speed", "commanded_speed"],
        "length of an episode [s]": ["episode_seconds"],
        "std of the actions, KL of an update": ["std", "kl"],
    }
    for axis, (title, names) in zip(axes.flat, panels.items()):
        for name in names:
            axis.plot(column["steps"] / 1e6, column[name], linewidth=1.2, label=name.replace("_", " "))
        axis.set_title(title, fontsize=10)
        axis.grid(alpha=0.3)
        if len(names) > 1:
            axis.legend(fontsize=8, frameon=False, loc="upper left")
    for axis in axes[1]:
        axis.set_xlabel("env steps [million]")
    save_figure(figure, picture)


def bar_charts(panels: Panels, cases: list[str], picture: Path, title: str) -> None:
    """One panel a quantity, one group of bars a case, one bar a method."""
    width = max(6.0, 0.75 * len(cases))
    figure, axes = plt.subplots(1, len(panels), figsize=(width * len(panels), 4), layout="constrained", squeeze=False)
    for axis, (label, methods) in zip(axes[0], panels.items()):
        bar = 0.8 / len(methods)
        for i, (method, (means, deviations)) in enumerate(methods.items()):
            x = np.arange(len(cases)) + (i - (len(methods) - 1) / 2) * bar
            axis.bar(x, means, bar, yerr=deviations, label=method, error_kw={"linewidth": 0.8})
        axis.set_xticks(np.arange(len(cases)), [case.replace(" (", "\n(") for case in cases], fontsize=8)
        axis.set_ylabel(label)
        axis.grid(axis="y", alpha=0.3)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, frameon=False, loc="outside lower center", ncols=min(6, len(methods)))
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def curves(panels: Panels, x: tuple[float, ...], picture: Path, title: str, axis_label: str) -> None:
    """One panel a quantity, one curve a method with a band of one standard deviation."""
    figure, axes = plt.subplots(1, len(panels), figsize=(5.2 * len(panels), 3.8), layout="constrained", squeeze=False)
    for axis, (label, methods) in zip(axes[0], panels.items()):
        for method, (means, deviations) in methods.items():
            means, deviations = np.array(means), np.array(deviations)
            (line,) = axis.plot(x, means, marker="o", markersize=3, label=method)
            axis.fill_between(x, means - deviations, means + deviations, alpha=0.12, color=line.get_color())
        axis.set_xlabel(axis_label)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0, -1].legend(fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def attention_maps(panels: dict[str, dict[str, np.ndarray]], picture: Path) -> None:
    """A row a situation: its (16, 12) heights, then the (12,) attention of each method on the 4 x 3
    patches."""
    rows, columns = len(panels), max(len(row) for row in panels.values())
    figure, axes = plt.subplots(rows, columns, figsize=(2.6 * columns, 2.9 * rows), layout="constrained", squeeze=False)
    for line, (situation, row) in zip(axes, panels.items()):
        for axis, (name, values) in zip(line, row.items()):
            heights = name == "heights"
            grid, limits = (values, {}) if heights else (values.reshape(4, 3), {"vmin": 0, "vmax": 0.25})
            image = axis.imshow(grid[::-1, ::-1], cmap="viridis" if heights else "magma", **limits)
            axis.set_title(f"{situation}: {'scandots [m]' if heights else name}", fontsize=9)
            axis.set_xticks([]), axis.set_yticks([])
            figure.colorbar(image, ax=axis, shrink=0.7)
    figure.suptitle("Trunk height - 0.5 m - ground, and the attention on its 12 patches; forward is up", fontsize=9)
    save_figure(figure, picture)


def probe_bars(rows: list[dict], gate: float, picture: Path) -> None:
    """rows: of `evaluate.mechanisms`: "method", "probe", "value". A dot a seed."""
    probes, methods = ([*dict.fromkeys(row[key] for row in rows)] for key in ("probe", "method"))
    figure, axis = plt.subplots(figsize=(8, 0.5 * len(probes) + 1.5), layout="constrained")
    for i, method in enumerate(methods):
        mine = [row for row in rows if row["method"] == method]
        y = [probes.index(row["probe"]) + 0.7 * (i / max(1, len(methods) - 1) - 0.5) for row in mine]
        axis.plot([float(row["value"]) for row in mine], y, "o", markersize=4, label=method)
    axis.axvline(gate, color="black", linewidth=0.8)
    axis.set_yticks(range(len(probes)), probes, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("change of the actions [their standard deviation]; share")
    axis.grid(axis="x", alpha=0.3)
    axis.legend(fontsize=8, frameon=False)
    save_figure(figure, picture)


def ratio_bands(rows: list[dict], picture: Path, title: str) -> None:
    """PPO's ratio against the dropout rate, a band for each way to treat the masks, and the share
    that PPO clips."""
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


def gait_diagrams(
    panels: list[tuple[str, np.ndarray]], legs: tuple[str, ...], dt: float, rows: int, picture: Path, title: str
) -> None:
    """A panel a walk: when each foot was on the ground (a bar). panels: (title, (T, L) bool
    contacts), row by row."""
    columns = len(panels) // rows
    size = (2.6 * columns, (0.2 * len(legs) + 0.6) * rows + 0.4)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axis, (label, contacts) in zip(axes.flat, panels):
        for y, foot in enumerate(contacts.T):
            axis.broken_barh([(t * dt, dt) for t in np.flatnonzero(foot)], (y - 0.35, 0.7), color=f"C{y}", linewidth=0)
        axis.set_yticks(range(len(legs)), legs, fontsize=7)
        axis.set_ylim(len(legs) - 0.4, -0.6)  # the first leg on top
        axis.tick_params(axis="x", labelsize=7)
        axis.set_title(label, fontsize=8, loc="left")
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)
