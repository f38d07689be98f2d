// The parts that the tests of the page share: the walking robot, `sinew view` beside it, Chromium, and counted checks.

import { execFile, spawn } from "node:child_process";
import { existsSync, mkdtempSync, readdirSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

/** The nodes of the robot. */
export const NODES = ["ankle", "central", "hip", "knee"];
/** Time limit for each step, ms. */
export const STEP_MS = 60_000;
/** Time limit for programs to end in order, ms. */
const END_MS = 10_000;
const LOOK_MS = 50;

const programs = resolve(process.env.SINEW_PROGRAMS ?? join(dirname(fileURLToPath(import.meta.url)), "../../target/debug"));
const chromium = process.env.CHROMIUM ?? "/usr/bin/chromium";

let failures = 0;

/** Prints a claim and whether it is true. A false one makes the test fail. */
export function check(name, isSo, detail = "") {
  console.log(`${isSo ? "ok    " : "FAILED"} ${name}${detail ? `: ${detail}` : ""}`);
  failures += isSo ? 0 : 1;
}

/** Prints a figure that is not judged. */
export const tell = (name, detail) => console.log(`told   ${name}: ${detail}`);

export const pause = (ms) => new Promise((done) => setTimeout(done, ms));

/** Waits until `find` returns a value. */
export async function until(what, find, ms = STEP_MS) {
  const end = Date.now() + ms;
  for (;;) {
    const found = await find();
    if (found) return found;
    if (Date.now() > end) throw new Error(`waited ${ms} ms for ${what}`);
    await pause(LOOK_MS);
  }
}

/** Waits for a promise, with a time limit. */
export function limited(what, promise, ms = STEP_MS) {
  let timer = 0;
  const late = new Promise((_, fail) => (timer = setTimeout(() => fail(new Error(`waited ${ms} ms for ${what}`)), ms)));
  return Promise.race([promise, late]).finally(() => clearTimeout(timer));
}

/** Returns when a program first prints this text, ms of the wall clock. */
export const printed = (child, text) => new Promise((done) => {
  const look = () => child.text.includes(text) && done(Date.now());
  child.stdout.on("data", look);
  look();
});

function skip(why) {
  console.log(`skipped: ${why}`);
  process.exit(0);
}

/** Returns Chromium's driver. Ends the test with the reason where something is missing. */
async function driver() {
  for (const program of ["sinew", "exoskeleton"]) {
    const path = join(programs, program);
    if (!existsSync(path)) skip(`${path} is missing; build it, or name its folder in SINEW_PROGRAMS`);
  }
  if (!existsSync(chromium)) skip(`${chromium} is missing; install the package chromium, or name it in CHROMIUM`);
  try {
    return (await import("playwright-core")).chromium;
  } catch {
    return skip("playwright-core is missing; run `npm ci` in view/browser");
  }
}

/** The programs of one walk, and a folder for their files. */
class Stage {
  folder = mkdtempSync(join(tmpdir(), "sinew-page-"));
  children = [];
  /** The socket of central, when the robot has started. */
  socket = "";

  constructor(browser) {
    this.browser = browser;
  }

  /** The folder of the walk, with the traces of its loops. */
  get walk() {
    const runs = join(this.folder, "runs");
    return join(runs, readdirSync(runs)[0]);
  }

  start(program, words) {
    const env = { ...process.env, TMPDIR: this.folder };
    const child = spawn(join(programs, program), words, { env, stdio: ["ignore", "pipe", "pipe"] });
    Object.assign(child, { text: "", notes: "" });
    child.stdout.on("data", (data) => (child.text += data));
    child.stderr.on("data", (data) => {
      child.notes += data;
      process.stderr.write(data);
    });
    this.children.push(child);
    return child;
  }

  /** Starts the robot. Without a recording, the nodes copy messages only while a page looks. */
  async startRobot(words) {
    const robot = this.start("exoskeleton", [...words, "--no-record", "--runs", join(this.folder, "runs")]);
    const find = () => readdirSync(this.folder).find((name) => name.endsWith("-central.sock"));
    this.socket = join(this.folder, await until("the socket of central", find));
    return robot;
  }

  /** Starts `sinew view`, and returns it with the address of the page. */
  async startView() {
    const words = ["--socket", this.socket, "--json", "view", "--listen", "127.0.0.1:0"];
    // The socket may be there before its node listens.
    return until("sinew view", async () => {
      const child = this.start("sinew", words);
      await until("the page", () => child.text.includes("\n") || child.exitCode !== null);
      if (child.exitCode !== null) return null;
      return { child, address: JSON.parse(child.text.split("\n")[0]).page };
    });
  }

  /** Runs a command of `sinew` at central, and returns its exit code. */
  sinew(words) {
    const options = { env: { ...process.env, TMPDIR: this.folder }, timeout: STEP_MS };
    const all = ["--socket", this.socket, "--deadline-ms", "10000", ...words];
    return new Promise((done) => execFile(join(programs, "sinew"), all, options, (fault) => done(fault ? (fault.code ?? 1) : 0)));
  }

  async end() {
    await this.browser.close();
    const running = this.children.filter((child) => child.exitCode === null && child.signalCode === null);
    for (const child of running) child.kill("SIGTERM");
    const hasEnded = (child) => child.exitCode !== null || child.signalCode !== null;
    await until("the programs to end", () => running.every(hasEnded), END_MS).catch(() => running.forEach((child) => child.kill("SIGKILL")));
    // The nodes stop when their launcher has ended.
    const hasSocket = () => readdirSync(this.folder).some((name) => name.endsWith(".sock"));
    await until("the nodes to end", () => !hasSocket(), END_MS).catch((why) => tell("the nodes", why.message));
    if (failures > 0) {
      console.log(`traces and logs: ${this.folder}`);
    } else {
      rmSync(this.folder, { recursive: true, force: true, maxRetries: 20, retryDelay: 250 });
    }
  }
}

/** Runs a test on a stage, and ends its programs in each case. Returns whether no check has failed. */
export async function onStage(test) {
  const playwright = await driver();
  const args = process.getuid() === 0 ? ["--no-sandbox"] : [];
  const stage = new Stage(await playwright.launch({ executablePath: chromium, args, handleSIGTERM: false, handleSIGINT: false }));
  const stopped = new Promise((_, fail) => {
    for (const signal of ["SIGTERM", "SIGINT"]) process.once(signal, () => fail(new Error(`stopped by ${signal}`)));
  });
  try {
    await Promise.race([test(stage), stopped]);
  } catch (why) {
    check("all steps end", false, `${why.message}`);
  }
  await stage.end();
  return failures === 0;
}
