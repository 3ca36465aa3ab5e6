"""Plots of a data set as SVG. They need matplotlib, which is not part of the core install."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from robotdiffuse.evaluation.datasets.report import OUTCOMES, DataFigures
from robotdiffuse.evaluation.style import INK, as_svg, make_figure, percent_axis
from robotdiffuse.scenes.scene_arrays import BOX, SPHERE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

START, GOAL = "#4f7fd9", "#10a37f"
"""As in replays."""
FAMILY_COLORS = ("#4f7fd9", "#e09a5f", "#8d76c4", "#5aa7a7")
OUTCOME_COLORS = {"solved": "#10a37f", "unsolved": "#d97b5c", "refused": "#c94f4f", "thinned": "#b9c0c9"}
DIFFICULTY_COLORS = ("#dfe3e8", "#a9c1ec", "#6b95de", "#34599f")
"""From easy to hard."""
DETOUR_CLASSES = ((1.05, "up to 5 % longer"), (1.25, "up to 25 %"), (np.inf, "more"))
LEGEND_ABOVE: dict[str, Any] = {
    "loc": "lower left",
    "bbox_to_anchor": (0.0, 0.98),
    "ncols": 4,
    "columnspacing": 1.2,
    "handletextpad": 0.5,
    "borderpad": 0.0,
    "borderaxespad": 0.3,
}
"""Place of legends."""
BINS = 50
LAST_QUANTILE = 0.995
"""Histograms end at this quantile; the last bar holds all larger values."""
POINTS_PER_OBSTACLE = 64
MAX_OBSTACLES = 20_000
MAX_TIPS = 2_500


def outcomes(figure: "Figure", data: DataFigures) -> None:
    """Draw bars of the outcomes of problems."""
    axes = figure.subplots()
    tried = max(1, data.counts.get("tried", 0))
    values = [data.counts.get(name, 0) for name in OUTCOMES]
    axes.barh(OUTCOMES, values, color=[OUTCOME_COLORS[name] for name in OUTCOMES], height=0.62)
    for i, value in enumerate(values):
        axes.text(value + 0.015 * tried, i, f"{value:,} ({100 * value / tried:.1f} %)", va="center")
    axes.set_xlim(0, 1.42 * max(1, *values))
    axes.invert_yaxis()
    axes.spines[["bottom"]].set_visible(False)
    axes.set_xticks([])
    axes.tick_params(axis="y", labelsize=8.5, labelcolor=INK)


def lengths(figure: "Figure", data: DataFigures) -> None:
    """Draw a histogram of the path lengths by family."""
    axes = figure.subplots()
    values = data.all["cost"]
    _histogram(axes, data, values, np.linspace(0, _end(values), BINS))
    axes.set_xlabel("length [rad]")


def clearances(figure: "Figure", data: DataFigures) -> None:
    """Draw a histogram of the clearances by family, with the safety distance marked."""
    axes, safety_distance = figure.subplots(), data.safety_distance
    values = 100 * data.all["clearance"]
    end = max(_end(values), 120 * safety_distance)
    # put the safety distance between two bars, as many motions keep exactly that
    width = 100 * safety_distance / max(1, round(BINS * 100 * safety_distance / end)) or end / BINS
    _histogram(axes, data, values, np.arange(0, end + width, width))
    axes.axvline(100 * safety_distance, color=INK, linewidth=1, linestyle=(0, (3, 2)))
    place = axes.get_xaxis_transform()
    axes.text(100 * safety_distance + 0.15, 0.8, "safety\ndistance", transform=place, fontsize=7.5)
    axes.set_xlabel("clearance [cm]")


def detours(figure: "Figure", data: DataFigures) -> None:
    """Draw a histogram of the detours on a logarithmic scale, of motions whose straight line is not free."""
    axes = figure.subplots()
    blocked = ~data.all["line_free"]
    values = data.all["detour"]
    end = max(1.5, _end(values[blocked])) if blocked.any() else 2.0
    _histogram(axes, data, values, np.linspace(1, end, BINS), blocked)
    if blocked.any():  # an empty histogram has no logarithm
        axes.set_yscale("log")
    percent_axis(axes)
    axes.set_xlabel("length / straight line")


def difficulty(figure: "Figure", data: DataFigures) -> None:
    """Draw shares by detour and by clearance, a bar for each family."""
    rows = data.all
    free, detour, clearance = rows["line_free"], rows["detour"], 100 * rows["clearance"]
    low = [(~free) & (detour <= edge) for edge, _ in DETOUR_CLASSES]
    by_detour = [free, low[0], low[1] & ~low[0], low[2] & ~low[1]]
    edges = (np.inf, 5.0, 2.0, 1.0)
    by_clearance = [
        (clearance < high) & (clearance >= lowest)
        for high, lowest in zip(edges, (*edges[1:], -np.inf), strict=True)
    ]
    top, bottom = figure.subplots(2, 1)
    _shares(top, data, by_detour, ("line free", *(text for _, text in DETOUR_CLASSES)))
    _shares(bottom, data, by_clearance, ("over 5 cm", "2 to 5", "1 to 2", "below 1"))


def goals(figure: "Figure", data: DataFigures) -> None:
    """Draw the numbers of given and reached goals, and the excess cost of those that are not the best."""
    costs = data.sample["goal_costs"].astype(np.float64)
    given, reached = (~np.isnan(costs)).sum(axis=1), np.isfinite(costs).sum(axis=1)
    left, right = figure.subplots(1, 2)
    most = costs.shape[1]
    at = np.arange(1, most + 1)
    shares = [100 * np.bincount(n, minlength=most + 1)[1:] / len(costs) for n in (given, reached)]
    left.bar(at - 0.2, shares[0], 0.4, color="#c3cad3", label="given")
    left.bar(at + 0.2, shares[1], 0.4, color=GOAL, label="reached")
    left.set_xlabel("goals")
    left.set_xticks([1, *range(5, most + 1, 5)])
    left.legend(**LEGEND_ABOVE)
    percent_axis(left)
    best = np.nanmin(np.where(np.isinf(costs), np.nan, costs), axis=1, keepdims=True)
    excess = 100 * (costs / best - 1)
    others = excess[np.isfinite(costs) & (excess > 0)]
    if len(others):
        bins = np.linspace(0, float(np.quantile(others, 0.98)), 30)
        weights = np.full(len(others), 100 / len(others))
        right.hist(others.clip(0, bins[-1]), bins, weights=weights, color=GOAL, alpha=0.85)
    right.set_xlabel("excess cost of the others [%]")
    right.set_xlim(left=0)
    percent_axis(right)


def joints(figure: "Figure", data: DataFigures) -> None:
    """Draw a histogram for each joint between its limits: all waypoints, starts and goals."""
    manifest, q = data.manifest, data.sample["trajectories"]
    across = min(7, manifest.dof)
    rows = -(-manifest.dof // across)
    figure.set_figheight(1.95 * rows)
    panels = figure.subplots(rows, across, squeeze=False).reshape(-1)
    for panel in panels[manifest.dof :]:
        panel.set_axis_off()
    for j, panel in enumerate(panels[: manifest.dof]):
        low, high = manifest.lower[j], manifest.upper[j]
        bins = np.linspace(low, high, 41)
        panel.hist(q[..., j].reshape(-1), bins, density=True, color="#ccd4de", label="all waypoints")
        for values, color, label in ((q[:, 0, j], START, "start"), (q[:, -1, j], GOAL, "goal")):
            panel.hist(
                values, bins[::2], density=True, histtype="step", color=color, linewidth=1.3, label=label
            )
        margin = 0.06 * (high - low)
        panel.set_xlim(low - margin, high + margin)
        for limit, side in ((low, -1), (high, 1)):
            panel.axvspan(limit, limit + side * margin, color="#f3dcd3", linewidth=0)
        panel.set_xticks([low, high], [f"{low:.2f}", f"{high:.2f}"])
        panel.set_title(manifest.joint_names[j])
        panel.set_yticks([])
        panel.spines[["left"]].set_visible(False)
        panel.set_xlabel("[rad]", labelpad=1)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3)


def obstacles(figure: "Figure", data: DataFigures) -> None:
    """Draw the density of the obstacles' volume from above and from the side."""
    points = _obstacle_points(data)
    half = max(1.0, 1.05 * float(np.abs(points).max(initial=0.0)))
    for axes, (name, across) in zip(_views(figure), (("top", 1), ("side", 2)), strict=True):
        low, high = (-half, half) if across == 1 else (0.0, 1.25 * half)
        cells = [64, round(64 * (high - low) / (2 * half))]
        counts, *_ = np.histogram2d(points[:, 0], points[:, across], cells, [[-half, half], [low, high]])
        axes.imshow(
            counts.T / max(1.0, counts.max()),
            origin="lower",
            extent=(-half, half, low, high),
            cmap=_ramp(),
            interpolation="bicubic",
        )
        _finish_view(axes, name, across)


