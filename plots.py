"""Pictures of numbers: the learning curve of a run and the bar charts of the tests."""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # files only: works without a display
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402

from scandots import PATCH, SCAN_SHAPE  # noqa: E402


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
    panel_width = max(5.2, 0.6 * len(cases))
    figure, axes = plt.subplots(1, len(panels), figsize=(panel_width * len(panels), 3.8), layout="constrained", squeeze=False)
    for axis, (label, methods) in zip(axes[0], panels.items()):
        width = 0.8 / len(methods)
        for i, (method, (mean, deviation)) in enumerate(methods.items()):
            x = np.arange(len(cases)) + (i - (len(methods) - 1) / 2) * width
            axis.bar(x, mean, width, yerr=deviation, capsize=2, label=method, error_kw={"linewidth": 0.8})
        axis.set_xticks(np.arange(len(cases)), [case.replace(" (", "\n(") for case in cases], fontsize=8)
        axis.set_xlim(-0.6, len(cases) - 0.4)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=min(0, axis.get_ylim()[0]))
        axis.grid(axis="y", alpha=0.3)
    if len(methods) > 1:
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, fontsize=8, frameon=False, loc="outside lower center", ncols=len(methods))
    else:
        title = f"{title}, {', '.join(methods)}"
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def curves(
    panels: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]], x: tuple[float, ...], picture: Path, title: str, axis_label: str
) -> None:
    """One panel a quantity, one curve a method with a band of one standard deviation. panels: as in `bar_charts`, the
    means in the order of x."""
    figure, axes = plt.subplots(1, len(panels), figsize=(5.2 * len(panels), 3.8), layout="constrained", squeeze=False)
    for axis, (label, methods) in zip(axes[0], panels.items()):
        for method, (mean, deviation) in methods.items():
            (line,) = axis.plot(x, mean, marker="o", markersize=3, label=method)
            axis.fill_between(x, mean - deviation, mean + deviation, alpha=0.12, color=line.get_color(), linewidth=0)
        axis.set_xlabel(axis_label)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=min(0, axis.get_ylim()[0]))
        axis.grid(alpha=0.3)
    axes[0, -1].legend(fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def ground_map(height: np.ndarray, extent: tuple[float, float, float, float], picture: Path, title: str) -> None:
    """Heights [m] of the ground, (rows along x, columns along y), seen from above, x upwards and y to the left.

    extent: x from, x to, y from, y to [m].
    """
    low_x, high_x, low_y, high_y = extent
    figure, axis = plt.subplots(figsize=(6.4, 6.8), layout="constrained")
    image = axis.imshow(height[::-1, ::-1], extent=(high_y, low_y, low_x, high_x), cmap="terrain", vmin=-0.3, interpolation="none")
    axis.set_xlabel("y, to the left [m]")
    axis.set_ylabel("x, forward [m]")
    figure.colorbar(image, ax=axis, label="height [m]", shrink=0.8)
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def scans(panels: dict[str, np.ndarray], picture: Path, title: str) -> None:
    """Scandots side by side: (16, 12) heights of the ground below the trunk [m] each, forward upwards, left to the left."""
    figure, axes = plt.subplots(1, len(panels), figsize=(2.4 * len(panels), 3.6), layout="constrained")
    low, high = min(p.min() for p in panels.values()), max(p.max() for p in panels.values())
    for axis, (label, heights) in zip(axes, panels.items()):
        image = axis.imshow(heights[::-1, ::-1], cmap="viridis", vmin=low, vmax=high)
        draw_patches(axis, heights.shape, PATCH)
        axis.set_title(label, fontsize=9)
    figure.colorbar(image, ax=axes, shrink=0.8)
    figure.suptitle(title, fontsize=10)
    save_figure(figure, picture)


def attention_maps(panels: dict[str, dict[str, np.ndarray]], picture: Path) -> None:
    """A row a situation: its (16, 12) heights, then the (12,) attention of each method on the 4 x 3 patches."""
    rows, columns = len(panels), max(len(row) for row in panels.values())
    figure, axes = plt.subplots(rows, columns, figsize=(2.6 * columns, 2.9 * rows), layout="constrained", squeeze=False)
    for line, (situation, row) in zip(axes, panels.items()):
        for axis, (name, values) in zip(line, row.items()):
            heights = name == "heights"
            grid = values if heights else values.reshape(SCAN_SHAPE[0] // PATCH, -1)
            limits = {} if heights else {"vmin": 0, "vmax": max(0.25, values.max())}
            image = axis.imshow(grid[::-1, ::-1], cmap="viridis" if heights else "magma", **limits)
            draw_patches(axis, grid.shape, PATCH if heights else 1)
            axis.set_title(f"{situation}: {'scandots [m]' if heights else name}", fontsize=9)
            figure.colorbar(image, ax=axis, shrink=0.7)
    figure.suptitle("Scandots (trunk height - 0.5 m - ground), and the attention on their patches; forward is up", fontsize=9)
    save_figure(figure, picture)


def draw_patches(axis, shape: tuple[int, int], side: int) -> None:
    """White lines between patches of side x side cells."""
    axis.set_xticks(np.arange(0, shape[1] + 1, side) - 0.5, [])
    axis.set_yticks(np.arange(0, shape[0] + 1, side) - 0.5, [])
    axis.grid(color="white", linewidth=1)
    axis.tick_params(length=0)


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
