"""Files that lie: a VolumeFileError that names the file, what was expected and what came, before memory is spent."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import logging.handlers
import os
import queue
import struct
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from experiments.extremes.mutations import KINDS, NUMBERS, WORDS, Edit, edited
from experiments.extremes.originals import Original, originals
from filterlab.io import VolumeFileError, describe, load_volume
from filterlab.volume import Volume
from tests.io.writers import SAMPLES, write_nifti, write_npy, write_npz, write_nrrd, write_raw

MEMORY = 24 * 2**20  # far below every claim made here

zipped = partial(gzip.compress, mtime=0)  # the same bytes whenever it is called: they are part of a test's name


def refused(path: Path, *words: str, action: Callable[[Path], object] = load_volume, peak: int = MEMORY) -> None:
    """load_volume refuses the file with all these words in the message, and allocates little on the way."""
    tracemalloc.start()
    try:
        with pytest.raises(VolumeFileError) as caught:
            action(path)
        allocated = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert str(path.parent) in message
    assert "expected" in message
    assert "; got " in message
    for word in words:
        assert word in message, message
    assert allocated < peak, f"{allocated} bytes were allocated"


# --- NRRD -------------------------------------------------------------------------------------------------------------

MINIMAL = {"type": "uint8", "dimension": "3", "sizes": "4 3 2", "encoding": "raw"}


def nrrd_file(path: Path, data: bytes = bytes(24), drop: str = "", **fields: str) -> Path:
    entries = MINIMAL | {k.replace("_", " "): v for k, v in fields.items()}
    header = "".join(f"{k}: {v}\n" for k, v in entries.items() if k != drop)
    path.write_bytes(b"NRRD0004\n" + header.encode("latin-1") + b"\n" + data)
    return path


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"sizes": "4 3 3"}, ["36 bytes", "got 24 bytes"]),
        ({"sizes": "40000 40000 40000"}, ["64000000000000 bytes"]),
        ({"sizes": "2147483647 2147483647 2147483647"}, ["bytes of samples"]),
        ({"sizes": "4294967296 4294967296 1"}, ["sizes from 1"]),
        ({"sizes": "9" * 30 + " 1 1"}, ["an integer of at most 18 digits for sizes"]),
        ({"sizes": "-4 -3 2"}, ["sizes from 1"]),
        ({"sizes": "0 3 2"}, ["sizes from 1"]),
        ({"sizes": "4 3"}, ["3 values in `sizes`"]),
        ({"sizes": "4 3 two"}, ["an integer", "'two'"]),
        ({"sizes": "4.0 3 2"}, ["an integer", "'4.0'"]),
        ({"sizes": "1_2 1 2"}, ["an integer"]),
        ({"dimension": "2", "sizes": "6 4"}, ["three axes of space", "(6, 4)"]),
        ({"dimension": "4", "sizes": "3 2 2 2"}, ["three axes of space, told from others by `kinds`"]),
        ({"kinds": "RGB-color domain domain"}, ["three axes of space"]),
        ({"kinds": "domain domain"}, ["3 values in `kinds`"]),
        (
            {"dimension": "5", "sizes": "2 1 3 2 2", "kinds": "list domain domain domain vector"},
            ["at most one axis of time and one of components"],
        ),
        ({"dimension": "99"}, ["from 1 to 16"]),
        ({"dimension": "-3"}, ["from 1 to 16"]),
        ({"dimension": "three"}, ["an integer", "dimension"]),
        ({"type": "block"}, ["a type among", "'block'"]),
        ({"type": "uint64", "sizes": "3 1 1"}, ["`endian`"]),
        ({"type": "uint128"}, ["a type among", "'uint128'"]),
        ({"type": "int16", "sizes": "2 3 2"}, ["`endian`"]),
        ({"type": "int16", "sizes": "2 3 2", "endian": "middle"}, ["little or big"]),
        ({"encoding": "ascii", "sizes": "40 3 2"}, ["240 numbers as text"]),
        ({"encoding": "ascii", "data_file": "/etc/passwd"}, ["same folder or below"]),
        ({"encoding": "base64"}, ["encoding raw, gzip"]),
        ({"encoding": "gzip", "sizes": "1000000 1000000 1000"}, ["cannot hold that many"]),
        ({"encoding": "bzip2", "sizes": "1000000 1000000 1000"}, ["at most 8589934592 bytes", "max_bytes"]),
        ({"encoding": "bzip2", "byte_skip": "67108865"}, ["at most 67108864 bytes before the samples"]),
        ({"spacings": "1 1 nan"}, ["a finite number for spacings"]),
        ({"spacings": "1 1 inf"}, ["a finite number"]),
        ({"spacings": "1 1 1e999"}, ["a finite number"]),
        ({"spacings": "1 1 0"}, ["invertible"]),
        ({"spacings": "1 1"}, ["3 values"]),
        ({"spacings": "1e-300 1e300 1"}, ["finite numbers"]),
        ({"space": "LPS", "space_directions": "(1,0,0) (2,0,0) (0,0,1)"}, ["invertible"]),
        ({"space": "LPS", "space_directions": "(1,0,0) (0,1,0)"}, ["3 space directions"]),
        ({"space": "LPS", "space_directions": "(1,0,0) (0,1,0) none"}, ["a space direction for axis 2"]),
        ({"space": "LPS", "space_directions": "(1,0) (0,1) (0,0)"}, ["three numbers"]),
        ({"space": "LPS", "space_directions": "(1,0,0) (0,1,0) (0,0,nan)"}, ["a finite number"]),
        ({"space": "LPS", "space_directions": "1 0 0 0 1 0 0 0 1"}, ["vectors (a,b,c)"]),
        ({"space": "LPS", "space_origin": "(1,2)"}, ["three numbers"]),
        ({"space": "LPS", "space_origin": "none"}, ["one vector"]),
        ({"space": "outer"}, ["a space among"]),
        ({"space_dimension": "4"}, ["space dimension: 3"]),
        ({"byte_skip": "5"}, ["29 bytes"]),
        ({"byte_skip": "-1", "sizes": "4 3 9"}, ["108 bytes"]),
        ({"byte_skip": "-2"}, ["byte skip"]),
        ({"byte_skip": "999999999999999999"}, ["got 24 bytes"]),
        ({"line_skip": "x"}, ["samples that ITK reads"]),
        ({"data_file": "/etc/passwd"}, ["same folder or below", "'/etc/passwd'"]),
        ({"data_file": "../secret.raw"}, ["same folder or below"]),
        ({"data_file": "sub/../../secret.raw"}, ["same folder or below"]),
        ({"data_file": "sub/../near.raw"}, ["same folder or below"]),
        ({"data_file": "link.raw"}, ["a link to a place outside"]),
        ({"data_file": "linked/secret.raw"}, ["a link to a place outside"]),
        ({"data_file": "missing.raw"}, ["no file"]),
        ({"data_file": "x" * 3000}, ["same folder or below"]),
        ({"data_file": "x" * 5000}, ["at most 4096 characters in `data file`", "5000"]),
        ({"data_file": "."}, ["no file"]),
        ({"data_file": "LIST"}, ["one data file"]),
        ({"data_file": "a%03d.raw 1 9 1"}, ["one data file"]),
    ],
)
def test_nrrd_headers_that_lie(tmp_path: Path, fields: dict[str, str], words: list[str]) -> None:
    folder = tmp_path / "inside"
    (folder / "sub").mkdir(parents=True)
    (tmp_path / "secret.raw").write_bytes(bytes(24))
    (folder / "near.raw").write_bytes(bytes(24))
    (folder / "link.raw").symlink_to(tmp_path / "secret.raw")
    (folder / "linked").symlink_to(tmp_path)
    refused(nrrd_file(folder / "a.nrrd", **fields), *words)


@pytest.mark.parametrize("field", ["type", "dimension", "sizes", "encoding"])
def test_nrrd_missing_fields(tmp_path: Path, field: str) -> None:
    refused(nrrd_file(tmp_path / "a.nrrd", drop=field), f"`{field}`")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "NRRD0001"),
        (b"NRRD0009\n", "NRRD0001"),
        (b"NRRD0004\n", "an empty line"),
        (b"NRRD0004\ntype: uint8\ntype: int8\n\n", "once"),
        (b"NRRD0004\nnonsense\n\n", "field: value"),
        (b"NRRD0004\n" + b"#" * 4 * 2**20, "at most 1048576 bytes"),
        (b"NRRD0004\n" + (b"#" * 1000 + b"\n") * 2**11, "at most 1048576 bytes"),
        (b"NRRD0004\n" + bytes(range(128, 256)) + b"\n\n", "field: value"),
    ],
)
def test_nrrd_headers_that_are_none(tmp_path: Path, content: bytes, word: str) -> None:
    path = tmp_path / "a.nrrd"
    path.write_bytes(content)
    refused(path, word)


def test_a_link_inside_the_folder_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real.raw").write_bytes(bytes(24))
    (tmp_path / "link.raw").symlink_to(tmp_path / "real.raw")
    assert load_volume(nrrd_file(tmp_path / "a.nhdr", b"", data_file="link.raw")).size == (4, 3, 2)


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (zipped(bytes(23)), "after 23"),
        (zipped(bytes(24))[:-9], "damaged or truncated"),
        (zipped(bytes(24))[:-4] + bytes(4), "damaged or truncated"),
        (b"no gzip at all, but long enough", "damaged or truncated"),
        (zipped(bytes(24))[:12] + b"\xff" * 20, "damaged or truncated"),
    ],
)
def test_gzip_that_lies(tmp_path: Path, data: bytes, word: str) -> None:
    refused(nrrd_file(tmp_path / "a.nrrd", data, encoding="gzip"), word)


@pytest.mark.parametrize("field", ["space directions", "sizes", "spacings", "space", "data file", "centerings", "type"])
@pytest.mark.parametrize("value", ["none", "()", "(1,0,0) ", "1 "])
def test_headers_of_a_megabyte_cost_a_few(tmp_path: Path, field: str, value: str) -> None:
    """61 MiB, once, for a list of 200,000 times none."""
    path = nrrd_file(tmp_path / "a.nrrd", **{field: value * (800_000 // len(value))})
    assert path.stat().st_size > 800_000
    refused(path, f"at most 4096 characters in `{field}`", peak=4 * 2**20)


def test_headers_of_very_many_fields(tmp_path: Path) -> None:
    path = nrrd_file(tmp_path / "a.nrrd", **{f"field {i}": "x" for i in range(60_000)})
    refused(path, "at most 1000 fields", peak=2**20)
    lines = "".join(f"key {i}:=value\n" for i in range(60_000))  # of which files may have many
    path.write_bytes(nrrd_file(path).read_bytes().replace(b"NRRD0004\n", b"NRRD0004\n" + lines.encode()))
    assert load_volume(path).size == (4, 3, 2)


def test_bzip2_of_any_ratio(tmp_path: Path) -> None:
    """67 MB of zeros are 79 bytes: 850,000 to one."""
    pack = bz2.BZ2Compressor()
    data = b"".join(pack.compress(bytes(2**20)) for _ in range(64)) + pack.flush()
    assert len(data) < 100
    path = nrrd_file(tmp_path / "a.nrrd", data, encoding="bzip2", sizes="512 512 256")
    assert describe(path).size == (512, 512, 256)
    path = nrrd_file(path, bz2.compress(bytes(2**24)), encoding="bzip2", sizes="256 256 256")
    volume = load_volume(path)
    assert volume.size == (256, 256, 256)
    assert not volume.samples.any()
    refused(path, "at most 1000000 bytes", action=lambda p: load_volume(p, max_bytes=10**6))
    # a claim of 4 GB that is not kept costs what is there
    path = nrrd_file(path, bz2.compress(bytes(2**20)), encoding="bzip2", sizes="2000 2000 1000")
    refused(path, "4000000000 bytes", "after 1048576")


def test_the_largest_ratio_of_gzip_is_no_lie(tmp_path: Path) -> None:
    """Zeros at the highest level: as near to 1032 : 1 as deflate comes."""
    data = gzip.compress(bytes(2**24), 9)
    assert len(data) * 1000 < 2**24
    path = nrrd_file(tmp_path / "a.nrrd", data, encoding="gzip", sizes="256 256 256")
    assert load_volume(path).size == (256, 256, 256)


def test_gzip_claims_what_it_could_but_does_not_hold(tmp_path: Path) -> None:
    """The claim passes the ratio (1032 : 1), so that only reading tells; memory follows what is there."""
    data = gzip.compress(os.urandom(2**20))
    refused(nrrd_file(tmp_path / "a.nrrd", data, encoding="gzip", sizes="1000 1000 1000"), "after 1048576")


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (bz2.compress(bytes(23)), "after 23"),
        (bz2.compress(bytes(24))[:-5], "damaged or truncated"),
        (b"x" * 40, "damaged or truncated"),
    ],
)
def test_bzip2_that_lies(tmp_path: Path, data: bytes, word: str) -> None:
    refused(nrrd_file(tmp_path / "a.nrrd", data, encoding="bzip2"), word)


# --- NIfTI ------------------------------------------------------------------------------------------------------------

# offsets of fields in a NIfTI-1 header
DIM, DATATYPE, BITPIX, VOX_OFFSET, SLOPE, INTER, SFORM_CODE, SROW, MAGIC = 40, 70, 72, 108, 112, 116, 254, 280, 344


def nifti_file(path: Path, *patches: tuple[int, str, tuple]) -> Path:
    """A valid NIfTI-1 file of uint8 SAMPLES with some fields of its header overwritten."""
    plain = write_nifti(path.with_name("plain.nii"), SAMPLES.astype(np.uint8))
    data = bytearray(plain.read_bytes())
    for offset, layout, values in patches:
        struct.pack_into("<" + layout, data, offset, *values)
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


@pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
@pytest.mark.parametrize(
    ("patch", "word"),
    [
        ((DIM, "4h", (3, 4, 3, 3)), "36"),
        ((DIM, "4h", (3, 32767, 32767, 32767)), "351811509"),
        ((DIM, "4h", (3, -4, 3, 2)), "sizes from 1"),
        ((DIM, "4h", (3, -1, 3, 2)), "sizes from 1"),
        ((DIM, "4h", (3, 0, 3, 2)), "sizes from 1"),
        ((DIM, "4h", (2, 8, 3, 1)), "three axes of space"),
        ((DIM, "5h", (4, 2, 2, 2, 3)), "a choice among its 3 frames"),
        ((DIM, "6h", (5, 2, 2, 2, 1, 3)), "a choice among its 3 channels, channel=0 to channel=2"),
        ((DIM, "7h", (6, 2, 2, 2, 1, 1, 3)), "three axes of space"),
        ((DIM, "h", (0,)), "dim[0]"),
        ((DIM, "h", (-3,)), "dim[0]"),
        ((DIM, "h", (200,)), "dim[0]"),
        ((DATATYPE, "h", (9999,)), "a known data type"),
        ((DATATYPE, "hh", (32, 64)), "a type among"),  # complex
        ((DATATYPE, "hh", (128, 24)), ""),  # RGB, of three times as many bytes
        ((DATATYPE, "hh", (1280, 64)), "192"),  # uint64
        ((BITPIX, "h", (16,)), "bitpix 8"),
        ((VOX_OFFSET, "f", (0.0,)), "vox_offset"),
        ((VOX_OFFSET, "f", (-400.0,)), "vox_offset"),
        ((VOX_OFFSET, "f", (352.5,)), "vox_offset"),
        ((VOX_OFFSET, "f", (float("nan"),)), "vox_offset"),
        ((VOX_OFFSET, "f", (1e30,)), "vox_offset"),
        ((VOX_OFFSET, "f", (1e12,)), "bytes"),
        ((VOX_OFFSET, "f", (360.0,)), ""),
        ((SLOPE, "ff", (float("inf"), 0.0)), "finite scl_slope"),
        ((SLOPE, "ff", (2.0, float("nan"))), "finite scl_slope"),
        ((SROW, "f", (float("nan"),)), "affine"),
        ((SROW, "11f", (1.0,) * 11), "invertible"),
        ((MAGIC, "4s", (b"ni1\0",)), "a single NIfTI file"),
        ((0, "i", (349,)), "a NIfTI header"),
    ],
)
def test_nifti_headers_that_lie(tmp_path: Path, ending: str, patch: tuple, word: str) -> None:
    refused(nifti_file(tmp_path / f"a{ending}", patch), word)


def test_the_patched_nifti_is_valid_unpatched(tmp_path: Path) -> None:
    for ending in (".nii", ".nii.gz"):
        assert load_volume(nifti_file(tmp_path / f"a{ending}")).size == (4, 3, 2)


def test_nifti_truncated_and_endless(tmp_path: Path) -> None:
    whole = nifti_file(tmp_path / "a.nii").read_bytes()
    for content, word in (
        (whole[:-1], "24 bytes"),
        (whole[:300], "header"),
        (b"", "header"),
    ):
        (tmp_path / "b.nii").write_bytes(content)
        refused(tmp_path / "b.nii", word)
    packed = gzip.compress(whole)
    for content, word in (
        (packed[:-1], "damaged or truncated"),
        (gzip.compress(whole[:-1]), "after 23"),
        (b"", "header"),
        (packed[:50], "damaged or truncated"),
    ):
        (tmp_path / "b.nii.gz").write_bytes(content)
        refused(tmp_path / "b.nii.gz", word)


def test_a_time_series_that_lies(tmp_path: Path) -> None:
    """A frame is read as carefully as a whole volume, and costs the memory of a frame."""

    def frame(path: Path, index: int = 1) -> Volume:
        return load_volume(path, frame=index)

    claim = (DIM, "5h", (4, 2000, 2000, 2000, 4))
    refused(nifti_file(tmp_path / "a.nii", claim), "32000000000 bytes", action=frame)
    refused(nifti_file(tmp_path / "a.nii.gz", claim), "cannot hold that many", action=frame)
    refused(nifti_file(tmp_path / "b.nii", (DIM, "5h", (4, 2, 2, 3, 3))), "36 bytes", action=frame)
    series = (DIM, "5h", (4, 2, 2, 2, 3))
    whole = nifti_file(tmp_path / "c.nii", series).read_bytes()
    packed = gzip.compress(whole)
    for content, word in (
        (gzip.compress(whole[:-1]), "more bytes"),  # the frame itself is there
        (gzip.compress(whole[:-9]), "after 7"),
        (packed[:-4] + bytes(4), "damaged or truncated"),
    ):
        (tmp_path / "d.nii.gz").write_bytes(content)
        refused(tmp_path / "d.nii.gz", word, action=frame)
    (tmp_path / "e.nii").write_bytes(whole[:-1])
    refused(tmp_path / "e.nii", "24 bytes", action=frame)
    refused(tmp_path / "c.nii", "at most 7 bytes", action=lambda p: load_volume(p, frame=0, max_bytes=7))
    assert load_volume(tmp_path / "c.nii", frame=0, max_bytes=8).size == (2, 2, 2)


# --- NumPy ------------------------------------------------------------------------------------------------------------


def npy_bytes(header: str, data: bytes = bytes(24), version: bytes = b"\x01\x00") -> bytes:
    text = header.encode("latin-1") + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text + data


@pytest.mark.parametrize("ending", [".npy", ".npz"])
@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3, 5)}", ["30 bytes", "24"]),
        ("{'descr': '<f8', 'fortran_order': True, 'shape': (100000, 100000, 100000)}", ["8000000000000000 bytes"]),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (-2, -3, 4)}", ["sizes from 1"]),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (0, 3, 4)}", ["sizes from 1"]),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (4294967296, 4294967296, 1)}", ["sizes from 1"]),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (True, 3, 8)}", ["integers"]),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (24,)}", ["(D, H, W)"]),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (4, 6)}", ["(D, H, W)"]),
        ("{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3, 2, 2)}", ["(D, H, W)"]),
        ("{'descr': '|O', 'fortran_order': False, 'shape': (1, 1, 3)}", ["a type among"]),
        ("{'descr': '<c8', 'fortran_order': False, 'shape': (1, 1, 3)}", ["a type among"]),
        ("{'descr': '<u8', 'fortran_order': False, 'shape': (1, 1, 4)}", ["32 bytes", "24"]),
        ("{'descr': '|S3', 'fortran_order': False, 'shape': (2, 2, 2)}", ["a type among"]),
        ("{'descr': [('a', '|u1')], 'fortran_order': False, 'shape': (2, 3, 4)}", ["a type among"]),
        ("{'descr': '<M8[s]', 'fortran_order': False, 'shape': (1, 1, 3)}", ["a type among"]),
        ("{'descr': '|u1', 'shape': (2, 3, 4)}", ["a valid npy header"]),
        ("__import__('os').abort()", ["a valid npy header"]),
        ("(" * 3000, ["a valid npy header"]),
        ("{" + "1:" * 9000, ["a valid npy header"]),
    ],
)
def test_npy_headers_that_lie(tmp_path: Path, ending: str, header: str, words: list[str]) -> None:
    path = tmp_path / f"a{ending}"
    if ending == ".npy":
        path.write_bytes(npy_bytes(header))
    else:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("samples.npy", npy_bytes(header))
    refused(path, *words)


def test_npy_objects_are_never_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.array([[[print]]], dtype=object), allow_pickle=True)
    refused(path, "a type among")
    np.savez(tmp_path / "a.npz", samples=np.array([[[print]]], dtype=object), allow_pickle=True)
    refused(tmp_path / "a.npz", "a type among")


def test_npy_header_length_that_lies(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**32 - 1) + b"{}")
    refused(path, "a valid npy header")
    path.write_bytes(b"\x93NUMPY\x07\x00")
    refused(path, "npy")
    path.write_bytes(b"")
    refused(path, "a valid npy header")


def zipped(path: Path, method: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def saved(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


SMALL = saved(np.zeros((2, 3, 4), np.uint8))


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"a": SMALL, "b": SMALL}, ["an array named samples", "a, b"]),
        ({}, ["an array named samples", "none"]),
        ({"samples": SMALL, "affine": saved(np.zeros((4, 4)))}, ["0 0 0 1"]),
        ({"samples": SMALL, "affine": saved(np.diag([1.0, 1.0, 0.0, 1.0]))}, ["invertible"]),
        ({"samples": SMALL, "affine": saved(np.diag([1.0, 1.0, np.nan, 1.0]))}, ["finite"]),
        ({"samples": SMALL, "affine": saved(np.eye(3))}, ["(4, 4)"]),
        ({"samples": SMALL, "affine": saved(np.zeros((4000, 4000)))}, ["(4, 4)"]),
        ({"samples": SMALL, "affine": saved(np.eye(4)), "spacing": saved(np.ones(3))}, ["both"]),
        ({"samples": SMALL, "spacing": saved(np.array([1.0, -1.0, 1.0]))}, ["positive"]),
        ({"samples": SMALL, "spacing": saved(np.array([1.0, np.nan, 1.0]))}, ["positive"]),
        ({"samples": SMALL, "spacing": saved(np.array(["a", "b", "c"]))}, ["numbers of shape (3,)"]),
    ],
)
def test_npz_contents(tmp_path: Path, members: dict[str, bytes], words: list[str]) -> None:
    refused(zipped(tmp_path / "a.npz", **members), *words)


def test_zip_bombs(tmp_path: Path) -> None:
    header = npy_bytes("{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3, 4)}", b"")
    refused(zipped(tmp_path / "a.npz", samples=header + bytes(2**26)), "24 bytes")
    refused(zipped(tmp_path / "b.npz", zipfile.ZIP_BZIP2, samples=SMALL), "stored or deflated")
    # the directory says the member is small, its data says 64 MiB: no more than the directory's size is read
    path = zipped(tmp_path / "c.npz", samples=header + bytes(2**26))
    content = path.read_bytes().replace(struct.pack("<I", len(header) + 2**26), struct.pack("<I", len(header) + 24))
    path.write_bytes(content)
    refused(path, "intact npz archive")
    # the directory says 2 GiB, in 200 bytes
    path = zipped(tmp_path / "d.npz", samples=SMALL)
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", len(SMALL)), struct.pack("<I", 2**31)))
    refused(path, "cannot hold that many")


def test_archives_of_very_many_entries(tmp_path: Path) -> None:
    """zipfile makes an object of each before it can be asked how many there are: 15 bytes of memory for every byte."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("samples.npy", SMALL)
        for i in range(6000):
            archive.writestr(f"{i}", b"")
    refused(path, "a directory of at most 262144 bytes", peak=2 * 2**20)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("samples.npy", SMALL)
        for i in range(3000):
            archive.writestr(f"array{i}.npy", b"")
    assert load_volume(path).size == (4, 3, 2)


