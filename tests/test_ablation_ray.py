"""Ray: addresses that do not answer, folders as bytes, and a real cluster of two nodes, one of which is killed."""

from __future__ import annotations

import io
import socket
import sys
import tarfile
import tempfile
import threading
import time
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gridreg.ablation import ray_cluster
from gridreg.ablation.packing import pack_folder, unpack_folder
from gridreg.ablation.perform import Scenes, perform
from gridreg.ablation.ray_cluster import check_answers
from gridreg.ablation.ray_task import Order, carry_out
from gridreg.ablation.store import Store
from gridreg.ablation.study import study_from_text
from gridreg.errors import InputError
from gridreg.training.checkpoint import has_checkpoint
from tests.ablation_runs import assert_same_numbers, study_text, tiny_study


def test_folders_as_bytes(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    (one / "test").mkdir(parents=True)
    (one / "a.txt").write_text("a")
    (one / "test" / "b.bin").write_bytes(bytes(1000))
    (one / "empty").write_bytes(b"")
    (one / "link").symlink_to("/etc/hostname")
    two.mkdir()
    (two / "old.txt").write_text("old")
    unpack_folder(pack_folder(one), two)
    assert sorted(p.relative_to(two).as_posix() for p in two.rglob("*") if p.is_file()) == [
        "a.txt",
        "empty",
        "test/b.bin",
    ]
    assert (two / "test" / "b.bin").read_bytes() == bytes(1000)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one", "two"]
    unpack_folder(pack_folder(tmp_path / "none"), two)
    assert list(two.iterdir()) == []


@pytest.mark.parametrize("name", ["../out.txt", "/out.txt", "a/../../out.txt"])
def test_what_a_worker_sends_stays_in_its_folder(tmp_path, name):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        member = tarfile.TarInfo(name)
        member.size = 1
        archive.addfile(member, io.BytesIO(b"x"))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "kept").write_text("kept")
    with pytest.raises(InputError, match="expected plain files"):
        unpack_folder(buffer.getvalue(), tmp_path / "run")
    assert [p.name for p in tmp_path.rglob("*")] == ["run", "kept"]


def test_damaged_bytes(tmp_path):
    with pytest.raises(InputError, match="what a worker sent is damaged"):
        unpack_folder(b"x" * 2000, tmp_path / "run")


def test_ray_is_an_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"Ray is not installed.*gridreg\[ray\]"):
        ray_cluster.import_ray()


@pytest.mark.parametrize("address", ["nonsense", "host:", "host:port", "host:0", "host:70000", "ray://host"])
def test_addresses_that_are_none(address):
    with pytest.raises(InputError, match="expected auto, HOST:PORT or ray://HOST:PORT"):
        check_answers(address)


@pytest.fixture
def listener():
    """A port, and what to answer there."""
    server = socket.create_server(("127.0.0.1", 0))
    answers: list[bytes | None] = []

    def serve():
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            answer = answers.pop()
            if answer is None:
                time.sleep(1.0)
            else:
                connection.recv(4096)
                connection.sendall(answer)
            connection.close()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield f"127.0.0.1:{server.getsockname()[1]}", answers
    server.shutdown(socket.SHUT_RDWR)
    server.close()
    thread.join()


SETTINGS = bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])


def headers(status):
    return bytes([0, 0, 1, 1, 5, 0, 0, 0, 1, status])


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (None, "no answer"),
        (b"", "the connection was closed"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "another program listens there"),
        (SETTINGS + headers(0x8D), "another program listens there"),
        (SETTINGS, "the connection was closed"),
    ],
)
def test_addresses_where_something_else_listens(listener, answer, reason):
    address, answers = listener
    answers.append(answer)
    began = time.monotonic()
    with pytest.raises(InputError, match=rf"no Ray cluster answers at {address} \(.*{reason}") as caught:
        check_answers(address, seconds=0.5)
    assert time.monotonic() - began < 5
    assert "\n" not in str(caught.value)


