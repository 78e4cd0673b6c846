"""Charts of numbers. Poses are drawn in watch.py."""

from pathlib import Path

import numpy as np
from matplotlib import colormaps, cycler, rcParams
from matplotlib.figure import Figure

from baselines import METHODS

TAB20 = colormaps["tab20"].colors
rcParams["axes.prop_cycle"] = cycler(color=TAB20[::2] + TAB20[1::2])  # ten dark, ten light
rcParams.update({"font.size": 8, "axes.titlesize": 8, "legend.frameon": False})


def grid_of_axes(rows: int, columns: int, width: float, height: float, title: str):
    """A figure of `rows` x `columns` panels of width x height inches, and its axes as an array."""
    figure = Figure(figsize=(width * columns, height * rows), dpi=120, layout="constrained")
    figure.suptitle(title)
    return figure, figure.subplots(rows, columns, squeeze=False)


def colour_of(name: str, i: int) -> str:
    """A method's, the same in all charts; else that of the i-th."""
    method = name.split(",")[0]  # "mlp, not trained"
    if method == "rolt":
        return "black"
    return f"C{[*METHODS].index(method) if method in METHODS else i}"


def learning_curves(methods: dict[str, list], picture: Path, title: str) -> None:
    """methods: {name: a (n, len(CURVE)) array per seed}. A line is the mean of the seeds, a band
    what lies between the lowest and the highest."""
    figure, axes = grid_of_axes(1, 3, 4, 3, title)
    names = "return of an episode", "speed / commanded speed", "share of falls"
    for axis, name in zip(axes[0], names):
        axis.set(title=name, xlabel="env steps [million]")
        axis.grid(alpha=0.3)
    for i, (method, seeds) in enumerate(methods.items()):
        length, colour = min(map(len, seeds)), colour_of(method, i)
        steps, returns, speed, command, falls = np.array([seed[:length] for seed in seeds]).T
        for axis, values in zip(axes[0], (returns, speed / command, falls)):
            x = steps[:, 0] / 1e6
            axis.plot(x, values.mean(axis=1), lw=1.2, label=method, color=colour)
            axis.fill_between(x, values.min(axis=1), values.max(axis=1), alpha=0.2, color=colour)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.savefig(picture)


def chart(panels: dict[str, dict], cases: list[str], picture: Path, title: str, x: str) -> None:
    """panels: {what: {method: (mean, low, high, seeds' means) of each case}}. A bar or, where the
    cases are numbers and x says of what, a curve per method, with its interval; a dot per seed."""
    figure, axes = grid_of_axes(1, len(panels), max(5.2, 0.75 * len(cases)), 4, title)
    for axis, (what, methods) in zip(axes[0], panels.items()):
        width = 0.8 / len(methods)
        for i, (method, cells) in enumerate(methods.items()):
            means, lows, highs = np.array([cell[:3] for cell in cells]).T
            colour = colour_of(method, i)
            if x:
                places = np.array(cases, dtype=float)
                axis.plot(places, means, label=method, color=colour)
                axis.fill_between(places, lows, highs, alpha=0.12, color=colour, lw=0)
            else:
                places = np.arange(len(cases)) + (i - (len(methods) - 1) / 2) * width
                errors = np.abs([means - lows, highs - means])
                axis.bar(places, means, width, label=method, color=colour)
                axis.errorbar(places, means, errors, fmt="none", ecolor="grey", elinewidth=0.8)
                words = [case.replace(" ", "\n").replace(":", ":\n") for case in cases]
                axis.set_xticks(range(len(cases)), words)
            for place, (*_, seeds) in zip(places, cells):
                axis.plot([place] * len(seeds), seeds, "o", ms=3, mfc="w", mec=colour, mew=0.8)
        axis.set(ylabel=what, xlabel=x)
        axis.grid(axis="y", alpha=0.3)
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=min(6, 2 + 2 * len(panels)))
    figure.savefig(picture)


def heat_maps(maps: dict[str, tuple], rows, columns, picture: Path, title: str) -> None:
    """A panel per method: {name: (shares, falls)}, each (rows, columns); falls are written in."""
    figure, axes = grid_of_axes(1, len(maps), 2.2, 0.8 + 0.22 * len(rows), title)
    for axis, (name, (shares, falls)) in zip(axes[0], maps.items()):
        image = axis.imshow(shares, cmap="viridis", vmin=0, vmax=1, aspect="auto")
        axis.set_title(name)
        axis.set_xticks(range(len(columns)), columns, rotation=60, ha="right")
        axis.set_yticks(range(len(rows)), rows)
        for (y, x), fell in np.ndenumerate(falls):
            if fell > 0:
                axis.text(x, y, f"{fell:.0%}", ha="center", va="center", size=6, color="w")
    figure.colorbar(image, ax=axes, shrink=0.7)
    figure.savefig(picture)


def attention_maps(panels: dict[str, dict[str, np.ndarray]], picture: Path) -> None:
    """A row per situation: (16, 12) scandots, each method's (4, 3) attention on the patches."""
    title = "Trunk height - 0.3 m - ground, and the attention on its 12 patches; forward is up"
    figure, axes = grid_of_axes(len(panels), max(map(len, panels.values())), 2.6, 2.9, title)
    for line, (situation, row) in zip(axes, panels.items()):
        for axis, (name, values) in zip(line, row.items()):
            colours = {"cmap": "magma", "vmin": 0, "vmax": 0.25} if values.shape == (4, 3) else {}
            image = axis.imshow(values[::-1, ::-1], **colours)
            axis.set(title=f"{situation}: {name}", xticks=[], yticks=[])
            figure.colorbar(image, ax=axis, shrink=0.7)
    figure.savefig(picture)


def gait_diagrams(panels: list, legs, dt: float, rows: int, picture: Path, title: str) -> None:
    """When each foot was down (a bar). panels: (title, (T, L) bool contacts), row by row."""
    figure, axes = grid_of_axes(rows, len(panels) // rows, 2.6, 0.2 * len(legs) + 0.8, title)
    for axis, (label, contacts) in zip(axes.flat, panels):
        for y, foot in enumerate(contacts.T):
            spans = [(t * dt, dt) for t in np.flatnonzero(foot)]
            axis.broken_barh(spans, (y - 0.35, 0.7), color=f"C{y}", linewidth=0)
        axis.set_yticks(range(len(legs)), legs)
        axis.set(title=label, ylim=(len(legs) - 0.4, -0.6))  # the first leg on top
    figure.savefig(picture)
