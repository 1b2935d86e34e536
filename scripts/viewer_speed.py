"""How fast a running viewer is: python scripts/viewer_speed.py PORT, beside `handavatar view RUN`.

One client on this machine asks for a picture of 256 x 256 as soon as it has the last one: sixty
with another camera, sixty with another pose, then both stages by the field.
"""

import http.client
import json
import statistics
import sys
import time
from typing import Any

connection = http.client.HTTPConnection("127.0.0.1", int(sys.argv[1]))
orders = 0


def seconds(stage: int, scene: dict[str, Any]) -> float:
    """Of one picture, from the wish to the last byte."""
    global orders
    orders += 1
    wish = {"client": "speed", "order": orders, "stage": stage, "scene": {"size": 256} | scene}
    begin = time.perf_counter()
    connection.request("POST", "/picture", json.dumps(wish), {"Content-Type": "application/json"})
    answer = connection.getresponse()
    body = answer.read()
    if answer.status != 200:
        sys.exit(f"status {answer.status}: {body.decode()}")
    return time.perf_counter() - begin


def bent(degrees: float) -> dict[str, Any]:
    """All fingers but the thumb, every joint alike."""
    return {"angles": [[0, 0, 0], *[[degrees, 0, 0]] * 12, *[[0, 0, 0]] * 3]}


seconds(0, {})
for name, scenes in (
    ("camera", [{"orbit": {"azimuth": angle}} for angle in range(60)]),
    ("pose", [bent(angle) for angle in range(60)]),
):
    times = [seconds(0, scene) for scene in scenes]
    print(
        f"fluid, another {name}: {len(times) / sum(times):.1f} pictures a second, "
        f"median {1000 * statistics.median(times):.0f} ms"
    )
for stage, label in ((1, "half"), (2, "full")):
    print(f"{label}: {seconds(stage, bent(20)):.1f} s")
