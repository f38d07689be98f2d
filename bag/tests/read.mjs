// Reads the two recordings of `official.rs` with the official readers for JavaScript, and compares the values that they
// decode with those that were sent. The test leaves the files in target/tmp/official.
//
//   cargo test -p sinew-bag --test official
//   mkdir -p target/readers && cd target/readers && npm install @mcap/core @mcap/nodejs @mcap/support protobufjs long
//   node ../../bag/tests/read.mjs ../tmp/official/whole.mcap ../tmp/official/killed.mcap
//
// The packages are those of the current folder. Exit code 1: a value differs.

import { open, readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { join } from "node:path";
import { isDeepStrictEqual } from "node:util";

const [whole, killed] = process.argv.slice(2);
if (!killed) {
  console.error("name two files: node read.mjs WHOLE KILLED");
  process.exit(2);
}
const require = createRequire(join(process.cwd(), "package.json"));
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { FileHandleReadable } = require("@mcap/nodejs");
const { loadDecompressHandlers } = require("@mcap/support");
const protobuf = require("protobufjs");
require("protobufjs/ext/descriptor");
// Without it, protobufjs rounds whole numbers above 2^53.
protobuf.util.Long = require("long");
protobuf.configure();

const RAW = "/knee.sensor/exo.sample";
const VIEW = `${RAW}/view`;
let failures = 0;

function check(name, found, expected) {
  const isSame = isDeepStrictEqual(found, expected);
  console.log(isSame ? `ok     ${name}` : `FAILED ${name}`);
  if (!isSame) console.log("  found", found, "\n  expected", expected);
  failures += isSame ? 0 : 1;
}

const decompressHandlers = await loadDecompressHandlers();
const handle = await open(whole, "r");
const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(handle), decompressHandlers });
const views = [];
for await (const message of reader.readMessages({ topics: [VIEW] })) {
  const schema = reader.schemasById.get(reader.channelsById.get(message.channelId).schemaId);
  const type = protobuf.Root.fromDescriptor(schema.data).lookupType(schema.name);
  const view = type.toObject(type.decode(message.data), { longs: String, enums: String, oneofs: true });
  views.push({ view, times: [message.logTime, message.publishTime] });
}
const raw = [];
for await (const message of reader.readMessages({ topics: [RAW] })) raw.push(message.data.length);

const [{ view, times }, misfit] = views;
check("messages", [views.length, raw.length, reader.statistics.messageCount], [2, 2, 6n]);
check("times", times, [100_001_000n, 100_000_750n]);
check("NaN", view.angle, NaN);
check("negative zero", view.torque, -0);
check("u64 above 2^53", view.big, "18446744073709551615");
check("i64", view.low, "-9223372036854775808");
check("u128", view.wide, "340282366920938463463374607431768211455");
check("bytes", Buffer.from(view.raw).toString("hex"), "00ff80");
check("enum", view.mode, "Walk");
check("variants", view.commands.map((command) => command.variant), ["Stop", "Torque"]);
check("value of a variant", view.commands[1].Torque, Math.fround(0.1));
check("map", JSON.parse(view.gains), { kd: "NaN", kp: 1.5 });
check("option with a value", view.limit, 0);
check("option without a value", view.none, undefined);
check("list", view.list, [1, 65_535]);
check("sequence", view.sinew.sequence, "18446744073709551516");
check("payload that does not fit", misfit.view.sinew.misfit, "a map for a struct");
await handle.close();

const stream = new McapStreamReader({ decompressHandlers });
stream.append(await readFile(killed));
const topics = new Map();
let count = 0;
for (let record; (record = stream.nextRecord()); ) {
  if (record.type === "Channel") topics.set(record.id, record.topic);
  if (record.type === "Message" && topics.get(record.channelId) === RAW) count += 1;
}
check("messages of a killed recorder", count, 10);
process.exit(failures === 0 ? 0 : 1);
