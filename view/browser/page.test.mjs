// Opens the page of `sinew view` in Chromium, beside the walking robot of the example: four nodes of this host.
//
//   npm ci && node page.test.mjs [--minutes N]
//
// It needs the programs `sinew` and `exoskeleton` in target/debug, or in the folder of the variable SINEW_PROGRAMS, and
// Chromium at /usr/bin/chromium, or at the path of the variable CHROMIUM. Without them it says so and ends with 0.
// With --minutes the page also stays open for so long, and its memory must not grow.

import { spawn } from "node:child_process";
import { existsSync, mkdtempSync, readdirSync, rmSync } from "node:fs";
import { request } from "node:http";
import { tmpdir } from "node:os";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const NODES = ["ankle", "central", "hip", "knee"];
const STEP_MS = 60_000;
const CRASH_SEEN_MS = 1_000;

const here = dirname(fileURLToPath(import.meta.url));
const programs = process.env.SINEW_PROGRAMS ?? resolve(here, "../../target/debug");
const chromium = process.env.CHROMIUM ?? "/usr/bin/chromium";
const minutes = Number(process.argv[process.argv.indexOf("--minutes") + 1] || 0) || 0;

function skip(why) {
  console.log(`skipped: ${why}`);
  process.exit(0);
}

async function browserOf() {
  try {
    return (await import("playwright-core")).chromium;
  } catch {
    return skip("playwright-core is missing; run `npm ci` in view/browser");
  }
}

for (const program of ["sinew", "exoskeleton"]) {
  const path = join(programs, program);
  if (!existsSync(path)) skip(`${path} is missing; build it, or name its folder in SINEW_PROGRAMS`);
}
if (!existsSync(chromium)) skip(`${chromium} is missing; install the package chromium, or name it in CHROMIUM`);
const playwright = await browserOf();

const folder = mkdtempSync(join(tmpdir(), "sinew-page-"));
const shots = mkdtempSync(join(tmpdir(), "sinew-page-shots-"));
const children = [];
let failures = 0;

function check(name, isSo, detail = "") {
  console.log(`${isSo ? "ok    " : "FAILED"} ${name}${detail ? `: ${detail}` : ""}`);
  failures += isSo ? 0 : 1;
}

