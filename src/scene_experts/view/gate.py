"""Decides who may use the viewer and what a browser may send to it.

viser serves every request and applies every message. This gate stands before it:

* A request must name a host that this server answers for, and come from a page of this server
  (`Origin`). So another web page cannot reach the viewer, also not through a name that its owner
  points at this machine (DNS rebinding).
* Where a token is required, the request must carry it: in its address, or in the cookie that the
  first answer sets.
* A message must be one that the page sends, with values within the limits of its control. Others
  are dropped. A client that sends many of them is disconnected.
* Messages, connections and the processor time of the server's thread are limited, so that a
  training beside it keeps its speed.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from scene_experts.core.errors import InputError

log: logging.Logger = logging.getLogger(__name__)

MOST_CLIENTS = 16
MOST_BYTES = 64 << 10  # of a message
MOST_MESSAGES = 100.0  # per second and client; more must wait
MOST_REFUSED = 100  # messages of one client until it is disconnected
MOST_HANDSHAKES = 20.0  # per second; more must wait
MOST_WAITING = 64  # handshakes
PULSE = 0.05  # seconds between looks at the processor time of the server's thread
BURST = 0.3  # seconds of processor time that it may use at once
_SERVE = threading.Lock()


class Refused(ValueError):
    """A message or a request that the gate does not let pass."""


def is_local(host: str) -> bool:
    """Return whether a server on `host` is reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass
class RateLimit:
    """Spreads events: `wait()` returns how long the next one must wait."""

    per_second: float
    burst: float
    next: float = 0.0  # monotonic seconds

    def wait(self) -> float:
        """Count an event and return the seconds until it may happen."""
        now = time.monotonic()
        self.next = max(self.next, now - self.burst / self.per_second) + 1 / self.per_second
        return max(0.0, self.next - now)


@dataclass
class Gate:
    """The rules of one server.

    `host` is the address it listens on. `share` returns the fraction of one core that its thread
    may use; None does not limit it.
    """

    host: str
    need_token: bool = False  # also on this machine
    share: Callable[[], float] | None = None
    token: str = ""
    gui: Any = None  # viser's GuiApi, once there is one
    open: int = 0  # connections
    waiting: int = 0  # handshakes
    handshakes: RateLimit = field(default_factory=lambda: RateLimit(MOST_HANDSHAKES, 2 * MOST_HANDSHAKES))

    def __post_init__(self) -> None:
        if not self.token and (self.need_token or not is_local(self.host)):
            self.token = secrets.token_urlsafe(16)

    # --- requests

    def check_request(self, path: str, headers: Any) -> None:
        """Raise Refused unless a request names this server, comes from its page and carries the
        token."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self.answers_for(hosts[0]):
            raise Refused("the request names another host")
        if len(origins) > 1 or any(origin not in (f"http://{hosts[0]}", f"https://{hosts[0]}") for origin in origins):
            raise Refused("the request comes from a page of another origin")
        if self.token and not any(hmac.compare_digest(given.encode(), self.token.encode()) for given in self.find_tokens(path, headers)):
            raise Refused("the address lacks its token; use the address that scene-experts printed")

    def answers_for(self, host: str) -> bool:
        """Return whether a Host header may name this server. Beyond this machine any name may;
        there the token decides."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        return bool(name) and (not is_local(self.host) or is_local(name))

    def find_tokens(self, path: str, headers: Any) -> list[str]:
        """Return the tokens of a request, from its address and its cookies."""
        found = parse_qs(urlsplit(path).query).get("token", [])
        for line in headers.get_all("Cookie"):
            try:
                found += [morsel.value for name, morsel in SimpleCookie(line).items() if name == self.cookie]
            except CookieError:
                continue
        return found[:4]

    @property
    def cookie(self) -> str:
        """Name of the cookie. Cookies of all ports of a host are sent to each of them, so every
        server has a name of its own."""
        return f"scene-experts-{self.token[:6]}"

    async def admit(self, request: Any, subprotocol: str) -> None:
        """Wait for this request's turn. Raises Refused if it is refused or the server is full."""
        self.check_request(request.path, request.headers)
        socket = (request.headers.get("Upgrade") or "").lower() == "websocket"
        if socket and subprotocol not in (request.headers.get("Sec-WebSocket-Protocol") or ""):
            raise Refused("the page is of another version of the viewer; load it again")
        if self.waiting >= MOST_WAITING or (socket and self.open >= MOST_CLIENTS):
            raise Refused("too many clients are connected")
        self.waiting += 1
        try:
            await asyncio.sleep(self.handshakes.wait())
        finally:
            self.waiting -= 1

    # --- messages

    def check_message(self, message: Any) -> bool:
        """Return whether a decoded message is passed on. Raises Refused if it is invalid; messages
        without use here are dropped."""
        if not isinstance(message, dict) or not isinstance(message.get("type"), str):
            raise Refused("a message without a type")
        check = _CHECKS.get(message["type"])
        if check is None:
            return False
        check(message, self.gui)
        return True


