// Connects the official client of Foxglove's protocol (`@foxglove/ws-protocol`) to `sinew view --foxglove`, beside two
// nodes of this host: the hip sends counts to the knee. The client subscribes, decodes each view by its schema, and has
// to get as many messages as `sinew audit` counts at the knee.
//
//   npm ci && node foxglove.mjs [--seconds N]
//
// It needs the programs `sinew` and `scenarios` in target/debug, or in the folder of the variable SINEW_PROGRAMS.
// Without them it says so and ends with 0.

import { execFile, spawn } from "node:child_process";
import { existsSync, mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const STEP_MS = 60_000;
const QUIET_MS = 2_000;
const TOPIC = "/hip/scenario.count/view";
const PARAMETER = "knee.gains.assistance";

const here = dirname(fileURLToPath(import.meta.url));
const programs = process.env.SINEW_PROGRAMS ?? resolve(here, "../../target/debug");
const seconds = Number(process.argv[process.argv.indexOf("--seconds") + 1] || 0) || 10;

function skip(why) {
  console.log(`skipped: ${why}`);
  process.exit(0);
}

async function modules() {
  try {
    const { FoxgloveClient } = (await import("@foxglove/ws-protocol")).default;
    const { WebSocket } = await import("ws");
    const protobuf = (await import("protobufjs")).default;
    await import("protobufjs/ext/descriptor/index.js");
    return { FoxgloveClient, WebSocket, protobuf };
  } catch (why) {
    return skip(`${why.message}; run \`npm ci\` in view/browser`);
  }
}

for (const program of ["sinew", "scenarios"]) {
  const path = join(programs, program);
  if (!existsSync(path)) skip(`${path} is missing; build it, or name its folder in SINEW_PROGRAMS`);
}
const { FoxgloveClient, WebSocket, protobuf } = await modules();

const folder = mkdtempSync(join(tmpdir(), "sinew-foxglove-"));
const children = [];
let failures = 0;

function check(name, isSo, detail = "") {
  console.log(`${isSo ? "ok    " : "FAILED"} ${name}${detail ? `: ${detail}` : ""}`);
  failures += isSo ? 0 : 1;
}

function start(program, words) {
  const child = spawn(join(programs, program), words, { stdio: ["ignore", "pipe", "inherit"] });
  child.text = "";
  child.stdout.on("data", (data) => (child.text += data));
  children.push(child);
  return child;
}

/** Waits until `find` returns a value. */
async function until(what, find) {
  const end = Date.now() + STEP_MS;
  for (;;) {
    const found = await find();
    if (found) return found;
    if (Date.now() > end) throw new Error(`waited ${STEP_MS} ms for ${what}`);
    await new Promise((done) => setTimeout(done, 50));
  }
}

const socket = (name) => join(folder, `${name}.sock`);

/** Starts a node of the project of this run, with an application of the same name. */
async function startNode(name, address, words) {
  const port = 20_000 + (process.pid % 20_000);
  const file = join(folder, `${name}.toml`);
  const node = `[node]\nname = "${name}"\naddress = "127.0.0.${address}"\nproject = "foxglove"\n`;
  const rest = `[lncl]\nsocket = "${socket(name)}"\n[ndl]\nmulticast = "239.255.71.7:${port}"\nmdns_port = false\n`;
  writeFileSync(file, node + rest);
  const child = start("scenarios", ["--role", "node_under_test", file, ...words]);
  await until(`the node ${name}`, () => child.text.includes("up"));
  return child;
}

/** Starts `sinew view` at the hip, and returns the address for Foxglove. */
async function startView() {
  const words = ["--socket", socket("hip"), "--json", "view", "--listen", "127.0.0.1:0", "--foxglove", "0"];
  const view = start("sinew", words);
  const line = await until("sinew view", () => view.text.includes("\n") && view.text.split("\n")[0]);
  return JSON.parse(line).foxglove;
}

/** Returns the messages of class Bulk that were delivered to the knee, as the audit counts them. */
function audited() {
  return new Promise((done, fail) => {
    const words = ["--socket", socket("knee"), "--json", "audit"];
    // An audit with findings has exit code 1.
    execFile(join(programs, "sinew"), words, (why, out) => {
      if (!out) return fail(why);
      const node = JSON.parse(out).nodes.find((one) => one.name === "knee");
      const mailbox = node.entries.find(({ place }) => place.Mailbox?.name === "knee" && place.Mailbox.class === "Bulk");
      return done(mailbox?.account.delivered ?? 0);
    });
  });
}

/** Connects, subscribes to the counts, and decodes them. */
function connect(url) {
  const client = new FoxgloveClient({ ws: new WebSocket(url, [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
  const found = { client, numbers: [], headers: [], statuses: [], parameters: new Map(), last: Date.now() };
  client.on("error", (why) => found.statuses.push(`error: ${why.message}`));
  client.on("status", (status) => found.statuses.push(status.message));
  client.on("parameterValues", ({ parameters }) => parameters.forEach((one) => found.parameters.set(one.name, one.value)));
  let subscription;
  let type;
  client.on("advertise", (channels) => {
    const channel = channels.find((one) => one.topic === TOPIC);
    if (!channel) return;
    const bytes = Buffer.from(channel.schema, "base64");
    type = protobuf.Root.fromDescriptor(bytes).lookupType(channel.schemaName);
    found.channel = channel;
    subscription = client.subscribe(channel.id);
  });
  client.on("message", (message) => {
    if (message.subscriptionId !== subscription) return;
    const { buffer, byteOffset, byteLength } = message.data;
    const view = type.toObject(type.decode(new Uint8Array(buffer, byteOffset, byteLength)), { longs: Number });
    found.numbers.push(view.number);
    found.headers.push(view.sinew);
    found.last = Date.now();
  });
  return found;
}

async function run() {
  await startNode("knee", 2, ["--tuned"]);
  const hip = await startNode("hip", 1, ["--requires", "knee", "--sends-to", "knee"]);
  const found = connect(await startView());
  await until("the first message", () => found.numbers.length > 0);
  check("the channel has a schema", found.channel.encoding === "protobuf", found.channel.schemaName);
  found.client.getParameters([], "all");
  await until("the parameters", () => found.parameters.has(PARAMETER));
  check("a parameter is listed", found.parameters.get(PARAMETER) === 0.3, `${PARAMETER} is ${found.parameters.get(PARAMETER)}`);
  await new Promise((done) => setTimeout(done, seconds * 1_000));
  hip.kill("SIGTERM");
  await until("the end of the hip", () => hip.exitCode !== null);
  await until("quiet", () => Date.now() - found.last > QUIET_MS);
  const { numbers, headers } = found;
  const [first, last] = [numbers[0], numbers.at(-1)];
  const gaps = numbers.filter((number, place) => number !== first + place);
  check("no message is missing or twice", gaps.length === 0, `${numbers.length} messages, ${first} to ${last}`);
  check("each view has its header", headers.every((header) => header?.number > 0));
  const delivered = await audited();
  const counted = delivered - first + 1;
  check("the client has as many messages as the audit counts", numbers.length === counted, `${numbers.length} of ${counted}`);
  check("nothing was dropped", !found.statuses.some((text) => text.includes("dropped")), found.statuses.join("; "));
  found.client.close();
}

try {
  await run();
} catch (why) {
  check("the run", false, why.stack);
}
for (const child of children) child.kill("SIGKILL");
rmSync(folder, { recursive: true, force: true });
console.log(failures ? `${failures} failed` : "all is fine");
process.exit(failures ? 1 : 0);
