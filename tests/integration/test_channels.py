"""The sockets on their own: who hears what, what happens to those that are gone, and the folder they lie in."""

import os
import stat
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from oodil.workers import channels
from oodil.workers.channels import Dealer, EndpointError, Router, endpoint_folder, private_endpoint
from tests.fakes import wait_until

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    """Give an endpoint that is removed afterwards."""
    with private_endpoint(tmp_path) as name:
        yield name


def receive(router: Router, count: int = 1) -> list[tuple[str, list[bytes]]]:
    """Return the next messages, within a bounded time."""
    messages: list[tuple[str, list[bytes]]] = []

    def arrived() -> bool:
        messages.extend(router.receive(0.1))
        return len(messages) >= count

    wait_until(arrived)
    return messages


def test_frames_arrive_whole_and_answers_find_their_worker(endpoint: str) -> None:
    router, one, two = Router(endpoint), Dealer(endpoint, "one"), Dealer(endpoint, "two")
    try:
        for dealer, name in ((one, b"1"), (two, b"2")):
            assert dealer.send([name, b"", bytes(1_000_000)])
        assert sorted(receive(router, 2)) == [
            ("one", [b"1", b"", bytes(1_000_000)]),
            ("two", [b"2", b"", bytes(1_000_000)]),
        ]
        assert router.send("two", [b"for two"]) and router.send("one", [b"for one"])
        assert (one.receive(30.0), two.receive(30.0)) == ([b"for one"], [b"for two"])
        assert one.receive(0.0) is None
    finally:
        for socket in (router, one, two):
            socket.close()


def test_sending_to_a_worker_that_is_gone_says_so(endpoint: str) -> None:
    router, dealer = Router(endpoint), Dealer(endpoint, "worker")
    try:
        assert not router.send("nobody", [b""])
        dealer.send([b"hello"])
        receive(router)
        dealer.close()
        wait_until(lambda: not router.send("worker", [b""]))
    finally:
        router.close()


def test_a_worker_reaches_the_learner_that_follows(endpoint: str) -> None:
    dealer, first = Dealer(endpoint, "worker"), Router(endpoint)
    dealer.send([b"to the first"])
    receive(first)
    first.close()
    second = Router(endpoint)
    try:
        dealer.send([b"to the second"])
        assert receive(second) == [("worker", [b"to the second"])]
    finally:
        dealer.close()
        second.close()


def test_queues_are_bounded_and_closing_does_not_wait_for_them(endpoint: str) -> None:
    dealer = Dealer(endpoint, "worker")
    taken = 0
    while dealer.send([b"nobody listens"]):
        taken += 1
        assert taken < 10_000
    dealer.close()


def test_a_frame_over_the_limit_never_arrives(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channels, "MAX_FRAME_BYTES", 1000)
    router, sender, other = Router(endpoint), Dealer(endpoint, "sender"), Dealer(endpoint, "other")
    try:
        sender.send([bytes(1001)])
        other.send([bytes(1000)])
        assert receive(router) == [("other", [bytes(1000)])]
        assert router.receive(0.2) == []
    finally:
        for socket in (router, sender, other):
            socket.close()


def test_another_thread_can_end_the_wait(endpoint: str) -> None:
    router = Router(endpoint)
    heard: list[list[tuple[str, list[bytes]]]] = []
    waiting = threading.Thread(target=lambda: heard.append(router.receive(3600.0)))
    waiting.start()
    router.wake()
    waiting.join(30.0)
    router.close()
    assert heard == [[]]


def test_the_folder_is_private_and_removed(tmp_path: Path) -> None:
    folder = endpoint_folder(tmp_path)
    with private_endpoint(tmp_path) as endpoint:
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        socket = Path(endpoint.removeprefix("ipc://"))
        assert socket.parent == folder == endpoint_folder(tmp_path) != endpoint_folder(tmp_path / "other")
        router = Router(endpoint)
        assert stat.S_ISSOCK(socket.stat().st_mode)
        router.close()
    assert not folder.exists()


def test_what_a_killed_run_left_is_cleared(tmp_path: Path) -> None:
    folder = endpoint_folder(tmp_path)
    folder.mkdir(mode=0o700)
    (folder / "learner").touch()
    with private_endpoint(tmp_path):
        assert not list(folder.iterdir())
    assert not folder.exists()


def test_a_folder_that_others_may_enter_is_refused(tmp_path: Path) -> None:
    folder = endpoint_folder(tmp_path)
    folder.mkdir(mode=0o700)
    try:
        folder.chmod(0o755)
        with pytest.raises(EndpointError, match="not a private folder"), private_endpoint(tmp_path):
            pass
    finally:
        folder.rmdir()


def test_a_link_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder = endpoint_folder(tmp_path)
    os.symlink(tmp_path, folder)
    try:
        with pytest.raises(EndpointError, match="not a private folder"), private_endpoint(tmp_path):
            pass
    finally:
        folder.unlink()


def test_a_path_too_long_for_a_socket_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / ("x" * 80)))
    with pytest.raises(EndpointError, match="TMPDIR"), private_endpoint(tmp_path):
        pass