function start(program, words, env) {
  const child = spawn(join(programs, program), words, { env: { ...process.env, ...env }, stdio: ["ignore", "pipe", "inherit"] });
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

/** Starts the robot and the view, and returns the address of the page. */
async function startAll() {
  start("exoskeleton", ["--strides", `${200 + 60 * minutes}`], { TMPDIR: folder });
  const socket = await until("the socket of central", () => readdirSync(folder).find((name) => name.endsWith("-central.sock")));
  const words = ["--socket", join(folder, socket), "--json", "view", "--listen", "127.0.0.1:0"];
  const isUp = () => {
    const view = start("sinew", words, { TMPDIR: folder });
    return until("the page", () => (view.text.includes("\n") ? view.text : view.exitCode !== null ? "none" : null));
  };
  // The socket may be there before its node listens.
  const line = await until("sinew view", async () => {
    const text = await isUp();
    return text.startsWith("{") && text.includes("page") ? text : null;
  });
  return JSON.parse(line.split("\n")[0]).page;
}

async function seeNodes(page) {
  const isGreen = (names) => names.every((name) => document.querySelector(`.card[data-node="${name}"][data-state="up"]`));
  await page.waitForFunction(isGreen, NODES, { timeout: STEP_MS });
  check("four nodes are up", true, NODES.join(", "));
  check("the token is not left in the address", !page.url().includes("token"), page.url());
  await page.waitForFunction(() => document.querySelectorAll("#map .link.up").length >= 6, null, { timeout: STEP_MS });
  check("the map shows the links", true);
}

async function takeScreenshots(page) {
  for (const scheme of ["light", "dark"]) {
    await page.emulateMedia({ colorScheme: scheme });
    await page.screenshot({ path: join(shots, `${scheme}.png`), fullPage: true });
  }
  await page.setViewportSize({ width: 390, height: 844 });
  for (const tab of ["system", "plots", "parameters", "outcomes", "events"]) {
    await page.locator(`#tab-${tab}`).click();
    await page.waitForTimeout(300);
    const [wide, window] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
    check(`the tab ${tab} fits a phone`, wide <= window, `${wide} of ${window}`);
    check(`the stop is visible on the tab ${tab} of a phone`, await isInWindow(page, "#stop-press"));
    await page.screenshot({ path: join(shots, `phone-${tab}.png`), fullPage: true });
  }
  await page.setViewportSize({ width: 1200, height: 900 });
}

/** Returns whether an element is wholly in the window, and nothing covers its middle. */
const isInWindow = (page, selector) => page.evaluate((found) => {
  scrollTo(0, document.documentElement.scrollHeight);
  const element = document.querySelector(found);
  const { left, right, top, bottom } = element.getBoundingClientRect();
  const isInside = left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight;
  const middle = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
  scrollTo(0, 0);
  return isInside && middle === element;
}, selector);

/** Waits until all nodes have confirmed the stop, and returns their rows. */
async function confirmed(page, name) {
  const all = (count) => {
    const cells = [...document.querySelectorAll("#stop-nodes tbody tr")].map((row) => row.cells);
    return cells.length === count && cells.every((row) => /^\d+\.\d ms$/.test(row[2].textContent)) && cells.map((row) => `${row[0].textContent} ${row[2].textContent}`);
  };
  const rows = await page.waitForFunction(all, NODES.length, { timeout: STEP_MS });
  check(name, true, (await rows.jsonValue()).join(", "));
}

const stateIs = (page, text) => page.locator("#stop-state", { hasText: text }).waitFor({ timeout: STEP_MS });

async function release(page) {
  await page.locator("#stop-release").click();
  // The second step at once counts as the same act.
  await page.locator("#stop-release-confirm").evaluate((button) => button.click());
  check("a release needs two steps", /^STOPPED/.test(await page.locator("#stop-state").textContent()));
  await page.waitForTimeout(700);
  await page.locator("#stop-release-confirm").click();
  await page.locator("#stop-outcome", { hasText: "released; nothing moves by that" }).waitFor({ timeout: STEP_MS });
  await stateIs(page, "running");
  check("the release is shown", true);
}

/** Returns the states of all guarded outputs, as the tab System shows them. */
const outputs = (page) => page.evaluate(() => document.querySelector("#outputs").textContent);

async function stop(page, address) {
  await page.locator("#tab-system").click();
  await stateIs(page, "running");
  await page.waitForFunction(() => document.querySelector("#outputs").textContent.includes("live"), null, { timeout: STEP_MS });
  check("the stop is visible beside a long page", await isInWindow(page, "#stop-press"));
  await page.locator("#stop-press").click();
  await stateIs(page, "STOPPED by");
  await confirmed(page, "a click stops the walking robot: four confirmations");
  await page.waitForFunction(() => !document.querySelector("#outputs").textContent.includes("live"), null, { timeout: STEP_MS });
  check("no output is live", true);
  await page.screenshot({ path: join(shots, "stop.png"), fullPage: true });
  await release(page);
  await page.waitForTimeout(1_000);
  check("no output is live after the release", !(await outputs(page)).includes("live"));
  await stopElsewhere(page, address);
  await page.locator("#tab-events").click();
  await page.locator("#event-list tr", { hasText: "4 of 4 nodes have confirmed" }).first().waitFor({ timeout: STEP_MS });
  check("the log of events has the press", true);
}

/** Presses on a phone by touch: the first page shows it. Then presses once more by the keyboard. */
async function stopElsewhere(page, address) {
  const phone = await browser.newContext({ hasTouch: true, viewport: { width: 390, height: 844 } });
  const other = await phone.newPage();
  await other.goto(address);
  await stateIs(other, "running");
  await other.locator("#stop-press").tap();
  await confirmed(other, "a touch stops: four confirmations");
  await other.screenshot({ path: join(shots, "phone-stop.png"), fullPage: true });
  await phone.close();
  await stateIs(page, "STOPPED by");
  await confirmed(page, "a press elsewhere is shown");
  const presses = () => page.locator("#stop-presses").textContent();
  const before = await presses();
  await page.locator("#stop-press").focus();
  await page.keyboard.press("Enter");
  await until("the press by Enter", async () => (await presses()) !== before);
  const second = await presses();
  await page.locator("#theme").focus();
  await page.keyboard.press("F9");
  await until("the press by the key", async () => (await presses()) !== second);
  check("the keyboard presses", true, await presses());
  await release(page);
}

async function useKeyboard(page) {
  await page.locator("#tab-system").focus();
  await page.keyboard.press("ArrowRight");
  const selected = await page.evaluate(() => document.querySelector("[role=tab][aria-selected=true]").id);
  check("arrow keys move between the tabs", selected === "tab-plots", selected);
}

async function plot(page) {
  await page.locator("#tab-plots").click();
  await page.locator('#plot-apps button[data-key="knee.drive"]').click();
  const field = page.locator("#messages button.field:not([data-key$='@age_ms'])").first();
  await field.waitFor({ timeout: STEP_MS });
  await field.click();
  await page.waitForFunction(() => Number(document.querySelector("figure.chart")?.dataset.points) > 100, null, { timeout: STEP_MS });
  const [one, other] = [await points(page), (await page.waitForTimeout(1_000), await points(page))];
  check("a chosen field is plotted", other !== one, `${one}, a second later ${other} points`);
  await page.screenshot({ path: join(shots, "plots.png"), fullPage: true });
}

const points = (page) => page.evaluate(() => Number(document.querySelector("figure.chart").dataset.points));

async function setParameter(page) {
  await page.locator("#tab-parameters").click();
  const form = page.locator('[data-app="knee.drive"] form:has(input[data-parameter="assistance"])');
  await form.waitFor({ timeout: STEP_MS });
  const number = form.locator("input[type=number]");
  const before = Number(await number.inputValue());
  const other = page.locator('[data-app="knee.drive"] input[data-parameter="damping"]');
  const written = `${Number(await other.inputValue()) + 0.125}`;
  await other.fill(written);
  await form.locator("input[type=range]").focus();
  await page.keyboard.press("ArrowLeft");
  const outcome = page.locator("#parameter-outcome", { hasText: "applied" });
  await outcome.waitFor({ timeout: STEP_MS });
  check("a moved slider is applied at a tick", /knee\.drive: assistance = .* at tick \d+/.test(await outcome.textContent()), await outcome.textContent());
  await page.waitForFunction(() => !document.querySelector('[data-undo="knee.drive"]').disabled, null, { timeout: STEP_MS });
  check("a set keeps what is written beside it", (await other.inputValue()) === written, written);
  await page.locator('[data-undo="knee.drive"]').click();
  await page.locator("#parameter-outcome", { hasText: `= ${before}` }).waitFor({ timeout: STEP_MS });
  check("undo gives the former value", true, await outcome.textContent());
  await page.screenshot({ path: join(shots, "parameters.png"), fullPage: true });
}

/** Sends a request with exactly these headers, and returns its status; 0 if the connection was cut. */
function status(address, path, { method = "GET", headers = {}, body = "" } = {}) {
  const { hostname, port } = new URL(address);
  return new Promise((done) => {
    const sent = request({ hostname, port, path, method, headers: { connection: "close", ...headers } }, (answer) => {
      answer.destroy();
      done(answer.statusCode);
    });
    sent.on("error", () => done(0));
    sent.end(body);
  });
}

async function attack(address) {
  const { origin, port, searchParams } = new URL(address);
  const cookie = `sinew_view_${port}=${searchParams.get("token")}`;
  const evil = "http://evil.example";
  const post = (headers, body = '{"app":"knee.drive","undo":true}') =>
    status(address, "/api/parameters", { method: "POST", body, headers: { "content-type": "application/json", ...headers } });
  const press = (headers, body = '{"act":"press"}') =>
    status(address, "/api/stop", { method: "POST", body, headers: { "content-type": "application/json", ...headers } });
  const get = (path, headers = {}) => status(address, path, { headers });
  const cases = [
    ["no token", 401, get("/")],
    ["another token", 401, get(`/?token=${"0".repeat(32)}`)],
    ["a stream without the token", 401, get("/api/stream")],
    ["a write without the token", 401, post({ origin })],
    ["another host", 403, get("/metrics", { host: "evil.example" })],
    ["a press without the token", 401, press({ origin })],
    ["a press of another origin", 403, press({ cookie, origin: evil })],
    ["a press of no known act", 400, press({ cookie, origin }, '{"act":"pause"}')],
    ["a write of another origin", 403, post({ cookie, origin: evil })],
    ["a write without an origin", 403, post({ cookie })],
    ["a stream of another origin", 403, get("/api/stream", { cookie, origin: evil })],
    ["a list of another origin", 403, get("/api/parameters", { cookie, origin: evil })],
    ["a huge query", 400, get(`/api/stream?app=${"x".repeat(5_000)}`, { cookie })],
    ["a huge body", 413, post({ cookie, origin }, JSON.stringify({ app: "x".repeat(40_000) }))],
    ["a body that claims a role", 400, post({ cookie, origin }, '{"app":"knee.drive","undo":true,"role":"operator"}')],
    ["the metrics", 200, get("/metrics")],
  ];
  for (const [name, wanted, asked] of cases) {
    const found = await asked;
    // The server may close before it has read a long body.
    check(`${name} is answered with ${wanted}`, found === wanted || (wanted === 413 && found === 0), `${found}`);
  }
}

async function killKnee(page) {
  await page.locator("#tab-system").click();
  const text = await page.locator('.card[data-node="knee"]').textContent();
  const pid = Number(/process (\d+)/.exec(text)?.[1]);
  // Beside the page, so that the time of this program's own steps does not count.
  const seen = page.evaluate(() => new Promise((done) => {
    const look = () => {
      if (document.querySelector('.card[data-node="knee"][data-state="crashed"]')) return done(Date.now());
      setTimeout(look, 5);
    };
    look();
  }));
  const killed = Date.now();
  process.kill(pid, "SIGKILL");
  const took = (await seen) - killed;
  check("a killed node is shown as crashed in time", took <= CRASH_SEEN_MS, `${took} ms`);
  await page.locator("#tab-events").click();
  await page.locator("#event-list tr", { hasText: "is lost: crashed" }).first().waitFor({ timeout: STEP_MS });
  check("the log of events has it", true);
  await page.screenshot({ path: join(shots, "events.png"), fullPage: true });
}

async function stayOpen(page) {
  const session = await page.context().newCDPSession(page);
  const used = async () => {
    await session.send("HeapProfiler.collectGarbage");
    return (await session.send("Runtime.getHeapUsage")).usedSize;
  };
  await page.locator("#tab-plots").click();
  await page.waitForTimeout(30_000);
  const before = await used();
  await page.waitForTimeout(minutes * 60_000);
  const after = await used();
  check(`the page does not grow in ${minutes} minutes`, after < before * 1.3 + 1e6, `${before} to ${after} bytes`);
}

let browser = null;
try {
  const address = await startAll();
  browser = await playwright.launch({ executablePath: chromium, args: process.getuid() === 0 ? ["--no-sandbox"] : [] });
  const page = await browser.newPage({ viewport: { width: 1200, height: 900 } });
  const errors = [];
  page.on("console", (message) => message.type() === "error" && errors.push(message.text()));
  page.on("pageerror", (error) => errors.push(`${error}`));
  await page.goto(address);
  await seeNodes(page);
  await takeScreenshots(page);
  await useKeyboard(page);
  await plot(page);
  await setParameter(page);
  await attack(address);
  await stop(page, address);
  if (minutes > 0) await stayOpen(page);
  await killKnee(page);
  check("no errors in the console", errors.length === 0, errors.join("; "));
} catch (why) {
  check("all steps end", false, `${why.message}`);
} finally {
  await browser?.close();
  children.forEach((child) => child.kill("SIGTERM"));
  rmSync(folder, { recursive: true, force: true });
}
console.log(`screenshots: ${shots}`);
process.exit(failures === 0 ? 0 : 1);
