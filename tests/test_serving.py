"""The server of a page: requests that it answers or refuses."""

import http.client
import os
import socket
import urllib.request
from contextlib import ExitStack

import browser
import pytest
from sinks import resident
from websockets.sync.client import connect

from twodof.errors import PageError
from twodof.pages.serving import LARGEST, MOST_CONNECTIONS, Connection, Server


def names_of(*names: str) -> list[str]:
    """Names of a host as a browser writes them into Host."""
    return [f"{name}:{port}" for name in names for port in (80, 9000)] + [*names]


LOOPBACK = ("127.0.0.1", "localhost", "LocalHost", "[::1]")
STRANGERS = ("evil.example", "127.0.0.1.evil.example", "localhost.evil.example", "[::1].example", "")
ASKED = {
    "127.0.0.1": (LOOPBACK, (*STRANGERS, "192.0.2.1", "[2001:db8::1]")),
    "localhost": (LOOPBACK, (*STRANGERS, "192.0.2.1")),
    "0.0.0.0": ((*LOOPBACK, "192.0.2.1", "[2001:db8::1]", socket.gethostname()), STRANGERS),
    socket.gethostname(): ((socket.gethostname(),), (*STRANGERS, "192.0.2.1")),
}


@pytest.mark.parametrize(
    ("host", "own", "other"),
    [
        pytest.param(host, *names, marks=[pytest.mark.needs("hostname")] if host == socket.gethostname() else [])
        for host, names in ASKED.items()
    ],
    ids=ASKED,
)
def test_page_answers_to_its_own_name_and_its_own_page_alone(host, own, other):
    """Requests are for the page and for a websocket, with a browser's headers."""

    async def talk(connection: object) -> None:
        pass

    def answer(url: str, *headers: tuple[str, str]) -> int:
        return browser.answer(url, *headers, path="/socket" if len(headers) > 4 else "/")

    with Server(b"a page", host, 0, talk) as served:
        for rest, fine in (((), 200), (browser.UPGRADE, 101)):
            for name in names_of(*other):
                asked = ("Host", name), *rest
                assert answer(served.url, *asked) == 403
                assert answer(served.url, *asked, ("Origin", f"http://{name}")) == 403
            for name in names_of(*own):
                asked = ("Host", name), *rest
                assert answer(served.url, *asked) == fine  # no browser, or a link
                assert answer(served.url, *asked, ("Origin", f"http://{name}")) == fine
                for origin in ("null", "http://[", "http://localhost:3000", "http://evil.example"):
                    assert answer(served.url, *asked, ("Origin", origin)) == 403
                assert answer(served.url, *asked, ("Host", name)) == 403
            assert answer(served.url, *rest) == 403


@pytest.mark.needs("linux")
@pytest.mark.parametrize(
    ("host", "asked"),
    [
        ("127.0.0.1", "127.0.0.1"),
        ("127.0.0.1", "::ffff:127.0.0.1"),
        ("0.0.0.0", "127.0.0.1"),
        ("::1", "::1"),
        ("::", "::1"),
        ("::", "127.0.0.1"),
        ("::", "::ffff:127.0.0.1"),
    ],
)
def test_a_token_is_of_no_use_to_another_user(host, asked, monkeypatch):
    """All users of a machine can read the command line of a browser, which has the token."""
    user = os.geteuid() or browser.NOBODY
    with Server(b"page", host, 0, token="secret") as server:
        for server_user, status in ((user, b"200"), (user + 1, b"403"), (0, b"200")):
            with browser.connected(server.url, asked) as one, monkeypatch.context() as patch:
                patch.setattr(os, "geteuid", lambda server_user=server_user: server_user)
                one.sendall(b"GET /?token=secret HTTP/1.1\r\nHost: localhost\r\n\r\n")
                assert one.recv(100).split()[1] == status