def tips(positions: dict[str, Float[ndarray, "n 3"]], figure: "Figure", data: DataFigures) -> None:
    """Draw the positions of the tip at both ends from above and from the side."""
    half = 1.05 * max(0.2, *(float(np.abs(p).max(initial=0.0)) for p in positions.values()))
    for axes, (name, across) in zip(_views(figure), (("top", 1), ("side", 2)), strict=True):
        for (end, points), color in zip(positions.items(), (START, GOAL), strict=True):
            few = points[:: -(-len(points) // MAX_TIPS)] if len(points) else points
            size = 3.0 if len(few) > 800 else 6.0
            axes.scatter(
                few[:, 0], few[:, across], size, color, alpha=0.6, linewidths=0, label=end, rasterized=True
            )
        axes.set_xlim(-half, half)
        axes.set_ylim(*((-half, half) if across == 1 else (0, 1.25 * half)))
        axes.set_aspect("equal")
        _finish_view(axes, name, across)
        if across == 1:
            axes.legend(loc="upper left", handletextpad=0.2, markerscale=2, borderpad=0)


def _views(figure: "Figure") -> tuple["Axes", "Axes"]:
    top, side = figure.subplots(1, 2)
    return top, side


def _finish_view(axes: "Axes", name: str, across: int) -> None:
    from matplotlib.ticker import MultipleLocator

    axes.set_anchor("S")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(0.5))
    axes.plot(0, 0, "+", color=INK, markersize=8, markeredgewidth=1.2, clip_on=False)
    axes.set_title(f"from the {name}")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]" if across == 1 else "z [m]")


