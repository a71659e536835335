"""Volume files that come with nibabel: the values and places that nibabel and ITK find, or a reason."""

from __future__ import annotations

import itertools
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813

from filterlab.io import VolumeFileError, describe, load_volume
from filterlab.io.itk import SUFFIXES

PACKAGE = Path(nibabel.__file__).parent
FILES = sorted(
    path
    for path in PACKAGE.rglob("tests/data/*")
    if path.name.lower().endswith((".nii", ".nii.gz", *(s for s in SUFFIXES if s not in (".img", ".img.gz"))))
)
MINC_1 = ("minc1-no-att.mnc", "minc1_1_scale.mnc", "minc1_4d.mnc", "minc2_baddim.mnc", "tiny.mnc")  # and a damaged one
REFUSED = {  # file -> words of the reason
    **dict.fromkeys(("0.dcm", "1.dcm", "decimal_rescale.dcm"), "give the folder of its series"),
    "slicethickness_empty_string.dcm": "give the folder of its series",
    "csa_slice_norm.dcm": "DICOM data that ITK reads",  # a header without an image, as the next three are
    "analyze.hdr": "samples that ITK reads",
    "nifti1.hdr": "samples that ITK reads",
    "nifti2.hdr": "Analyze data that ITK reads",
    "row_major.dconn.nii": "three axes of space",
    **dict.fromkeys(MINC_1, "MINC data that ITK reads"),
}


def parts(path: Path) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
    """(frame, channel, samples, affine) of everything in a file."""
    choice = describe(path).choice
    found = []
    for t, c in itertools.product(range(choice.frames), range(choice.channels)):
        volume = load_volume(path, frame=t, channel=c)
        found.append((t, c, volume.samples.numpy(), volume.affine))
    return found


def by_nibabel(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(T, C, D, H, W) and the affine."""
    image = nibabel.load(path)
    data = np.asarray(image.dataobj)
    data = data.reshape(*data.shape, *(1,) * (5 - data.ndim))
    return data.transpose(3, 4, 2, 1, 0), image.affine


def by_itk(path: Path) -> tuple[np.ndarray, np.ndarray]:
    image = sitk.ReadImage(str(path))
    n, channels = image.GetDimension(), image.GetNumberOfComponentsPerPixel()
    data = sitk.GetArrayFromImage(image).reshape(-1, *image.GetSize()[2::-1], channels)
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(n, n)[:3, :3] * image.GetSpacing()[:3]
    affine[:3, 3] = image.GetOrigin()[:3]
    return data.transpose(0, 4, 1, 2, 3), np.diag([-1, -1, 1, 1]) @ affine


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_equal_or_refused(path: Path) -> None:
    if path.name in REFUSED:
        with pytest.raises(VolumeFileError, match=REFUSED[path.name]):
            parts(path)
        return
    found = parts(path)
    data, affine = by_nibabel(path) if ".nii" in path.name else by_itk(path)
    assert len(found) == data.shape[0] * data.shape[1]
    for t, c, samples, place in found:
        np.testing.assert_allclose(samples, data[t, c], rtol=1e-6, atol=1e-6 * np.nanmax(np.abs(data)))
        np.testing.assert_allclose(place, affine, atol=1e-9)
