"""The viewer over real sockets with the page's protocol: disconnected clients leave nothing, and nonsense affects only its sender."""

import gc
import threading
import time
from contextlib import contextmanager

import pytest

pytest.importorskip("viser")
import msgspec
import viser
from viser._messages import ViewerCameraMessage
from websockets.sync.client import connect


@contextmanager
def socket(viewer, camera=True):
    url, protocol = viewer.url.replace("http", "ws"), f"viser-v{viser.__version__}"
    with connect(url, subprotocols=[protocol], max_size=None, open_timeout=10) as made:  # type: ignore[list-item]
        if camera:
            look = ViewerCameraMessage((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.8, 0.01, 1e3, 48, 64, (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
            made.send(msgspec.msgpack.encode(look.as_serializable_dict()))
        yield made


def picture(made, seconds=20.0) -> bool:
    """Return whether a picture arrives. Its name is compressed, so any message of a picture's size counts."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            if b"\xff\xd8\xff" in made.recv(timeout=0.5):  # the first bytes of a JPEG, which is not compressed again
                return True
        except TimeoutError:
            pass
    return False


def settled(viewer, seconds=20.0):
    end = time.monotonic() + seconds
    while viewer.clients and time.monotonic() < end:
        time.sleep(0.02)


@pytest.mark.slow
def test_fifty_reconnects_leak_nothing(serving):
    with socket(serving) as made:
        assert picture(made)
    settled(serving)
    gc.collect()
    threads, clients = threading.active_count(), len(gc.get_objects())
    for _ in range(50):
        with socket(serving):
            end = time.monotonic() + 10
            while not serving.clients and time.monotonic() < end:
                time.sleep(0.002)
            assert len(serving.clients) == 1
        settled(serving)
        assert serving.clients == {}
    gc.collect()
    assert threading.active_count() <= threads + 4  # a thread pool of viser may grow to its limit
    assert len(gc.get_objects()) < clients + 50 * 20  # nothing remains of each client
    assert serving.server.get_clients() == {}


def test_malformed_messages_end_their_own_client_alone(serving):
    camera = {"type": "ViewerCameraMessage"}
    nonsense = [
        b"",
        b"\xff\x00nonsense",
        "text",
        msgspec.msgpack.encode({"type": "NoSuchMessage"}),
        msgspec.msgpack.encode(camera),
        msgspec.msgpack.encode([1, 2, 3]),
        msgspec.msgpack.encode(camera | {"wxyz": "x", "position": None}),
    ]
    with socket(serving) as good:
        assert picture(good)
        for message in nonsense:
            with socket(serving, camera=False) as bad:
                bad.send(message)
                time.sleep(0.05)
        serving.request_redraw()
        assert picture(good)
        assert len(serving.clients) == 1
    settled(serving)
    with socket(serving) as again:
        assert picture(again)
