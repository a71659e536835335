"""Scenes of surfaces of their own: quadrics in a file, ellipsoids in the scene, molecules; what info and plans say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from filterlab.cli import main
from filterlab.io import load_image, load_molecule, save_quadrics
from filterlab.io.config import ConfigError, dump_config
from filterlab.render import PerspectiveCamera, Phong, raycast
from filterlab.scenes.build import build, load_scene, picture
from filterlab.scenes.plan import PiecesPlan, plan
from filterlab.surfaces import Quadrics, molecular_skin

CONFIGS = Path(__file__).resolve().parent.parent / "configs" / "scenes"
HEAD = "size: [16, 12]\ncamera: {direction: [0.2, 1, -0.3]}\n"
WATER = "3\nwater\nO 0 0 0\nH 0.96 0 0\nh -0.24 0.93 0 more\n"


def glyphs() -> Quadrics:
    tubes = Quadrics.cylinders(torch.tensor([[0.0, 0, 0]]), torch.tensor([[3.0, 0, 0]]), torch.tensor([0.4]), caps=True)
    balls = Quadrics.ellipsoids(torch.tensor([[0.0, 0, 1], [3, 0, 1]]), torch.tensor([[1.0, 0.5, 0.4]] * 2))
    return Quadrics.joined([tubes, balls])


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("glyphs") / "glyphs.npz"
    save_quadrics(glyphs(), path)
    return path


def written(folder: Path, text: str, name: str = "scene.yaml") -> Path:
    (folder / name).write_text(text)
    return folder / name


def cast(surface: Quadrics) -> torch.Tensor:
    """What HEAD says, of a surface in the default material."""
    camera = PerspectiveCamera.framing(surface.domain, (0.2, 1.0, -0.3), aspect=16 / 12)
    return raycast(surface, camera, Phong((0.85, 0.72, 0.55)), size=(16, 12))[..., :3]


def test_quadrics_in_a_file_are_cast(stored, tmp_path):
    scene = load_scene(written(stored.parent, f"surface: {{quadrics: {stored.name}}}\n{HEAD}"))
    assert torch.equal(picture(build(scene)), cast(glyphs()))
    assert load_scene(written(tmp_path, dump_config(scene))) == scene
    cut = load_scene(stored.parent / "scene.yaml", {"region": "{lower: [-2, -2, 0.5], upper: [4, 2, 2]}"})
    assert 0 < int((build(cut).render()[..., 3] > 0).sum()) < int((build(scene).render()[..., 3] > 0).sum())


def test_ellipsoids_stand_in_the_scene(tmp_path):
    listed = "{center: [0, 0, 0], radii: [1, 0.5, 0.3]}, {center: [2, 0, 0], axes: [[1, 1, 0], [-1, 1, 0], [0, 0, 2]]}"
    scene = load_scene(written(tmp_path, f"surface: {{ellipsoids: [{listed}]}}\n{HEAD}"))
    axes = [[[1, 0, 0], [0, 0.5, 0], [0, 0, 0.3]], [[1, -1, 0], [1, 1, 0], [0, 0, 2]]]  # half axes in columns
    centers = torch.tensor([[0, 0, 0], [2, 0, 0]], dtype=torch.float64)
    assert torch.equal(
        picture(build(scene)), cast(Quadrics.ellipsoids(centers, torch.tensor(axes, dtype=torch.float64)))
    )
    assert load_scene(written(tmp_path, dump_config(scene), "full.yaml")) == scene


def test_molecules_are_skins_of_their_atoms(tmp_path):
    path = written(tmp_path, WATER, "water.xyz")
    scene = load_scene(written(tmp_path, f"surface: {{molecule: water.xyz, shrink: 0.7, scale: 0.5}}\n{HEAD}"))
    atoms = load_molecule(path)
    assert atoms.elements == ("O", "H", "H")
    assert atoms.radii.tolist() == [1.52, 1.10, 1.10]  # Mantina et al., table 12
    assert torch.equal(picture(build(scene)), cast(molecular_skin(atoms.centers, 0.5 * atoms.radii, 0.7)))


def test_atoms_of_a_pdb_file(tmp_path):
    """Columns as the format has them: no element, alternate places, a second model."""
    rows = [
        "HEADER    nothing",
        "ATOM      1  CA AGLY A   1      11.104   6.134  -6.504  1.00  0.00           C",
        "ATOM      2  CA BGLY A   1      99.104   6.134  -6.504  1.00  0.00           C",
        "HETATM    3 ZN    ZN A   2       1.000  -2.000   3.500",
        "ENDMDL",
        "ATOM      1  CA  GLY A   1       0.000   0.000   0.000  1.00  0.00           C",
    ]
    found = load_molecule(written(tmp_path, "\n".join(rows), "a.pdb"))
    assert found.elements == ("C", "Zn")
    assert found.centers.tolist() == [[11.104, 6.134, -6.504], [1, -2, 3.5]]


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.xyz", "", r":1: expected how many atoms there are; got ''"),
        ("a.xyz", "C 0 0 0\n", r":1: expected how many atoms there are; got 'C 0 0 0'"),
        ("a.xyz", "2\n\nC 0 0 0\n", "expected 2 atoms, one a line from the third on; got 1"),
        ("a.xyz", "1\n\nC 0 0\n", ":3: expected element x y z; got 'C 0 0'"),
        ("a.xyz", "1\n\nCarbon 0 0 0\n", ":3: unknown element 'Carbon'"),
        ("a.xyz", "0\n\n", "expected atoms; got none"),
        ("a.pdb", "HEADER\n", "expected atoms; got none"),
        ("a.pdb", "ATOM      1  CA  GLY A   1      11.1\n", "columns 31 to 54"),
        ("a.mol", "", "unknown ending '.mol'; known endings: .xyz, .pdb, .ent"),
    ],
)
def test_what_holds_no_atoms_is_refused(tmp_path, name, text, told):
    with pytest.raises(ValueError, match=told):
        load_molecule(written(tmp_path, text, name))


def test_what_is_known_of_quadrics(stored, tmp_path, capsys):
    assert main(["info", str(stored)]) == 0
    assert main(["render", str(stored), "--explain", "--size", "16", "12"]) == 0
    told = capsys.readouterr().out
    assert "5, float32" in told
    assert "quadrics, cut by up to 2 planes" in told
    assert "x, y, z" in told
    assert main(["render", str(stored), "-o", str(tmp_path / "a.png"), "--size", "16", "12", "-q"]) == 0
    assert load_image(tmp_path / "a.png").amax() > 0.3
    found = plan(build(load_scene(written(stored.parent, f"surface: {{quadrics: {stored.name}}}\n{HEAD}"))))
    assert isinstance(found, PiecesPlan)
    assert (found.pieces, found.planes, found.rays, found.image_bytes) == (5, 2, 192, 3072)
    assert found.surface_bytes > 5 * 188


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("surface: {quadrics: none.npz}", "surface.quadrics: expected a file; found none"),
        ("surface: {quadrics: volume.npz}", r"surface.quadrics: expected a file that .*save_quadrics wrote"),
        ("surface: {quadrics: torn.npz}", "surface.quadrics: .*an intact npz archive"),
        ("surface: {quadrics: glyphs.npz, slim: a.npz}", "expected one of level, slim, .*; got slim and quadrics"),
        ("surface: {}", "expected one of level, slim, .*; got none of them"),
        ("surface: {quadric: glyphs.npz}", "expected one of .*; got none of them"),
        ("surface: {quadrics: glyphs.npz, sheet: 2}", "unknown key 'sheet'; did you mean 'sheets'"),
        ("surface: {quadrics: glyphs.npz}\nvolume: volume.npz", "volume: a surface of quadrics is no part of a volume"),
        ("surface: {ellipsoids: []}", "surface.ellipsoids: "),
        (
            "surface: {ellipsoids: [{center: [0, 0, 0]}]}",
            r"ellipsoids\[0\]: expected either radii or axes; got neither",
        ),
        ("surface: {ellipsoids: [{center: [0, 0], radii: [1, 1, 1]}]}", r"surface.ellipsoids\[0\].center"),
        ("surface: {ellipsoids: [{center: [0, 0, 0], radii: [1, 0, 1]}]}", r"surface.ellipsoids\[0\].radii\[1\]"),
        (
            "surface: {ellipsoids: [{center: [0, 0, 0], axes: [[1, 0, 0], [2, 0, 0], [0, 0, 1]]}]}",
            r"ellipsoids\[0\]: axes: expected three that span space",
        ),
        ("surface: {molecule: none.xyz}", "surface.molecule: expected a file of atoms; found none"),
        ("surface: {molecule: volume.npz}", "surface.molecule: .*unknown ending '.npz'"),
        ("surface: {molecule: a.xyz, shrink: 1}", "surface.shrink: expected less than 1"),
    ],
)
def test_mistakes_name_the_key(stored, tmp_path, text, told):
    (tmp_path / "glyphs.npz").write_bytes(stored.read_bytes())
    (tmp_path / "torn.npz").write_bytes(stored.read_bytes()[:100])
    np.savez(tmp_path / "volume.npz", samples=np.zeros((3, 3, 3), np.float32))
    written(tmp_path, WATER, "a.xyz")
    with pytest.raises(ConfigError, match=told):
        load_scene(written(tmp_path, text))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["mesh", "{}", "-o", "a.ply"], "expected a level set, of which triangles are made; got a surface of quadrics"),
        (["render", "{}", "--level", "3", "-o", "a.png"], "no --level, --frame and --channel of quadrics"),
    ],
)
def test_quadrics_are_not_mistaken_for_volumes(stored, tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    assert main([a.format(stored) for a in arguments]) == 1
    assert told in capsys.readouterr().err
