"""Ray: addresses that do not answer, folders as bytes, and a real cluster of two nodes, one of which is killed."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from dataclasses import replace

import pytest
import torch

from gridreg.ablation import ray_cluster
from gridreg.ablation.perform import Scenes, perform
from gridreg.ablation.ray_cluster import check_answers
from gridreg.ablation.ray_task import Task, read_folder, run_task, write_folder
from gridreg.ablation.store import Store
from gridreg.ablation.study import study_from_text
from gridreg.errors import InputError
from gridreg.training.checkpoint import has_checkpoint
from tests.ablation_runs import assert_same_numbers, study_text, tiny_study


def test_folders_travel_as_bytes(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    (one / "test").mkdir(parents=True)
    (one / "a.txt").write_text("a")
    (one / "test" / "b.bin").write_bytes(bytes(1000))
    (one / "empty").write_bytes(b"")
    (one / "link").symlink_to("/etc/hostname")
    two.mkdir()
    (two / "old.txt").write_text("old")
    files = read_folder(one)
    assert files == {"a.txt": b"a", "empty": b"", "test/b.bin": bytes(1000)}
    write_folder(files, two)
    assert read_folder(two) == files
    assert not (two / "old.txt").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one", "two"]
    write_folder(read_folder(tmp_path / "none"), two)
    assert list(two.iterdir()) == []


@pytest.mark.parametrize("name", ["../out.txt", "/out.txt", "a/../../out.txt", "", "."])
def test_what_a_worker_sends_stays_in_its_folder(tmp_path, name):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "kept").write_text("kept")
    with pytest.raises(InputError, match="expected plain files"):
        write_folder({"fine": b"x", name: b"x"}, tmp_path / "run")
    assert [p.name for p in tmp_path.rglob("*")] == ["run", "kept"]


def test_ray_is_an_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setattr(os, "environ", dict(os.environ))
    with pytest.raises(InputError, match=r"Ray is not installed.*gridreg\[ray\]"):
        ray_cluster.import_ray()


@pytest.mark.parametrize("address", ["nonsense", "host:", "host:port", "host:0", "host:70000", "ray://host"])
def test_addresses_that_are_none(address):
    with pytest.raises(InputError, match="expected auto, HOST:PORT or ray://HOST:PORT"):
        check_answers(address)


@pytest.fixture
def listener():
    """A port where a program of another kind gives one and the same answer; None: it says nothing."""
    server = socket.create_server(("127.0.0.1", 0))
    answers: list[bytes | None] = []

    def serve():
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                if answers[0] is None:
                    time.sleep(1.0)
                else:
                    connection.recv(4096)
                    connection.sendall(answers[0])

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield f"127.0.0.1:{server.getsockname()[1]}", answers
    server.shutdown(socket.SHUT_RDWR)
    server.close()
    thread.join()


# HTTP/2: an empty frame of settings, and headers that are the one entry 0x8d of the table, "status 404".
NOT_FOUND = bytes([0, 0, 0, 4, 0, 0, 0, 0, 0]) + bytes([0, 0, 1, 1, 5, 0, 0, 0, 1, 0x8D])


@pytest.mark.parametrize("answer", [None, b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", NOT_FOUND])
def test_addresses_where_something_else_listens(listener, answer):
    address, answers = listener
    answers.append(answer)
    began = time.monotonic()
    with pytest.raises(InputError, match=rf"no Ray cluster answers at {address} \(no answer\)") as caught:
        check_answers(address, seconds=3)
    assert time.monotonic() - began < 20
    assert "\n" not in str(caught.value)


def test_of_rays_client_server_an_open_port_must_do(listener):
    address, answers = listener
    answers.append(b"")
    assert check_answers(f"ray://{address}") is None


def test_a_closed_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    for prefix in ("", "ray://"):
        with pytest.raises(InputError, match=f"answers at {prefix}127.0.0.1:{port} "):
            check_answers(f"{prefix}127.0.0.1:{port}")


def task(spec, files=None, **changes):
    values = {
        "spec": spec.to_json(),
        "files": files or {},
        "threads": 1,
        "keep_checkpoint": True,
        "modules": (),
    }
    return Task(**{**values, **changes})


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
def test_a_task_on_a_worker(tmp_path):
    (spec,) = tiny_study(rows="[none]").runs
    result = run_task(task(spec))
    write_folder(result.files, tmp_path / "run")
    assert result.metrics is not None
    assert (tmp_path / "run" / "metrics.json").is_file()
    assert "step 6/6" in (tmp_path / "run" / "log.txt").read_text()
    assert has_checkpoint(tmp_path / "run" / "checkpoint")
    # It goes on from what it is sent.
    again = run_task(task(spec, result.files, keep_checkpoint=False))
    assert again.metrics["images"] == result.metrics["images"]
    write_folder(again.files, tmp_path / "run")
    assert not has_checkpoint(tmp_path / "run" / "checkpoint")
    # A scene that was shipped is not looked for.
    scene = Scenes(tmp_path).get(spec)
    shipped = replace(spec, scene="/nowhere/lighthouse_32")
    assert run_task(task(shipped), lambda: scene).metrics["images"] == result.metrics["images"]
    failed = run_task(task(replace(spec, scene="/nowhere/another")))
    assert failed.metrics is None
    assert "scene another: not on" in failed.reason
    assert "No module named" in run_task(task(spec, modules=("no_such_module_here",))).reason


LISTENING = """
import subprocess, sys
from gridreg.ablation.ray_cluster import connected
with connected(None, cpus=1) as ray:
    print(ray.get(ray.remote(lambda: "ran").remote()))
    print(subprocess.run(["ss", "-Hltnp"], capture_output=True, text=True, check=True).stdout)
