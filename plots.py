"""Charts of numbers, written whole or not at all. Poses are drawn in watch.py."""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # files only: works without a display
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

Panels = dict[str, dict[str, tuple]]  # {axis label: {method: (means, deviations) of all cases}}


def grid_of_axes(rows: int, columns: int, width: float, height: float):
    """A figure of `rows` x `columns` panels of width x height inches, and its axes as an array."""
    size = (width * columns, height * rows)
    return plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)


def save_figure(figure, picture: Path, title: str | None = None) -> None:
    if title:
        figure.suptitle(title, fontsize=10)
    temporary = picture.with_name("." + picture.name)
    figure.savefig(temporary, dpi=120, format="png")
    temporary.replace(picture)
    plt.close(figure)


def learning_curve(progress: Path, picture: Path) -> None:
    """Draws a run's progress.csv over steps."""
    with open(progress, newline="") as file:
        rows = list(csv.DictReader(file))
    column = {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}
    panels = {
        "return of an episode": ["episode_return"],
        "forward speed [m/s]": ["speed", "commanded_speed"],
        "length of an episode [s]": ["episode_seconds"],
        "std of the actions, KL of an update": ["std", "kl"],
    }
    figure, axes = grid_of_axes(2, 2, 4.5, 2.75)
    million = column["steps"] / 1e6
    for axis, (title, names) in zip(axes.flat, panels.items()):
        for name in names:
            axis.plot(million, column[name], linewidth=1.2, label=name.replace("_", " "))
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("env steps [million]")
        axis.grid(alpha=0.3)
        if len(names) > 1:
            axis.legend(fontsize=8, frameon=False, loc="upper left")
    save_figure(figure, picture)


def bar_charts(panels: Panels, cases: list[str], picture: Path, title: str) -> None:
    """One panel a quantity, one group of bars a case, one bar a method."""
    figure, axes = grid_of_axes(1, len(panels), max(6.0, 0.75 * len(cases)), 4)
    centres, names = np.arange(len(cases)), [case.replace(" (", "\n(") for case in cases]
    for axis, (label, methods) in zip(axes[0], panels.items()):
        bar = 0.8 / len(methods)
        for i, (method, (means, deviations)) in enumerate(methods.items()):
            x = centres + (i - (len(methods) - 1) / 2) * bar
            axis.bar(x, means, bar, yerr=deviations, label=method, error_kw={"linewidth": 0.8})
        axis.set_xticks(centres, names, fontsize=8)
        axis.set_ylabel(label)
        axis.grid(axis="y", alpha=0.3)
    place = {"loc": "outside lower center", "ncols": min(6, len(methods))}
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, frameon=False, **place)
    save_figure(figure, picture, title)


def curves(panels: Panels, x: tuple, picture: Path, title: str, axis_label: str) -> None:
    """One panel a quantity, one curve a method with a band of one standard deviation."""
    figure, axes = grid_of_axes(1, len(panels), 5.2, 3.8)
    for axis, (label, methods) in zip(axes[0], panels.items()):
        for method, (means, deviations) in methods.items():
            low, high = np.subtract(means, deviations), np.add(means, deviations)
            (line,) = axis.plot(x, means, marker="o", markersize=3, label=method)
            axis.fill_between(x, low, high, alpha=0.12, color=line.get_color())
        axis.set(xlabel=axis_label, ylabel=label)
        axis.grid(alpha=0.3)
    axes[0, -1].legend(fontsize=8, frameon=False)
    save_figure(figure, picture, title)


