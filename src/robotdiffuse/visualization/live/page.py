"""The interactive page: shows a session in browsers with viser, with a control panel."""

import contextlib
import html
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation
from viser import uplot

from robotdiffuse.core.errors import InputError
from robotdiffuse.core.transforms import quaternion_from_rotation, rotation_from_quaternion, transform
from robotdiffuse.core.types import Configuration, Pose, Trajectory, Tree, interpolated
from robotdiffuse.drawables import GOAL, START, Color, Drawable, Surface, drawables, own_frame, thinned
from robotdiffuse.planning import PLANNERS
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.scenes.shapes import Mesh, PointCloud, Shape
from robotdiffuse.validation.validator import verify
from robotdiffuse.visualization.live.server import PageServer
from robotdiffuse.visualization.live.session import (
    COLLISIONS,
    INVALID,
    MAX_DIMENSION,
    MIN_DIMENSION,
    NEW_OBSTACLES,
    NO_MOTION,
    PENDING,
    TREE_PLANNERS,
    VALID,
    Changes,
    LatestTask,
    Player,
    Session,
    State,
    Validity,
    dimensions,
    moved_to,
    problem_text,
    resized,
    uploaded_problem,
    validity,
)
from robotdiffuse.visualization.picture import DrawnArm
from robotdiffuse.visualization.replay_page import result_page

# sizes of gizmos (transform controls), as fractions of the arm's reach
GIZMO_SIZE = 0.23
SMALL_GIZMO_SIZE = 0.16
BADGE_COLORS = {VALID: "#0f8f6f", INVALID: "#c92f2f", NO_MOTION: "#b26a00", PENDING: "#6b7684"}
JOINT_COLORS = ("#4f7fd9", "#10a37f", "#d97b5c", "#8a63d2", "#c2a23a", "#4fa3b8", "#c96a9a", "#7a8794")
"""Colors of joints in the plot."""
NO_OBSTACLE = "(none)"
"""Entry of the dropdown if no obstacle is selected."""
PLOTS = ("position", "velocity", "acceleration")
NOTIFICATION_TIME = 8.0
"""Time for which notifications are shown [s]."""


class LivePage(ABC):
    """Shows the state of a session in all browsers that the server accepts, until the page is closed."""

    def __init__(self, session: Any, server: PageServer, robot: Robot) -> None:
        self.session = session
        self.server = server
        self._changes = Changes()
        self._open = threading.Lock()
        self._closed = False
        self._drawing = LatestTask(self._draw_if_open, "draw")
        server.add_stage(robot.reach)

    def close(self) -> None:
        """Stop serving and end all threads."""
        self.session.close()
        self._drawing.close()
        with self._open:  # waits until the current drawing is complete
            self._closed = True
        self.server.stop()

    def _begin(self) -> None:
        self.session.on_change = self._redraw
        self._redraw()

    def _redraw(self) -> None:
        self._drawing.submit(None)

    def _draw_if_open(self, _: None) -> None:
        with self._open:
            if not self._closed:
                self._draw()

    @abstractmethod
    def _draw(self) -> None:
        """Draw what has changed. It is called only by the drawing task's thread."""


