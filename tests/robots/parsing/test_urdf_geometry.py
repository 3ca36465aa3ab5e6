"""Collision elements of URDFs as triangle meshes."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from robotdiffuse.core.errors import InputError
from robotdiffuse.robots.fitting.convex_parts import Surface
from robotdiffuse.robots.parsing.urdf import UrdfTree


def surfaces(file: Path, shape: str, origin: str = "") -> tuple[Surface, ...]:
    link = f'<link name="arm"><collision>{origin}<geometry>{shape}</geometry></collision></link>'
    file.write_text(f'<robot name="arm">{link}</robot>')
    return UrdfTree(file, {}).surfaces("arm")


@pytest.mark.parametrize(
    ("shape", "volume", "extents"),
    [
        ('<box size="0.1 0.2 0.3"/>', 0.006, [0.1, 0.2, 0.3]),
        ('<sphere radius="0.1"/>', 4 / 3 * np.pi * 1e-3, [0.2] * 3),
        ('<cylinder radius="0.1" length="0.5"/>', np.pi * 5e-3, [0.2, 0.2, 0.5]),
        ('<capsule radius="0.1" length="0.5"/>', np.pi * (5e-3 + 4 / 3 * 1e-3), [0.2, 0.2, 0.7]),
    ],
)
def test_polyhedra_lie_closely_around_primitives(
    tmp_path: Path, shape: str, volume: float, extents: list[float]
) -> None:
    [surface] = surfaces(tmp_path / "arm.urdf", shape)
    solid = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert solid.is_watertight and -1e-9 < solid.volume / volume - 1 < 0.06
    assert (solid.extents > np.array(extents) - 1e-9).all()
    np.testing.assert_allclose(solid.extents, extents, rtol=0.03)


def test_meshes_by_package_relative_and_scaled(tmp_path: Path) -> None:
    package = tmp_path / "my_arm"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    trimesh.creation.annulus(0.02, 0.03, 0.1).export(package / "meshes" / "ring.stl")
    for name in ("package://my_arm/meshes/ring.stl", "../meshes/ring.stl"):
        shape = f'<mesh filename="{name}" scale="2 2 1"/>'
        [ring] = surfaces(package / "urdf" / "arm.urdf", shape, '<origin xyz="0 0 1"/>')
        assert np.linalg.norm(ring.vertices[:, :2], axis=1).max() == pytest.approx(0.06)
        np.testing.assert_allclose(ring.vertices[:, 2].mean(), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("", "link arm: a <collision> has no geometry"),
        ('<torus size="1"/>', "shape <torus> is not supported; known: box, capsule, cylinder, mesh, sphere"),
        ('<sphere radius="0"/>', "link arm: sphere radius is '0'; it must be positive"),
        ('<mesh filename="a.stl" scale="1 0 1"/>', "link arm: mesh scale is '1 0 1'; its numbers must"),
    ],
)
def test_what_is_no_shape_is_refused_by_one_line(shape: str, message: str, tmp_path: Path) -> None:
    trimesh.creation.box([1, 1, 1]).export(tmp_path / "a.stl")
    file = tmp_path / "arm.urdf"
    with pytest.raises(InputError, match=message) as raised:
        surfaces(file, shape)
    assert str(raised.value).count(str(file)) == 1 and "\n" not in str(raised.value)
