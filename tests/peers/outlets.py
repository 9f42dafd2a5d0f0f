#!/usr/bin/env python3
"""What Crossfix tells others, read by their own software: each command decodes a file (or what a live
server says), prints what it found as JSON, and ends with 0 where the checker accepts it, with 1 where
it refuses, and with 77 and "SKIPPED: ..." where the checker is not installed.

usage: outlets.py cot FILE                events, one after another          taky, @tak-ps/node-cot
       outlets.py sapient FILE            messages, each after its length    sapient-pydantic
       outlets.py asterix FILE            data blocks                        asterix-decoder
       outlets.py geojson FILE            a collection, or one a line        geojson-pydantic
       outlets.py kml FILE                                                   fastkml, its XSD
       outlets.py mcap FILE               every message of it                mcap, mcap-protobuf-support
       outlets.py foxglove HOST:PORT [N]  N messages of a live server        websockets

To install:
  pip install taky==0.10 sapient-pydantic==0.1.0 asterix-decoder==0.7.11 geojson-pydantic==2.2.0 \\
      fastkml==1.4.0 lxml==6.1.3 mcap==1.6.0 mcap-protobuf-support==0.6.0 websockets==17.4
  npm install --prefix "$NODE_COT" @tak-ps/node-cot@12.23.0     (node 20; else taky alone is asked)

Times are nanoseconds since the Unix epoch; of ASTERIX, seconds since midnight. Of a picture in
base64 its length is printed.
"""
import asyncio
import base64
import collections
import contextlib
import datetime
import json
import os
import pathlib
import re
import shutil
import struct
import subprocess
import sys

DECIMAL = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)")
UUID4 = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}")
ULID = re.compile(r"[0-7][0-9A-HJKMNP-TV-Z]{25}")
# As SAPIENT's public middleware (Apex) has them.
ICD, DETECTION_GAP_NS, LONGEST_MESSAGE = "BSI Flex 335 v2.0", 80_000_000, 1 << 20
CAT062_ALWAYS = {"I010", "I040", "I070", "I080"}
LIVE_WAIT_S, LIVE_MESSAGES, LONGEST_TEXT = 10, 20, 200

NODE_COT = """import CoT from '@tak-ps/node-cot'; import { readFileSync } from 'node:fs';
for (const event of JSON.parse(readFileSync(0, 'utf8'))) new CoT(event);"""


def need(true, why):
    if not true:
        raise ValueError(why)