class Page(LivePage):
    """The page on which visitors change a problem and plan."""

    session: Session

    def __init__(self, session: Session, server: PageServer) -> None:
        super().__init__(session, server, session.state.problem.robot)
        self._selected = ""
        self.goal_gizmo = _Gizmo(server, "/drag/goal", GIZMO_SIZE, session.move_goal)
        self._start_gizmo = _Gizmo(server, "/drag/start", SMALL_GIZMO_SIZE, session.move_start)
        self._obstacle_gizmo = _Gizmo(server, "/drag/obstacle", GIZMO_SIZE, self._move_selected)
        self._gizmos = self.goal_gizmo, self._start_gizmo, self._obstacle_gizmo
        self._panel = Panel(self)
        self._obstacles = Obstacles(server, self.select)
        self._moving = Obstacles(server)
        self._arms = dict[str, Arm]()
        self._frames: Float[ndarray, "n frames 4 4"] | None = None
        """T_base_frame of all frames along the shown motion, at POSE_RATE."""
        self._lock = threading.Lock()
        self.player = Player(self._show_time)
        self._begin()
        session.start()

    def select(self, name: str) -> None:
        """Select an obstacle by name; an empty name selects no obstacle."""
        self._selected = name
        self._redraw()

    def close(self) -> None:
        """Stop serving and end all threads."""
        self.player.close()
        for gizmo in self._gizmos:
            gizmo.close()
        super().close()

    def _move_selected(self, T_base_handle: Pose) -> None:
        if self._selected:
            self.session.change_obstacle(self._selected, lambda shape: moved_to(shape, T_base_handle))

    def _draw(self) -> None:
        state = self.session.state
        selected = self._selected
        new = self._changes.new
        problem = state.problem
        robot = problem.robot
        motion = None if state.motion is None else state.motion.trajectory
        violation = None if state.validation is None else state.validation.report.violation
        if new("robot", robot):
            self._new_robot(robot)
        # the first call compiles, which would delay the messages in the atomic block
        self._drawn.frames(problem.start)
        with self.server.atomic():
            self._panel.show(state, validity(state), selected)
            if new("scene", robot, problem.scene, selected):
                self._obstacles.show(drawables(problem.scene), selected)
                shapes = state.obstacles
                self._obstacle_gizmo.show(own_frame(shapes[selected]) if selected in shapes else None)
            if new("moving", problem.moving):
                self._show_moving(0.0)
            self._start_gizmo.show(robot.fk(problem.start))
            if new("start", robot, problem.start, state.motion):
                at_start = motion is None or np.allclose(motion.positions[0], problem.start)
                self._arms["start"].show(None if at_start else problem.start)
            if new("goal", robot, state.goal_configuration):
                self._arms["goal"].show(state.goal_configuration)
            self.goal_gizmo.show(state.goal_pose)
            if new("motion", robot, problem.start if state.motion is None else state.motion):
                self._new_motion(motion, problem.start)
            if new("validation", robot, state.validation):
                contact = None
                if violation is not None and motion is not None and violation.kind in COLLISIONS:
                    contact = interpolated(violation.time, motion.times, motion.positions)
                self._arms["contact"].show(contact)
            answer = state.answer
            tree_answer = answer if state.options.trees else None
            # until there is an answer, the trees of the last one stay visible
            if (answer is not None or not state.options.trees) and new("trees", robot, tree_answer):
                draw_trees(self.server, self._drawn, () if tree_answer is None else tree_answer.trees)

    def _new_robot(self, robot: Robot) -> None:
        with self._lock:
            self._frames = None  # of the old robot; the player must not show them on the new arm
        for arm in self._arms.values():
            arm.root.remove()
        self._drawn = DrawnArm(robot)
        draw = partial(Arm, self.server)
        self._arms = {
            "arm": draw("arm", self._drawn),
            "start": draw("start", self._drawn, START, GHOST_OPACITY),
            "goal": draw("goal", self._drawn, GOAL, GHOST_OPACITY),
            "contact": draw("contact", self._drawn, RED, 2 * GHOST_OPACITY),
        }
        for gizmo in self._gizmos:
            gizmo.handle.scale = gizmo.size * robot.reach
        state = self.session.state
        self.server.set_first_view(self._drawn, state.problem, state.goal_configuration)
        draw_trees(self.server, self._drawn, ())

    def _new_motion(self, motion: Trajectory | None, start: Configuration) -> None:
        frames = None
        if motion is not None:
            at = np.append(np.arange(0.0, motion.duration, 1 / POSE_RATE), motion.duration)
            frames = self._drawn.frames(interpolated(at, motion.times, motion.positions))
        with self._lock:
            self._frames = frames
        draw_trace(self.server, self._drawn, motion)
        if motion is None:
            self._arms["arm"].show(start)
        else:
            self.player.load(motion.duration)

    def _show_time(self, at: float) -> None:
        with self._lock:
            if self._frames is None:
                return
            last = len(self._frames) - 1
            number = last if at >= self.player.duration else min(round(at * POSE_RATE), last)
            self._arms["arm"].show_frames(self._frames[number])
        self._show_moving(at)
        self._panel.show_time(at, self.player.duration)

    def _show_moving(self, at: float) -> None:
        """Show the moving obstacles at their poses at a time of the motion [s]."""
        obstacles = drawables(Scene(), self.session.state.problem.moving)
        with self._lock:
            self._moving.show(obstacles, time=at)

    def seek(self, at: float) -> None:
        """Stop playing, and go to a time of the motion [s]."""
        self.set_playing(False)
        self.player.seek(at)

    def set_playing(self, playing: bool) -> None:
        """Play the motion, or stop playing."""
        self.player.playing = playing
        self._panel.show_playing(playing)


