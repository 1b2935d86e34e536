"""Who is let in: a check of every request's head before anything else is done.

A page of any site can send requests to this machine, and a name of any site can be made to point
at it. So the ``Host`` must be a name of this machine that no stranger controls, the ``Origin``,
where the browser states one, this page's own, and beyond loopback a secret must be known.
"""

import hmac
import ipaddress
import secrets
import socket
from dataclasses import dataclass, field
from email.message import Message
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from handavatar.errors import ArgumentError

LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
JSON_KIND = "application/json"
POSTED_KINDS = {
    "/paint": ("image/png",),
    "/look": ("image/jpeg",),
    "/recording": ("video/webm", "video/mp4"),
}
"""What a page may send besides JSON: like it, no foreign form can without asking first."""
_MOST_TOKEN = 200


class Refused(Exception):
    """A request that is not served: the HTTP status and why."""

    def __init__(self, status: int, why: str) -> None:
        """Keeps both."""
        super().__init__(why)
        self.status = status


@dataclass(frozen=True)
class Guard:
    """The rules of one server.

    Attributes:
        host: where it listens.
        token: the secret that every request must carry, in the address or the cookie; empty asks
            for none.
        names: further names by which this machine may be addressed.
        cookie: name of the cookie that carries the token; a browser does not tell ports apart.
    """

    host: str
    token: str = field(default="", repr=False)
    names: frozenset[str] = frozenset()
    cookie: str = "handavatar-view"

    def check(self, method: str, target: str, headers: Message) -> None:
        """Lets a request pass, or not.

        Args:
            method: such as GET.
            target: path and query.
            headers: of the request.

        Raises:
            Refused: 403 for a wrong ``Host`` or ``Origin``, 401 without the token, 415 for a body
                that a foreign form could have sent.
        """
        hosts = headers.get_all("Host", [])
        host = hosts[0] if len(hosts) == 1 else ""
        if not self._is_own_name(_name_in(host)):
            raise Refused(403, "this Host is not served here")
        origin = headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            raise Refused(403, "this Origin is not served here")
        if headers.get("Sec-Fetch-Site", "same-origin") not in ("same-origin", "none"):
            raise Refused(403, "requests from other sites are not served here")
        if self.token and not self._is_token(given_token(target, headers, self.cookie)):
            raise Refused(401, "open the address with its token, as the terminal prints it")
        kind = headers.get("Content-Type", "").partition(";")[0].strip().lower()
        if method == "POST" and kind not in kinds_expected(target):
            raise Refused(415, f"expected {' or '.join(kinds_expected(target))}")

    def _is_own_name(self, name: str) -> bool:
        if is_loopback(self.host):
            return name in LOOPBACK_NAMES
        # A name can be made to point anywhere; an address is what it is.
        return name in LOOPBACK_NAMES | self.names or _is_address(name)

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode("utf-8"))


def kinds_expected(target: str) -> tuple[str, ...]:
    """The media types of what may be posted to an address."""
    return POSTED_KINDS.get(target.partition("?")[0], (JSON_KIND,))


def guard_of(host: str, token: str) -> Guard:
    """The rules for a place to listen at; beyond loopback a token is made where none is given.

    Raises:
        ValueError: for a token that no address can carry.
    """
    if token and (
        len(token) > _MOST_TOKEN
        or not token.replace("-", "").replace("_", "").isalnum()
        or not token.isascii()
    ):
        raise ArgumentError("token", "others, or too many", "letters, digits, - and _, at most 200")
    if is_loopback(host):
        return Guard(host, token)
    own = frozenset(name.lower() for name in (host, socket.gethostname()))
    return Guard(host, token or secrets.token_urlsafe(24), own)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches what listens there."""
    if host == "localhost":
        return True
    return _is_address(host) and ipaddress.ip_address(host).is_loopback


def given_token(target: str, headers: Message, name: str) -> str:
    """The token in a request's address, or in its cookie of that name; empty where none is."""
    try:
        query = parse_qs(urlsplit(target).query, max_num_fields=8)
        if "token" in query:
            return query["token"][0][:_MOST_TOKEN]
        cookie = SimpleCookie(headers.get("Cookie", "")[:4096])
    except (ValueError, CookieError):
        return ""
    return cookie[name].value if name in cookie else ""


def _name_in(host: str) -> str:
    """The name in a ``Host`` header, without the port; empty if it is none."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port
    except ValueError:
        return ""
    if "@" in host or parts.path or parts.query or parts.fragment:
        return ""
    return parts.hostname or ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
