"""The command `robotdiffuse live`, and the page of `robotdiffuse explore --live`."""

import threading
from typing import NoReturn

from rich.console import Console

from robotdiffuse.cli.arguments import Namespace, chosen
from robotdiffuse.core.interrupts import exit_on_interrupt
from robotdiffuse.planning.exploration.steps import ExplorerSettings
from robotdiffuse.problems.files import load_problem
from robotdiffuse.visualization.live.exploration import ExplorationPage, ExplorationSession
from robotdiffuse.visualization.live.page import LivePage, Page
from robotdiffuse.visualization.live.server import PageServer, free_port
from robotdiffuse.visualization.live.session import PageOptions, Session, first_problem


def run_live(arguments: Namespace) -> NoReturn:
    options = PageOptions(**chosen(arguments, PageOptions.__dataclass_fields__))
    port = free_port(arguments.host, arguments.port)
    with Console(stderr=True).status("loading the robot (preparing a new URDF takes a minute)"):
        problem = first_problem(arguments.problem, arguments.robot)
    serve_until_stopped(Page(Session(problem, options), PageServer(arguments.host, port)))


def show_live(arguments: Namespace, settings: ExplorerSettings) -> NoReturn:
    """Serve the page of an exploration until Ctrl-C."""
    port = free_port(arguments.host, arguments.port)
    problem = load_problem(arguments.problem)
    session = ExplorationSession(problem, settings, arguments.noise, arguments.seed, arguments.speed)
    serve_until_stopped(ExplorationPage(session, PageServer(arguments.host, port)))


def serve_until_stopped(page: LivePage) -> NoReturn:
    """Print the address of a page, serve it until Ctrl-C, and end the process."""
    # at once: closing the page first would wait for a drawing, which may be compiling
    with exit_on_interrupt():
        print(f"the page is at {page.server.url} (stop with Ctrl-C)", flush=True)
        while True:
            threading.Event().wait()