class _Gizmo:
    """A transform control. `moved` is called with its pose while a visitor drags it."""

    def __init__(self, server: viser.ViserServer, name: str, size: float, moved: Any) -> None:
        """`size` is a fraction of the arm's reach."""
        self.handle = server.scene.add_transform_controls(name, depth_test=False, visible=False)
        self.size = size
        self._held = False
        self._moved = moved
        self._moving = LatestTask(self._move, name)

        @self.handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._held = event.phase != "end"
            if event.phase != "start":
                rotation = rotation_from_quaternion(np.array(event.target.wxyz))
                self._moving.submit(transform(np.array(event.target.position), rotation))

    def _move(self, T: Pose) -> None:
        with contextlib.suppress(InputError):  # another visitor has deleted the obstacle
            self._moved(T)

    def close(self) -> None:
        """End the gizmo's thread."""
        self._moving.close()

    def show(self, T: Pose | None) -> None:
        """Move the gizmo to a pose, unless it is being dragged; None hides it."""
        if T is not None and not self._held:
            place(self.handle, T)
        self.handle.visible = T is not None


class Panel:
    """The widgets of the control panel."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._server = page.server
        self._session = page.session
        gui = self._server.gui
        self._changes = Changes()
        self._badge = gui.add_html("")
        self._slider = gui.add_slider("Time", min=0.0, max=1.0, step=0.01, initial_value=0.0)
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Plan"):
            self._plan_tab()
        with tabs.add_tab("Obstacles"):
            self._obstacles_tab()
        with tabs.add_tab("Start"):
            self._joints_box = gui.add_folder("Joints")
            self._joints: list[viser.GuiInputHandle[float]] = []
        with tabs.add_tab("Files"):
            self._files_tab()
        self._on(self._slider.on_update, lambda event: page.seek(event.target.value))
        self._play.on_click(lambda _event: page.set_playing(self._play.label == "Play"))

    def _on(self, connect: Callable[[Any], object], do: Callable[[Any], object]) -> None:
        """Call `do` when a visitor uses a widget; `connect` is the widget's `on_update`, `on_click` or
        `on_upload`. An InputError of `do` is shown to the visitor as a notification."""

        @connect
        def _(event: viser.GuiEvent) -> None:
            if event.client is None:  # the page itself set the widget
                return
            try:
                do(event)
            except InputError as error:
                event.client.add_notification(
                    "Not possible", str(error), auto_close_seconds=NOTIFICATION_TIME, color="red"
                )

    # tabs

    def _plan_tab(self) -> None:
        gui = self._server.gui
        session = self._session
        options = self._session.state.options
        planners = ", ".join(TREE_PLANNERS)
        trees = f"Search trees from the start (blue) and the goal (green); only {planners} have them"
        boxes = (
            ("follow", "Plan automatically", "Plan again after each change"),
            ("trees", "Search trees", trees),
        )
        self._options: dict[str, Any] = {
            "planner": gui.add_dropdown("Planner", tuple(PLANNERS), initial_value=options.planner)
        }
        limit = gui.add_slider(
            "Time limit [s]", min=0.05, max=10.0, step=0.05, initial_value=min(options.time_limit, 10.0)
        )
        for name, label, hint in boxes:
            self._options[name] = gui.add_checkbox(label, getattr(options, name), hint=hint)
        now = gui.add_button("Plan now", icon=viser.Icon.ROUTE)
        self._stages = gui.add_html("")
        self._kind = gui.add_dropdown("Plot", PLOTS, initial_value=PLOTS[0])
        self._plot_box = gui.add_folder("Joint values relative to limits")
        self._plot: viser.GuiUplotHandle | None = None
        for name, widget in {**self._options, "time_limit": limit}.items():
            self._on(
                widget.on_update, lambda event, name=name: session.set_options(**{name: event.target.value})
            )
        self._on(self._kind.on_update, lambda _event: self._show_plot(session.state))
        self._on(now.on_click, lambda _event: session.plan_now())

    def _obstacles_tab(self) -> None:
        gui = self._server.gui
        self._selected: Any = gui.add_dropdown("Obstacle", (NO_OBSTACLE,), initial_value=NO_OBSTACLE)
        self._sizes_box = gui.add_folder("Size [m]", visible=False)
        self._sizes = dict[str, Any]()
        self._delete = gui.add_button("Delete", icon=viser.Icon.TRASH, visible=False)
        new = gui.add_dropdown("New obstacle", tuple(NEW_OBSTACLES), initial_value="sphere")
        add = gui.add_button("Add", icon=viser.Icon.PLUS)
        session = self._session
        self._on(self._selected.on_update, lambda event: self._page.select(event.target.value))
        self._on(
            self._delete.on_click,
            lambda _event: session.change_obstacle(self._selected.value, lambda _shape: None),
        )
        self._on(add.on_click, lambda _event: self._page.select(session.add_obstacle(new.value)))

    def _files_tab(self) -> None:
        gui = self._server.gui
        session = self._session
        load = gui.add_upload_button("Load problem", icon=viser.Icon.UPLOAD, mime_type=".yaml,.yml,.json")
        save = gui.add_button("Save problem", icon=viser.Icon.DOWNLOAD)
        share = gui.add_button("Save replay", icon=viser.Icon.SHARE)

        def opened(_event: viser.GuiEvent) -> None:
            file = load.value
            session.open(uploaded_problem(file.content, file.name, session.state.problem.robot))

        self._on(load.on_upload, opened)
        self._on(
            save.on_click, lambda event: _send(event, "problem.yaml", problem_text(session.state.problem))
        )
        self._on(share.on_click, lambda event: _send(event, "replay.html", self._replay()))

    def _replay(self) -> bytes:
        state = self._session.state
        if state.motion is None:
            raise InputError("there is no motion to save yet")
        # the problem may have changed since the motion was planned
        report = verify(state.problem, state.motion.trajectory)
        if report.violation is not None:
            raise InputError(f"the motion is not valid any more: {report.violation.message}")
        return result_page(state.problem, replace(state.motion, min_clearance=report.min_clearance)).encode()

    # display

    def show(self, state: State, validity: Validity, selected: str) -> None:
        """Update the widgets to a state."""
        if self._changes.new("validity", validity, state.planning):
            self._badge.content = badge_html(validity, state.planning)
        if self._changes.new("seconds", state.seconds):
            self._stages.content = _stages_html(state.seconds)
        for name, widget in self._options.items():
            set_value(widget, getattr(state.options, name))
        if self._changes.new("motion", state.motion):
            self._show_plot(state)
        if self._changes.new("robot", state.problem.robot):
            self._new_joints(state.problem.robot)
        if self._changes.new("start", state.problem.start):
            for widget, value in zip(self._joints, state.problem.start, strict=True):
                set_value(widget, round(float(value), 3))
        self._show_obstacle(state, selected)

    def _show_obstacle(self, state: State, selected: str) -> None:
        shapes = state.obstacles
        options = (NO_OBSTACLE, *shapes)
        if self._changes.new("options", options):
            self._selected.options = options
        name = selected if selected in shapes else NO_OBSTACLE
        set_value(self._selected, name)
        shape = shapes.get(selected)
        self._delete.visible = shape is not None
        sizes = {} if shape is None else dimensions(shape)
        self._sizes_box.visible = bool(sizes)
        if self._changes.new("sizes of", (name, *sizes)):
            for widget in self._sizes.values():
                widget.remove()
            with self._sizes_box:
                self._sizes = {
                    size_name: self._size_slider(name, size_name, value) for size_name, value in sizes.items()
                }
        for size_name, value in sizes.items():
            set_value(self._sizes[size_name], value)

    def _size_slider(self, name: str, dimension: str, value: float) -> Any:
        slider = self._server.gui.add_slider(
            dimension,
            min=min(MIN_DIMENSION, value),
            max=max(MAX_DIMENSION, value),
            step=0.005,
            initial_value=value,
        )
        resize = self._session.change_obstacle
        self._on(
            slider.on_update,
            lambda event: resize(name, lambda shape: resized(shape, dimension, event.target.value)),
        )
        return slider

    def _new_joints(self, robot: Robot) -> None:
        for widget in self._joints:
            widget.remove()
        self._joints = []
        limits = zip(robot.joint_names, robot.lower, robot.upper, robot.continuous, strict=True)
        with self._joints_box:
            for name, low, high, is_continuous in limits:
                low, high = (-np.pi, np.pi) if is_continuous else (float(low), float(high))
                # rounded outwards, so that labels are short
                low = np.floor(100 * low) / 100
                high = np.ceil(100 * high) / 100
                widget = self._server.gui.add_slider(name, min=low, max=high, step=0.001, initial_value=low)
                self._on(widget.on_update, partial(self._move_joint, len(self._joints)))
                self._joints.append(widget)

    def _move_joint(self, index: int, event: Any) -> None:
        problem = self._session.state.problem
        q = problem.start.copy()
        q[index] = np.clip(event.target.value, problem.robot.lower[index], problem.robot.upper[index])
        self._session.set_start(q)

    def show_time(self, at: float, duration: float) -> None:
        """Set the time slider [s]."""
        max_time = max(np.ceil(100 * duration) / 100, 0.01)
        if self._slider.max != max_time:
            self._slider.max = max_time
        self._slider.value = round(at, 2)

    def show_playing(self, playing: bool) -> None:
        """Set the play button."""
        self._play.label = "Pause" if playing else "Play"
        self._play.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

    def _show_plot(self, state: State) -> None:
        robot = state.problem.robot
        motion = state.motion
        names = robot.joint_names
        other_joints = self._changes.new("joints of the plot", names)
        if self._plot is not None and (motion is None or other_joints):
            self._plot.remove()
            self._plot = None
        if motion is None:
            return
        data = plotted(robot, motion.trajectory, self._kind.value)
        if self._plot is not None:
            self._plot.data = data
            return
        joints = [
            uplot.Series(label=name, stroke=JOINT_COLORS[i % len(JOINT_COLORS)], width=1.5)
            for i, name in enumerate(names)
        ]
        limit = uplot.Series(label="limit", stroke="#c92f2f", width=1, dash=(6, 4))
        with self._plot_box:
            self._plot = self._server.gui.add_uplot(
                data=data,
                series=(uplot.Series(label="time [s]"), *joints, limit, limit),
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(-118.0, 118.0))},
                axes=(uplot.Axis(label="s"), uplot.Axis(label="% of limit")),
                legend=uplot.Legend(show=False),
                height=220,
            )


def plotted(robot: Robot, motion: Trajectory, kind: str) -> tuple[np.ndarray, ...]:
    """Data of the plot: times, the values of each joint in percent of its limit, and the limits 100 and -100.

    A position of 0 % is the middle of the joint's range. For continuous joints, 100 % is half a turn.
    """
    if kind == "velocity":
        values = motion.velocities / robot.velocity
    elif kind == "acceleration":
        values = motion.accelerations / robot.acceleration
    else:
        middle = np.where(robot.continuous, 0.0, robot.middle)
        half = np.where(robot.continuous, np.pi, 0.5 * (robot.upper - robot.lower))
        values = (motion.positions - middle) / half
    limit = np.full(len(motion.times), 100.0)
    return (motion.times, *(100.0 * values).T, limit, -limit)


def set_value(widget: Any, value: object) -> None:
    """Set the value of a widget. If it has the value already, no message is sent to browsers."""
    if widget.value != value:
        widget.value = value


def _send(event: Any, name: str, content: bytes) -> None:
    event.client.send_file_download(name, content, save_immediately=True)


def badge_html(validity: Validity, planning: bool = False) -> str:
    """HTML of the badge: a colored box with a headline and lines."""
    lines = "".join(f"<div>{html.escape(line)}</div>" for line in validity.lines)
    busy = " · planning" if planning and validity.kind != PENDING else ""
    return (
        f'<div data-validity="{validity.kind}" style="margin: 0 0.8em 0.8em; padding: 0.7em 0.9em; '
        f"border-radius: 8px; color: white; font-size: 0.85em; line-height: 1.4; "
        f'background: {BADGE_COLORS[validity.kind]}; overflow-wrap: anywhere">'
        f"<b>{html.escape(validity.headline)}</b>{busy}{lines}</div>"
    )


def _stages_html(seconds: tuple[tuple[str, float], ...]) -> str:
    rows = "".join(
        f'<tr><td>{html.escape(stage)}</td><td style="text-align: right">{1e3 * took:.1f} ms</td></tr>'
        for stage, took in seconds
    )
    return f'<table style="margin: 0 0.8em; width: calc(100% - 1.6em); font-size: 0.85em">{rows}</table>'


POSE_RATE = 30.0
"""The poses of the arm along a motion are precomputed at this rate [1/s], and at its end."""
RED = (0xD6, 0x3B, 0x3B)
GAMMA = 2.2
"""Exponent for converting sRGB colors to linear ones, approximately."""
EDGE_POINTS = 6
"""Number of points of the tool's trace along an edge of a search tree."""
MAX_EDGES = 4000
"""Largest number of edges that are drawn per tree; the first edges are drawn."""
TREES = ("/trees/start", "/trees/goal")
GHOST_OFFSET = 0.002
"""Distance by which the surfaces of a see-through arm are moved outwards, so that it covers the solid arm at
the same place [m]. It is multiplied by the ratio of the arm's opacity to GHOST_OPACITY."""
# line widths, as fractions of the arm's reach
TRACE_WIDTH = 0.0094
TREE_WIDTH = 0.0028
GHOST_OPACITY = 0.3
"""Opacity of the arms at start and goal."""
HIGHLIGHT = 0.35
"""Fraction of white that is mixed into the color of the selected obstacle."""


