"""Affine maps of other tools: their files, their coordinates, and what comes out of `resample` by them."""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch

from filterlab import Volume, load_volume, resample, save_volume
from filterlab.cli import main
from filterlab.io import CONVENTIONS, VolumeFileError, describe, load_affine
from filterlab.world import LPS, World

sitk = pytest.importorskip("SimpleITK", reason="the extra `itk` is not installed")

pytestmark = pytest.mark.filterwarnings("ignore::filterlab.resampling.AliasingWarning")  # some grids are coarser


def turned(seed: int, scale: float = 0.2) -> np.ndarray:
    """A 4×4 matrix near a rotation about an oblique axis, with shear, and a translation."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] += scale * rng.standard_normal((3, 3))
    matrix[:3, 3] = rng.uniform(-2, 2, 3)
    return matrix


def grid(seed: int, size: tuple[int, int, int], flipped: bool) -> np.ndarray:
    """An oblique affine of anisotropic voxels at right angles whose box has its middle at the origin."""
    rotation, _ = np.linalg.qr(turned(seed)[:3, :3])
    rotation *= np.sign(np.diag(rotation))
    affine = np.eye(4)
    affine[:3, :3] = rotation * [1.5 if flipped else -1.5, 0.8, 2.5]
    affine[:3, 3] = -affine[:3, :3] @ ((np.array(size) - 1) / 2)
    return affine


def smooth(size: tuple[int, int, int]) -> torch.Tensor:
    x, y, z = np.meshgrid(*(np.arange(n) / n for n in size), indexing="ij")
    return torch.from_numpy((100 * np.sin(5 * x) * np.cos(4 * y + 1) + 50 * z).T.copy())


SIZES = (20, 18, 16), (15, 17, 13)


@pytest.fixture(params=["negative.nii", "positive.nii", "negative.nrrd", "positive.nrrd"])
def pair(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, Path]:
    """A volume and a target, both oblique; the determinant of the target is said, that of the volume is the other."""
    sign, _, ending = request.param.partition(".")
    paths = tmp_path / f"volume.{ending}", tmp_path / f"target.{ending}"
    for seed, (path, size) in enumerate(zip(paths, SIZES, strict=True)):
        affine = grid(seed, size, (sign == "positive") ^ (seed == 0))
        save_volume(Volume(smooth(size), affine=affine, world=World(LPS)), path)
    return paths


def by_sitk(volume: Path, target: Path, transform: object, order: int) -> np.ndarray:
    """What SimpleITK makes of the two files."""
    moving, fixed = (sitk.ReadImage(str(p), sitk.sitkFloat64) for p in (volume, target))
    return sitk.GetArrayFromImage(sitk.Resample(moving, fixed, transform, order, -1e4))


def itk_transform(matrix: np.ndarray, center: tuple[float, float, float] = (3.0, -2.0, 1.0)) -> object:
    """An affine transform of ITK about a centre: y = M (x − c) + t + c."""
    transform = sitk.AffineTransform(3)
    transform.SetMatrix(matrix[:3, :3].ravel())
    transform.SetTranslation(matrix[:3, 3])
    transform.SetCenter(center)
    return transform


def by_command(volume: Path, target: Path, affine: Path, *more: str) -> np.ndarray:
    out = volume.with_name("out.npy")
    line = ["resample", str(volume), "-q", "-o", str(out), "--like", str(target), "--affine", str(affine)]
    assert (
        main([*line, "--method", "trilinear", "--boundary", "border", "--fill", "-10000", "--dtype", "float64", *more])
        == 0
    )
    return load_volume(out).samples.numpy()


def check_same(found: np.ndarray, expected: np.ndarray, path: Path) -> None:
    """NIfTI has its place in float32, which ITK makes a rotation of once more."""
    inside = (expected > -9999) & (found > -9999)
    assert inside.mean() > 0.3
    assert np.mean(inside != (expected > -9999)) < 0.01
    assert np.abs(found - expected)[inside].max() < (1e-3 if path.suffix == ".nii" else 1e-9)


ONE = pytest.mark.parametrize("pair", ["negative.nrrd"], indirect=True)


@ONE
@pytest.mark.parametrize("kind", ["txt", "mat", "h5", "matrix"])
def test_every_file_of_itk_says_the_same(pair: tuple[Path, Path], tmp_path: Path, kind: str) -> None:
    check_itk(pair, tmp_path / f"transform.{kind}", inverse=False)


@pytest.mark.parametrize("inverse", [False, True])
def test_itk(pair: tuple[Path, Path], tmp_path: Path, inverse: bool) -> None:
    check_itk(pair, tmp_path / "transform.tfm", inverse)


def check_itk(pair: tuple[Path, Path], path: Path, inverse: bool) -> None:
    """A file of ITK puts the volume where SimpleITK puts it, oblique and anisotropic."""
    transform = itk_transform(turned(7, 0.1))
    if path.suffix == ".matrix":
        matrix = np.eye(4)
        matrix[:3, 3] = transform.TransformPoint((0, 0, 0))
        matrix[:3, :3] = np.reshape(transform.GetMatrix(), (3, 3))
        np.savetxt(path, matrix, fmt="%.17g")
    else:
        sitk.WriteTransform(transform, str(path))
    expected = by_sitk(*pair, transform.GetInverse() if inverse else transform, sitk.sitkLinear)
    found = by_command(*pair, path, "--convention", "itk", *(["--inverse"] if inverse else []))
    check_same(found, expected, pair[0])


@pytest.mark.parametrize("declared", [None, "left-posterior-superior", "right-anterior-superior", "scanner-xyz"])
def test_itk_s_axes_are_those_that_it_reads_from_a_file(tmp_path: Path, declared: str | None) -> None:
    """Numbers of NRRD files without an anatomical space are not turned round, neither by ITK nor here."""
    paths = tmp_path / "volume.nrrd", tmp_path / "target.nii"
    save_volume(Volume(smooth(SIZES[0]), affine=grid(0, SIZES[0], True), world=World(declared)), paths[0])
    save_volume(Volume(smooth(SIZES[1]), affine=grid(1, SIZES[1], False)), paths[1])
    transform = itk_transform(turned(7, 0.1))
    sitk.WriteTransform(transform, str(tmp_path / "a.tfm"))
    expected = by_sitk(*paths, transform, sitk.sitkLinear)
    check_same(by_command(*paths, tmp_path / "a.tfm", "--convention", "itk"), expected, paths[1])


def fsl_points(path: Path, voxels: np.ndarray) -> np.ndarray:
    """FSL's coordinates of voxels (…, 3), as its documentation tells: millimetres from the first voxel, and where the
    determinant of the sform or qform is positive, x counted back from the last one."""
    header = nibabel.load(path).header
    place = header.get_sform() if header["sform_code"] > 0 else header.get_qform()
    voxels = voxels.astype(float).copy()
    if np.linalg.det(place[:3, :3]) > 0:
        voxels[..., 0] = header["dim"][1] - 1 - voxels[..., 0]
    return voxels * np.abs(header["pixdim"][1:4].astype(float))


@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("pair", ["negative.nii", "positive.nii"], indirect=True)
def test_fsl(pair: tuple[Path, Path], tmp_path: Path, inverse: bool) -> None:
    """Voxels of the volume come to lie where FLIRT's matrix leads their scaled coordinates to in the target."""
    matrix = turned(5, 0.1)
    np.savetxt(tmp_path / "flirt.mat", matrix, fmt="%.10f  ")
    headers = [describe(p) for p in pair]
    found = load_affine(tmp_path / "flirt.mat", "fsl", volume=headers[0], target=headers[1], inverse=inverse)
    read = np.loadtxt(tmp_path / "flirt.mat")
    voxels = np.random.default_rng(0).uniform(0, 12, (50, 3))
    scaled = fsl_points(pair[0], voxels)
    led = np.linalg.solve(read, np.c_[scaled, np.ones(50)].T).T if inverse else np.c_[scaled, np.ones(50)] @ read.T
    moved = np.c_[voxels, np.ones(50)] @ (found @ headers[0].affine).T  # in the world of the target
    in_target = np.linalg.solve(headers[1].affine, moved.T).T[:, :3]
    assert np.allclose(fsl_points(pair[1], in_target), led[:, :3], atol=1e-4)  # pixdim is float32