# --- what the page sends


def check_camera(message: dict[str, Any], gui: Any) -> None:
    """Raise Refused unless the message describes a camera."""
    for name, count in (("wxyz", 4), ("position", 3), ("look_at", 3), ("up_direction", 3)):
        check_numbers(message.get(name), count, 1e9)
    if sum(part * part for part in message["wxyz"]) < 1e-12:
        raise Refused("a rotation of length 0")
    check_numbers([message.get("near"), message.get("far")], 2, 1e12)
    check_numbers([message.get("fov"), message.get("image_height"), message.get("image_width")], 3, 32768, 0)
    expect_names(message, {"wxyz", "position", "fov", "near", "far", "image_height", "image_width", "look_at", "up_direction"})


def check_click(message: dict[str, Any], gui: Any) -> None:
    """Raise Refused unless the message is a click on a camera of the capture."""
    expect_names(message, {"name", "instance_index", "ray_origin", "ray_direction", "screen_pos", "modifier", "owner"})
    if not isinstance(message.get("name"), str) or not re.fullmatch(r"/cameras/\d{1,9}", message["name"]):
        raise Refused("a click on something else")
    for name, count in (("ray_origin", 3), ("ray_direction", 3), ("screen_pos", 2)):
        check_numbers(message.get(name), count, 1e12)
    if message.get("instance_index") is not None:
        check_numbers([message["instance_index"]], 1, 1e6, 0)
    for value in (message.get("modifier"), message.get("owner")):
        if value is not None and not (isinstance(value, str) and len(value) < 64):
            raise Refused("a click with other keys")


def check_update(message: dict[str, Any], gui: Any) -> None:
    """Raise Refused unless the message gives a control a value within its limits."""
    expect_names(message, {"uuid", "updates"})
    uuid, updates = message.get("uuid"), message.get("updates")
    if not isinstance(uuid, str) or not isinstance(updates, dict) or list(updates) != ["value"]:
        raise Refused("an update of something other than a value")
    handle = gui._gui_input_handle_from_uuid.get(uuid) if gui else None
    if handle is None:
        raise Refused("an update of a control that does not exist")
    check_value(handle, updates["value"])


def check_value(handle: Any, value: Any) -> None:
    """Raise Refused unless `value` is of the type and within the limits of a control of viser."""
    kind, now = type(handle).__name__, handle.value
    if kind == "GuiDropdownHandle":
        fine = isinstance(value, str) and value in handle.options
    elif kind == "GuiButtonHandle" or isinstance(now, bool):
        fine = isinstance(value, bool)
    elif kind == "GuiRgbHandle":
        check_numbers(value, 3, 255, 0)
        fine = all(isinstance(part, int) for part in value)
    elif kind in ("GuiSliderHandle", "GuiNumberHandle", "GuiMultiSliderHandle"):
        low = -1e6 if handle.min is None else handle.min
        high = 1e6 if handle.max is None else handle.max
        slack = 1e-6 * (high - low)  # JavaScript may round a step beyond the end
        parts = value if isinstance(now, tuple) else [value]
        check_numbers(parts, len(now) if isinstance(now, tuple) else 1, high + slack, low - slack)
        fine = True
    else:
        fine = False
    if not fine:
        raise Refused(f"a value that the control does not have ({kind})")


