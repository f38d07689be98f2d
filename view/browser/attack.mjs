// Attacks on `sinew view` beside the walking robot: each is refused or bounded, and the robot does not notice.

import { readFileSync, readdirSync } from "node:fs";
import { createServer, request } from "node:http";
import { connect } from "node:net";

import { inWords, lateness, now } from "./lateness.mjs";
import { STEP_MS, check, pause, tell, until } from "./robot.mjs";

const CROWD = 1_000;
/** Descriptors of `sinew view` beyond those before: its 64 connections, and those to the nodes. */
const DESCRIPTORS_MORE_MAX = 96;
/** Memory of `sinew view` beyond that before, kB: 64 connections with at most 8 KiB each, and the queues of one stream. */
const MEMORY_MORE_MAX_KB = 32_768;
/** A tick of a drive may be late by so much, us: the p99 of all may not grow by more. */
const LATE_MORE_MAX_US = 2_000;
/** The share of ticks that assist may not fall by more. */
const ASSISTING_LESS_MAX = 0.02;
/** Time in which a stream that nothing reads is cut, ms: its buffers in the kernel have to be full first. */
const SLOW_CUT_MS = 180_000;
const DRIVES = 3;
const EVIL = "http://evil.example";
const UNDO = '{"app":"knee.drive","undo":true}';

/** Sends a request with exactly these headers, and returns its status and body; status 0 if the connection was cut. */
function ask({ hostname, port }, path, { method = "GET", headers = {}, body = "" } = {}) {
  return new Promise((done) => {
    const sent = request({ hostname, port, path, method, headers: { connection: "close", ...headers } }, (answer) => {
      let text = "";
      answer.on("data", (data) => (text += data));
      answer.on("close", () => done({ status: answer.statusCode, text }));
      // An event stream does not end.
      if (answer.headers["content-type"] === "text/event-stream") answer.destroy();
    });
    sent.on("error", () => done({ status: 0, text: "" }));
    sent.end(body);
  });
}

function cases({ origin, cookie }) {
  const json = { "content-type": "application/json" };
  const write = (path, headers, body) => [path, { method: "POST", headers: { ...json, ...headers }, body }];
  const set = (headers, body = UNDO) => write("/api/parameters", headers, body);
  const press = (headers, body = '{"act":"press"}') => write("/api/stop", headers, body);
  const role = { authorization: "Bearer operator", "x-role": "operator", "x-forwarded-for": "127.0.0.1" };
  return [
    ["no token", 401, "/"],
    ["another token", 401, `/?token=${"0".repeat(32)}`],
    ["a file of the page without the token", 401, "/main.js"],
    ["a stream without the token", 401, "/api/stream"],
    ["a write without the token", 401, ...set({ origin })],
    ["a press without the token", 401, ...press({ origin })],
    ["a press with a forged role and without the token", 401, ...press({ origin, ...role, cookie: "role=operator" })],
    ["another host", 403, "/metrics", { headers: { host: "evil.example" } }],
    ["a write of another origin", 403, ...set({ cookie, origin: EVIL })],
    ["a write without an origin", 403, ...set({ cookie })],
    ["a press of another origin", 403, ...press({ cookie, origin: EVIL })],
    ["a press of another port of this host", 403, ...press({ cookie, origin: "http://127.0.0.1:1" })],
    ["a stream of another origin", 403, "/api/stream", { headers: { cookie, origin: EVIL } }],
    ["a list of another origin", 403, "/api/parameters", { headers: { cookie, origin: EVIL } }],
    ["a press of no known act", 400, ...press({ cookie, origin }, '{"act":"pause"}')],
    ["a press that claims a role", 400, ...press({ cookie, origin }, '{"act":"press","role":"operator"}')],
    ["a set that claims a role", 400, ...set({ cookie, origin }, '{"app":"knee.drive","undo":true,"role":"operator"}')],
    ["a huge query", 400, `/api/stream?app=${"x".repeat(5_000)}`, { headers: { cookie } }],
    ["a query beyond the first part of a request", 414, `/api/stream?app=${"x".repeat(100_000)}`, { headers: { cookie } }],
    ["a huge body", 413, ...set({ cookie, origin }, JSON.stringify({ app: "x".repeat(40_000) }))],
    ["the metrics", 200, "/metrics"],
  ];
}