def test_an_entry_that_many_names_share(tmp_path: Path) -> None:
    """Overlapping entries multiply what an archive holds; only what is asked for is inflated."""
    path = zipped(tmp_path / "a.npz", samples=SMALL)
    content = path.read_bytes()
    at = content.index(b"PK\1\2")
    end = content.index(b"PK\5\6")
    entry = content[at:end]
    more = b"".join(entry.replace(b"samples", b"other%02d" % i) for i in range(90))
    tail = struct.pack("<HHII", 91, 91, len(entry) + len(more), at)
    path.write_bytes(content[:end] + more + content[end : end + 8] + tail + content[end + 20 :])
    assert load_volume(path).size == (4, 3, 2)


def test_npz_damage(tmp_path: Path) -> None:
    whole = write_npz(tmp_path / "a.npz", SAMPLES.astype(np.uint8)).read_bytes()
    for content in (whole[:-1], whole[:40], b"", b"PK", whole[:60] + b"\xff" * 8 + whole[68:]):
        (tmp_path / "b.npz").write_bytes(content)
        refused(tmp_path / "b.npz", "b.npz")


def test_sidecars_that_lie(tmp_path: Path) -> None:
    path = write_npy(tmp_path / "a.npy", SAMPLES.astype(np.uint8))
    row = "[0, 0, 0, 0]"
    for text, word in (
        ("size: [4, 3, 2]\naffine: 5", "affine"),
        (f"size: [4, 3, 2]\naffine: [{row}, {row}, {row}, {row}]", "last row 0 0 0 1"),
        (f"size: [4, 3, 2]\naffine: [{row}, {row}, {row}, [0, 0, 0, 1]]", "invertible"),
        ("size: [4, 3, 2]\nafine: 1", "did you mean 'affine'"),
    ):
        (tmp_path / "a.npy.yaml").write_text(text)
        refused(path, word)


