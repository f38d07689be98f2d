"""A program of ROS 2 beside the bridge: zenoh_ros2_sdk speaks rmw_zenoh, rosbags has the types, CDR and hashes.

peer.py PORT DOMAIN: prints a line for each fact, and obeys lines of its standard input: `torque NUMBER`, `end`.
"""

import sys
import threading
import time

import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2Subscriber
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.discovery import get_service_names_and_types, get_topic_names_and_types
from zenoh_ros2_sdk.utils import compute_service_type_hash

PORT, DOMAIN = int(sys.argv[1]), int(sys.argv[2])
STORE = get_typestore(Stores.ROS2_JAZZY)
WHERE = {"router_port": PORT, "domain_id": DOMAIN}
EMPTY = "uint8 structure_needs_at_least_one_member"
TRIGGER = "bool success\nstring message"


def tell(*words):
    print(*words, flush=True)


def definition(name):
    """Returns the text of a type, with those in it."""
    return STORE.generate_msgdef(name, ros_version=2)[0]


def of_type(name):
    return {"msg_type": name, "msg_definition": definition(name), "type_hash": STORE.hash_rihs01(name), **WHERE}


def parameter_types():
    """Returns the types of a request that sets parameters, with full names."""
    value = "\n".join(
        f"{of} {name}"
        for of, name in (
            ("uint8", "type"),
            ("bool", "bool_value"),
            ("int64", "integer_value"),
            ("float64", "double_value"),
            ("string", "string_value"),
            ("byte[]", "byte_array_value"),
            ("bool[]", "bool_array_value"),
            ("int64[]", "integer_array_value"),
            ("float64[]", "double_array_value"),
            ("string[]", "string_array_value"),
        )
    )
    return {
        "rcl_interfaces/msg/ParameterValue": value,
        "rcl_interfaces/msg/Parameter": "string name\nrcl_interfaces/msg/ParameterValue value",
        "rcl_interfaces/msg/SetParametersResult": "bool successful\nstring reason",
    }


def with_types(text, types):
    parts = [text] + [f"MSG: {name.replace('/msg/', '/')}\n{body}" for name, body in types.items()]
    return ("\n" + "=" * 80 + "\n").join(parts)


def watch_joints():
    """Tells the first message, and the rate of some."""
    seen, done = [], threading.Event()

    def take(message):
        seen.append((time.monotonic(), message))
        if len(seen) == 101:
            done.set()

    subscriber = ROS2Subscriber(topic="/joint_states", callback=take, **of_type("sensor_msgs/msg/JointState"))
    if not done.wait(60):
        tell("joints: only", len(seen))
        sys.exit(1)
    subscriber.close()
    message = seen[0][1]
    tell("joints:", message.header.frame_id, list(message.name), [float(one) for one in message.position])
    age = time.time() - (seen[-1][1].header.stamp.sec + seen[-1][1].header.stamp.nanosec * 1e-9)
    tell("stamp is of now:", abs(age) < 60)
    tell("rate:", round(100 / (seen[100][0] - seen[0][0]), 1))


def watch_attachments():
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{PORT}"]')
    key = f"{DOMAIN}/joint_states/*/{STORE.hash_rihs01('sensor_msgs/msg/JointState')}"
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber(key)
        samples = [subscriber.recv() for _ in range(3)]
        found = [Attachment.from_bytes(sample.attachment.to_bytes()) for sample in samples]
        numbers = [one.sequence_id - found[0].sequence_id for one in found]
        tell("attachments:", numbers, len(found[0].gid), str(samples[0].encoding))
        message = STORE.deserialize_cdr(samples[0].payload.to_bytes(), "sensor_msgs/msg/JointState")
        again = bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/JointState"))
        tell("rosbags writes the same bytes:", again == samples[0].payload.to_bytes())


def show_graph():
    topics = dict(get_topic_names_and_types(DOMAIN, router_port=PORT, timeout=5))
    tell("topics:", *sorted(f"{topic}={','.join(types)}" for topic, types in topics.items()))
    services = dict(get_service_names_and_types(DOMAIN, router_port=PORT, timeout=5))
    tell("services:", *sorted(services))


def set_parameters():
    types = parameter_types()
    request = "rcl_interfaces/msg/Parameter[] parameters"
    response = "rcl_interfaces/msg/SetParametersResult[] results"
    name = "rcl_interfaces/srv/SetParameters"
    client = ROS2ServiceClient(
        service_name="/knee_drive/set_parameters",
        srv_type=name,
        request_definition=with_types(request, types),
        response_definition=with_types(response, types),
        type_hash=compute_service_type_hash(name, request, response, types),
        timeout=60,
        **WHERE,
    )
    store = client.session_mgr.store
    value, parameter = store.types["rcl_interfaces/msg/ParameterValue"], store.types["rcl_interfaces/msg/Parameter"]

    def double(number):
        import numpy

        none = {"byte_array_value": numpy.array([], dtype=numpy.uint8), "bool_array_value": numpy.array([], dtype=bool)}
        none |= {"integer_array_value": numpy.array([], dtype=numpy.int64), "string_array_value": []}
        none |= {"double_array_value": numpy.array([], dtype=numpy.float64), "string_value": "", "bool_value": False}
        return value(type=3, integer_value=0, double_value=number, **none)

    wanted = [("assistance", 0.5), ("assistance", 1.5), ("damped", 1.0)]
    response = client.call(parameters=[parameter(name=name, value=double(number)) for name, number in wanted])
    for (name, number), result in zip(wanted, response.results):
        tell("set:", name, number, result.successful, result.reason)
    client.close()


def press_stop():
    client = ROS2ServiceClient(
        service_name="/exo/stop",
        srv_type="std_srvs/srv/Trigger",
        request_definition=EMPTY,
        response_definition=TRIGGER,
        type_hash=compute_service_type_hash("std_srvs/srv/Trigger", EMPTY, TRIGGER),
        timeout=60,
        **WHERE,
    )
    response = client.call(structure_needs_at_least_one_member=0)
    tell("stop:", response.success, response.message)
    client.close()


def main():
    watch_joints()
    watch_attachments()
    show_graph()
    set_parameters()
    torque = ROS2Publisher(topic="/knee/torque", **of_type("std_msgs/msg/Float64"))
    exo = ROS2Publisher(topic="/exo/knee/torque", **of_type("std_msgs/msg/Float64"))
    tell("ready")
    for line in sys.stdin:
        words = line.split()
        if words[0] == "end":
            break
        torque.publish(data=float(words[1]))
        exo.publish(data=float(words[1]))
        tell("published")
    press_stop()
    tell("done")


main()