async function hostileRequests(target) {
  for (const [name, wanted, path, options] of cases(target)) {
    const { status } = await ask(target, path, options);
    // The server may close before it has read all of a long request, or refuse its head as too long.
    const isCut = (wanted === 413 && status === 0) || (wanted === 414 && [0, 400, 431].includes(status));
    check(`${name} is answered with ${wanted}`, status === wanted || isCut, `${status}`);
  }
}

/** Visits a server on another port of this host: the browser sends the cookie of the page there, and back from it. */
async function foreignSite(context, { origin }) {
  const server = createServer((_, answer) => answer.setHeader("content-type", "text/html").end("<!doctype html><title>x</title>"));
  await new Promise((done) => server.listen(0, "127.0.0.1", done));
  const page = await context.newPage();
  const statuses = [];
  page.on("response", (answer) => answer.url().startsWith(`${origin}/api`) && statuses.push(answer.status()));
  await page.goto(`http://127.0.0.1:${server.address().port}/`);
  await page.evaluate(async ([target, undo]) => {
    const send = (path, more) => fetch(target + path, { mode: "no-cors", credentials: "include", ...more }).catch(() => null);
    await send("/api/parameters", { method: "POST", body: undo });
    await send("/api/stop", { method: "POST", body: '{"act":"press"}' });
    await send("/api/parameters", {});
    const frame = document.createElement("iframe");
    const loaded = new Promise((done) => (frame.onload = done));
    frame.src = `${target}/`;
    document.body.append(frame);
    await Promise.race([loaded, new Promise((done) => setTimeout(done, 2_000))]);
  }, [origin, UNDO]);
  check("a server on another port of this host is refused", statuses.every((status) => status === 403), statuses.join(", "));
  const hasButton = (frame) => frame.evaluate(() => document.querySelector("#stop-press") !== null).catch(() => false);
  const frames = await Promise.all(page.frames().slice(1).map(hasButton));
  check("the page is in no frame of another site", !frames.includes(true));
  await page.close();
  server.close();
}

const descriptors = (pid) => readdirSync(`/proc/${pid}/fd`).length;
const memoryKb = (pid) => Number(/VmRSS:\s+(\d+) kB/.exec(readFileSync(`/proc/${pid}/status`, "utf8"))[1]);

/** Holds connections: half of them send nothing, half an unfinished request. */
async function crowd(stage, target, { pid, page, isShort }) {
  const before = descriptors(pid);
  let connected = 0;
  const sockets = Array.from({ length: CROWD }, (_, place) => {
    const socket = connect({ host: target.hostname, port: target.port });
    socket.on("error", () => {});
    socket.on("connect", () => {
      connected += 1;
      if (place % 2 === 0) socket.write("GET /metrics HTTP/1.1\r\n");
    });
    return socket;
  });
  let [most, isLive] = [0, true];
  const end = Date.now() + (isShort ? 3_000 : 10_000);
  while (Date.now() < end) {
    most = Math.max(most, descriptors(pid));
    isLive &&= (await page.locator("#connection").textContent()) === "live";
    await pause(200);
  }
  const code = await stage.sinew(["stop", "status"]);
  for (const socket of sockets) socket.destroy();
  tell("the crowd", `${connected} of ${CROWD} connections were taken by the system`);
  check(`${CROWD} connections take few descriptors`, most <= before + DESCRIPTORS_MORE_MAX, `${before}, at most ${most}`);
  if (isShort) tell("an open page stays live meanwhile", `${isLive}`);
  else check("an open page stays live meanwhile", isLive);
  check("the command reaches the stop meanwhile", code === 0, `exit code ${code}`);
  const { status } = await until("an answer after the crowd", async () => {
    const answer = await ask(target, "/metrics");
    return answer.status === 200 && answer;
  });
  check("the metrics are answered after the crowd", status === 200);
}