def check_numbers(values: Any, count: int, most: float, least: float | None = None) -> None:
    """Raise Refused unless `values` are `count` finite numbers between `least` (None: -most) and
    `most`."""
    if not isinstance(values, (list, tuple)) or len(values) != count:
        raise Refused(f"expected {count} numbers")
    least = -most if least is None else least
    for value in values:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not least <= value <= most:
            raise Refused("a number out of range")  # NaN is in no range


def expect_names(message: dict[str, Any], names: set[str]) -> None:
    """Raise Refused if a message has other fields than `names`."""
    if not message.keys() <= {"type", *names}:
        raise Refused("a message with other fields")


_CHECKS: dict[str, Callable[[dict[str, Any], Any], None]] = {
    "ViewerCameraMessage": check_camera,
    "SceneNodeClickMessage": check_click,
    "GuiUpdateMessage": check_update,
}


class GuardedConnection:
    """A connection of `websockets` whose `recv` returns only messages that pass the gate."""

    def __init__(self, connection: Any, gate: Gate) -> None:
        self._connection, self._gate = connection, gate
        self._rate, self._refused = RateLimit(MOST_MESSAGES, MOST_MESSAGES), 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """Return the next message that passes. Messages beyond the rate wait, which slows their
        sender down."""
        import msgspec

        while True:
            raw = await self._connection.recv()
            await asyncio.sleep(self._rate.wait())
            try:
                if not isinstance(raw, bytes):
                    raise Refused("text")
                if self._gate.check_message(msgspec.msgpack.decode(raw)):
                    return raw
            except (Refused, msgspec.DecodeError, RecursionError, ValueError, OverflowError) as error:
                self._refused += 1
                log.debug("refused a message: %s", error)
                if self._refused >= MOST_REFUSED:
                    self._connection.transport.abort()  # a polite close would read its other messages first


@contextmanager
def guarding(gate: Gate, subprotocol: str) -> Iterator[None]:
    """While this context is open, a server that `websockets` starts is behind `gate`. viser has no
    place to give it.

    Raises InputError if no server was started, which means that this version of viser serves in
    another way.
    """
    import websockets.asyncio.server as module

    serve, used = module.serve, []

    def guarded(handler: Any, *args: Any, process_request: Any = None, **options: Any) -> Any:
        if gate.share is not None and not used:  # viser calls this again for the next port if one is taken
            asyncio.get_running_loop().call_later(PULSE, Governor(gate.share).beat)
        used.append(True)

        async def handle(connection: Any) -> None:
            gate.open += 1
            try:
                await handler(GuardedConnection(connection, gate))
            finally:
                gate.open -= 1

        async def process(connection: Any, request: Any) -> Any:
            try:
                await gate.admit(request, subprotocol)
            except ValueError as error:  # Refused, or an address that cannot be parsed
                return connection.respond(HTTPStatus.FORBIDDEN, f"{error}\n")
            response = process_request(connection, request) if process_request else None
            if response is not None:
                response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"  # no other page may show this one in a frame
                response.headers["Referrer-Policy"] = "no-referrer"
                if gate.token:
                    response.headers["Set-Cookie"] = f"{gate.cookie}={gate.token}; Path=/; HttpOnly; SameSite=Strict"
            return response

        return serve(handle, *args, **{**options, "process_request": process, "max_size": MOST_BYTES})

    with _SERVE:
        module.serve = guarded
        try:
            yield
        finally:
            module.serve = serve
    if not used:
        raise InputError("this version of viser cannot be used, because its server cannot be guarded; install viser 1.1")


@dataclass
class Governor:
    """Holds the processor time of the thread that it beats in to a share: a thread that used more
    sleeps, whatever it was asked to do."""

    share: Callable[[], float]
    credit: float = BURST  # seconds of processor time
    wall: float = field(default_factory=time.monotonic)
    used: float = field(default_factory=time.thread_time)

    def beat(self) -> None:
        """Compare the time used since the last beat with the share, sleep off what is above, and
        come again."""
        wall, used, share = time.monotonic(), time.thread_time(), self.share()
        self.credit = min(BURST, self.credit + share * (wall - self.wall)) - (used - self.used)
        if self.credit < 0:
            time.sleep(min(1.0, -self.credit / share))
        self.wall, self.used = wall, used
        asyncio.get_running_loop().call_later(PULSE, self.beat)