def add_surface(
    server: viser.ViserServer,
    name: str,
    surface: Surface,
    color: Color,
    opacity: float | None = None,
) -> viser.MeshHandle:
    """Draw a surface in one color."""
    vertices = surface.vertices.astype(np.float32)
    faces = surface.faces.astype(np.uint32)
    return server.scene.add_mesh_simple(name, vertices, faces, color=color, opacity=opacity)


class Arm:
    """A robot in the 3D scene."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        drawn: DrawnArm,
        color: Color | None = None,
        opacity: float | None = None,
    ) -> None:
        """Without `color`, the arm has its own colors. With `color`, it is drawn in this color and without
        the base. `opacity` makes it see-through."""
        self._server = server
        self._drawn = drawn
        self.root = server.scene.add_frame(f"/{name}", show_axes=False, visible=False)
        self._frames = []
        for i, surface in enumerate(drawn.surfaces):
            self._frames.append(server.scene.add_frame(f"/{name}/{i}", show_axes=False))
            if len(surface.faces) == 0 or (i == 0 and color is not None):
                continue
            for k, (part_color, part) in enumerate(surface.by_color if color is None else [(color, surface)]):
                if opacity is not None:
                    vertices = part.vertices + opacity / GHOST_OPACITY * GHOST_OFFSET * part.normals
                    part = replace(part, vertices=vertices)
                add_surface(server, f"/{name}/{i}/{k}", part, part_color, opacity)

    def show(self, q: Configuration | None) -> None:
        """Show the arm at a configuration; None hides it."""
        self.show_frames(None if q is None else self._drawn.frames(q))

    def show_frames(self, T_base_frame: Float[ndarray, "frames 4 4"] | None) -> None:
        """Show the arm with its frames at these poses; None hides it."""
        if T_base_frame is not None:
            quaternions = Rotation.from_matrix(T_base_frame[:, :3, :3]).as_quat(scalar_first=True)
            with self._server.atomic():
                for frame, T, wxyz in zip(self._frames, T_base_frame, quaternions, strict=True):
                    frame.position = T[:3, 3]
                    frame.wxyz = wxyz
        self.root.visible = T_base_frame is not None


def place(node: Any, T: Pose) -> None:
    """Move a node of the 3D scene to a pose. If it is there already, viser sends no message to browsers."""
    node.position = T[:3, 3]
    node.wxyz = quaternion_from_rotation(T)


class Obstacles:
    """The obstacles in the 3D scene. Obstacles that only moved are moved, and obstacles that changed are
    drawn again."""

    def __init__(self, server: viser.ViserServer, clicked: Callable[[str], None] = lambda _: None) -> None:
        self._server = server
        self._clicked = clicked
        self._nodes = dict[str, tuple[object, Any]]()

    def show(self, obstacles: Sequence[Drawable], selected: str = "", time: float = 0.0) -> None:
        """Show obstacles at their poses at a time [s], and highlight the selected obstacle."""
        names = {obstacle.name for obstacle in obstacles}
        for name in [name for name in self._nodes if name not in names]:
            self._nodes.pop(name)[1].remove()
        for obstacle in obstacles:
            is_selected = obstacle.name == selected
            key = _appearance(obstacle.shape), obstacle.color, is_selected
            drawn_node = self._nodes.get(obstacle.name)
            if drawn_node is None or drawn_node[0] != key:
                if drawn_node is not None:
                    drawn_node[1].remove()
                self._nodes[obstacle.name] = key, self._draw(obstacle, is_selected)
            place(self._nodes[obstacle.name][1], obstacle.frame(time))

    def _draw(self, obstacle: Drawable, selected: bool) -> Any:
        """Adds a node with the geometry in the obstacle's own frame."""
        color = obstacle.color
        name = obstacle.name
        if selected:
            r, g, b = (round(c + HIGHLIGHT * (255 - c)) for c in color)
            color = r, g, b
        own = obstacle.own  # in the frame of the obstacle
        node = f"/obstacles/{name.encode().hex()}"  # a plain "/" would add a level to the tree
        if isinstance(own.shape, PointCloud):
            points = thinned(own.shape.points).astype(np.float32)
            size = 2 * own.shape.point_radius
            return self._server.scene.add_point_cloud(node, points, color, point_size=size)
        handle = add_surface(self._server, node, own.surface, color)
        handle.on_click(lambda _event: self._clicked(name))
        return handle


