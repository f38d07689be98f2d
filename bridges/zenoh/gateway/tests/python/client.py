"""A Zenoh program: sends to Sinew, receives from it, asks, is asked, and sees liveliness.

`client.py ENDPOINT PROJECT`; it prints `done` when everything was seen.
"""

import json
import queue
import sys

import zenoh

WITHIN = 30.0
"""Seconds within which each step must happen."""


def main() -> None:
    endpoint, project = sys.argv[1:]
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        knee = f"sinew/{project}/n/knee.drive"

        tokens: "queue.Queue[str]" = queue.Queue(100)
        seen = session.liveliness().declare_subscriber(
            f"sinew/{project}/@/**", lambda sample: tokens.put(str(sample.key_expr)), history=True
        )
        assert tokens.get(timeout=WITHIN).endswith("/knee.drive")

        angles: "queue.Queue[zenoh.Sample]" = queue.Queue(10_000)
        telemetry = session.declare_subscriber(f"sinew/{project}/g/telemetry/robot.angle", angles.put)
        angle = angles.get(timeout=WITHIN)
        assert json.loads(angle.payload.to_string())["joint"] == "knee"
        assert json.loads(angle.attachment.to_string())["class"] == "stream"

        session.put(f"{knee}/robot.move", json.dumps({"degrees": 55.0}))
        outcome = ask(session, f"{knee}/robot.move", {"degrees": 56.0})
        assert outcome == {"outcome": "Delivered"}, outcome
        reply = ask(session, f"{knee}/robot.get_angle", {})
        assert reply == {"joint": "knee", "degrees": 56.0}, reply

        session.put(f"{knee}/robot.move", json.dumps({"degrees": "far"}))
        session.put(f"{knee}/robot.move/now", "{}")
        session.put(f"sinew/{project}/n/hip/robot.move", "{}")

        # Sinew asks as soon as the name is there.
        answered = queue.Queue(1)
        questions = session.declare_queryable(
            f"sinew/{project}/n/operator/robot.question", lambda query: answer(query, answered)
        )
        token = session.liveliness().declare_token(f"sinew/{project}/@z/operator")
        answered.get(timeout=WITHIN)
        token.undeclare()
        questions.undeclare()
        telemetry.undeclare()
        seen.undeclare()
    print("done", flush=True)


def ask(session: zenoh.Session, key: str, value: dict) -> dict:
    for reply in session.get(key, payload=json.dumps(value), timeout=WITHIN):
        if reply.ok is None:
            raise AssertionError(reply.err.payload.to_string())
        return json.loads(reply.ok.payload.to_string())
    raise AssertionError(f"no reply to {key}")


def answer(query: zenoh.Query, answered: "queue.Queue[None]") -> None:
    number = json.loads(query.payload.to_string())["number"]
    query.reply(query.key_expr, json.dumps({"text": f"{number} of Python"}))
    answered.put(None)


main()
