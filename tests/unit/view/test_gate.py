"""Who is served by the viewer, and what a browser may send: over real sockets with viser's protocol."""

import asyncio
import random
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

pytest.importorskip("viser")
import msgspec
import viser
from viser._messages import ViewerCameraMessage
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from scene_experts.view.gate import Gate, Governor, Refused, is_local
from scene_experts.view.live import Live
from scene_experts.view.server import Viewer
from support.viewers import DRAW

PROTOCOL = f"viser-v{viser.__version__}"
CAMERA = ViewerCameraMessage((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.8, 0.01, 1e3, 48, 64, (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))


def camera(**changes):
    return msgspec.msgpack.encode({**CAMERA.as_serializable_dict(), **changes})


def update(uuid, **updates):
    return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates})


def socket(viewer, path="", host=None, protocol=PROTOCOL, **more):
    """Connect; `host` is the Host header."""
    port = viewer.server.get_port()
    from websockets.asyncio.client import connect as open_async

    async def once():
        headers = dict(more.get("headers", {}))
        url = f"ws://{host or 'localhost'}:{port}{path}"
        try:
            made = await open_async(url, host="127.0.0.1", port=port, subprotocols=[protocol], additional_headers=headers, proxy=None)  # type: ignore[list-item]
        except InvalidStatus as error:
            return error.response.status_code
        await made.close()
        return 101

    return asyncio.run(once())


def page(viewer, path="/", **headers) -> tuple[int, dict[str, str]]:
    request = urllib.request.Request(f"http://127.0.0.1:{viewer.server.get_port()}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, dict(answer.headers)
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers)


def test_a_page_of_another_origin_and_another_host_are_not_served(viewer):
    port = viewer.server.get_port()
    assert viewer.url == f"http://localhost:{port}"
    for own in ("localhost", "127.0.0.1"):
        assert socket(viewer, host=own, headers={"Origin": f"http://{own}:{port}"}) == 101
        assert page(viewer, Host=f"{own}:{port}")[0] == 200
    assert page(viewer, Host="localhost:9000")[0] == 200  # a forwarded port
    for origin in ("http://evil.example", "null", "http://localhost:1", f"http://localhost:{port}.evil.example", "file://", "http://["):
        assert socket(viewer, headers={"Origin": origin}) == 403
        assert page(viewer, Origin=origin)[0] == 403
    for host in ("evil.example", "localhost.evil.example", "127.0.0.1.evil.example"):
        assert socket(viewer, host=host) == 403  # DNS rebinding: the name is the attacker's, the address this machine's
        assert socket(viewer, host=host, headers={"Origin": f"http://{host}:{port}"}) == 403
        assert page(viewer, Host=f"{host}:{port}")[0] == 403
    assert socket(viewer, protocol="viser-v0.0.1") == 403
    assert viewer.clients == {}
    assert "frame-ancestors" in page(viewer)[1]["Content-Security-Policy"]


def test_beyond_this_machine_the_address_has_a_token(viewer):
    open_to_all = Viewer(viewer.capture, viewer.current, DRAW, host="0.0.0.0", port=0)
    try:
        address, token = open_to_all.url.split("/?token=")
        port = open_to_all.server.get_port()
        assert address == f"http://localhost:{port}" and len(token) > 20
        for path in ("", "/?token=", "/?token=wrong", f"/?token={token[:-1]}", f"/{token}", "/?token=%ff"):
            assert socket(open_to_all, path) == 403
            assert page(open_to_all, path or "/")[0] == 403
        assert socket(open_to_all, f"/?token={token}") == 101
        assert socket(open_to_all, f"/?token={token}", headers={"Origin": "http://evil.example"}) == 403
        code, headers = page(open_to_all, f"/?token={token}", Host=f"some-machine:{port}")
        cookie = headers["Set-Cookie"].split(";")[0]
        assert code == 200 and "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
        assert socket(open_to_all, headers={"Cookie": cookie}) == 101  # the page opens its socket without the query
        assert socket(open_to_all, headers={"Cookie": cookie.replace(token, token[::-1])}) == 403
    finally:
        open_to_all.close()


