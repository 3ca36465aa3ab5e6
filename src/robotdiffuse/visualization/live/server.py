"""The server of a page: viser behind an access proxy, with lights, a floor and a first view."""

import secrets

import numpy as np
import rich
import viser
from jaxtyping import Float
from numpy import ndarray
from viser import infra

from robotdiffuse.problems.problem import Problem
from robotdiffuse.visualization import style
from robotdiffuse.visualization.camera import VERTICAL_FIELD, view_of_motion
from robotdiffuse.visualization.live.access import SECRET
from robotdiffuse.visualization.style import Surface

FLOOR_SIZE = 4.7
"""Edge length of the floor, as a multiple of the arm's reach."""
VIEW_SIZE, VIEW_MARGINS = (900, 800), (0.06, 0.06)
"""Window size for which the first view is chosen [pixels], and the fractions of its height left free."""
LIGHTS = (2.0, (-2.0, -3.0, 5.0)), (1.1, (3.0, 2.0, 3.0)), (0.7, (-3.0, 3.0, 1.0))
"""Intensity and position of each light."""
PANEL_OFFSET = 0.2
"""Shift of the view to the left of the control panel, as a fraction of the window's height."""


class _Server(viser.ViserServer):
    """viser's server without its public share URLs."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: a browser must not open a tunnel from the internet to the page."""
        return None


def new_server() -> tuple[viser.ViserServer, str]:
    """A viser server on a local port, and the secret that its access proxy needs."""
    secret = secrets.token_urlsafe(32)
    with rich.get_console().capture():  # viser prints its own address; other threads' output is left alone
        server = _Server("127.0.0.1", 0, verbose=False)
    _require_secret(secret, server)
    return server, secret


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server without the message that its thread would print."""
    loop = server._websock_server._background_event_loop
    assert loop is not None, "the server runs"
    loop.call_soon_threadsafe(rich.get_console().begin_capture)
    server.stop()


def add_stage(server: viser.ViserServer, reach: float) -> None:
    """Add the theme, lights and a floor for an arm of this reach [m]."""
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.set_panel_label("RobotDiffuse")
    # viser's default lighting, an environment map with shadows, is a hundred times slower without a
    # graphics card
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(enabled=False)
    server.scene.add_light_ambient("/light/sky", intensity=1.1)
    for i, (intensity, at) in enumerate(LIGHTS):
        server.scene.add_light_directional(f"/light/{i}", intensity=intensity, position=at)
    side = FLOOR_SIZE * reach
    server.scene.add_grid(
        "/floor",
        side,
        side,
        cell_size=side / 40,
        cell_color=(236, 238, 241),
        section_size=side / 8,
        section_color=(214, 218, 224),
    )


def set_first_view(
    server: viser.ViserServer, problem: Problem, surfaces: list[Surface], q: Float[ndarray, "n dof"]
) -> None:
    """Set the view of new browsers so that the arm is visible in all configurations, beside the panel."""
    tool = style.tool_point(problem.robot, surfaces)
    view = view_of_motion(problem.robot, problem.scene, surfaces, tool, q, *VIEW_SIZE, VIEW_MARGINS)
    height = 2 * np.tan(VERTICAL_FIELD / 2) * np.linalg.norm(view.target - view.eye)
    aside = PANEL_OFFSET * height * view.rotation[0]
    camera = server.initial_camera
    camera.fov = VERTICAL_FIELD
    camera.position, camera.look_at = tuple(view.eye + aside), tuple(view.target + aside)


def _require_secret(secret: str, server: viser.ViserServer) -> None:
    """Close connections that bypass the access proxy: viser accepts any page in any browser on this machine
    that finds its port. Raises AttributeError for a version of viser with other internals."""
    inner = server._websock_server
    connections = inner._live_connections

    async def check(client: infra.WebsockClientConnection) -> None:
        connection = connections[client.client_id]
        request = connection.request
        given = "" if request is None else request.headers.get(SECRET, "")
        if not secrets.compare_digest(given.encode(), secret.encode()):
            await connection.close(1008)

    inner.on_client_connect(check)