def nanos(text):
    """Of an ISO 8601 time in UTC with any number of decimals."""
    match = re.fullmatch(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?(?:Z|\+00:00)", text or "")
    need(match, f"no time in UTC: {text!r}")
    seconds = int(datetime.datetime.fromisoformat(match[1] + "+00:00").timestamp())
    return seconds * 10**9 + int((match[2] or "0").ljust(9, "0"))


def cot(name):
    from lxml import etree
    from taky.cot.models import Event
    from taky.util import XMLDeclStrip

    # As taky's server does it with what comes over TCP.
    parser = etree.XMLPullParser(tag="event", resolve_entities=False)
    parser.feed(b"<root>")
    XMLDeclStrip(parser).feed(pathlib.Path(name).read_bytes() + b"</root>")
    elements = [element for _, element in parser.read_events()]
    parser.close()
    need(elements, "no event")
    events = [cot_event(element, Event.from_elm(element)) for element in elements]
    texts = [etree.tostring(element, encoding="unicode", with_tail=False) for element in elements]
    return {"checkers": ["taky"] + ["node-cot"] * node_cot(texts), "events": events}


def cot_event(element, event):
    """An event, held against the public schema, which both checkers know less of."""
    patterns = {"version": r"2(\.0)?", "type": r"\w+(-\w+)*", "how": r"\w(-\w+)*", "uid": r".+"}
    for key, pattern in patterns.items():
        need(re.fullmatch(pattern, element.get(key, "")), f"{key}={element.get(key)!r}")
    times = {key: nanos(element.get(key)) for key in ("time", "start", "stale")}
    need(times["start"] < times["stale"], "stale is not after start")
    need(len(element.findall("point")) == 1, "not one point")
    numbers = {}
    for part in element.findall("point") + element.findall("detail/track"):
        for key, value in part.items():
            need(DECIMAL.fullmatch(value), f"{part.tag} {key}={value!r} is no xs:decimal")
            numbers[key] = float(value)
    need(abs(numbers["lat"]) <= 90 and abs(numbers["lon"]) <= 180, "a place on no map")
    need(numbers["ce"] > 0 and numbers["le"] > 0, "an error that is not positive")
    need(0 <= numbers.get("course", 0) < 360 and numbers.get("speed", 0) >= 0, "course or speed")
    said = {part.tag: part.text or dict(part.attrib) for part in element.iterfind("detail/*")}
    return {**element.attrib, **times, **numbers, "uid": event.uid, "detail": said}


def node_cot(texts):
    """Whether node-cot is there and accepts them all; where it does not, that is a refusal."""
    where = pathlib.Path(os.environ.get("NODE_COT", "."))
    if not shutil.which("node") or not (where / "node_modules/@tak-ps/node-cot").is_dir():
        return False
    run = subprocess.run(["node", "--input-type=module", "-e", NODE_COT], cwd=where, text=True,
                         input=json.dumps(texts), capture_output=True, timeout=120)
    said = [line for line in run.stderr.splitlines() if "Error" in line] or [run.stderr[-300:]]
    need(run.returncode == 0, f"node-cot: {said[0]}")
    return True


def sapient(name):
    from google.protobuf.json_format import MessageToDict
    from google.protobuf.unknown_fields import UnknownFieldSet
    from sapient_msg.bsi_flex_335_v2_0 import sapient_message_pb2
    from sapient_msg_pydantic.bsi_flex_335_v2_0.sapient_message import SapientMessage

    data, at, messages, detected = pathlib.Path(name).read_bytes(), 0, [], None
    while at < len(data):
        (length,) = struct.unpack_from("<I", data, at)
        need(0 < length <= LONGEST_MESSAGE, f"a message of {length} bytes at {at}")
        need(at + 4 + length <= len(data), f"the message at {at} is torn")
        message = sapient_message_pb2.SapientMessage.FromString(data[at + 4:at + 4 + length])
        at += 4 + length
        SapientMessage.from_pb2(message).to_pb2()
        need(not len(UnknownFieldSet(message)), "a field that is not in the standard")
        kind = message.WhichOneof("content")
        time = message.timestamp.seconds * 10**9 + message.timestamp.nanos
        said = MessageToDict(message, preserving_proto_field_name=True)[kind]
        need(UUID4.fullmatch(message.node_id), f"node_id {message.node_id} is no UUID v4")
        for key in ("report_id", "object_id", "alert_id"):
            need(key not in said or ULID.fullmatch(said[key]), f"{key} {said.get(key)} is no ULID")
        if kind == "registration":
            need(said["icd_version"] == ICD, f"icd_version {said['icd_version']!r}")
        if kind == "detection_report":
            gap = time - detected if detected is not None else 0
            need(gap == 0 or gap >= DETECTION_GAP_NS, f"{gap} ns after the detection before")
            detected = time
        messages.append({"kind": kind, "time": time, "node_id": message.node_id, **said})
    need(messages, "no message")
    return {"checkers": ["sapient-pydantic"], "messages": messages}


def asterix(name):
    import asterix as decoder

    data, at, blocks = pathlib.Path(name).read_bytes(), 0, 0
    while at < len(data):
        _, length = struct.unpack_from(">BH", data, at)
        need(length > 3 and at + length <= len(data), f"a block of {length} bytes at {at}")
        at, blocks = at + length, blocks + 1
    records = decoder.parse(data, verbose=False)
    for record in records:
        need(record["hexdata"], "a record that cannot be decoded")
        if record["category"] == 62:
            need(CAT062_ALWAYS <= record.keys(), f"without {sorted(CAT062_ALWAYS - record.keys())}")
    need(records, "no record")
    # A bit too many in a field specification would show here.
    read = sum(len(record["hexdata"]) // 2 for record in records) + 3 * blocks
    need(read == len(data), f"{read} of {len(data)} bytes are in records")
    return {"checkers": ["asterix-decoder"], "blocks": blocks, "records": records}


def geojson(name):
    from geojson_pydantic import Feature, FeatureCollection

    text = pathlib.Path(name).read_text()
    try:
        whole = [json.loads(text)]
    except json.JSONDecodeError:
        whole = [json.loads(line) for line in text.splitlines() if line.strip()]
    need(whole, "nothing")
    features = []
    for part in whole:
        kind = Feature if part["type"] == "Feature" else FeatureCollection
        read = kind.model_validate(part)
        for feature in getattr(read, "features", [read]):
            geometry = feature.geometry and json.loads(feature.geometry.model_dump_json())
            on_map((geometry or {}).get("coordinates", []))
            features.append({"id": feature.id, "geometry": geometry, "properties": feature.properties})
    return {"checkers": ["geojson-pydantic"], "features": features}


def on_map(coordinates):
    """Refuses places that no map has, in lists of any depth."""
    if coordinates and isinstance(coordinates[0], (int, float)):
        lon, lat = coordinates[:2]
        need(abs(lon) <= 180 and abs(lat) <= 90, f"a place on no map: {lon} {lat}")
    else:
        for inner in coordinates:
            on_map(inner)


def kml(name):
    import fastkml
    from fastkml.gx import Track
    from fastkml.validator import validate

    schema = pathlib.Path(fastkml.__file__).parent / "schema/kml22gx.xsd"
    need(validate(file_to_validate=pathlib.Path(name), schema=schema), "not valid by kml22gx.xsd")
    marks = []

    def walk(feature):
        for inner in getattr(feature, "features", []):
            walk(inner)
        geometry = getattr(feature, "kml_geometry", None)
        if geometry is None:
            return
        data = {value.name: value.value for value in getattr(feature.extended_data, "elements", [])}
        mark = {"id": feature.id, "name": feature.name, "geometry": type(geometry).__name__, "data": data}
        if isinstance(geometry, Track):
            mark["times"] = [nanos(item.when.dt.isoformat()) for item in geometry.track_items]
            mark["coordinates"] = [item.coord.coords[0] for item in geometry.track_items]
            need(mark["times"] == sorted(mark["times"]), f"the times of {feature.name} go back")
        marks.append(mark)

    walk(fastkml.KML.parse(name, strict=True, validate=False))
    return {"checkers": ["fastkml"], "placemarks": marks}


def mcap(name):
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    schemas, topics = collections.Counter(), {}
    with open(name, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            schemas[schema.name] += 1
            seen(topics, channel.topic, schema.name, message.log_time, decoded)
    return {"checkers": ["mcap", "mcap-protobuf-support"], "schemas": schemas, "topics": topics}


def seen(topics, topic, schema, time, decoded):
    from google.protobuf.json_format import MessageToDict

    entry = topics.setdefault(topic, {"schema": schema, "messages": 0, "first": time})
    need(entry["schema"] == schema, f"{topic} has two schemas")
    said = MessageToDict(decoded, preserving_proto_field_name=True)
    long = {key for key, value in said.items() if isinstance(value, str) and len(value) > LONGEST_TEXT}
    said.update({key: len(said[key]) for key in long})
    entry.update(messages=entry["messages"] + 1, last=time, last_message=said)


def foxglove(address, wanted=LIVE_MESSAGES):
    import mcap_protobuf.decoder
    import websockets
    from mcap.records import Schema

    channels, topics = {}, {}

    async def listen():
        left = int(wanted)
        decoders = mcap_protobuf.decoder.DecoderFactory()
        # With a bounded queue the client stops reading once it is full, and would at the end wait for a
        # goodbye that it never reads.
        async with websockets.connect(f"ws://{address}", subprotocols=["foxglove.sdk.v1"],
                                      max_size=None, max_queue=None, proxy=None) as socket:
            need(socket.subprotocol == "foxglove.sdk.v1", f"sub-protocol {socket.subprotocol}")
            info = json.loads(await socket.recv())
            need(info["op"] == "serverInfo", f"first comes {info['op']}")
            while left:
                if isinstance(message := await socket.recv(), str):
                    said = json.loads(message)
                    for channel in said["channels"] if said["op"] == "advertise" else []:
                        number, topic = channel["id"], channel["topic"]
                        schema = Schema(number, base64.b64decode(channel["schema"], validate=True),
                                        channel["schemaEncoding"], channel["schemaName"])
                        decode = decoders.decoder_for(channel["encoding"], schema)
                        need(decode, f"{topic} is no protobuf")
                        channels[number] = topic, schema.name, decode
                        await socket.send(json.dumps({"op": "subscribe", "subscriptions": [
                            {"id": number, "channelId": number}]}))
                elif message[0] == 1:
                    _, number, time = struct.unpack_from("<BIQ", message)
                    need(number in channels, f"a message of subscription {number}")
                    topic, name, decode = channels[number]
                    seen(topics, topic, name, time, decode(message[13:]))
                    left -= 1
        named = {said[0]: said[1] for said in channels.values()}
        return {"checkers": ["websockets"], "server": info, "channels": named, "topics": topics}

    try:
        return asyncio.run(asyncio.wait_for(listen(), LIVE_WAIT_S))
    except TimeoutError:
        heard = {topic: entry["messages"] for topic, entry in topics.items()}
        told = [topic for topic, *_ in channels.values()]
        raise ValueError(f"after {LIVE_WAIT_S} s heard {heard} of {told}") from None


def main():
    checks = {check.__name__: check for check in (cot, sapient, asterix, geojson, kml, mcap, foxglove)}
    if len(sys.argv) not in (3, 4) or sys.argv[1] not in checks:
        print(__doc__, file=sys.stderr)
        sys.exit(2)
    try:
        # Some checkers print of their own: the summary has standard output for itself.
        with contextlib.redirect_stdout(sys.stderr):
            summary = checks[sys.argv[1]](*sys.argv[2:])
    except ImportError as missing:
        print(f"SKIPPED: {missing.name} is not installed")
        sys.exit(77)
    except Exception as error:  # Each checker refuses in its own way.
        print(json.dumps({"accepted": False, "error": f"{type(error).__name__}: {error}"[:1000]}))
        sys.exit(1)
    print(json.dumps({"accepted": True, **summary}))


if __name__ == "__main__":
    main()