# --- raw --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("size: [4, 3, 3]\ndtype: uint8", ["36 bytes", "24"]),
        ("size: [4, 3, 1]\ndtype: uint8", ["12 bytes", "24"]),
        ("size: [40000, 40000, 40000]\ndtype: float64\nbyte_order: big", ["512000000000000 bytes"]),
        ("size: [99999999999, 1, 1]\ndtype: uint8", ["sizes from 1"]),
        ("size: [-4, -3, 2]\ndtype: uint8", ["size[0]", "greater than or equal to 1"]),
        ("size: [4, 6]\ndtype: uint8", ["size"]),
        ("size: [4, 3, two]\ndtype: uint8", ["size[2]", "integer"]),
        ("size: [4, 3, 2]\ndtype: uint7", ["unknown dtype 'uint7'; did you mean 'uint8'?"]),
        ("size: [4, 3, 2]\ndtype: object", ["unknown dtype"]),
        ("size: [4, 3, 1]\ndtype: int16", ["byte_order"]),
        ("size: [4, 3, 2]\ndtype: uint8\noffset: 1", ["got 23 bytes"]),
        ("size: [4, 3, 2]\ndtype: uint8\noffset: -1", ["offset"]),
        ("size: [4, 3, 2]\ndtype: uint8\noffset: 4000000000000000000", ["got 0 bytes"]),
        ("size: [4, 3, 2]\ndtype: uint8\nspacing: [1, 1, .nan]", ["finite"]),
        ("size: [4, 3, 2]\ndtype: uint8\nspacing: [1, 1, 0]", ["greater than 0"]),
        ("size: [4, 3, 2]\ndtype: uint8\nspacings: [1, 1, 1]", ["did you mean 'spacing'?"]),
        ("size: [4, 3, 2]\ndtype: uint8\nfile: b.raw", ["file: a.raw", "b.raw"]),
        ("size: [4, 3, 2]", ["dtype", "missing"]),
        ("&x 5", ["anchors"]),
    ],
)
def test_raw_sidecars_that_lie(tmp_path: Path, text: str, words: list[str]) -> None:
    path = write_raw(tmp_path / "a.raw", SAMPLES.astype(np.uint8))
    path.with_name("a.raw.yaml").write_text(text)
    refused(path, *words)


