"""The commands `robotdiffuse data generate`, `info`, `check`, `view`, `export` and `import`."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from robotdiffuse.cli.arguments import Namespace, check_workers, chosen
from robotdiffuse.cli.console import progress
from robotdiffuse.cli.view import open_in_browser
from robotdiffuse.core.errors import InputError, counted
from robotdiffuse.core.files import check_output
from robotdiffuse.core.tables import show
from robotdiffuse.datasets.external import export_npz, import_npz
from robotdiffuse.datasets.shards import motion_of, random_rows, read_manifest, scenes_of
from robotdiffuse.evaluation.checks import check_data
from robotdiffuse.evaluation.data_report import tables, write_page
from robotdiffuse.generation import GenerationSettings, generate
from robotdiffuse.generation.factory import SEARCHES
from robotdiffuse.robots import load_robot
from robotdiffuse.robots.robot import Robot
from robotdiffuse.visualization.replay_page import GalleryEntry, write_gallery


def run_generate(arguments: Namespace) -> None:
    check_workers(arguments)
    options = chosen(arguments, GenerationSettings.__dataclass_fields__)
    if arguments.planner not in (None, GenerationSettings.planner):
        options["search"] = SEARCHES.defaults(arguments.planner)
    settings = GenerationSettings(**options)
    if arguments.safety_distance is not None:
        search = replace(settings.search, safety_distance=arguments.safety_distance)
        settings = replace(settings, search=search)
    with progress("trajectories") as update:
        workers = arguments.workers or os.cpu_count() or 1
        count = generate(settings, Path(arguments.out), workers, arguments.cluster, update)
    print(
        f"{counted(count, 'trajectory', 'trajectories')} of {settings.waypoints} waypoints in {arguments.out}"
    )


def run_info(arguments: Namespace) -> None:
    page = Path(arguments.page or f"{arguments.folder}/report.html")
    show(*tables(write_page(arguments.folder, page, arguments.robot and load_robot(arguments.robot))))
    print(f"wrote {page}")


def run_check(arguments: Namespace) -> int:
    with progress("checking motions") as update:
        check = check_data(
            arguments.folder,
            arguments.robot and load_robot(arguments.robot),
            arguments.count,
            arguments.seed,
            arguments.workers,
            not arguments.no_pybullet,
            update,
        )
    show(*check.tables)
    return 1 if check.findings else 0


def run_view(arguments: Namespace) -> None:
    folder = Path(arguments.folder)
    manifest = read_manifest(folder)
    out = check_output(arguments.out or folder / "samples.html", (".html", ".htm"))
    robot = load_robot(arguments.robot or manifest.robot)
    manifest.check_robot(robot)
    entries = list(_gallery_entries(folder, robot, arguments.count, arguments.seed))
    if not entries:
        raise InputError(f"{folder} holds no motions yet; continue `robotdiffuse data generate` first")
    with progress("drawing motions") as update:
        write_gallery(robot, entries, out, folder.resolve().name, update)
    print(f"wrote {out}")
    if not arguments.out:
        open_in_browser(out)


def _gallery_entries(folder: Path, robot: Robot, number: int, seed: int) -> Iterator[GalleryEntry]:
    """Random motions, in the order of the shards."""
    manifest = read_manifest(folder)
    for shard, rows in random_rows(folder, number, seed):
        for row in rows.tolist():
            # first, since it checks the index of the family
            scene = scenes_of(manifest, shard, slice(row, row + 1)).scene(0)
            family = list(manifest.families)[int(shard["family"][row])]
            cost, detour, clearance = (float(shard[name][row]) for name in ("cost", "detour", "clearance"))
            line = "trivial" if shard["line_free"][row] else f"detour {detour:.2f}"
            caption = f"{cost:.2f} rad · {line} · {100 * clearance:.1f} cm clear"
            title = f"{family} · shard {shard.index}, row {row}"
            yield GalleryEntry(title, caption, scene, motion_of(robot, shard, row))


def run_export(arguments: Namespace) -> None:
    count, left_out = export_npz(arguments.folder, arguments.file)
    print(
        f"wrote {arguments.file}: {counted(count, 'motion')}; "
        f"{left_out:,} left out, since their scenes are not two spheres"
    )


def run_import(arguments: Namespace) -> None:
    with progress("importing motions") as update:
        count = import_npz(arguments.file, arguments.out, arguments.robot, arguments.radius, update)
    print(
        f"{counted(count, 'motion')} in {arguments.out}; to validate: robotdiffuse data check {arguments.out}"
    )
