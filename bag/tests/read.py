"""Reads two recordings with the official readers of MCAP and of its protobuf messages; prints their content as JSON.

The first file is finished, the second one was left by a killed recorder.
"""

import json
import struct
import sys

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory


def bits(value):
    return struct.pack(">d", value).hex()


def shown(view):
    if view.sinew.misfit:
        return {"misfit": view.sinew.misfit, "number": view.sinew.number}
    command = view.commands[1]
    return {
        "angle": bits(view.angle),
        "torque": bits(view.torque),
        "big": view.big,
        "low": view.low,
        "wide": view.wide,
        "raw": view.raw.hex(),
        "mode": type(view).Mode.Value.Name(view.mode),
        "variants": [command.WhichOneof("variant") for command in view.commands],
        "torque of the command": bits(command.Torque),
        "gains": json.loads(view.gains),
        "limit": view.limit if view.HasField("limit") else None,
        "none": view.none if view.HasField("none") else None,
        "list": list(view.list),
        "sequence": view.sinew.sequence,
        "number": view.sinew.number,
        "age_ns": view.sinew.age_ns,
        "misfit": view.sinew.misfit,
    }


def main():
    result = {"views": [], "raw": [], "topics": []}
    with open(sys.argv[1], "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, view in reader.iter_decoded_messages(topics=["/knee.sensor/exo.sample/view"]):
            result["views"].append(shown(view) | {"times": [message.log_time, message.publish_time]})
        for schema, channel, message in reader.iter_messages(topics=["/knee.sensor/exo.sample"]):
            result["raw"].append(message.data.hex())
        summary = reader.get_summary()
        result["topics"] = sorted(channel.topic for channel in summary.channels.values())
        result["messages"] = summary.statistics.message_count
        result["metadata"] = [[record.name, record.metadata["node"]] for record in reader.iter_metadata()]
    killed = 0
    with open(sys.argv[2], "rb") as file:
        try:
            for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                killed += channel.topic == "/knee.sensor/exo.sample"
        except EndOfFile:
            pass
    result["killed"] = killed
    print(json.dumps(result))


main()