@ONE
def test_flirt_s_volumes_may_be_others_than_the_ones_resampled(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """A matrix between two grids moves any volume of the same worlds: cut at another place, put on another grid."""
    volume, target = pair
    np.savetxt(tmp_path / "flirt.mat", turned(5, 0.1))
    whole = load_volume(volume)
    shift = np.eye(4)
    shift[:3, 3] = 2, 1, 3
    part = Volume(whole.samples[3:, 1:, 2:], affine=whole.affine @ shift, world=whole.world)
    save_volume(part, tmp_path / f"part{volume.suffix}", nifti2=volume.suffix == ".nii")
    expected = by_command(volume, target, tmp_path / "flirt.mat", "--convention", "fsl")
    flirt = ["--convention", "fsl", "--flirt-in", str(volume)]
    found = by_command(tmp_path / f"part{volume.suffix}", target, tmp_path / "flirt.mat", *flirt)
    inside = (expected > -9999) & (found > -9999)
    assert inside.mean() > 0.2
    assert np.mean(np.abs(found - expected)[inside] < 1e-9) > 0.8
    back = ["--convention", "fsl", "--inverse"]
    once = by_command(target, volume, tmp_path / "flirt.mat", *back)
    assert np.array_equal(once, by_command(target, volume, tmp_path / "flirt.mat", *back, "--flirt-in", str(volume)))
    assert np.array_equal(once, by_command(target, volume, tmp_path / "flirt.mat", *back, "--flirt-ref", str(target)))
    inverted = tmp_path / "inverted.mat"
    np.savetxt(inverted, np.linalg.inv(turned(5, 0.1)), fmt="%.17g")
    assert np.allclose(once, by_command(target, volume, inverted, "--convention", "fsl"), atol=1e-6)


@ONE
def test_world_moves_the_volume_by_the_matrix(pair: tuple[Path, Path], tmp_path: Path) -> None:
    """What was at p is at matrix · p afterwards."""
    matrix, volume = turned(3, 0.1), load_volume(pair[0])
    np.savetxt(tmp_path / "a.txt", matrix, header="a comment", fmt="%.17g", delimiter=", ")
    moved = Volume(volume.samples, affine=matrix @ volume.affine)
    options = {"method": "trilinear", "boundary": "border", "fill": -10000.0, "dtype": torch.float64}
    expected = resample(moved, like=load_volume(pair[1]), **options).samples.numpy()
    assert np.array_equal(by_command(*pair, tmp_path / "a.txt"), expected)
    assert np.array_equal(
        resample(volume, like=load_volume(pair[1]), affine=matrix, **options).samples.numpy(), expected
    )
    back = Volume(volume.samples, affine=np.linalg.inv(matrix) @ volume.affine)
    found = by_command(*pair, tmp_path / "a.txt", "--inverse")
    assert np.allclose(found, resample(back, like=load_volume(pair[1]), **options).samples.numpy(), atol=1e-9)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_identity_moves_nothing(pair: tuple[Path, Path], tmp_path: Path, convention: str) -> None:
    """Of a volume onto its own grid, to the bit where the grid is read back from FSL's coordinates or ITK's too."""
    np.savetxt(tmp_path / "one.txt", np.eye(4))
    header = describe(pair[0])
    for inverse in (False, True):
        found = load_affine(tmp_path / "one.txt", convention, volume=header, target=header, inverse=inverse)
        assert np.allclose(found, np.eye(4), atol=1e-14)


def test_the_grid_is_told_as_if_nothing_had_moved(tmp_path: Path) -> None:
    """Alone the matrix leaves the grid of the volume; spacing and shape are those of the volume where it was."""
    volume = Volume(smooth((12, 10, 8)), spacing=(1, 2, 3), origin=(4, 5, 6), world=World(unit="mm"))
    step = np.eye(4)
    step[:3, 3] = 2.0, -2.0, 3.0
    found = resample(volume, "trilinear", affine=step, fill=0.0)
    assert (found.size, found.world) == (volume.size, volume.world)
    assert np.array_equal(found.affine, volume.affine)
    expected = torch.zeros_like(volume.samples)
    expected[1:, :-1, 2:] = volume.samples[:-1, 1:, :-2]
    assert torch.allclose(found.samples, expected, atol=1e-12)
    for labels in (False, True):
        near = resample(Volume(volume.samples.int(), spacing=(1, 2, 3)), "nearest", affine=step, fill=0, labels=labels)
        assert torch.equal(near.samples, expected.int())
    finer = resample(volume, "trilinear", affine=step, spacing=(0.5, 1, 1.5))
    assert np.array_equal(finer.affine, resample(volume, "trilinear", spacing=(0.5, 1, 1.5)).affine)
    with pytest.raises(ValueError, match=r"expected grids that overlap; got Volume.*spacing \[1.0, 2.0, 3.0\]"):
        resample(volume, affine=[[1, 0, 0, 1e4], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    samples = smooth((12, 10, 8)).requires_grad_()
    resample(Volume(samples), "trilinear", affine=step).samples.square().sum().backward()
    assert samples.grad is not None


WRONG = {
    "no number": ("a b c d\n" * 4, "a finite number for the matrix; got 'a'"),
    "nan": ("1 0 0 0\n0 nan 0 0\n0 0 1 0\n0 0 0 1", "a finite number for the matrix; got 'nan'"),
    "too few": ("1 0 0\n0 1 0\n0 0 1\n", "4 rows of 4 numbers; got '1 0 0"),
    "too many": ("1 0 0 0\n" * 5, "4 rows of 4 numbers"),
    "empty": ("", "4 rows of 4 numbers; got ''"),
    "singular": ("1 0 0 0\n0 1 0 0\n1 1 0 0\n0 0 0 1", "a matrix that can be inverted; got [[1.0, 0.0"),
    "projective": ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0.1 1", "the last row 0 0 0 1; got [0.0, 0.0, 0.1, 1.0]"),
    "long": ("#" * 70_000, "4 rows of 4 numbers in at most 65536 bytes; got 70000"),
    "bytes": ("\0\1\2\3", "4 rows of 4 numbers; got '\\x00"),
}


@ONE
@pytest.mark.parametrize("wrong", WRONG)
def test_a_matrix_that_is_none_is_refused(pair: tuple[Path, Path], tmp_path: Path, wrong: str) -> None:
    text, word = WRONG[wrong]
    path = tmp_path / "a.txt"
    path.write_text(text)
    header = describe(pair[0])
    for convention in ("world", "fsl"):
        with pytest.raises(VolumeFileError) as caught:
            load_affine(path, convention, volume=header, target=header)
        assert word in str(caught.value)
    with pytest.raises(VolumeFileError, match=r"a\.txt: expected"):
        load_affine(path, "itk", volume=header, target=header)


@ONE
def test_transforms_that_no_matrix_tells_are_refused(pair: tuple[Path, Path], tmp_path: Path) -> None:
    header = describe(pair[0])
    plane, bent = sitk.AffineTransform(2), sitk.BSplineTransform(3, 3)
    bent.SetTransformDomainMeshSize((2, 2, 2))
    bent.SetParameters([0.1] * len(bent.GetParameters()))
    for transform, word in ((plane, "AffineTransform of 2 dimensions"), (bent, "a BSplineTransform of 3")):
        sitk.WriteTransform(transform, str(tmp_path / "a.tfm"))
        with pytest.raises(VolumeFileError, match=f"a linear transform of three dimensions; got .*{word}"):
            load_affine(tmp_path / "a.tfm", "itk", volume=header, target=header)
    sitk.WriteTransform(itk_transform(np.eye(4)), str(tmp_path / "a.tfm"))
    with pytest.raises(VolumeFileError, match=r"a transform of ITK: convention itk"):
        load_affine(tmp_path / "a.tfm", volume=header, target=header)
    with pytest.raises(ValueError, match="unknown convention 'ants'; known conventions: world, itk, fsl"):
        load_affine(tmp_path / "a.tfm", "ants", volume=header, target=header)
    with pytest.raises(FileNotFoundError):
        load_affine(tmp_path / "no.tfm", "itk", volume=header, target=header)


def test_fsl_is_refused_where_a_header_has_two_sizes_of_voxels(tmp_path: Path) -> None:
    """FSL measures in pixdim whatever the sform says."""
    image = nibabel.Nifti1Image(np.zeros((4, 4, 4), np.float32), np.diag([2.0, 2, 2, 1]))
    image.header["pixdim"][1:4] = 1
    nibabel.save(image, tmp_path / "a.nii")
    np.savetxt(tmp_path / "one.txt", np.eye(4))
    header = describe(tmp_path / "a.nii")
    assert header.fields["pixdim"] == "1 1 1"
    with pytest.raises(VolumeFileError, match="a pixdim of 1 1 1 and an affine of 2 2 2"):
        load_affine(tmp_path / "one.txt", "fsl", volume=header, target=header)


@ONE
def test_a_composite_of_linear_transforms_is_one(pair: tuple[Path, Path], tmp_path: Path) -> None:
    turn = sitk.Euler3DTransform((1.0, 2.0, 3.0), 0.1, -0.2, 0.3, (1.0, -1.0, 2.0))
    both = sitk.CompositeTransform([itk_transform(turned(7, 0.1)), turn])
    sitk.WriteTransform(both, str(tmp_path / "a.h5"))
    found = by_command(*pair, tmp_path / "a.h5", "--convention", "itk")
    check_same(found, by_sitk(*pair, both, sitk.sitkLinear), pair[0])


@ONE
def test_what_is_said_of_a_matrix_has_to_make_sense(
    pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savetxt(tmp_path / "one.txt", np.eye(4))
    line = ["resample", str(pair[0]), "-o", str(tmp_path / "out.nii")]
    like, affine = ["--like", str(pair[1])], ["--affine", str(tmp_path / "one.txt")]

    def told(code: int, *more: str) -> str:
        assert main([*line, *more]) == code
        return capsys.readouterr().err

    assert "expected --affine FILE with --convention" in told(2, *like, "--convention", "fsl")
    assert "expected --affine FILE with --inverse" in told(2, *like, "--inverse")
    assert "unknown convention 'flirt'" in told(1, *like, *affine, "--convention", "flirt")
    assert "expected --convention fsl with --flirt-in" in told(2, *like, *affine, "--flirt-ref", str(pair[0]))
    assert "expected --like or --flirt-ref" in told(2, *affine, "--convention", "fsl")
    assert "expected --like or --flirt-in" in told(2, *affine, "--convention", "fsl", "--inverse")
    assert "got several" in told(2, *like, *affine, "--shape", "2", "2", "2")
    assert "no file of this name" in told(1, *like, "--affine", str(tmp_path / "no.txt"))
    assert not (tmp_path / "out.nii").exists()
    assert "wrote" in told(0, *affine)
    assert describe(tmp_path / "out.nii").size == describe(pair[0]).size
