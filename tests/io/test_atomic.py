"""A file appears whole or not at all."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from filterlab.io.atomic import atomic_folder, atomic_write, check_writable, disk_is_full, remove_temporaries


def test_writes_and_leaves_nothing_else(tmp_path: Path) -> None:
    with atomic_write(tmp_path / "a.nii.gz") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name.endswith(".nii.gz")
        temporary.write_text("new")
    assert (tmp_path / "a.nii.gz").read_text() == "new"
    assert os.listdir(tmp_path) == ["a.nii.gz"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_keeps_the_old_file(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail() -> None:
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_the_old_file_is_there_until_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    target, link = tmp_path / "there" / "a.txt", tmp_path / "link.txt"
    target.write_text("old")
    link.symlink_to(target)
    with atomic_write(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_an_impossible_place_is_found_before_the_block_runs(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path, error in (
        (tmp_path / "missing" / "a.txt", FileNotFoundError),
        (tmp_path / "file" / "a.txt", NotADirectoryError),
        (tmp_path, IsADirectoryError),
    ):
        with pytest.raises(error, match="expected"):
            check_writable(path)
        with pytest.raises(error), atomic_write(path):
            pytest.fail("the block must not run")


def test_a_read_only_folder(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o500)
    if os.access(folder, os.W_OK):
        pytest.skip("this user may write everywhere (root)")
    with pytest.raises(PermissionError, match="writable"):
        check_writable(folder / "a.txt")


def test_an_error_of_the_disk_names_the_file_that_was_asked_for(tmp_path: Path) -> None:
    for number, full in ((errno.ENOSPC, True), (errno.EFBIG, True), (errno.EROFS, False)):
        with pytest.raises(OSError, match=r"a\.txt") as caught, atomic_write(tmp_path / "a.txt") as temporary:
            raise OSError(number, "no", str(temporary) if number == errno.EROFS else None)
        assert caught.value.filename == str(tmp_path / "a.txt")
        assert caught.value.errno == number
        assert disk_is_full(caught.value) == full
    with pytest.raises(FileNotFoundError, match=r"other\.txt"), atomic_write(tmp_path / "a.txt"):
        (tmp_path / "other.txt").read_text()
    assert not disk_is_full(ValueError())


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    left = tmp_path / ".tmp-0123456789abcdef.nii.gz"
    for name in (left.name, ".tmp-mine", "a.tmp-0123456789abcdef", ".tmp-0123456789abcdefg"):
        (tmp_path / name).write_text("")
    remove_temporaries(tmp_path, older=60)
    assert left.exists()
    os.utime(left, (0, 0))
    remove_temporaries(tmp_path, older=60)
    assert sorted(os.listdir(tmp_path)) == [".tmp-0123456789abcdefg", ".tmp-mine", "a.tmp-0123456789abcdef"]
    remove_temporaries(tmp_path / "missing")


def test_a_folder_appears_whole_and_what_a_killed_writer_left_of_one_is_removed(tmp_path: Path) -> None:
    with atomic_folder(tmp_path / "frames") as folder:
        (folder / "a.png").write_bytes(b"a")
        assert not (tmp_path / "frames").exists()
    assert [p.name for p in tmp_path.rglob("*")] == ["frames", "a.png"]
    left = tmp_path / ".tmp-0123456789abcdef"
    left.mkdir()
    (left / "000.png").touch()
    remove_temporaries(tmp_path)
    assert not left.exists()
    with pytest.raises(FileExistsError, match="one with files in it"), atomic_folder(tmp_path / "frames"):
        pytest.fail("nothing may be written")
