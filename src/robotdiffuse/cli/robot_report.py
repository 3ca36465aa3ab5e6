"""What the preparation of a robot made of it, as tables."""

import sys

from robotdiffuse.evaluation.tables import Column, Table, show
from robotdiffuse.robots.fitting.add import AddReport

MOST_PAIRS = 8
"""Pairs of links that are shown: those that refuse most."""


def print_preparation(report: AddReport) -> None:
    """Links, the pairs that refuse most, and what preparation took; warnings on standard error."""
    columns = ("link", "convex parts", "spheres", Column("sticking out", "mm", ".1f", scale=1e3), "covered")
    links = [
        (of.link, of.parts, of.spheres, of.stick_out, "yes" if of.covered else "no") for of in report.links
    ]
    share = [
        Column(name, "%", ".1f", scale=100.0) for name in ("colliding", "refused by parts", "by spheres")
    ]
    pairs = [
        (", ".join(of.links), of.colliding, of.by_parts, of.by_spheres)
        for of in report.false_collisions.pairs[:MOST_PAIRS]
    ]
    of = report.false_collisions
    parts = sum(link.parts for link in report.links)
    summary = [
        ("convex parts, spheres", f"{parts}, {report.sphere_count}"),
        ("configurations free of self-collision", f"{of.free:.1%}"),
        ("of these refused by convex parts, by spheres", f"{of.by_parts:.1%}, {of.by_spheres:.1%}"),
        ("processor time, memory", f"{report.seconds:.0f} s, {report.memory / 2**20:.0f} MiB"),
    ]
    show(
        Table.of("", columns, links), Table.of("", ("pair of links", *share), pairs), Table.pairs("", summary)
    )
    for warning in report.warnings:
        print(f"warning: {warning}", file=sys.stderr)
