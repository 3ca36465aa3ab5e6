"""The server of a page: viser with access control, lights, a floor and a first view.

viser by itself accepts every connection. This server checks each browser before it sends data of the session.
If there is a token, it must be the path of the address that the browser connects to. Without a token, the
address must name this machine, which prevents DNS rebinding. Pages of other origins are refused. Viser's own
web page (HTML and JavaScript) is served without a check.
"""

import hmac
import secrets
import socket

import numpy as np
import rich
import viser
from viser import infra

from robotdiffuse.core.network import is_loopback, listening, named_host, url_part
from robotdiffuse.core.types import Configuration
from robotdiffuse.drawables import drawables
from robotdiffuse.problems.problem import Problem
from robotdiffuse.visualization.picture import VERTICAL_FIELD, DrawnArm, view_of_motion

FLOOR_SIZE = 4.7
"""Edge length of the floor, as a multiple of the arm's reach."""
VIEW_SIZE = (900, 800)
"""Window size for which the first view is chosen [pixels]."""
VIEW_MARGINS = (0.06, 0.06)
"""Fractions of the window's height that the first view leaves free above and below."""
LIGHTS = (2.0, (-2.0, -3.0, 5.0)), (1.1, (3.0, 2.0, 3.0)), (0.7, (-3.0, 3.0, 1.0))
"""Intensity and position of each light."""
PANEL_OFFSET = 0.2
"""How far the arm is moved to the left, so that the control panel does not cover it, as a fraction of the
window's height."""
POLICY_VIOLATION = 1008
"""WebSocket close code for refused clients."""


def free_port(host: str, port: int) -> int:
    """The port, or a free port for 0. Raises InputError if the server cannot listen on it."""
    with listening(host, port) as listener:
        return listener.getsockname()[1]


def may_connect(path: str, host: str, origin: str | None, token: str) -> bool:
    """Whether a browser may connect, by the path and the headers Host and Origin of its request."""
    if origin is not None and url_part(origin, "netloc") != host:
        return False
    if token:
        return hmac.compare_digest(path.partition("?")[0].strip("/").encode(), token.encode())
    return is_loopback(named_host(host))


class PageServer(viser.ViserServer):
    """A viser server that checks each browser, prints no messages, and offers no public share URLs.

    It uses internals of viser: raises AttributeError for a version of viser with other internals.
    """

    def __init__(self, host: str, port: int) -> None:
        """If other machines can reach `host`, a random token is required of browsers."""
        self.token = "" if is_loopback(host) else secrets.token_urlsafe(16)
        # suppresses the address that viser prints in this thread
        with rich.get_console().capture():
            super().__init__(host, port, verbose=False)
        websock = self._websock_server

        async def check(client: infra.WebsockClientConnection) -> None:
            connection = websock._live_connections[client.client_id]
            request = connection.request
            assert request is not None, "the handshake was answered, so there is a request"
            headers = request.headers
            hosts = headers.get_all("Host")
            origins = headers.get_all("Origin") or [None]
            single_headers = len(hosts) == len(origins) == 1
            if not (single_headers and may_connect(request.path, hosts[0], origins[0], self.token)):
                await connection.close(POLICY_VIOLATION)

        websock.on_client_connect(check)
        # browsers that connected before the check existed; they reconnect by themselves and are then checked
        websock.disconnect_all_clients()

    @property
    def url(self) -> str:
        """The address of the page, for browsers."""
        host = self.get_host()
        name = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        place = f"{name}:{self.get_port()}/"
        return f"http://{place}" + (f"?websocket=ws://{place}{self.token}" if self.token else "")

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Returns None, so that browsers cannot request a public tunnel to the page."""
        return None

    def stop(self) -> None:
        """Stop the server, suppressing the message that viser's thread prints."""
        loop = self._websock_server._background_event_loop
        assert loop is not None, "the server runs"
        loop.call_soon_threadsafe(rich.get_console().begin_capture)
        super().stop()

    def add_stage(self, reach: float) -> None:
        """Add the theme, lights and a floor for an arm of this reach [m]."""
        self.gui.configure_theme(show_logo=False, show_share_button=False)
        self.gui.set_panel_label("RobotDiffuse")
        # viser's default lighting, an environment map with shadows, is a hundred times slower without a
        # graphics card
        self.scene.configure_environment_map(None)
        self.scene.configure_default_lights(enabled=False)
        self.scene.add_light_ambient("/light/sky", intensity=1.1)
        for i, (intensity, at) in enumerate(LIGHTS):
            self.scene.add_light_directional(f"/light/{i}", intensity=intensity, position=at)
        side = FLOOR_SIZE * reach
        self.scene.add_grid(
            "/floor",
            side,
            side,
            cell_size=side / 40,
            cell_color=(236, 238, 241),
            section_size=side / 8,
            section_color=(214, 218, 224),
        )

    def set_first_view(self, arm: DrawnArm, problem: Problem, goal: Configuration | None) -> None:
        """Set the view of new browsers so that the arm is visible beside the panel, at the problem's start
        and at the configuration `goal`, if there is one."""
        q = np.stack([problem.start, problem.start if goal is None else goal])
        view = view_of_motion(arm, drawables(problem.scene), q, VIEW_SIZE, VIEW_MARGINS)
        height = 2 * np.tan(VERTICAL_FIELD / 2) * np.linalg.norm(view.target - view.eye)
        aside = PANEL_OFFSET * height * view.rotation[0]
        camera = self.initial_camera
        camera.fov = VERTICAL_FIELD
        camera.position, camera.look_at = tuple(view.eye + aside), tuple(view.target + aside)