@pytest.mark.parametrize("text", ["size: [" + "1," * 90_000 + "]", "x: 1\n" * 40_000, "dtype: " + "x" * 2**18])
def test_sidecars_are_small(tmp_path: Path, text: str) -> None:
    """PyYAML takes some 700 bytes of memory, and 0.1 ms, for every value: 70 MiB and 9 s for such a file."""
    path = write_raw(tmp_path / "a.raw", SAMPLES.astype(np.uint8))
    path.with_name("a.raw.yaml").write_text(text)
    refused(path, "at most 16384 bytes", peak=2**20)
    path = write_npy(tmp_path / "a.npy", SAMPLES.astype(np.uint8))
    path.with_name("a.npy.yaml").write_text(text)
    refused(path, "at most 16384 bytes", peak=2**20)


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.raw", "link.raw", "nothing.raw", "''"])
def test_raw_files_elsewhere(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "a.raw").write_bytes(bytes(24))
    (folder / "link.raw").symlink_to(tmp_path / "a.raw")
    sidecar = folder / "b.raw.yaml"
    sidecar.write_text(f"file: {name}\nsize: [4, 3, 2]\ndtype: uint8")
    refused(sidecar, "same folder or below")


# --- TIFF -------------------------------------------------------------------------------------------------------------


def tags_of(data: bytes, page: int = 0) -> dict[int, int]:
    """Tag -> position of its entry, for a little-endian TIFF; key 0: where the next page's offset stands."""
    at = struct.unpack_from("<I", data, 4)[0]
    for _ in range(page):
        at = struct.unpack_from("<I", data, at + 2 + 12 * struct.unpack_from("<H", data, at)[0])[0]
    count = struct.unpack_from("<H", data, at)[0]
    return {struct.unpack_from("<H", data, at + 2 + 12 * i)[0]: at + 2 + 12 * i for i in range(count)} | {
        0: at + 2 + 12 * count
    }