@pytest.mark.parametrize(
    ("host", "local"), [("127.0.0.1", True), ("127.9.9.9", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("", False)]
)
def test_which_addresses_are_of_this_machine_alone(host, local):
    assert is_local(host) is local and bool(Gate(host).token) is not local


def controls(viewer):
    """The controls of the page by label."""
    return {handle.label: handle for handle in viewer.server.gui._gui_input_handle_from_uuid.values() if hasattr(handle, "label")}


def test_values_beyond_the_limits_of_a_control_are_refused(viewer):
    found, check = controls(viewer), viewer.gate.check_message
    send = lambda label, value: check(  # noqa: E731
        {"type": "GuiUpdateMessage", "uuid": found[label]._impl.uuid, "updates": {"value": value}}
    )
    good = {"seconds between keyframes": 60, "height, px": 120, "what": "depth", "background": [0, 255, 3], "crop": True, "save": True}
    for label, value in good.items():
        assert send(label, value)
    low, high = viewer.panel.bounds[0].value
    assert send("x", [low, high])
    bad = {
        "seconds between keyframes": (1e12, -1, float("nan"), float("inf"), "1", None, True, [1], 10**400),
        "height, px": (1e9, 0, -5, {}, 2**63),
        "what": ("nonsense", 0, None, ["depth"]),
        "background": ([0, 0, 256], [0, 0], [0, 0, 0.5], "red", [-1, 0, 0]),
        "crop": (1, "yes", None),
        "x": ([low], [low - 10, high], [float("nan"), high], low),
        "save": ("now", 1, None),
    }
    for label, values in bad.items():
        for value in values:
            with pytest.raises(Refused):
                send(label, value)
    uuid = found["height, px"]._impl.uuid
    for updates in ({"min": 5}, {"value": 200, "min": 5}, {"update_cb": []}, {}, {"disabled": True}, [], None):
        with pytest.raises(Refused):
            check({"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates})
    for other in ("ShareUrlRequest", "FileTransferStartUpload", "FileTransferPart", "CommandTriggerMessage", "Message", ""):
        assert not check({"type": other})  # dropped: the page does not need them


def test_ten_thousand_malformed_messages_change_nothing(serving):
    """Each is refused; the clients that send them are disconnected, another one is still served, memory stays."""
    rng, panel = random.Random(0), serving.panel
    uuids = list(serving.server.gui._gui_input_handle_from_uuid)
    values = [float("nan"), float("inf"), -1, 10**18, 2**64 - 1, "x", None, [], {}, [1e308] * 4, True, b"\0" * 100]
    fields = list(CAMERA.as_serializable_dict())
    make = [
        lambda: bytes(rng.randrange(256) for _ in range(rng.randrange(60))),
        lambda: b"\x91" * rng.randrange(1, 3000),
        lambda: camera(**{rng.choice([f for f in fields if f != "type"]): rng.choice(values)}),
        lambda: camera()[: rng.randrange(100)],
        lambda: update(rng.choice(uuids), **{rng.choice(["value", "min", "max", "options", "disabled"]): rng.choice(values[:-2])}),
        lambda: msgspec.msgpack.encode({"type": rng.choice(["GuiUpdateMessage", "SceneNodeClickMessage", "ViewerCameraMessage", 7])}),
    ]
    before = {label: getattr(handle, "value", None) for label, handle in controls(serving).items()}
    address, rate, sent = serving.url.replace("http", "ws"), "scene_experts.view.gate.MOST_MESSAGES", 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rate, 1e9)
        first = memory()
        while sent < 10_000:
            opened = connect(address, subprotocols=[PROTOCOL], open_timeout=20)  # type: ignore[list-item]
            with pytest.raises(ConnectionClosed), opened as made:
                for _ in range(150):
                    made.send(rng.choice(make)())
                    sent += 1
                while True:
                    made.recv(timeout=20)
    settled(serving)
    assert serving.clients == {} and memory() - first < 100 << 20
    allowed = {label: getattr(handle, "value", None) for label, handle in controls(serving).items()}
    changed = [label for label in before if before[label] != allowed[label]]
    assert set(changed) <= {"crop", "cameras", panel.traits.rows, "loop", *(f"expert {i}" for i in range(9))}  # True is a value of these
    assert socket(serving) == 101


def settled(viewer, seconds=20.0):
    end = time.monotonic() + seconds
    while (viewer.clients or viewer.gate.open) and time.monotonic() < end:
        time.sleep(0.02)


def memory() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096


@pytest.mark.slow
def test_two_hundred_reconnects(serving):
    first = memory()
    for _ in range(200):
        assert socket(serving) == 101
    settled(serving)
    assert memory() - first < 100 << 20 and serving.gate.open == 0


def test_a_large_message_ends_its_connection(serving):
    address = serving.url.replace("http", "ws")
    with pytest.raises(ConnectionClosed), connect(address, subprotocols=[PROTOCOL]) as made:  # type: ignore[list-item]
        made.send(b"\0" * (1 << 20))
        while True:
            made.recv(timeout=10)


def test_the_servers_thread_keeps_to_its_share_of_the_processor():
    governor = Governor(lambda: 0.1)

    async def busy():
        governor.beat()
        began = time.thread_time(), time.monotonic()
        while time.monotonic() - began[1] < 2.0:
            end = time.thread_time() + 0.002
            while time.thread_time() < end:
                pass
            await asyncio.sleep(0)
        return (time.thread_time() - began[0]) / (time.monotonic() - began[1])

    assert asyncio.run(busy()) < 0.1 + 0.4 / 2.0


@contextmanager
def live(capture, scene):
    said: list[str] = []
    made = Live(capture, DRAW, lambda: False, port=0, ready=said.append)
    made(SimpleNamespace(scene=scene, step=5))
    try:
        yield made, said[0]
    finally:
        made.close()


def test_the_page_of_a_training_needs_the_token_also_on_this_machine(viewer, capture):
    training = SimpleNamespace(scene=viewer.current()[0], step=5)
    with live(capture, training.scene) as (made, address):
        assert made.viewer is not None and "/?token=" in address
        assert socket(made.viewer) == 403 and page(made.viewer)[0] == 403
        assert socket(made.viewer, "/" + address.rpartition("/")[2]) == 101
        made.viewer.panel.pause.value = True
        began = time.monotonic()
        made(training)  # nobody is connected: the pause ends
        assert time.monotonic() - began < 30 and not made.viewer.panel.is_paused()
