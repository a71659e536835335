"""Run folders: an interrupted run resumes where it stopped and loses nothing."""

import errno
import json
import os
import signal
import subprocess
import time

import pytest
import torch

from experiments import registry
from experiments.__main__ import main
from experiments.config import ExperimentConfig
from experiments.errors import RunError
from experiments.report.page import Section, picture
from experiments.runs import Run, Unit, _commit, config_hash, read_provenance, read_records, run_folder

START = {"started": "2026-01-01T00:00:00+00:00"}


class Config(ExperimentConfig):
    """A config with nothing of its own."""

    count: int = 4


def config(**changes):
    return Config(experiment="counting", description="counts", **changes)


def opened(folder, **changes):
    return Run.open(folder, config(**changes), START)


# Units that take a while: killed in the middle, resumed, and never done twice.
SLOW = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a process in the background inherits that it is ignored
from experiments import __main__
from tests.experiments import test_runs
test_runs.count_slowly(sys.argv[1], 0.1)
sys.exit(__main__.main(sys.argv[2:]))
"""


def count_slowly(journal, seconds):
    """Registers an experiment whose units write their name into the journal and take so long."""

    def compute(config, unit, run):
        with open(journal, "a") as file:
            file.write(unit.key + "\n")
        time.sleep(seconds)
        return {"files": [run.save_array(unit.key, torch.arange(3.0))]}

    def units(config):
        return [Unit(str(i), str(i)) for i in range(config.count)]

    counting = registry.Experiment("counting", Config, units, compute, lambda *_: Section("counting"))
    registry.EXPERIMENTS = {"counting": counting}


@pytest.fixture
def slow(tmp_path, forks, command, monkeypatch, capsys):
    """A process that counts, and what goes on with its run in this process: None -> what was told."""
    path = tmp_path / "slow.yaml"
    path.write_text("experiment: counting\ndescription: counts slowly\ncount: 30\n")
    journal = tmp_path / "journal"
    arguments = ["run", path, "--runs", tmp_path / "runs"]
    monkeypatch.setattr(registry, "EXPERIMENTS", registry.EXPERIMENTS)  # as it was, afterwards

    def start(code=SLOW):
        return command(journal, *arguments, code=code)

    def go_on():
        count_slowly(journal, 0.0)
        assert main([str(a) for a in arguments]) == 0
        return capsys.readouterr().err

    return start, go_on, journal, tmp_path / "runs"


def wait_for(journal, lines, process):
    deadline = time.monotonic() + 60
    while not journal.exists() or len(journal.read_text().splitlines()) < lines:
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_stopped_run_resumes_where_it_stopped(slow, how):
    start, go_on, journal, runs = slow
    process = start()
    wait_for(journal, 4, process)
    process.send_signal(how)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL)
    if how == signal.SIGINT:
        assert "Traceback" not in errors
        assert "python -m experiments run" in errors
    (folder,) = runs.iterdir()
    kept, _ = read_records(folder)
    assert 3 <= len(kept) < 30
    before = (folder / "records.jsonl").read_bytes()
    assert f"{len(kept)} of 30 units of work are done already" in go_on()
    records, _ = read_records(folder)
    assert list(records) == [str(i) for i in range(30)]
    assert (folder / "records.jsonl").read_bytes().startswith(before[: before.rindex(b"\n") + 1])
    done = journal.read_text().splitlines()
    assert sorted(set(done), key=int) == [str(i) for i in range(30)]
    assert len(done) <= 31  # at most the one that was cut off was begun twice
    assert len(read_provenance(folder)) == 2
    assert (folder / "report.html").is_file()
    assert not list(folder.rglob(".tmp*"))


def test_a_torn_last_line_is_cut_off_and_redone(tmp_path):
    with opened(tmp_path / "run") as run:
        for key in "abc":
            run.append(key, {"x": 1})
    path = tmp_path / "run" / "records.jsonl"
    whole = path.read_bytes()
    for cut in range(len(whole) - len(whole.splitlines()[-1]), len(whole)):
        path.write_bytes(whole[:cut])
        with opened(tmp_path / "run") as run:
            assert [run.done(key) for key in "abc"] == [True, True, False]
            run.append("c", {"x": 1})
        lines = path.read_bytes().splitlines(keepends=True)
        assert lines[:2] == whole.splitlines(keepends=True)[:2]
        start = run.start["start"]
        assert start > 1
        assert json.loads(lines[2]) == {"key": "c", "start": start, "x": 1}


def test_damage_before_whole_records_is_not_thrown_away(tmp_path):
    with opened(tmp_path / "run") as run:
        run.append("a", {})
        run.append("b", {})
    path = tmp_path / "run" / "records.jsonl"
    damaged = b'{"key": "a\n' + path.read_bytes().splitlines(keepends=True)[1]
    path.write_bytes(damaged)
    with pytest.raises(RunError, match="broken line"), opened(tmp_path / "run"):
        pass
    assert path.read_bytes() == damaged


def test_a_record_whose_file_is_gone_is_not_done(tmp_path):
    with opened(tmp_path / "run") as run:
        name = run.save_array("numbers", torch.arange(4.0))
        run.append("a", {"files": [name]})
        assert run.done("a")
        assert run.load_array(name).tolist() == [0, 1, 2, 3]
        (run.folder / name).unlink()
        assert not run.done("a")


def test_images_survive_the_round_trip(tmp_path):
    image = torch.rand(5, 7, 3, generator=torch.Generator().manual_seed(0))
    with opened(tmp_path / "run") as run:
        name = run.section("part").save_image("picture", image)
        assert (run.load_image(name) - image).abs().max() < 0.02


def test_sections_keep_their_records_apart(tmp_path):
    with opened(tmp_path / "run") as run:
        run.section("one").append("a", {"x": 1})
        run.section("two").append("a", {"x": 2})
        assert run.section("two").records["a"]["x"] == 2
        assert not run.done("a")
        assert set(run.records) == {"one/a", "two/a"}


def test_memo_keeps_one_of_a_kind(tmp_path):
    made = []
    with opened(tmp_path / "run") as run:
        for key in ("volume:8", "volume:8", "points:0", "volume:16", "points:0", "volume:8"):
            run.memo(key, lambda key=key: made.append(key))
    assert made == ["volume:8", "points:0", "volume:16", "volume:8"]


def test_a_changed_config_gets_another_folder_and_fresh_a_new_one(tmp_path):
    folder = run_folder(tmp_path, "x", config())
    assert folder == run_folder(tmp_path, "x", config())
    assert folder != run_folder(tmp_path, "x", config(count=5))
    assert config_hash(config()) in folder.name
    folder.mkdir()
    assert run_folder(tmp_path, "x", config()) == folder
    second = run_folder(tmp_path, "x", config(), fresh=True)
    assert second.name == folder.name + "-2"
    second.mkdir()
    assert run_folder(tmp_path, "x", config()) == second
    with opened(tmp_path / "y"):
        pass
    with pytest.raises(RunError, match="another config"), opened(tmp_path / "y", count=5):
        pass


def test_records_name_the_start_that_made_them(tmp_path):
    folder = tmp_path / "run"
    for key in "ab":
        with opened(folder) as run:
            run.section("part").append(key, {})
    with (folder / "provenance.jsonl").open("a") as file:
        file.write('{"start": 3, "sta')  # torn by a kill
    with opened(folder) as run:
        run.append("c", {})
    assert [record["start"] for record in read_records(folder)[0].values()] == [1, 2, 3]
    assert read_provenance(folder) == [{"start": n, **START} for n in (1, 2, 3)]


@pytest.mark.parametrize("changed", [{"commit": "b"}, {"filterlab": "2"}])
def test_other_code_is_known_by_the_records_it_made(tmp_path, changed):
    code = {**START, "commit": "a", "filterlab": "1"}

    def start(key, **changes):
        with Run.open(tmp_path / "run", config(), {**code, **changes}) as run:
            others = run.made_by_other_code()
            if key:
                run.append(key, {})
            return [s["start"] for s in others]

    assert start(None, **changed) == []
    assert start("a") == []  # the first start made nothing: nothing is mixed
    assert start("b") == []
    assert start(None, **changed) == [2, 3]
    assert start("c", **changed) == [2, 3]
    assert start(None) == [5]


def test_a_run_goes_on_with_other_code_only_with_a_warning(undrawn, tiny_rms, tmp_path, monkeypatch, capsys):
    arguments = ["run", str(tiny_rms), "--runs", str(tmp_path / "runs")]
    monkeypatch.setattr("experiments.runs._commit", lambda: "aaaa")
    assert main(arguments) == 0
    assert main(arguments) == 0
    assert "warning" not in capsys.readouterr().err
    monkeypatch.setattr("experiments.runs._commit", lambda: "bbbb")
    assert main(arguments) == 0
    (warning,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    for word in ("aaaa", "bbbb", "mixes records of both", "--fresh"):
        assert word in warning
    assert main([*arguments, "--fresh"]) == 0
    assert "warning" not in capsys.readouterr().err


def test_changed_files_change_the_commit(tmp_path, monkeypatch):
    def git(*words):
        identity = ("-c", "user.name=n", "-c", "user.email=e", "-c", "commit.gpgsign=false")
        subprocess.run(["git", "-C", str(tmp_path), *identity, *words], check=True, capture_output=True)

    monkeypatch.setattr("experiments.runs.__file__", str(tmp_path / "runs.py"))
    git("init")
    found = []
    for text in ("1", "2", "3"):
        (tmp_path / "runs.py").write_text(text)
        if text == "1":
            git("add", ".")
            git("commit", "-m", "one")
        found.append(_commit())
    assert len(set(found)) == 3
    clean, *changed = found
    assert len(clean) == 12
    assert all(name.startswith(f"{clean}+changes.") for name in changed)


def test_other_input_files_get_another_folder(tmp_path):
    files = [{"/a": "1"}, {"/a": "2"}, {"/b": "1"}, {}]
    folders = [run_folder(tmp_path, "x", config(), inputs) for inputs in files]
    assert len(set(folders)) == len(files)
    assert folders[3] == run_folder(tmp_path, "x", config())
    with Run.open(tmp_path / "x", config(), {**START, "inputs": files[0]}):
        pass
    with (
        pytest.raises(RunError, match="other input files"),
        Run.open(tmp_path / "x", config(), {**START, "inputs": files[1]}),
    ):
        pass


def test_two_processes_do_not_share_a_folder(tmp_path):
    with opened(tmp_path / "run"), pytest.raises(RunError, match="in use"), opened(tmp_path / "run"):
        pass
    with opened(tmp_path / "run"):
        pass


def test_what_makes_a_run_repeatable_is_written_down(undrawn, tiny_rms, tmp_path):
    assert main(["run", str(tiny_rms), "--runs", str(tmp_path / "runs")]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    (start,) = read_provenance(folder)
    assert start["seed"] == 3
    assert start["device"] == "cpu"
    assert start["threads"] == torch.get_num_threads()
    assert start["torch"] == torch.__version__
    assert {"filterlab", "commit", "numpy", "python"} <= set(start)
    assert "boundary: reflect" in (folder / "config.yaml").read_text()  # a default, written out


def test_a_finished_run_is_not_computed_again(undrawn, tiny_rms, tmp_path, monkeypatch, capsys):
    arguments = ["run", str(tiny_rms), "--runs", str(tmp_path / "runs")]
    assert main(arguments) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    before = (folder / "records.jsonl").read_bytes()
    assert len(before.splitlines()) == 3 * 2 + 3
    assert main(arguments) == 0
    assert "done already" in capsys.readouterr().err
    assert (folder / "records.jsonl").read_bytes() == before
    assert main([*arguments, "--fresh"]) == 0
    assert len(list((tmp_path / "runs").iterdir())) == 2


def test_a_folder_that_cannot_be_written_is_named(tiny_rms, tmp_path, capsys):
    (tmp_path / "runs").write_text("a file")
    assert main(["run", str(tiny_rms), "--runs", str(tmp_path / "runs")]) == 1
    message = capsys.readouterr().err
    assert str(tmp_path / "runs") in message
    assert "Traceback" not in message


def test_a_start_torn_in_the_middle_of_a_letter_is_passed_over(tmp_path):
    folder = tmp_path / "run"
    with Run.open(folder, config(), {"command": "first"}):
        pass
    line = json.dumps({"start": 2, "command": "ünïcode"}, ensure_ascii=False).encode()
    for cut in (line.index("ü".encode()) + 1, len(line) - 1):
        with (folder / "provenance.jsonl").open("ab") as file:
            file.write(line[:cut])
        with Run.open(folder, config(), {"command": "a\u2028b"}) as run:  # no line ends there
            assert run.start["command"] == "a\u2028b"
    assert [start["command"] for start in read_provenance(folder)] == ["first", "a\u2028b", "a\u2028b"]


def test_a_line_that_only_looks_like_json_is_no_record(tmp_path):
    with opened(tmp_path / "run") as run:
        run.append("a", {})
    with (tmp_path / "run" / "records.jsonl").open("ab") as file:
        file.write(b"[" * 100_000 + b"\n")
    with opened(tmp_path / "run") as run:
        assert list(run.records) == ["a"]


@pytest.mark.parametrize("name", ["../a.png", "/etc/passwd", "files/../../a.png", "a\0.png"])
def test_files_of_a_record_are_in_the_folder(tmp_path, name):
    (tmp_path / "a.png").write_bytes(b"")
    with opened(tmp_path / "run") as run:
        for read in (run.load_array, run.load_image, lambda name: picture(run.folder, name, "")):
            with pytest.raises(RunError, match="expected the name of a file in"):
                read(name)
        run.append("a", {"files": [name]})
        with pytest.raises(RunError, match="expected the name of a file in"):
            run.done("a")


@pytest.mark.parametrize("name", ["../a", "/a", "a/../../../b", ".."])
def test_files_are_written_into_the_folder(tmp_path, name):
    with opened(tmp_path / "run") as run:
        for part in (run, run.section("../..")):
            saved = part.save_array(name, torch.zeros(3))
            assert saved.startswith("files/")
            assert (run.folder / saved).resolve().parent == run.folder.resolve() / "files"
        with pytest.raises(RunError):
            run.save_array("a\0", torch.zeros(3))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run"]


def test_arrays_of_every_shape_are_kept(tmp_path):
    whole = torch.arange(24.0).reshape(2, 3, 4)
    with opened(tmp_path / "run") as run:
        for array in (whole, whole.permute(2, 0, 1), whole[:, ::2], whole[:0], torch.tensor(1.5), whole.double() > 3):
            found = run.load_array(run.save_array("a", array))
            assert found.dtype == array.dtype
            assert torch.equal(found, array)


def test_a_record_that_does_not_fit_leaves_no_half_line(tmp_path, monkeypatch):
    """The disk is full after more and more bytes of a record."""
    with opened(tmp_path / "run") as run:
        run.append("a", {})
        path, write = run.folder / "records.jsonl", os.write
        before = path.read_bytes()
        for room in range(0, 24, 5):

            def full(descriptor, data, room=room):
                if len(data) > room:
                    write(descriptor, data[:room])
                    raise OSError(errno.ENOSPC, "No space left on device")
                return write(descriptor, data)

            monkeypatch.setattr("experiments.runs.os.write", full)
            with pytest.raises(OSError, match="No space"):
                run.append("b", {})
            assert path.read_bytes() == before
        monkeypatch.undo()
        run.append("b", {})
    assert list(read_records(tmp_path / "run")[0]) == ["a", "b"]


def test_a_full_disk_keeps_what_was_finished(slow):
    """A limit on the size of files stands for the disk: writing fails in the middle of a record."""
    start, go_on, _, runs = slow
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (900, 900)); sys.exit("
    process = start(code=SLOW.replace("sys.exit(", limit))
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "the disk is full" in errors
    assert "Traceback" not in errors
    (folder,) = runs.iterdir()
    kept = len(read_records(folder)[0])
    assert 0 < kept < 30
    go_on()
    assert len(read_records(folder)[0]) == 30


def test_records_are_plain_json(tmp_path):
    with opened(tmp_path / "run") as run:
        run.append("a", {"words": "ω", "number": 0.1})
        with pytest.raises(ValueError, match="JSON"):
            run.append("b", {"number": float("inf")})
    (line,) = (tmp_path / "run" / "records.jsonl").read_text().splitlines()
    assert json.loads(line) == {"key": "a", "start": 1, "words": "ω", "number": 0.1}