/** Opens a stream with many messages, and reads nothing of it. */
function slowReader(target, robotApps) {
  const query = robotApps.map((app) => `app=${app}`).join("&");
  const socket = connect({ host: target.hostname, port: target.port });
  socket.on("error", () => {});
  socket.on("connect", () => {
    socket.pause();
    socket.write(`GET /api/stream?${query} HTTP/1.1\r\nHost: ${target.hostname}:${target.port}\r\nCookie: ${target.cookie}\r\n\r\n`);
  });
  return socket;
}

/** Returns whether the server's end of a connection is still open. */
function isOpen(serverPort, clientPort) {
  const hex = (port) => Number(port).toString(16).toUpperCase().padStart(4, "0");
  const lines = readFileSync("/proc/net/tcp", "utf8").split("\n").map((line) => line.trim().split(/\s+/));
  const ESTABLISHED = "01";
  return lines.some(([, local, remote, state]) =>
    local?.endsWith(`:${hex(serverPort)}`) && remote.endsWith(`:${hex(clientPort)}`) && state === ESTABLISHED);
}

async function slowReaderIsCut(target, socket, { pid, before }) {
  const began = Date.now();
  await until("the slow reader to be cut off", () => !isOpen(target.port, socket.localPort), SLOW_CUT_MS);
  check("a stream that nothing reads is cut off", true, `${((Date.now() - began) / 1000).toFixed(0)} s after the others`);
  socket.destroy();
  const after = memoryKb(pid);
  check("the memory of sinew view is bounded", after <= before + MEMORY_MORE_MAX_KB, `${before} to ${after} kB`);
}

/** Returns the values that the robot has, as the page reads them, when all drives have answered. */
function values(target) {
  return until("the parameters of all drives", async () => {
    const { status, text } = await ask(target, "/api/parameters", { headers: { cookie: target.cookie } });
    const apps = status === 200 ? JSON.parse(text).apps.filter((app) => app.list) : [];
    const lists = apps.map((app) => [app.app, app.list.parameters.map((one) => [one.name, one.target])]);
    return lists.length >= DRIVES && JSON.stringify(lists.sort());
  });
}

function compare(walk, [from, middle, to], isShort) {
  const [before, during] = [lateness(walk, from, middle), lateness(walk, middle, to)];
  tell("lateness before the attacks", inWords(before));
  tell("lateness during the attacks", inWords(during));
  if (isShort) return;
  for (const loop of ["drives", "central"]) {
    const more = during[loop].p99 - before[loop].p99;
    check(`the loops of ${loop} are as punctual as before`, more <= LATE_MORE_MAX_US, `p99 ${more} us later`);
  }
  const less = before.assisting - during.assisting;
  check("the drives assist as before", less <= ASSISTING_LESS_MAX, `${(100 * less).toFixed(1)} % less`);
}

/** Attacks `sinew view`, while a page is open. The short form is quicker, and judges no times. */
export async function attack(stage, { view, page, isShort }) {
  const { hostname, port, origin, searchParams } = new URL(view.address);
  const target = { hostname, port, origin, cookie: `sinew_view_${port}=${searchParams.get("token")}` };
  const { pid } = view.child;
  await page.locator("#tab-system").click();
  const [valuesBefore, notesBefore, memoryBefore] = [await values(target), view.child.notes.length, memoryKb(pid)];
  const from = now();
  await pause(isShort ? 2_000 : 10_000);
  const middle = now();
  await hostileRequests(target);
  await foreignSite(page.context(), target);
  const apps = ["hip", "knee", "ankle"].flatMap((joint) => [`${joint}.drive`, `${joint}.sensor`]).concat("central.gait");
  const reader = isShort ? null : slowReader(target, apps);
  await crowd(stage, target, { pid, page, isShort });
  const to = now();
  // The rows of the traces are written a tenth of a second later, and longer after a stall.
  await pause(1_000);
  compare(stage.walk, [from, middle, to], isShort);
  check("no attack has changed a parameter", (await values(target)) === valuesBefore);
  const notes = view.child.notes.slice(notesBefore);
  check("no attack has reached the robot", !/a set of the page|the stop, by the page/.test(notes), notes.trim());
  check("no attack has stopped the robot", /^running/.test(await page.locator("#stop-state").textContent({ timeout: STEP_MS })));
  if (reader !== null) await slowReaderIsCut(target, reader, { pid, before: memoryBefore });
}