def _appearance(shape: Shape) -> object:
    """A key of a shape's geometry without its pose: shapes with equal keys look alike. A shape without sizes,
    such as a height map, has a key of its own."""
    if isinstance(shape, Mesh):
        return "mesh", shape.vertices.tobytes(), shape.faces.tobytes()
    if isinstance(shape, PointCloud):
        points = shape.points - shape.bounds.mean(axis=0)
        return "points", shape.point_radius, np.round(points, 6).tobytes()
    sizes = dimensions(shape)
    return (shape.kind, *sizes.items()) if sizes else id(shape)


def draw_trace(server: viser.ViserServer, arm: DrawnArm, motion: Trajectory | None) -> None:
    """Draw the trace of the tool along a motion, in colors from START to GOAL; without a motion, remove
    it."""
    if motion is None:
        server.scene.remove_by_name("/trace")
        return
    points = arm.trace(motion.positions)
    share = np.linspace(0, 1, len(points))[:, None]
    colors = (1 - share) * np.array(START) + share * np.array(GOAL)
    draw_lines(server, "/trace", [points], colors, TRACE_WIDTH * arm.robot.reach)


def draw_trees(server: viser.ViserServer, arm: DrawnArm, trees: tuple[Tree, ...]) -> None:
    """Draw the tool's traces along the edges of both search trees, in the colors of start and goal."""
    for name, color, tree in zip(TREES, (START, GOAL), trees or (None, None), strict=True):
        edges = [] if tree is None else _edges(arm, tree)
        draw_lines(server, name, edges, color, TREE_WIDTH * arm.robot.reach)