def tiff_file(path: Path, tag: int, value: int, page: int = 0, **options: object) -> Path:
    """A valid three-page stack with the (inline) value of one tag overwritten."""
    tifffile.imwrite(path, np.zeros((3, 40, 50), np.uint8), photometric="minisblack", **options)
    data = bytearray(path.read_bytes())
    at = tags_of(data, page)[tag]
    if tag == 0:
        struct.pack_into("<I", data, at, value)
    else:
        struct.pack_into("<H" if struct.unpack_from("<H", data, at + 2)[0] == 3 else "<I", data, at + 8, value)
    path.write_bytes(data)
    return path


WIDTH, LENGTH, BITS, COMPRESSION, OFFSETS, SAMPLES_PER_PIXEL, ROWS, COUNTS = 256, 257, 258, 259, 273, 277, 278, 279


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
@pytest.mark.parametrize(
    ("tag", "value", "page"),
    [
        (WIDTH, 60_000, 0),
        (WIDTH, 0, 0),
        (LENGTH, 60_000, 0),
        (LENGTH, 41, 1),
        (BITS, 16, 0),
        (BITS, 1, 2),
        (BITS, 7, 0),
        (COMPRESSION, 5, 0),
        (COMPRESSION, 7, 0),
        (COMPRESSION, 999, 0),
        (OFFSETS, 2**31, 0),
        (OFFSETS, 2**31, 2),
        (SAMPLES_PER_PIXEL, 3, 0),
        (SAMPLES_PER_PIXEL, 0, 0),
        (ROWS, 0, 0),
        (ROWS, 1, 0),
        (COUNTS, 1, 0),
        (COUNTS, 2**31, 1),
        (0, 8, 2),  # pages in a circle
        (0, 2**31, 2),
    ],
)
def test_tiff_headers_that_lie(tmp_path: Path, tag: int, value: int, page: int, options: dict) -> None:
    refused(tiff_file(tmp_path / "a.tif", tag, value, page, **options))


