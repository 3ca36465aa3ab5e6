"""Prints the result of preparing a robot as tables."""

import sys

from robotdiffuse.evaluation.tables import Column, Table, show
from robotdiffuse.robots.fitting.add import AddReport

MAX_PAIRS = 8
"""Number of pairs of links in the table, those with the most false collisions."""


def print_preparation(report: AddReport) -> None:
    """Print links, pairs with the most false collisions, and cost of the preparation; warnings on standard
    error."""
    columns = ("link", "convex parts", "spheres", Column("stick-out", "mm", ".1f", scale=1e3), "covered")
    links = [
        (of.link, of.parts, of.spheres, of.stick_out, "yes" if of.covered else "no") for of in report.links
    ]
    share = [
        Column(name, "%", ".1f", scale=100.0)
        for name in ("colliding", "falsely by parts", "falsely by spheres")
    ]
    pairs = [
        (", ".join(of.links), of.colliding, of.by_parts, of.by_spheres)
        for of in report.false_collisions.pairs[:MAX_PAIRS]
    ]
    of = report.false_collisions
    parts = sum(link.parts for link in report.links)
    summary = [
        ("convex parts, spheres", f"{parts}, {report.sphere_count}"),
        ("configurations free of self-collision", f"{of.free:.1%}"),
        ("of these false collisions by convex parts, by spheres", f"{of.by_parts:.1%}, {of.by_spheres:.1%}"),
        ("processor time, memory", f"{report.seconds:.0f} s, {report.memory / 2**20:.0f} MiB"),
    ]
    show(
        Table.of("", columns, links), Table.of("", ("pair of links", *share), pairs), Table.pairs("", summary)
    )
    for warning in report.warnings:
        print(f"warning: {warning}", file=sys.stderr)