def _edges(arm: DrawnArm, tree: Tree) -> list[Float[ndarray, "points 3"]]:
    children = np.flatnonzero(tree.parents >= 0)[:MAX_EDGES]
    begin = tree.nodes[tree.parents[children]]
    end = tree.nodes[children]
    share = np.linspace(0, 1, EDGE_POINTS)[:, None]
    q = (begin[:, None] + share * (end - begin)[:, None]).astype(np.float64)
    return list(arm.tool_points(q.reshape(-1, arm.robot.dof)).reshape(-1, EDGE_POINTS, 3))


def draw_lines(
    server: viser.ViserServer, name: str, lines: list[ndarray], color: Color | ndarray, width: float
) -> None:
    """Draw polylines in one color, or with a color for each of their points. Without lines, the node is
    removed.

    `width` is in [m]. Colors are sRGB; they are converted because viser expects linear colors.
    """
    if not lines:
        server.scene.remove_by_name(name)
        return
    points = np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])
    point_colors = [np.broadcast_to(color, line.shape) for line in lines]
    ends = np.concatenate([np.stack([rgb[:-1], rgb[1:]], axis=1) for rgb in point_colors])
    linear = np.round(255 * (ends / 255) ** GAMMA).astype(np.uint8)
    server.scene.add_line_segments(name, points.astype(np.float32), linear, thickness=width)