def test_a_long_circle_of_pages(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((300, 4, 4), np.uint8), photometric="minisblack", metadata=None)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, tags_of(data, 299)[0], struct.unpack_from("<I", data, tags_of(data, 148)[0])[0])
    path.write_bytes(data)
    refused(path, "a chain of pages that ends")


def test_tags_larger_than_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((3, 4, 4), np.uint8), photometric="minisblack")
    data = bytearray(path.read_bytes())
    at = tags_of(data)[270]  # ImageDescription
    for count in (2**32 - 1, 10**6):
        struct.pack_into("<I", data, at + 4, count)
        path.write_bytes(data)
        refused(path, "tag 270 within its")


def test_a_deflate_bomb_in_a_strip(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((2, 40, 50), np.uint8), photometric="minisblack", compression="zlib")
    data = bytearray(path.read_bytes())
    bomb = zlib.compress(bytes(2**26), 9)
    tags = tags_of(data)
    struct.pack_into("<I", data, tags[OFFSETS] + 8, len(data))
    kind = struct.unpack_from("<H", data, tags[COUNTS] + 2)[0]
    assert kind in (3, 4)
    struct.pack_into("<HII", data, tags[COUNTS] + 2, 4, 1, len(bomb))
    path.write_bytes(bytes(data) + bomb)
    refused(path, "a strip or tile of 2000 bytes", "got more than that")


