"""Pictures that pages send as paint: the same paint as the command line's, or refused cleanly."""

import http.client
import io
import json
import random
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from live import live_server
from patience import PATIENCE
from PIL import Image

from handavatar.avatar import HandAvatar
from handavatar.edit import Paint
from handavatar.retouch import paint_from
from handavatar.view.scene import Coat, Scene, SceneError, Stroke, Touches
from handavatar.view.server import ViewServer
from handavatar.view.studio import MOST_PICTURE_BYTES, Studio


def png(pixels: np.ndarray, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", **options)
    return buffer.getvalue()


def spots(seed: int, size: int = 48) -> np.ndarray:
    """Squares of any colour and opacity."""
    chance = np.random.default_rng(seed)
    return chance.integers(0, 256, (6, 6, 4), dtype=np.uint8).repeat(size // 6, 0).repeat(8, 1)


def bomb(width: int, height: int) -> bytes:
    """A PNG of few bytes that claims to be very large."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        checked = kind + data
        return struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))

    head = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    body = zlib.compress(bytes(100_000))
    start = b"\x89PNG\r\n\x1a\n"
    return start + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


@pytest.fixture(scope="module")
def server(
    small_avatar: HandAvatar, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ViewServer]:
    with live_server(small_avatar, tmp_path_factory.mktemp("paint") / "edited") as running:
        yield running


def send(
    server: ViewServer, content: bytes, path: str = "/paint", kind: str = "image/png", **more: str
) -> tuple[int, dict[str, Any]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    try:
        connection.request("POST", path, content, {"Content-Type": kind} | more)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())
    finally:
        connection.close()


def send_json(server: ViewServer, path: str, content: Any) -> tuple[int, dict[str, Any]]:
    return send(server, json.dumps(content).encode(), path, "application/json")


def test_a_picture_is_the_paint_of_the_command_line(
    small_avatar: HandAvatar, tmp_path: Path
) -> None:
    (tmp_path / "spots.png").write_bytes(png(spots(1)))
    wanted = paint_from(tmp_path / "spots.png", small_avatar)
    studio = Studio(small_avatar)
    name = studio.coat(png(spots(1)))
    found = studio.edit(Touches(strokes=(Coat(name),))).paint
    assert found is not None
    assert torch.equal(found.colors, wanted.colors) and torch.equal(found.opacity, wanted.opacity)
    assert 0.1 < float(wanted.opacity.mean()) < 0.9


def test_pictures_and_dabs_lie_in_the_order_they_came(small_avatar: HandAvatar) -> None:
    studio = Studio(small_avatar)
    one, other = (Coat(studio.coat(png(spots(seed)))) for seed in (1, 2))
    dab = Stroke(5, 0.02, (1.0, 0.0, 0.0))
    paints: list[Paint] = []
    for strokes in ((one,), (dab,), (other,)):
        paint = studio.edit(Touches(strokes=strokes)).paint
        assert paint is not None
        paints.append(paint)
    found = studio.edit(Touches(strokes=(one, dab, other))).paint
    assert found is not None
    wanted = paints[2].over(paints[1].over(paints[0]))
    torch.testing.assert_close(found.colors, wanted.colors)
    torch.testing.assert_close(found.opacity, wanted.opacity)
    # Taking the last one back leaves the others: nothing was mixed for good.
    before = studio.edit(Touches(strokes=(one, dab))).paint
    assert before is not None
    torch.testing.assert_close(before.opacity, paints[1].over(paints[0]).opacity)


def test_a_painted_picture_is_seen_and_saved(server: ViewServer) -> None:
    status, answer = send(server, png(spots(3)))
    assert status == 200 and send(server, png(spots(3))) == (status, answer)
    touches = {"strokes": [answer]}
    status, saved = send_json(server, "/avatar", {"touches": touches})
    paint = HandAvatar.load(saved["path"]).edit.paint
    assert status == 200 and paint is not None and float(paint.opacity.max()) > 0.5
    scene = {"size": 64, "layer": "albedo", "touches": touches}
    wish = {"client": "p", "order": 1, "stage": 0}
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    seen = []
    for order, shown in ((1, scene), (2, scene | {"touches": {}})):
        body = json.dumps(wish | {"order": order, "scene": shown})
        connection.request("POST", "/picture", body, {"Content-Type": "application/json"})
        seen.append(np.asarray(Image.open(io.BytesIO(connection.getresponse().read()))))
    connection.close()
    assert np.abs(seen[0].astype(int) - seen[1]).max() > 60


def test_a_picture_that_was_never_sent_is_refused(server: ViewServer) -> None:
    for name in ("0" * 32, "../../etc/passwd", "x"):
        status, answer = send_json(
            server,
            "/picture",
            {"client": "n", "scene": {"touches": {"strokes": [{"picture": name}]}}},
        )
        assert status == 400 and "choose its file again" in answer["error"]


def test_only_so_many_pictures_are_kept(small_avatar: HandAvatar) -> None:
    studio = Studio(small_avatar)
    names = [studio.coat(png(spots(seed, 6)[:, :6])) for seed in range(70)]
    assert len(set(names)) == 70
    studio.shot(Scene(touches=Touches(strokes=(Coat(names[-1]),))))
    with pytest.raises(SceneError, match="choose its file again"):
        studio.shot(Scene(touches=Touches(strokes=(Coat(names[0]),))))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "not a PNG"),
        (b"GIF89a" + bytes(200), "not a PNG"),
        (png(spots(1))[:-40], "damaged"),
        (png(spots(1)[..., :3]), "no transparency"),
        (bomb(4097, 4096), "more than 16 megapixels"),
        (bomb(60_000, 60_000), "more than 16 megapixels"),
        (bomb(2**31 - 1, 2**31 - 1), "more than 16 megapixels|not a PNG"),
        (bomb(3000, 3000), "damaged"),
    ],
)
def test_what_is_no_picture_is_refused(server: ViewServer, content: bytes, why: str) -> None:
    status, answer = send(server, content)
    assert status == 400
    assert any(part in answer["error"] for part in why.split("|")), answer


def test_a_jpeg_by_another_name_is_refused(server: ViewServer) -> None:
    buffer = io.BytesIO()
    Image.fromarray(spots(1)[..., :3]).save(buffer, "JPEG")
    status, answer = send(server, buffer.getvalue())
    assert status == 400 and "not a PNG" in answer["error"]


def test_pictures_that_are_too_long_or_in_the_wrong_place_are_refused(server: ViewServer) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    connection.putrequest("POST", "/paint")
    connection.putheader("Content-Type", "image/png")
    connection.putheader("Content-Length", str(MOST_PICTURE_BYTES + 1))
    connection.endheaders()
    assert connection.getresponse().status == 413
    connection.close()
    assert send(server, png(spots(1)), kind="application/json")[0] == 415
    assert send(server, png(spots(1)), path="/avatar")[0] == 415
    assert send(server, png(spots(1)), Origin="http://evil.example")[0] == 403
    assert send(server, png(spots(1)), Host="evil.example")[0] == 403


def test_a_few_pictures_at_a_time_are_taken(server: ViewServer) -> None:
    head = f"POST /paint HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n"
    head += "Content-Type: image/png\r\nContent-Length: 1000\r\n\r\n"

    def begin_one() -> http.client.HTTPConnection:
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
        connection.connect()
        connection.sock.sendall(head.encode())
        return connection

    slow = [begin_one(), begin_one()]
    for _ in range(20):
        status, answer = send(server, png(spots(1)))
        if status == 503:
            break
        # The whole picture may have been there first, and one of the slow ones refused.
        slow.append(begin_one())
    assert status == 503 and "again" in answer["error"]
    for connection in slow:
        connection.close()
    for _ in range(200):
        status, _answer = send(server, png(spots(1)))
        if status == 200:
            break
    assert status == 200


@pytest.mark.slow
def test_a_thousand_spoilt_pictures_are_read_or_refused(
    server: ViewServer, capfd: pytest.CaptureFixture[str]
) -> None:
    chance = random.Random(0)
    palette = Image.fromarray(spots(1)[..., 0]).convert("P")
    kinds = [png(spots(1)), png(spots(2)[..., [0, 3]]), png(spots(4), compress_level=0)]
    for options in ({"transparency": 3}, {"transparency": 1, "bits": 4}):
        buffer = io.BytesIO()
        palette.save(buffer, "PNG", **options)
        kinds.append(buffer.getvalue())
    statuses = set()
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE)
    for _ in range(1000):
        content = bytearray(chance.choice(kinds))
        for _ in range(chance.choice([0, 1, 1, 2, 8])):
            where = chance.randrange(len(content))
            way = chance.randrange(4)
            if way == 0:
                content[where] = chance.randrange(256)
            elif way == 1:
                del content[where : where + chance.randrange(1, 60)]
            elif way == 2:
                content[where:where] = chance.randbytes(chance.randrange(1, 60))
            else:
                content[8:40] = content[8:40].replace(b"IDAT", b"tRNS")
            content = content or bytearray(b"x")
        connection.request("POST", "/paint", bytes(content), {"Content-Type": "image/png"})
        answer = connection.getresponse()
        data = answer.read()
        statuses.add(answer.status)
        assert answer.status in (200, 400), data
        if answer.status != 200:
            connection.close()
    connection.close()
    assert statuses == {200, 400}
    assert capfd.readouterr().err == ""