def test_a_request_that_is_no_text_is_refused():
    with Server(b"page", port=0, token="secret") as server, browser.connected(server.url, "127.0.0.1") as one:
        one.sendall(b"GET /?token=\xff HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert one.recv(100).split()[1] == b"403"


def test_a_server_has_one_page_and_no_socket_that_it_does_not_need():
    own = ("Host", "localhost")
    with Server(b"page", port=0) as server:
        for path in ("/socket", "/?bag=other", "/run.json", "/../run.json", "//evil.example"):
            assert browser.answer(server.url, own, path=path) == 404
            assert browser.answer(server.url, own, *browser.UPGRADE, path=path) == 404


def test_port_that_another_is_about_to_serve():
    with Server(b"", port=0) as free:
        port = int(free.url.rpartition(":")[2])
    first = Server(b"", port=port)
    with pytest.raises(PageError, match=f"port {port} of 127.0.0.1 is in use"):
        Server(b"", port=port)
    with first:
        assert browser.answer(first.url, ("Host", "localhost")) == 200


@pytest.mark.parametrize("method", ["HEAD", "POST", "DELETE"])
def test_unexpected_requests_of_a_page_are_answered(method):
    """Methods other than GET get status 405, for example with curl -I."""
    with Server(b"page", port=0) as server:
        asking = http.client.HTTPConnection(server.url.removeprefix("http://"), timeout=60)
        asking.request(method, "/")
        answer = asking.getresponse()
        assert (answer.status, answer.getheader("Allow"), answer.read()) == (405, "GET", b"")


def test_connections_without_a_request_are_bounded() -> None:
    """Idle ones neither use up the descriptors nor block others; websockets stay open."""
    page = Server(b"page", port=0, talk=lambda connection: connection.wait_closed(), token="t")
    with page, connect(page.url.replace("http:", "ws:").replace("?", "socket?")) as held, ExitStack() as idle:
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(5 * MOST_CONNECTIONS):
            idle.enter_context(browser.connected(page.url, "127.0.0.1"))
        with urllib.request.urlopen(page.url, timeout=60) as answer:
            assert answer.read() == b"page"
        assert len(os.listdir("/proc/self/fd")) - before < 6 * MOST_CONNECTIONS + 10
        held.ping().wait(10)


@pytest.mark.parametrize("begin", [b"GET / HTTP/1.1\r\n", b"GET /" + b"a" * LARGEST])
def test_a_request_without_end_is_cut_off(begin: bytes) -> None:
    with Server(b"page", port=0) as page, browser.connected(page.url, "127.0.0.1") as one:
        one.sendall(begin)
        with pytest.raises(ConnectionError):
            for _ in range(100):
                one.sendall(b"X: " + b"a" * 1_000_000 + b"\r\n")


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_a_page_on_all_addresses_is_opened_as_printed(host):
    with Server(b"page", host, 0) as server:
        assert f"//{host}:" not in server.url and "[::]" not in server.url
        with urllib.request.urlopen(server.url, timeout=60) as answer:
            assert answer.read() == b"page"


@pytest.mark.parametrize(
    ("begin", "flood"),
    [
        pytest.param(b"", (b"\x89\xfd\0\0\0\0" + b"x" * 125) * 500, id="pings"),
        pytest.param(b"\x01\x80\0\0\0\0", b"\0\x80\0\0\0\0" * 10_000, id="empty fragments"),
    ],
)
def test_a_websocket_that_floods_is_ended(begin: bytes, flood: bytes) -> None:
    """Answers to its pings, and fragments of a message without end, would fill the memory."""

    async def talk(connection: Connection) -> None:
        async for _ in connection:
            pass

    with Server(None, port=0, talk=talk) as server, browser.connected(server.url, "127.0.0.1") as one:
        upgrade = "".join(f"{name}: {value}\r\n" for name, value in (("Host", "localhost"), *browser.UPGRADE))
        one.sendall(f"GET / HTTP/1.1\r\n{upgrade}\r\n".encode())
        assert one.recv(100).split()[1] == b"101"
        one.sendall(begin)
        with pytest.raises(ConnectionError):
            for _ in range(300):
                one.sendall(flood)


def test_slow_browsers_take_no_memory() -> None:
    page = os.urandom(8 * 1024**2)
    with Server(page, port=0) as server, ExitStack() as slow:
        before = resident()
        for _ in range(MOST_CONNECTIONS):
            one = slow.enter_context(browser.connected(server.url, "127.0.0.1"))
            one.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert one.recv(10)
        with urllib.request.urlopen(server.url, timeout=60) as answer:
            assert answer.read() == page
        assert resident() - before < 100 * 1024**2
