"""Phones: who may send photos over the local network, and the two listeners that take them while the switch is on.

Off by default. A code to scan holds an address with a secret that lets one phone in, once; the phone gets a cookie, and
the page the next code. Both end with the switch, or two hours after it was turned on. A studio that was killed opens
the same listeners again, so that what phones were sending goes on.

A certificate that this machine signs itself: live cameras need https, and no authority signs for a home network.
"""

import datetime
import hashlib
import io
import ipaddress
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import psutil
import segno
import uvicorn
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from msgspec import Meta
from starlette.types import ASGIApp

from capture.errors import CaptureError
from capture.files.atomic import atomic_file, write_json
from capture.files.names import in_one_line
from capture.files.schema import Count, Number, Text, read_kept
from viewer.studio_server.gate import free_socket, http_server

DAYS = 30
PRIVATE = 0o600
EVERYWHERE = "0.0.0.0"
FIRST_PORT = 8490
Port = Annotated[int, Meta(ge=0, le=65535)]
OPEN_S = 2 * 3600.0  # seconds that the switch stays on
TOKEN_BYTES = 16
MOST_PHONES = 12
SEEN_S = 30.0  # after which a phone that asks for nothing counts as away
LONGEST_NAME = 60  # letters


def make_certificate(folder: Path, addresses: list[str]) -> tuple[Path, Path]:
    """Write a new certificate and its key for these addresses; return both paths.

    Raises:
        OSError: they cannot be written.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.datetime.now(datetime.UTC)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Shadowgraph studio on this network")])
    places = [x509.IPAddress(ipaddress.ip_address(one)) for one in dict.fromkeys(["127.0.0.1", *addresses])]
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=DAYS))
        .add_extension(x509.SubjectAlternativeName(places), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    public = certificate.public_bytes(serialization.Encoding.PEM)
    folder.mkdir(parents=True, exist_ok=True)
    for path, content in ((folder / "key.pem", secret), (folder / "certificate.pem", public)):
        with atomic_file(path) as temporary:
            temporary.touch(PRIVATE)
            temporary.write_bytes(content)
        os.chmod(path, PRIVATE)
    return folder / "certificate.pem", folder / "key.pem"


@dataclass(frozen=True)
class Phone:
    """One phone that was let in."""

    secret: Text
    name: Text
    role: Text = ""  # "camera" | "light" in live mode
    seen: Number = 0.0  # seconds since 1970

    @property
    def id(self) -> str:
        """Who it is, without its secret: names may be alike."""
        return hashlib.sha256(self.secret.encode()).hexdigest()[:32]


@dataclass
class Door:
    """What is kept, also in a file, while the switch is on."""

    capture: Text  # its key; phones send to this one
    until: Number  # seconds since 1970
    token: Text  # of the code that is shown
    ports: tuple[Port, Port] = (0, 0)  # http, https
    phones: dict[str, Phone] = field(default_factory=dict)  # by secret
    shots: Count = 0  # that the owner's page has asked for: a live camera takes one when it grows


class Phones:
    """The switch, the phones, and the listeners."""

    def __init__(self, file: Path, certificates: Path, app: Callable[["Phones"], ASGIApp]):
        """Open nothing yet; `app` makes what the listeners serve."""
        self._file, self._certificates, self._lock = file, certificates, threading.RLock()
        self._app = app(self)
        self._door = read_kept(file, Door)
        self._servers: list[uvicorn.Server] = []
        self._threads: list[threading.Thread] = []

    @property
    def door(self) -> Door | None:
        """What is open; None: the switch is off, or its time is over."""
        with self._lock:
            if self._door is not None and time.time() > self._door.until:
                self.turn_off()
            return self._door

    def resume(self) -> None:
        """Open again what was open when the studio ended."""
        if self.door is not None:
            self._listen()

    def turn_on(self, capture: str) -> None:
        """Let phones send to a capture; those that are there go on with this one.

        Raises:
            UserError: no port is free.
        """
        with self._lock:
            before = self.door
            if before is not None:
                before.capture, before.until = capture, time.time() + OPEN_S
                self._note()
                return
            self._door = Door(capture, time.time() + OPEN_S, secrets.token_urlsafe(TOKEN_BYTES))
            self._listen()

    def turn_off(self) -> None:
        """Send all phones away."""
        with self._lock:
            self._door = None
            self._file.unlink(missing_ok=True)
            self.close()

    def close(self) -> None:
        """End the listeners; what is open is remembered."""
        with self._lock:
            for server in self._servers:
                server.should_exit = True
            if threading.current_thread() not in self._threads:
                for thread in self._threads:
                    thread.join(5.0)
            self._servers, self._threads = [], []

    def join(self, token: str, name: str) -> Phone:
        """Let a phone in that shows the code's secret; the code is used up.

        Raises:
            CaptureError: the switch is off, the code was used or is another one, or there are too many phones.
        """
        with self._lock:
            door = self.door
            if door is None or not secrets.compare_digest(token.encode(), door.token.encode()):
                raise CaptureError("This code was used already, or is over. Scan the new code that the studio shows.")
            if len(door.phones) >= MOST_PHONES:
                raise CaptureError(f"{MOST_PHONES} phones are in already. Turn the switch off and on to start anew.")
            shown = in_one_line(name).strip()[:LONGEST_NAME] or "a phone"
            phone = Phone(secrets.token_urlsafe(TOKEN_BYTES), shown, seen=time.time())
            door.phones[phone.secret] = phone
            door.token = secrets.token_urlsafe(TOKEN_BYTES)
            self._note()
            return phone

    def find(self, secret: str) -> Phone | None:
        """Return the phone with this cookie, which was seen now; None: it is none of ours."""
        with self._lock:
            door = self.door
            phone = door.phones.get(secret) if door is not None else None
            if phone is not None and door is not None:
                door.phones[secret] = phone = replace(phone, seen=time.time())
            return phone

    def set_role(self, phone: Phone, role: str) -> None:
        """Note what a phone does in live mode."""
        if role not in ("", "camera", "light"):
            raise CaptureError(f"{role!r:.40} is no role of a phone.")
        with self._lock:
            if self._door is not None and phone.secret in self._door.phones:
                self._door.phones[phone.secret] = replace(phone, role=role)

    def shoot(self) -> None:
        """Ask the live cameras for a photo."""
        with self._lock:
            if self.door is None or not any(phone.role == "camera" for phone in self.door.phones.values()):
                raise CaptureError("No phone photographs live at the moment.")
            self.door.shots += 1

    def row(self) -> dict[str, Any]:
        """Return what the owner's page shows."""
        door = self.door
        if door is None:
            return {"on": False, "phones": []}
        now = time.time()
        phones = [
            {"name": one.name, "role": one.role, "is_here": now - one.seen < SEEN_S, "seen": one.seen}
            for one in door.phones.values()
        ]
        addresses = self.addresses()
        return {"on": True, "capture": door.capture, "left_s": door.until - now, "phones": phones} | addresses

    def addresses(self) -> dict[str, Any]:
        """Return the addresses of the code, for uploads and for live mode."""
        door = self.door
        assert door is not None
        host = next(iter(own_addresses()), "127.0.0.1")
        http, https = door.ports
        return {
            "address": f"http://{host}:{http}/#{door.token}",
            "live_address": f"https://{host}:{https}/live#{door.token}",
        }

    def code(self, is_live: bool) -> bytes:
        """Return the code to scan, as SVG.

        Raises:
            CaptureError: the switch is off.
        """
        if self.door is None:
            raise CaptureError("Phones are not let in at the moment.")
        address = self.addresses()["live_address" if is_live else "address"]
        target = io.BytesIO()
        segno.make(address, error="m").save(target, kind="svg", scale=8, border=2, light="#fff")
        return target.getvalue()

    # --- inside ------------------------------------------------------------------------------------------------------

    def _listen(self) -> None:
        assert self._door is not None
        plain, safe = self._door.ports
        listeners = [free_socket(EVERYWHERE, plain or FIRST_PORT), free_socket(EVERYWHERE, safe or FIRST_PORT + 1)]
        self._door.ports = (listeners[0].getsockname()[1], listeners[1].getsockname()[1])
        certificate, key = make_certificate(self._certificates, own_addresses())
        self._servers = [http_server(self._app), http_server(self._app, certificate, key)]
        for server, listener in zip(self._servers, listeners, strict=True):
            thread = threading.Thread(target=_run, args=(server, listener), name="phones", daemon=True)
            thread.start()
            self._threads.append(thread)
        self._note()

    def _note(self) -> None:
        if self._door is not None:
            write_json(self._file, asdict(self._door))


def _run(server: uvicorn.Server, listener: socket.socket) -> None:
    server.run(sockets=[listener])
    listener.close()


def own_addresses() -> list[str]:
    """Return this machine's IPv4 addresses in its networks, that of the way to the outside first."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # nothing is sent: the system only says from which address it would be
            found.append(probe.getsockname()[0])
        except OSError:
            pass
    for rows in psutil.net_if_addrs().values():
        found += [row.address for row in rows if row.family == socket.AF_INET and not row.address.startswith("127.")]
    return list(dict.fromkeys(found))