def test_a_grpc_server_answers(listener):
    address, answers = listener
    answers.append(SETTINGS + headers(0x88))
    assert check_answers(address) is None
    answers.append(SETTINGS + headers(0x88))
    assert check_answers(f"ray://{address}") is None


def test_a_closed_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(InputError, match=f"answers at 127.0.0.1:{port} "):
        check_answers(f"127.0.0.1:{port}")


def test_with_tls_an_open_port_must_do(listener, monkeypatch):
    address, answers = listener
    answers.append(b"")
    monkeypatch.setenv("RAY_USE_TLS", "1")
    assert check_answers(address) is None


def order(spec, files=b"", **changes):
    values = {"spec": spec.to_json(), "files": files, "threads": 1, "keep_checkpoint": True, "modules": ()}
    return Order(**{**values, **changes})


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
def test_what_a_worker_does(tmp_path):
    (spec,) = tiny_study(rows="[none]").runs
    nothing = pack_folder(tmp_path / "none")
    reply = carry_out(order(spec, nothing))
    unpack_folder(reply.files, tmp_path / "run")
    assert reply.metrics is not None
    assert (tmp_path / "run" / "metrics.json").is_file()
    assert "step 6/6" in (tmp_path / "run" / "log.txt").read_text()
    assert has_checkpoint(tmp_path / "run" / "checkpoint")
    # It goes on from what it is sent.
    again = carry_out(order(spec, reply.files, keep_checkpoint=False))
    assert again.metrics["images"] == reply.metrics["images"]
    unpack_folder(again.files, tmp_path / "run")
    assert not has_checkpoint(tmp_path / "run" / "checkpoint")
    # A scene that was shipped is not looked for.
    scene = Scenes(tmp_path).get(spec)
    shipped = replace(spec, scene="/nowhere/lighthouse_32")
    assert carry_out(order(shipped, nothing), [lambda: scene]).metrics["images"] == reply.metrics["images"]
    missing = replace(spec, scene="/nowhere/another")
    failed = carry_out(order(missing, nothing))
    assert failed.metrics is None
    assert "scene another: not on" in failed.reason
    assert "No module named" in carry_out(order(spec, nothing, modules=("no_such_module_here",))).reason


@pytest.fixture(scope="module")
def cluster():
    """A head without processors, and two nodes of one each: three raylets on this machine."""
    pytest.importorskip("ray", reason="Ray is not installed (extra: ray)")
    ray_cluster.import_ray()
    with warnings.catch_warnings():
        # Ray's own start and end, which leave sockets and logs to the garbage collector.
        warnings.simplefilter("ignore")
        from ray.cluster_utils import Cluster

        small = {"object_store_memory": 80 * 2**20}
        quick = {"health_check_period_ms": 500, "health_check_failure_threshold": 4}
        head = {"num_cpus": 0, "include_dashboard": False, "_system_config": quick, **small}
        cluster = Cluster(initialize_head=True, head_node_args=head)
        nodes = [cluster.add_node(num_cpus=1, **small) for _ in range(2)]
        cluster.wait_for_nodes()
        yield cluster, nodes
        cluster.shutdown()


@pytest.mark.usefixtures("one_thread")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.timeout(120)
def test_two_nodes_one_of_which_is_killed(cluster, tmp_path):
    from gridreg.ablation.ray_runner import RayRunner

    cluster, nodes = cluster
    text = study_text(rows="[none]", seeds="[0, 1, 2]").replace("steps: 6", "steps: 150")
    study, store = study_from_text(text, name="ray"), Store.open(tmp_path / "store")
    store.add(study)
    began, over = time.time(), threading.Event()

    def under_way():
        """Runs whose first step is near: their configuration is written."""
        found = Path(tempfile.gettempdir()).glob("gridreg-run-*/run/config.yaml")
        return [path for path in found if path.stat().st_mtime > began]

    def kill():
        while len(under_way()) < 2 and not over.wait(0.01):
            pass
        cluster.remove_node(nodes[0], allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    check_answers(cluster.address)
    RayRunner(address=cluster.address, ship_scenes=True).run(store, study, lambda event: None)
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