"""


@pytest.mark.timeout(300)
def test_a_cluster_of_ones_own_is_not_open_to_the_network():
    pytest.importorskip("ray", reason="Ray is not installed (extra: ray)")
    if shutil.which("ss") is None:
        pytest.skip("ss (iproute2) is not installed")
    command = [sys.executable, "-W", "ignore", "-c", LISTENING]
    # Its own token, whatever the caller has.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=280)
    first, *lines = ended.stdout.splitlines()
    assert first == "ran", ended.stderr
    own = [line.split()[3] for line in lines if "gcs_server" in line or "raylet" in line or "ray::" in line]
    assert len(own) >= 3
    assert all(place.startswith(("127.0.0.1:", "[::ffff:127.0.0.1]:", "[::1]:")) for place in own), own


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A head without processors, and two nodes of one each (three raylets here), with their folder for files."""
    pytest.importorskip("ray", reason="Ray is not installed (extra: ray)")
    ray_cluster.import_ray("elsewhere")
    with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
        # Ray's own start and end, which leave sockets and logs to the garbage collector.
        warnings.simplefilter("ignore")
        from ray.cluster_utils import Cluster

        # Tests before this one may have asked for a cluster of their own, with a token.
        for name in [name for name in os.environ if name.startswith("RAY_AUTH")]:
            patch.delenv(name)

        # The runs of other programs on this machine are none of this test's; Ray's sockets need short names.
        folder = tmp_path_factory.mktemp("nodes")
        patch.setenv("RAY_TMPDIR", tempfile.gettempdir())
        patch.setenv("TMPDIR", str(folder))
        small = {"object_store_memory": 80 * 2**20}
        quick = {"health_check_period_ms": 500, "health_check_failure_threshold": 4}
        # On a busy machine, Ray's workers would hardly ever have a turn, and be killed for the memory that others take.
        system = {**quick, "worker_niceness": 0, "memory_monitor_refresh_ms": 0}
        head = {"num_cpus": 0, "include_dashboard": False, "_system_config": system, **small}
        cluster = Cluster(initialize_head=True, head_node_args=head)
        nodes = [cluster.add_node(num_cpus=1, **small) for _ in range(2)]
        cluster.wait_for_nodes(timeout=120)
        yield cluster, nodes, folder
        cluster.shutdown()


@pytest.mark.usefixtures("one_thread")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.timeout(600)
def test_two_nodes_one_of_which_is_killed(cluster, tmp_path):
    """However slow the machine is: the node is killed while both nodes have a run, and no run ends before that."""
    from gridreg.ablation.ray_runner import RayRunner

    cluster, nodes, folder = cluster
    text = study_text(rows="[none]", seeds="[0, 1, 2]").replace("steps: 6", "steps: 150")
    study, store = study_from_text(text, name="ray"), Store.open(tmp_path / "store")
    store.add(study)
    over = threading.Event()

    def kill():
        # Runs whose first step is near: their configuration is written.
        while len(list(folder.glob("gridreg-run-*/run/config.yaml"))) < 2 and not over.wait(0.005):
            pass
        cluster.remove_node(nodes[0], allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        check_answers(cluster.address, seconds=120)
        RayRunner(address=cluster.address, ship_scenes=True).run(store, study, lambda event: None)
    finally:
        over.set()
        killer.join()
    outcomes = [attempt["outcome"] for attempt in store.attempts()]
    assert outcomes.count("done") == 3
    assert outcomes.count("lost") == 1
    assert store.counts() == {"waiting": 0, "running": 0, "done": 3, "failed": 0}
    for result in store.results(study):
        assert (result.folder / "test.png").is_file()
        assert result.metrics["versions"]["threads"] == 1
    torch.set_num_threads(1)
    first = store.results(study)[0]
    here = perform(first.spec, tmp_path / "here", Scenes(tmp_path))
    assert_same_numbers(here.metrics["images"], first.metrics["images"])