def attention_maps(panels: dict[str, dict[str, np.ndarray]], picture: Path) -> None:
    """A row a situation: (16, 12) heights, then each method's (12,) attention on 4 x 3 patches."""
    figure, axes = grid_of_axes(len(panels), max(map(len, panels.values())), 2.6, 2.9)
    for line, (situation, row) in zip(axes, panels.items()):
        for axis, (name, values) in zip(line, row.items()):
            if name == "heights":
                name, image = "scandots [m]", axis.imshow(values[::-1, ::-1], cmap="viridis")
            else:
                values = values.reshape(4, 3)
                image = axis.imshow(values[::-1, ::-1], cmap="magma", vmin=0, vmax=0.25)
            axis.set_title(f"{situation}: {name}", fontsize=9)
            axis.set(xticks=[], yticks=[])
            figure.colorbar(image, ax=axis, shrink=0.7)
    title = "Trunk height - 0.5 m - ground, and the attention on its 12 patches; forward is up"
    save_figure(figure, picture, title)


def probe_bars(rows: list[dict], gate: float, picture: Path) -> None:
    """rows: of `evaluate.mechanisms`. A dot a seed."""
    probes, methods = ([*dict.fromkeys(row[key] for row in rows)] for key in ("probe", "method"))
    figure, axis = plt.subplots(figsize=(8, 0.5 * len(probes) + 1.5), layout="constrained")
    for i, method in enumerate(methods):
        mine = [row for row in rows if row["method"] == method]
        shift = 0.7 * (i / max(1, len(methods) - 1) - 0.5)  # methods side by side
        y = [probes.index(row["probe"]) + shift for row in mine]
        axis.plot([float(row["value"]) for row in mine], y, "o", markersize=4, label=method)
    axis.axvline(gate, color="black", linewidth=0.8)
    axis.set_yticks(range(len(probes)), probes, fontsize=8)
    axis.set_xlabel("change of the actions [their standard deviation]; share")
    axis.invert_yaxis()
    axis.grid(axis="x", alpha=0.3)
    axis.legend(fontsize=8, frameon=False)
    save_figure(figure, picture)


def ratio_bands(rows: list[dict], picture: Path, title: str) -> None:
    """PPO's ratio and the share that it clips over the dropout rate, for each use of the masks."""
    labels = {
        "stored": "stored masks (consistent dropout)",
        "fresh": "fresh masks (ordinary dropout)",
        "none": "no masks (Roll-Drop)",
    }
    figure, ((left, right),) = grid_of_axes(1, 2, 5.2, 3.8)
    for masks, label in labels.items():
        mine = [row for row in rows if row["masks"] == masks]
        columns = ("rate", "low", "median", "high", "clipped")
        rate, low, median, high, clipped = np.array([[row[c] for c in columns] for row in mine]).T
        (line,) = left.plot(rate, median, marker="o", markersize=3, label=label)
        left.fill_between(rate, low, high, alpha=0.2, color=line.get_color())
        right.plot(rate, 100 * clipped, marker="o", markersize=3, label=label)
    left.set(yscale="log", ylabel="pi_new / pi_old")
    right.set_ylabel("samples outside the clip range [%]")
    for axis in (left, right):
        axis.set(xscale="log", xlabel="feature dropout rate")
        axis.grid(alpha=0.3)
    right.legend(fontsize=8, frameon=False)
    save_figure(figure, picture, title)


def gait_diagrams(panels: list, legs, dt: float, rows: int, picture: Path, title: str) -> None:
    """When each foot was down (a bar). panels: (title, (T, L) bool contacts), row by row."""
    figure, axes = grid_of_axes(rows, len(panels) // rows, 2.6, 0.2 * len(legs) + 0.6 + 0.4 / rows)
    for axis, (label, contacts) in zip(axes.flat, panels):
        for y, foot in enumerate(contacts.T):
            spans = [(t * dt, dt) for t in np.flatnonzero(foot)]
            axis.broken_barh(spans, (y - 0.35, 0.7), color=f"C{y}", linewidth=0)
        axis.set_yticks(range(len(legs)), legs, fontsize=7)
        axis.set_ylim(len(legs) - 0.4, -0.6)  # the first leg on top
        axis.tick_params(axis="x", labelsize=7)
        axis.set_title(label, fontsize=8, loc="left")
    save_figure(figure, picture, title)
