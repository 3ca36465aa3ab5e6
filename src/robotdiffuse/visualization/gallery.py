"""A gallery of replays in one HTML file: thumbnails on the left, the replay on the right."""

import base64
import html
import io
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

from PIL import Image

from robotdiffuse.core.output_files import check_output, write_atomically
from robotdiffuse.core.types import Path, Trajectory
from robotdiffuse.robots.robot import Robot
from robotdiffuse.scenes.moving_obstacles import MovingObstacle
from robotdiffuse.scenes.scene import Scene
from robotdiffuse.visualization.picture import PictureSettings, render
from robotdiffuse.visualization.replay_page import page_data, page_text

THUMBNAIL = PictureSettings(480, 300, ghosts=3)

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{title}}</title>
<style>
* { box-sizing: border-box; }
html, body { margin: 0; height: 100%; overflow: hidden; background: #eceef1; color: #222b38;
  font: 13px/1.4 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
body { display: flex; }
nav { flex: none; width: 262px; padding: 16px 14px; overflow-y: auto; background: #f7f8fa;
  border-right: 1px solid rgba(34, 43, 56, .1); }
h1 { margin: 2px 4px 13px; font-size: 17px; font-weight: 650; letter-spacing: -.01em; }
button { display: block; width: 100%; margin: 0 0 12px; padding: 0 0 8px; overflow: hidden; border: 0;
  border-radius: 12px; background: white; color: inherit; font: inherit; text-align: left; cursor: pointer;
  box-shadow: 0 0 0 1px rgba(34, 43, 56, .08), 0 3px 12px rgba(30, 40, 60, .06); }
button:hover { box-shadow: 0 0 0 1px rgba(34, 43, 56, .22), 0 3px 12px rgba(30, 40, 60, .1); }
button[aria-current=true] { box-shadow: 0 0 0 2.5px #10a37f, 0 3px 12px rgba(30, 40, 60, .1); }
img { display: block; width: 100%; aspect-ratio: 8 / 5; }
b { display: block; margin: 8px 12px 0; font-weight: 600; }
span { display: block; margin: 1px 12px 0; color: #6b7684; font-size: 12px;
  font-variant-numeric: tabular-nums; }
iframe { flex: 1; min-width: 0; height: 100%; border: 0; }
@media (max-width: 760px) { body { flex-direction: column; }
  nav { width: 100%; display: flex; gap: 10px; padding: 8px; overflow-x: auto; } h1 { display: none; }
  button { flex: none; width: 150px; margin: 2px; } }
</style>
</head>
<body>
<nav><h1>{{title}}</h1>{{buttons}}</nav>
<iframe title="replay"></iframe>
<script type="application/json" id="replays">{{replays}}</script>
<script>
const replays = JSON.parse(document.getElementById("replays").textContent);
const buttons = [...document.querySelectorAll("button")], frame = document.querySelector("iframe");
let shown = -1;
function show(i, scroll = true) {
  if (i === shown || !replays.pages[i]) return;
  shown = i;
  buttons.forEach((button, j) => button.setAttribute("aria-current", i === j));
  // not at first: in an iframe it would scroll the outer page
  if (scroll) buttons[i].scrollIntoView({ block: "nearest", inline: "nearest" });
  frame.srcdoc = replays.pages[i].map((part) => replays.parts[part]).join("");
}
buttons.forEach((button, i) => button.addEventListener("click", () => show(i)));
addEventListener("keydown", (event) => {
  const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
  if (step) { event.preventDefault(); show(shown + step); }
});
show(0, false);
</script>
</body>
</html>
"""


@dataclass(frozen=True, eq=False)
class GalleryEntry:
    """A motion in a gallery."""

    title: str
    caption: str
    """One line below the title."""
    scene: Scene
    motion: Path | Trajectory
    moving: tuple[MovingObstacle, ...] = ()


def write_gallery(
    robot: Robot,
    entries: Sequence[GalleryEntry],
    file: str | FilePath,
    title: str,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a gallery as .html; it opens offline.

    `progress` is called with the number of motions drawn so far and in all. Raises InputError for another
    ending or a file that cannot be written.
    """
    target = check_output(file, (".html", ".htm"))
    replays = []
    buttons = []
    for i, entry in enumerate(entries):
        data = page_data(robot, entry.scene, entry.motion, moving=entry.moving)
        replays.append(page_text(entry.title, data))
        buttons.append(
            f'<button><img alt="" src="data:image/jpeg;base64,{_thumbnail(robot, entry)}">'
            f"<b>{html.escape(entry.title)}</b><span>{html.escape(entry.caption)}</span></button>"
        )
        if progress is not None:
            progress(i + 1, len(entries))
    # in JSON '<' occurs only in strings; escaped, it cannot end the script element
    data = json.dumps(_shared(replays)).replace("<", "\\u003c")
    page = PAGE.replace("{{title}}", html.escape(title)).replace("{{buttons}}", "".join(buttons))
    write_atomically(target, page.replace("{{replays}}", data))


def _shared(pages: list[str]) -> dict[str, list]:
    """Pages split into parts, each stored once, because all share the 3D library and the robot."""
    cut = [re.split(r'(?=<script)|(?="scene":)', page) for page in pages]
    places = {part: i for i, part in enumerate(dict.fromkeys(part for parts in cut for part in parts))}
    return {"parts": list(places), "pages": [[places[part] for part in parts] for parts in cut]}


def _thumbnail(robot: Robot, entry: GalleryEntry) -> str:
    """A small JPEG in base64."""
    pixels, _ = render(robot, entry.scene, entry.motion, THUMBNAIL, moving=entry.moving)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=88)
    return base64.b64encode(buffer.getvalue()).decode("ascii")
