"""Strangers are not served: names that were bent here, pages of other sites, who knows no token."""

from email.message import Message

import pytest

from handavatar.view.guard import Guard, Refused, guard_of, is_loopback


def headers(**given: str) -> Message:
    message = Message()
    for name, value in ({"Host": "127.0.0.1:7007"} | given).items():
        if value:
            message[name.replace("_", "-")] = value
    return message


def status(guard: Guard, method: str = "GET", target: str = "/", **given: str) -> int:
    try:
        guard.check(method, target, headers(**given))
    except Refused as refusal:
        return refusal.status
    return 200


LOCAL = guard_of("127.0.0.1", "")


@pytest.mark.parametrize(
    "host", ["127.0.0.1:7007", "localhost:9999", "LOCALHOST", "[::1]:7007", "127.0.0.1"]
)
def test_this_machines_own_names_are_served(host: str) -> None:
    assert status(LOCAL, Host=host) == 200
    assert status(LOCAL, Host=host, Origin=f"http://{host}") == 200


@pytest.mark.parametrize(
    "host",
    [
        "",
        "evil.example",
        "evil.example:7007",
        "127.0.0.1.evil.example",
        "localhost.evil.example",
        "127.0.0.1@evil.example",
        "evil.example@127.0.0.1",
        "127.0.0.1/evil",
        "127.0.0.1:port",
        "[::1",
        "192.168.1.5:7007",
        "0.0.0.0:7007",
        " ",
        "127.0.0.1:7007, evil.example",
        "2130706433",
    ],
)
def test_other_names_are_refused(host: str) -> None:
    assert status(LOCAL, Host=host) == 403


def test_two_hosts_are_none() -> None:
    message = headers()
    message["Host"] = "evil.example"
    with pytest.raises(Refused):
        LOCAL.check("GET", "/", message)


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        "http://127.0.0.1",
        "http://127.0.0.1:7008",
        "https://127.0.0.1:7007",
        "http://localhost:7007",
        "file://",
        "http://127.0.0.1:7007.evil.example",
    ],
)
def test_pages_of_other_origins_are_refused(origin: str) -> None:
    assert status(LOCAL, Origin=origin) == 403
    assert status(LOCAL, "POST", "/picture", Origin=origin, Content_Type="application/json") == 403


def test_what_another_site_makes_the_browser_ask_is_refused() -> None:
    assert status(LOCAL, Sec_Fetch_Site="cross-site") == 403
    assert status(LOCAL, Sec_Fetch_Site="same-site") == 403
    assert status(LOCAL, Sec_Fetch_Site="none") == 200
    # A form of another site can send these kinds without asking first.
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""):
        assert status(LOCAL, "POST", "/avatar", Content_Type=kind) == 415
        assert status(LOCAL, "POST", "/paint", Content_Type=kind) == 415
    assert status(LOCAL, "POST", "/avatar", Content_Type="application/json; charset=utf-8") == 200
    # A picture goes to its own address, and nothing else does.
    assert status(LOCAL, "POST", "/paint", Content_Type="image/png") == 200
    assert status(LOCAL, "POST", "/paint", Content_Type="application/json") == 415
    assert status(LOCAL, "POST", "/avatar", Content_Type="image/png") == 415


def test_beyond_loopback_a_token_is_made_and_asked_for() -> None:
    guard = guard_of("0.0.0.0", "")
    assert len(guard.token) >= 32 and guard.token != guard_of("0.0.0.0", "").token
    assert guard.token not in repr(guard)
    for host in ("192.168.1.5:7007", "[fe80::1]:7007", "localhost:7007"):
        assert status(guard, Host=host) == 401
        assert status(guard, target="/?token=wrong", Host=host) == 401
        assert status(guard, target=f"/?token={guard.token}", Host=host) == 200
        assert status(guard, Host=host, Cookie=f"a=b; {guard.cookie}={guard.token}") == 200
        assert status(guard, Host=host, Cookie=f"{guard.cookie}=wrong") == 401
        assert status(guard, Host=host, Cookie=f"other={guard.token}") == 401
    # A token does not make up for a name that can be bent.
    assert status(guard, target=f"/?token={guard.token}", Host="evil.example") == 403


@pytest.mark.parametrize("cookie", ["", "=", ";;;", "\x00", "a" * 100_000, 'x="', "é=é"])
def test_any_cookie_is_read_or_not(cookie: str) -> None:
    assert status(guard_of("0.0.0.0", "secret"), Host="10.0.0.1", Cookie=cookie) == 401


@pytest.mark.parametrize("target", ["/?token=", "http://[", "/?" + "&" * 99, "/?token=%ff", "//"])
def test_any_address_is_read_or_not(target: str) -> None:
    assert status(guard_of("0.0.0.0", "secret"), target=target, Host="10.0.0.1") == 401


def test_a_token_on_loopback_is_asked_for_too() -> None:
    guard = guard_of("localhost", "mine")
    assert status(guard, Host="localhost:1") == 401
    assert status(guard, target="/?token=mine", Host="localhost:1") == 200


@pytest.mark.parametrize("token", ["a b", "x\r\nSet-Cookie: y", "ü", "a" * 201, "a;b"])
def test_tokens_that_no_address_carries_are_errors(token: str) -> None:
    with pytest.raises(ValueError, match="`token`"):
        guard_of("127.0.0.1", token)


def test_what_is_loopback() -> None:
    assert all(is_loopback(host) for host in ("127.0.0.1", "127.8.8.8", "::1", "localhost"))
    assert not any(is_loopback(host) for host in ("0.0.0.0", "::", "10.0.0.1", "example", ""))
