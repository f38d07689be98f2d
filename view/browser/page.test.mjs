// Opens the page of `sinew view` in Chromium, beside the walking robot of the example: four nodes of this host.
//
//   npm ci && node page.test.mjs [--short] [--minutes N]
//
// It needs the programs `sinew` and `exoskeleton` in target/debug, or in the folder of the variable SINEW_PROGRAMS, and
// Chromium at /usr/bin/chromium, or at the path of the variable CHROMIUM. Without them it says so and ends with 0.
// Times and torques are judged, so it needs an idle machine and a release build. The short form is for any machine: it
// judges no times, and leaves out torques and attacks that take minutes. With --minutes the page stays open for so long,
// and must not grow.

import { mkdtempSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { parseArgs } from "node:util";

import { attack } from "./attack.mjs";
import { NODES, STEP_MS, check, limited, onStage, printed, tell, until } from "./robot.mjs";
import { torqueChanges } from "./torque.mjs";
import { stayOpen } from "./growth.mjs";

const CRASH_SEEN_MS = 1_000;
/** The stride with which the knee is killed: the least one that the robot takes. */
const KILL_STRIDE = 8;
const KILLED = "knee is killed";

const { values: options } = parseArgs({ options: { short: { type: "boolean", default: false }, minutes: { type: "string", default: "0" } } });
const minutes = Number(options.minutes);
if (!(minutes === 0 || minutes >= 2)) {
  console.error("--minutes has to be a number of at least 2: the page is measured after one minute, and at the end");
  process.exit(2);
}
const shots = mkdtempSync(join(tmpdir(), "sinew-page-shots-"));
const shot = (page, name) => page.screenshot({ path: join(shots, `${name}.png`), fullPage: true });

async function seeNodes(page) {
  const isGreen = (names) => names.every((name) => document.querySelector(`.card.good[data-node="${name}"][data-state="up"]`));
  await page.waitForFunction(isGreen, NODES, { timeout: STEP_MS });
  check("four nodes are up and green", true, NODES.join(", "));
  check("the token is not left in the address", !page.url().includes("token"), page.url());
  await page.waitForFunction(() => document.querySelectorAll("#map .link.up").length >= 6, null, { timeout: STEP_MS });
  check("the map shows the links", true);
}

/** Waits for the kill of the knee, which the launcher starts again. */
async function killKnee(page, robot) {
  if (robot.text.includes(KILLED)) throw new Error("the knee was killed before the page showed four nodes: this machine is too slow for that");
  // Beside the page, so that the time of this program's own steps does not count.
  const seen = page.evaluate(() => new Promise((done) => {
    const look = () => {
      if (document.querySelector('.card[data-node="knee"][data-state="crashed"]')) return done(Date.now());
      setTimeout(look, 5);
    };
    look();
  }));
  // Without the kill nothing waits for it.
  seen.catch(() => {});
  // The line is printed after the kill, within milliseconds.
  const killed = await limited("the kill of the knee", printed(robot, KILLED));
  const took = (await limited("the page to show the crash", seen)) - killed;
  const name = `a killed node is shown as crashed within ${CRASH_SEEN_MS} ms`;
  if (options.short) tell(name, `${took} ms`);
  else check(name, took <= CRASH_SEEN_MS, `${took} ms`);
  await shot(page, "crashed");
  await page.locator('.card[data-node="knee"][data-state="up"]').first().waitFor({ timeout: STEP_MS });
  check("the node that was started again is up", true);
  await page.locator("#tab-events").click();
  await page.locator("#event-list tr", { hasText: "is lost: crashed" }).first().waitFor({ timeout: STEP_MS });
  check("the log of events has the crash", true);
  await shot(page, "events");
  await page.locator("#tab-system").click();
}

async function takeScreenshots(page) {
  const backs = [];
  for (const scheme of ["light", "dark"]) {
    await page.emulateMedia({ colorScheme: scheme });
    await shot(page, scheme);
    backs.push(await page.evaluate(() => getComputedStyle(document.body).backgroundColor));
  }
  check("light and dark differ", backs[0] !== backs[1], backs.join(", "));
  await page.emulateMedia({ colorScheme: "light" });
  await page.setViewportSize({ width: 390, height: 844 });
  for (const tab of ["system", "plots", "parameters", "outcomes", "events"]) {
    await page.locator(`#tab-${tab}`).click();
    await page.waitForTimeout(300);
    const [wide, window] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
    check(`the tab ${tab} fits a phone`, wide <= window, `${wide} of ${window}`);
    check(`the stop is visible on the tab ${tab} of a phone`, await isInWindow(page, "#stop-press"));
    await shot(page, `phone-${tab}`);
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
  const points = () => page.evaluate(() => Number(document.querySelector("figure.chart").dataset.points));
  const [one, other] = [await points(), (await page.waitForTimeout(1_000), await points())];
  check("a chosen field is plotted", other !== one, `${one}, a second later ${other} points`);
  await shot(page, "plots");
}

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
  const text = await outcome.textContent();
  check("a moved slider is applied at a tick", /knee\.drive: assistance = .* at tick \d+/.test(text), text);
  await page.waitForFunction(() => !document.querySelector('[data-undo="knee.drive"]').disabled, null, { timeout: STEP_MS });
  check("a set keeps what is written beside it", (await other.inputValue()) === written, written);
  await page.locator('[data-undo="knee.drive"]').click();
  await page.locator("#parameter-outcome", { hasText: `= ${before}` }).waitFor({ timeout: STEP_MS });
  check("undo gives the former value", true, await outcome.textContent());
  await shot(page, "parameters");
}

/** Waits until all nodes have confirmed the stop, and shows their times. */
async function confirmed(page, name) {
  const all = (count) => {
    const cells = [...document.querySelectorAll("#stop-nodes tbody tr")].map((row) => row.cells);
    const isTime = (text) => /^\d+\.\d ms$/.test(text);
    return cells.length === count && cells.every((row) => isTime(row[2].textContent)) && cells.map((row) => `${row[0].textContent} ${row[2].textContent}`);
  };
  const rows = await page.waitForFunction(all, NODES.length, { timeout: STEP_MS });
  check(name, true, (await rows.jsonValue()).join(", "));
}

const stateIs = (page, text) => page.locator("#stop-state", { hasText: text }).waitFor({ timeout: STEP_MS });
const isAnyLive = () => document.querySelector("#outputs").textContent.includes("live");
const anyLive = (page, wanted) => until(`outputs ${wanted ? "" : "not "}to be live`, async () => (await page.evaluate(isAnyLive)) === wanted);

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

async function stop(page, address) {
  await page.locator("#tab-system").click();
  await stateIs(page, "running");
  await anyLive(page, true);
  check("the stop is visible beside a long page", await isInWindow(page, "#stop-press"));
  await page.locator("#stop-press").click();
  await stateIs(page, "STOPPED by");
  await confirmed(page, "a click stops the walking robot: four confirmations");
  await anyLive(page, false);
  check("no output is live", true);
  await shot(page, "stop");
  await release(page);
  await page.waitForTimeout(1_000);
  check("no output is live after the release", !(await page.evaluate(isAnyLive)));
  await stopElsewhere(page, address);
  await page.locator("#tab-events").click();
  await page.locator("#event-list tr", { hasText: "4 of 4 nodes have confirmed" }).first().waitFor({ timeout: STEP_MS });
  check("the log of events has the press", true);
}

/** Presses on a phone by touch: the first page shows it. Then presses once more by the keyboard. */
async function stopElsewhere(page, address) {
  const phone = await page.context().browser().newContext({ hasTouch: true, viewport: { width: 390, height: 844 } });
  const other = await phone.newPage();
  await other.goto(address);
  await stateIs(other, "running");
  await other.locator("#stop-press").tap();
  await confirmed(other, "a touch stops: four confirmations");
  await shot(other, "phone-stop");
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

/** Resets the stop and lets the leg walk, as the person at central does. A drive that is not at rest yet refuses. */
async function walkAgain(page, stage) {
  await page.locator("#tab-system").click();
  const orders = [["central.gait", "exo.reset"], ["exo.stop", "exo.reset"], ["central.gait", "exo.release"]];
  await until("all parts to be reset", async () => {
    for (const order of orders) {
      if ((await stage.sinew(["send", ...order])) !== 0) return false;
    }
    return true;
  });
  await anyLive(page, true);
  check("the outputs are live after reset and release by the person at central", true);
}

const isFine = await onStage(async (stage) => {
  const context = await stage.browser.newContext({ viewport: { width: 1200, height: 900 } });
  const page = await context.newPage();
  const errors = [];
  page.on("console", (message) => message.type() === "error" && errors.push(message.text()));
  page.on("pageerror", (error) => errors.push(`${error}`));
  const strides = Math.ceil(300 + 60 * minutes);
  const robot = await stage.startRobot(["--strides", `${strides}`, "--kill", `knee@${KILL_STRIDE}`]);
  const view = await stage.startView();
  await page.goto(view.address);
  await seeNodes(page);
  await killKnee(page, robot);
  await takeScreenshots(page);
  await useKeyboard(page);
  await plot(page);
  await setParameter(page);
  if (!options.short) await torqueChanges(page);
  await attack(stage, { view, page, isShort: options.short });
  if (minutes > 0) await stayOpen(page, minutes);
  await stop(page, view.address);
  await walkAgain(page, stage);
  check("no errors in the console", errors.length === 0, errors.join("; "));
});
console.log(`screenshots: ${shots}`);
process.exit(isFine ? 0 : 1);