def _ramp() -> "Colormap":
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("obstacles", ["#ffffff", "#f3d3bd", "#d97b5c", "#7f3a2b"])


def _obstacle_points(data: DataFigures) -> Float[ndarray, "n 3"]:
    """Random points in the obstacles, as many in each; the rotation of boxes is ignored."""
    kinds, params = data.sample["obstacle_kinds"], data.sample["obstacle_params"]
    rows = params[kinds > 0].astype(np.float64)
    kinds = kinds[kinds > 0]
    step = max(1, -(-len(rows) // MAX_OBSTACLES))
    rows, kinds = rows[::step], kinds[::step]
    cube = np.random.default_rng(0).uniform(-1, 1, (8 * POINTS_PER_OBSTACLE, 3))
    ball = cube[np.linalg.norm(cube, axis=1) <= 1][:POINTS_PER_OBSTACLE]
    spheres, boxes = rows[kinds == SPHERE], rows[kinds == BOX]
    return np.concatenate(
        [
            (spheres[:, None, :3] + spheres[:, None, 3:4] * ball).reshape(-1, 3),
            (boxes[:, None, :3] + boxes[:, None, 3:6] / 2 * cube[:POINTS_PER_OBSTACLE]).reshape(-1, 3),
        ]
    )


def _present(data: DataFigures) -> list[tuple[str, str, ndarray]]:
    """Name, colour and rows of each family that occurs."""
    colors = {name: FAMILY_COLORS[i % len(FAMILY_COLORS)] for i, name in enumerate(data.manifest.families)}
    return [(name, colors[name], rows) for name, rows in data.families.items()]


def _end(values: Float[ndarray, "n"]) -> float:
    return float(max(np.quantile(values, LAST_QUANTILE), 1e-3))


def _histogram(
    axes: "Axes",
    data: DataFigures,
    values: Float[ndarray, "n"],
    bins: Float[ndarray, "b"],
    chosen: ndarray | None = None,
) -> None:
    """Draw a histogram stacked by family in percent of all shown values; outliers are in the outer bins."""
    chosen = np.ones(len(values), bool) if chosen is None else chosen
    families = _present(data)
    parts = [values[rows & chosen].clip(bins[0], bins[-1]) for _, _, rows in families]
    weights = [np.full(len(part), 100 / max(1, chosen.sum())) for part in parts]
    colors, labels = [color for _, color, _ in families], [name for name, _, _ in families]
    axes.hist(parts, bins.tolist(), weights=weights, stacked=True, color=colors, label=labels)
    axes.set_xlim(bins[0], bins[-1])
    percent_axis(axes)
    if len(families) > 1:
        axes.legend(**LEGEND_ABOVE)


def _shares(axes: "Axes", data: DataFigures, classes: list[ndarray], labels: tuple[str, ...]) -> None:
    """Draw a bar of 100 % for each family, divided by classes."""
    families = _present(data)
    left = np.zeros(len(families))
    names = [name for name, _, _ in families]
    for chosen, color, label in zip(classes, DIFFICULTY_COLORS, labels, strict=True):
        shares = np.array([100 * chosen[rows].mean() for _, _, rows in families])
        axes.barh(names, shares, left=left, color=color, height=0.62, label=label)
        for i, share in enumerate(shares):
            if share >= 9:
                dark = color in DIFFICULTY_COLORS[2:]
                axes.text(
                    left[i] + share / 2,
                    i,
                    f"{share:.0f} %",
                    ha="center",
                    va="center",
                    fontsize=7.5,
                    color="white" if dark else INK,
                )
        left += shares
    axes.set_xlim(0, 100)
    axes.invert_yaxis()
    axes.set_xticks([])
    axes.spines[["bottom", "left"]].set_visible(False)
    axes.tick_params(axis="y", labelcolor=INK)
    axes.legend(**LEGEND_ABOVE)


class Plot(NamedTuple):
    """A plot of the page."""

    title: str
    draw: "Callable[[Figure, DataFigures], None]"
    text: str
    """Its caption, with fields for `str.format` that the page fills in."""
    width: int = 4
    """In columns of the page."""
    height: float = 2.3
    """[inch]"""

    def svg(self, data: DataFigures) -> str:
        figure = make_figure(self.width, self.height)
        self.draw(figure, data)
        return as_svg(figure)


PLOTS = (
    Plot("Problems", outcomes, "Outcomes of the {tried:,} problems"),
    Plot("Path length", lengths, "Joint-space length of the motions, by family of scenes"),
    Plot(
        "Clearance",
        clearances,
        "Least distance between arm and obstacles; the search keeps {cm} away from the ends",
    ),
    Plot("Detour", detours, "Path length over that of the straight line, where the line is not free"),
    Plot("Difficulty", difficulty, "Detours and clearances"),
    Plot("Goals", goals, "Goal configurations per problem, and what the others cost over the best one"),
    Plot(
        "Joints",
        joints,
        "Joint values between their limits: all waypoints, starts and goals{drawn}",
        width=12,
    ),
    Plot(
        "Obstacles",
        obstacles,
        "Density of obstacles, without the floor{drawn}; the cross is the robot's base",
        width=6,
        height=3.0,
    ),
)
"""The plots of every data set; that of the tips needs the robot, see `page`."""
