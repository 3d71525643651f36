"""Atomic writes: whole or not there, nothing lost, and one clear line when the place cannot be written to."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gridreg.errors import InputError
from gridreg.scenes import builtin_scene
from gridreg.training import files


@contextmanager
def no_write_access(folder: Path) -> Iterator[None]:
    """The folder without permission to write, also when the tests run as root (who may write anywhere)."""
    mode = folder.stat().st_mode
    folder.chmod(0o555)
    root = os.geteuid() == 0
    try:
        if root:
            try:
                os.seteuid(65534)
            except OSError:
                pytest.skip("runs as root and cannot become another user")
        yield
    finally:
        if root:
            os.seteuid(0)
        folder.chmod(mode)


def one_line(error: pytest.ExceptionInfo[InputError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    ("write", "content", "expected"),
    [
        (files.write_text, "ä\n", b"\xc3\xa4\n"),
        (files.write_bytes, b"\0\1\xff", b"\0\1\xff"),
        (
            files.write_json,
            {"b": 1, "a": [0.1, None]},
            b'{\n  "a": [\n    0.1,\n    null\n  ],\n  "b": 1\n}\n',
        ),
    ],
)
def test_writes_and_replaces(tmp_path, write, content, expected):
    path = tmp_path / "file.dat"
    path.write_bytes(b"what stood here before, and was longer than what comes now")
    write(path, content)
    assert path.read_bytes() == expected
    assert list(tmp_path.iterdir()) == [path]


def test_json_keeps_the_order_when_asked_and_floats_bit_for_bit(tmp_path):
    value = {"z": 0.1 + 0.2, "a": 5e-324}
    files.write_json(tmp_path / "v.json", value, sort_keys=False)
    back = json.loads((tmp_path / "v.json").read_text())
    assert list(back) == ["z", "a"]
    assert back == value


def test_json_refuses_what_it_cannot_hold_and_keeps_the_old_file(tmp_path):
    path = tmp_path / "v.json"
    path.write_text("old")
    for bad, exception in ((float("nan"), ValueError), ({1, 2}, TypeError)):
        with pytest.raises(exception):
            files.write_json(path, {"x": bad})
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_temporary_name_keeps_the_suffix_and_the_folder(tmp_path):
    with files.writing(tmp_path / "turntable.mp4") as temporary:
        assert temporary.suffix == ".mp4"
        assert temporary.parent == tmp_path
        temporary.write_bytes(b"x")
    assert (tmp_path / "turntable.mp4").read_bytes() == b"x"


@pytest.mark.parametrize("exception", [RuntimeError, KeyboardInterrupt])
def test_an_exception_inside_leaves_the_old_file_alone(tmp_path, exception):
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def fail() -> None:
        with files.writing(path) as temporary:
            temporary.write_text("half")
            raise exception

    with pytest.raises(exception):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EDQUOT, errno.EIO])
def test_operating_system_errors_become_one_line(tmp_path, monkeypatch, code):
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def full(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError) as caught:
        files.write_text(path, "new")
    monkeypatch.undo()
    assert str(path) in one_line(caught)
    if code == errno.ENOSPC:
        assert "no space left" in str(caught.value)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_real_limit_in_the_middle_of_a_write(tmp_path):
    """The kernel refuses the write after 8 KiB, as a disk does that fills up."""
    path = tmp_path / "kept.bin"
    path.write_bytes(b"old")
    program = textwrap.dedent(
        """
        import resource, sys
        from gridreg.errors import InputError
        from gridreg.training import files
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))
        try:
            files.write_bytes(sys.argv[1], bytes(100_000))
        except InputError as error:
            print(error)
            sys.exit(2)
        """
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert done.stdout.startswith(f"{path}: cannot write here: ")
    assert done.stdout.count("\n") == 1
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_no_permission(tmp_path):
    folder = tmp_path / "closed"
    folder.mkdir()
    with no_write_access(folder), pytest.raises(InputError) as caught:
        files.write_text(folder / "a.txt", "x")
    assert "a.txt: cannot write here: permission denied" in one_line(caught)
    with no_write_access(folder), pytest.raises(InputError) as caught:
        files.check_output_folder(folder)
    assert str(folder) in one_line(caught)
    assert list(folder.iterdir()) == []


def test_writing_to_a_folder_that_does_not_exist_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"a\.txt: cannot write here: No such file"):
        files.write_text(tmp_path / "missing" / "a.txt", "x")


def test_a_folder_where_a_file_is_expected(tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(InputError, match="a folder stands where a file is expected"):
        files.write_text(tmp_path / "taken", "x")
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


def test_check_output_folder_creates_and_leaves_no_probe(tmp_path):
    folder = files.check_output_folder(str(tmp_path / "a" / "b"))
    assert folder == tmp_path / "a" / "b"
    assert list(folder.iterdir()) == []
    (folder / "mine.txt").write_text("kept")
    files.check_output_folder(folder)
    assert [p.name for p in folder.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("inner", ["", "deeper"])
def test_check_output_folder_refuses_a_file(tmp_path, inner):
    (tmp_path / "out").write_text("a file of the user")
    with pytest.raises(InputError) as caught:
        files.check_output_folder(tmp_path / "out" / inner)
    assert "a file stands where a folder is expected" in one_line(caught)
    assert (tmp_path / "out").read_text() == "a file of the user"


def test_check_output_folder_on_a_full_disk(tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match="no space left on the disk"):
        files.check_output_folder(tmp_path)


def test_remove_folder(tmp_path):
    (tmp_path / "gone" / "inner").mkdir(parents=True)
    (tmp_path / "gone" / "inner" / "f").write_text("x")
    files.remove_folder(tmp_path / "gone")
    files.remove_folder(tmp_path / "gone")
    assert list(tmp_path.iterdir()) == []


def run(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """A child process with the module at hand."""
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom gridreg.machine import temporary_beside\n"
        "from gridreg.training import files\n" + textwrap.dedent(code)
    )
    return subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True)


def test_what_a_killed_process_left_goes_with_the_next_run(tmp_path):
    done = run(
        """
        with files.writing(Path(sys.argv[1]) / "mesh.ply") as temporary:
            temporary_beside(Path(sys.argv[1]) / "frames").mkdir()
            temporary.write_bytes(b"part")
            os.kill(os.getpid(), signal.SIGKILL)
        """,
        tmp_path,
    )
    assert done.returncode == -9
    assert len(list(tmp_path.iterdir())) == 2
    strangers = [".mesh.00000000-1-0123abcd.tmp.ply", ".mesh.tmp.ply", ".notes.tmp"]
    for name in strangers:
        (tmp_path / name).touch()
    # What another machine is writing, or a living process, is left alone.
    with files.writing(tmp_path / "own.txt") as temporary:
        temporary.touch()
        files.check_output_folder(tmp_path)
        assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*strangers, temporary.name])


def test_one_writer_keeps_others_out_and_dies_with_its_process(tmp_path):
    with files.one_writer(tmp_path):
        done = run("with files.one_writer(sys.argv[1]): print('in')", tmp_path)
        assert done.stdout == ""
        assert "another run is writing here" in done.stderr
    assert list(tmp_path.iterdir()) == []
    killed = run("with files.one_writer(sys.argv[1]): os.kill(os.getpid(), signal.SIGKILL)", tmp_path)
    assert killed.returncode == -9
    assert run("with files.one_writer(sys.argv[1]): print('in')", tmp_path).stdout == "in\n"


def test_what_a_process_left_that_died_right_after_the_builtin_scene(tmp_path):
    done = run(
        """
        from gridreg.scenes import builtin_scene
        rename = Path.rename
        def dying(path, target):
            rename(path, target)
            os.kill(os.getpid(), signal.SIGKILL)
        Path.rename = dying
        builtin_scene(Path(sys.argv[1]), size=8)
        """,
        tmp_path,
    )
    assert done.returncode == -9
    assert len(list(tmp_path.iterdir())) == 2
    assert builtin_scene(tmp_path, size=8).parent == tmp_path
    assert [path.name for path in tmp_path.iterdir()] == ["lighthouse_8"]