def tiff_of(
    width: int, rows: int, pages: int = 2, more: bytes = b"", strip: bytes = b"", strips: int = 1, **tags: int
) -> bytes:
    """A little-endian TIFF whose pages share everything: one strip (or list of strips), and some more bytes.

    tags: `depth=(32997, 4, 300, 0)` is an entry as it stands; a value of -1 is where `more` begins.
    """
    entries = {256: (4, 1, width), 257: (4, 1, rows), 258: (3, 1, 8), 262: (3, 1, 1)}
    per_strip = -(-rows // strips)
    more_at = 8
    strip_at = more_at + len(more)
    lists_at = strip_at + len(strip)
    lists = struct.pack(f"<{strips}I", *[strip_at] * strips) + struct.pack(f"<{strips}I", *[len(strip)] * strips)
    entries |= {278: (4, 1, per_strip), 273: (4, strips, lists_at), 279: (4, strips, lists_at + 4 * strips)}
    if strips == 1:
        entries |= {273: (4, 1, strip_at), 279: (4, 1, len(strip))}
    entries |= {tag: (kind, n, more_at if value == -1 else value) for tag, kind, n, value in tags.values()}
    at = lists_at + len(lists)
    size = 2 + 12 * len(entries) + 4
    content = struct.pack("<2sHI", b"II", 42, at) + more + strip + lists
    for page in range(pages):
        following = at + (page + 1) * size if page + 1 < pages else 0
        content += struct.pack("<H", len(entries))
        content += b"".join(struct.pack("<HHII", tag, *entry) for tag, entry in sorted(entries.items()))
        content += struct.pack("<I", following)
    return content


def test_a_small_tiff_of_great_depth(tmp_path: Path) -> None:
    """300 values where one belongs: tifffile multiplies with all of them, row by row."""
    path = tmp_path / "a.tif"
    for rows in (2**18, 2**31 - 1):
        path.write_bytes(tiff_of(1, rows, more=bytes(1200), strip=b"?", depth=(32997, 4, 300, -1)))
        assert path.stat().st_size < 2000
        refused(path, "1 whole numbers in tag 32997", "300", action=describe)


@pytest.mark.parametrize("tag", [256, 257, 258, 259, 266, 277, 278, 317, 322, 339, 32997])
def test_tags_of_many_values_where_one_belongs(tmp_path: Path, tag: int) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(tiff_of(4, 4, more=bytes(2**20), strip=bytes(16), many=(tag, 3, 2**19, -1)))
    refused(path, action=describe)


def test_pages_that_share_a_strip_are_described_without_inflating_it(tmp_path: Path) -> None:
    """0.26 MB that are 100 planes of 256 MB: 50 s to describe, when every strip was inflated for it."""
    path = tmp_path / "a.tif"
    strip = zlib.compress(bytes(2**24), 9)
    path.write_bytes(tiff_of(2**12, 2**12, pages=100, strip=strip, compression=(259, 3, 1, 8)))
    before = time.process_time()
    assert describe(path).shape == (100, 2**12, 2**12)
    assert time.process_time() - before < 1  # 1.6 GB take longer than that to inflate
    refused(path, "at most 1677721599 bytes", action=lambda p: load_volume(p, max_bytes=100 * 2**24 - 1))
    plane = bytes(range(16))
    path.write_bytes(tiff_of(4, 4, pages=3, strip=zlib.compress(plane), compression=(259, 3, 1, 8)))
    assert load_volume(path).samples.flatten().tolist() == 3 * list(plane)
    path.write_bytes(tiff_of(4, 4, pages=3, strip=plane))
    assert load_volume(path).samples.flatten().tolist() == 3 * list(plane)


def test_pages_that_share_lists_of_strips(tmp_path: Path) -> None:
    """Many pages, all with the same list of a hundred thousand strips: reading the list costs more than the planes."""
    path = tmp_path / "a.tif"
    path.write_bytes(tiff_of(1, 10**5, pages=1000, strip=b"?", strips=10**5))
    refused(path, "directories or lists of strips that overlap", action=describe)


def test_a_list_of_strips_may_be_as_long_as_the_file_holds(tmp_path: Path) -> None:
    """17 MiB of offsets, and as many counts, of rows of one voxel: true, and refused for being one page only."""
    path, rows = tmp_path / "a.tif", 17 * 2**18
    path.write_bytes(tiff_of(1, rows, pages=1, strip=b"?", strips=rows))
    refused(path, "a stack of two or more pages", "1 (a 2-D image)", action=describe, peak=2**27)


def test_strips_that_hold_much_and_are_little(tmp_path: Path) -> None:
    """A strip of a million empty blocks, shared; a tile of 64 MiB for a plane of one voxel, shared."""
    path = tmp_path / "a.tif"
    empty = b"\x78\x9c" + b"\0\0\0\xff\xff" * 200_000
    path.write_bytes(tiff_of(10, 10, pages=100, strip=empty, compression=(259, 3, 1, 8)))
    refused(path, "pages of", action=describe)
    tile = zlib.compress(bytes(2**24), 9)
    tags = {"compression": (259, 3, 1, 8), "wide": (322, 4, 1, 2**12), "high": (323, 4, 1, 2**12)}
    path.write_bytes(tiff_of(1, 1, pages=10_000, strip=tile, **tags))
    refused(path, "pages of", action=describe)


# What a byte of deflate data can be at most, and one byte more, claimed of noise that holds far less.


@pytest.mark.parametrize("ratio", [1032, 1033])
def test_gzip_is_told_by_its_header_where_it_cannot_hold_so_much(tmp_path: Path, ratio: int) -> None:
    noise = os.urandom(1000)
    path = nrrd_file(tmp_path / "a.nrrd", noise, encoding="gzip", sizes=f"{ratio} {len(noise)} 1")
    if ratio == 1032:
        assert describe(path).size == (1032, 1000, 1)
    else:
        refused(path, "1000 bytes of gzip data, which cannot hold that many", action=describe)


@pytest.mark.parametrize("ratio", [1032, 1033])
def test_a_strip_is_told_by_its_tags_where_it_cannot_hold_so_much(tmp_path: Path, ratio: int) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(tiff_of(ratio, 1000, strip=os.urandom(1000), compression=(259, 3, 1, 8)))
    if ratio == 1032:
        assert describe(path).size == (1032, 1000, 2)
    else:
        refused(path, "strips or tiles of 1033000 bytes; got 1000 bytes of deflate data", action=describe)


@pytest.mark.parametrize("ratio", [1032, 1033])
def test_a_member_is_told_by_the_directory_where_it_cannot_hold_so_much(tmp_path: Path, ratio: int) -> None:
    path = zipped(tmp_path / "a.npz", samples=SMALL)
    with zipfile.ZipFile(path) as archive:
        packed = archive.getinfo("samples.npy").compress_size
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", len(SMALL)), struct.pack("<I", ratio * packed)))
    refused(path, "24 bytes of samples" if ratio == 1032 else "which cannot hold that many", action=describe)


@pytest.mark.parametrize("tag", [270, 282, 305, 65000])
def test_texts_are_read_no_further_than_they_matter(tmp_path: Path, tag: int) -> None:
    """17 MiB in one tag: a description of which OME alone wants 4, and tags of which nothing counts."""
    path, text = tmp_path / "a.tif", bytes(range(33, 127)) * 200_000
    path.write_bytes(tiff_of(4, 4, more=text[: 17 * 2**20], strip=bytes(range(16)), long=(tag, 2, 17 * 2**20, -1)))
    assert len(text) > 17 * 2**20
    tracemalloc.start()
    found = load_volume(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.samples.flatten().tolist() == 2 * list(range(16))
    assert peak < 9 * 2**20


@pytest.mark.parametrize("element", [b"<a/>", b"<TiffData/>", b"<Channel ID='1'/>", b"<!-- -->", b"&lt;"])
def test_ome_xml_of_many_small_things(tmp_path: Path, element: bytes) -> None:
    """A tree of them takes a hundred times their bytes."""
    path, start = tmp_path / "a.tif", b"<OME><Pixels SizeX='4' SizeY='4' SizeZ='2' SizeC='1' SizeT='1'>"
    count = 1_000_000 // len(element)
    text = start + count * element + b"</Pixels></OME>"
    path.write_bytes(tiff_of(4, 4, more=text, strip=bytes(16), description=(270, 2, len(text), -1)))
    tracemalloc.start()
    with contextlib.suppress(VolumeFileError):
        assert describe(path).shape == (2, 4, 4)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 2**20 + 2 * path.stat().st_size
    text = text.replace(b"</Pixels>", b"x" * 2**22 + b"</Pixels>")
    path.write_bytes(tiff_of(4, 4, more=text, strip=bytes(16), description=(270, 2, len(text), -1)))
    refused(path, "an OME description of at most 4194304 bytes", action=describe)


def test_directories_of_very_many_tags(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    entries = struct.pack("<HHII", 65000, 4, 1, 0) * 60_000
    path.write_bytes(struct.pack("<2sHIH", b"II", 42, 8, 60_000) + entries + bytes(4))
    refused(path, "at most 4096 tags", "60000", action=describe)


def test_predictors_that_do_not_fit(tmp_path: Path) -> None:
    path, plane = tmp_path / "a.tif", zlib.compress(bytes(16))
    for predictor in (0, 3, 4, 34892):
        path.write_bytes(tiff_of(4, 4, strip=plane, compression=(259, 3, 1, 8), predictor=(317, 3, 1, predictor)))
        refused(path, "predictor 1, 2 for uint8 (deflate)", str(predictor), action=describe)
    path.write_bytes(tiff_of(4, 4, strip=bytes(16), predictor=(317, 3, 1, 2)))
    refused(path, "no predictor for uint8 (raw)", action=describe)


def test_tiff_pages_that_differ_and_images(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as writer:
        writer.write(np.zeros((4, 4), np.uint8))
        writer.write(np.zeros((4, 5), np.uint8))
    refused(path, "pages of 4 × 4 uint8", "page 1 of 5 × 4 uint8")
    with tifffile.TiffWriter(path) as writer:
        writer.write(np.zeros((4, 4), np.uint8))
        writer.write(np.zeros((4, 4), np.uint16))
    refused(path, "page 1 of 4 × 4 uint16")
    tifffile.imwrite(path, np.zeros((4, 4), np.uint8))
    refused(path, "two or more pages")
    tifffile.imwrite(path, np.zeros((3, 8, 8, 3), np.uint8), photometric="rgb")
    refused(path, "a choice among its 3 channels")
    tifffile.imwrite(path, np.zeros((3, 8, 8), np.complex64), photometric="minisblack")
    refused(path, "a type among")
    tifffile.imwrite(path, np.zeros((2, 3, 8, 8), np.uint8), imagej=True, metadata={"axes": "TZYX"})
    refused(path, "a choice among its 2 frames")


def test_tiff_folders(tmp_path: Path) -> None:
    refused(tmp_path, "a folder of .tif or .tiff slices")
    tifffile.imwrite(tmp_path / "a1.tif", np.zeros((4, 4), np.uint8))
    refused(tmp_path, "two or more pages")
    tifffile.imwrite(tmp_path / "a2.tif", np.zeros((4, 5), np.uint8))
    refused(tmp_path, "a2.tif", "5 × 4")
    tifffile.imwrite(tmp_path / "a2.tif", np.zeros((3, 4, 4), np.uint8), photometric="minisblack")
    refused(tmp_path, "one page in every slice")


# --- any bytes at all -------------------------------------------------------------------------------------------------

patches = st.binary(max_size=30) | st.sampled_from(NUMBERS + WORDS)
edits = st.lists(st.builds(Edit, st.sampled_from(KINDS), st.floats(0, 1), patches), min_size=1, max_size=3)


@pytest.mark.filterwarnings("ignore::filterlab.io.warned.VolumeFileWarning")
@pytest.mark.parametrize("original", originals().values(), ids=lambda original: original.name)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edits=edits)
def test_any_bytes_are_a_volume_or_a_volume_file_error(original: Original, tmp_path: Path, edits: list[Edit]) -> None:
    """What hypothesis finds it also makes small; many more cases are tried by `experiments.extremes.fuzzing`."""
    original.write(tmp_path)
    original.damage(tmp_path, edited(original.content, edits))
    with contextlib.suppress(VolumeFileError):
        assert isinstance(load_volume(tmp_path / original.path, frame=original.frame, max_bytes=2**20), Volume)


def test_a_damaged_tiff_is_told_of_once(tmp_path: Path) -> None:
    """tifffile logs what it does not like of a file; our message says it."""
    path = tiff_file(tmp_path / "a.tif", BITS, 7)
    data = bytearray(path.read_bytes())
    struct.pack_into("<H", data, tags_of(data)[270] + 2, 999)  # no type of a tag
    path.write_bytes(data)
    logger, heard = logging.getLogger("tifffile"), queue.SimpleQueue()
    handler = logging.handlers.QueueHandler(heard)
    logger.addHandler(handler)
    try:
        refused(path, "a.tif")
        logger.error("ours")
    finally:
        logger.removeHandler(handler)
    assert heard.get_nowait().getMessage() == "ours"


def test_a_detached_header_with_a_huge_claim_costs_nothing(tmp_path: Path) -> None:
    path = write_nrrd(tmp_path / "a.nhdr", SAMPLES.astype(np.uint8), "raw")
    path.write_text(path.read_text().replace("sizes: 4 3 2", "sizes: 40000 40000 4000"))
    refused(path, "6400000000000 bytes")
