// The assistance of a drive is set to zero by its slider: the torque of its device changes over the whole stride.

import { STEP_MS, check } from "./robot.mjs";

/** The joint with the greatest moment. */
const JOINT = "ankle";
/** Two strides. */
const LOOK_MS = 2_800;
/** A set moves the assistance by at most 0.5 in a second, and a device follows within milliseconds. */
const SLOPE_MS = 1_500;
/** Parts of a stride that are compared. */
const PARTS = 20;
/** Mean change of the torque beyond which it has changed, Nm. */
const CHANGE_MIN_NM = 1;
/** A change is so many times the difference between two strides before it. */
const CHANGE_FACTOR = 2;

/** Reads points of two fields by a stream of the page: lists of time and value. */
const collect = (page, keys) => page.evaluate(([app, series, ms]) => new Promise((done) => {
  const query = [`app=${app}`, ...series.map((key) => `series=${encodeURIComponent(key)}`)].join("&");
  const points = series.map(() => []);
  const stream = new EventSource(`/api/stream?${query}`);
  stream.addEventListener("points", (event) => {
    for (const part of JSON.parse(event.data)) part.t.forEach((t, place) => points[part.series].push([t, part.v[place]]));
  });
  setTimeout(() => {
    stream.close();
    done(points);
  }, ms);
}), [`${JOINT}.drive`, keys, LOOK_MS]);

/** Returns the mean torque in each part of a stride; null for a part without any. */
function curve([torques, phases]) {
  const parts = Array.from({ length: PARTS }, () => []);
  let place = 0;
  for (const [t, torque] of torques) {
    while (place + 1 < phases.length && phases[place + 1][0] <= t) place += 1;
    const phase = phases[place]?.[1] ?? null;
    if (torque !== null && phase !== null) parts[Math.min(PARTS - 1, Math.floor(phase * PARTS))].push(torque);
  }
  return parts.map((all) => (all.length === 0 ? null : all.reduce((sum, one) => sum + one, 0) / all.length));
}

/** Returns the mean difference of two curves, Nm. */
function difference(one, other) {
  const each = one.flatMap((value, place) => (value === null || other[place] === null ? [] : [Math.abs(value - other[place])]));
  if (each.length < PARTS / 2) throw new Error(`only ${each.length} of ${PARTS} parts of a stride have a torque; does the robot walk?`);
  return each.reduce((sum, value) => sum + value, 0) / each.length;
}

/** Returns the key of a field of the drive's messages, as the tab Plots has it. */
async function key(page, source, field) {
  const button = page.locator(`#messages button.field[data-key^="${source}\t${JOINT}.drive\t"][data-key$="\t${field}"]`).first();
  await button.waitFor({ timeout: STEP_MS });
  return button.getAttribute("data-key");
}

async function set(page, act) {
  await page.locator("#tab-parameters").click();
  await act(page.locator(`[data-app="${JOINT}.drive"]`));
  await page.locator("#parameter-outcome", { hasText: `${JOINT}.drive: assistance` }).waitFor({ timeout: STEP_MS });
  await page.waitForTimeout(SLOPE_MS);
}

/** Moves the assistance to zero and back. Drives on a busy machine pause often, so that their torque cannot be judged. */
export async function torqueChanges(page) {
  await page.locator("#tab-plots").click();
  await page.locator(`#plot-apps button[data-key="${JOINT}.drive"]`).click();
  const assists = page.locator(`#messages button.field[data-key^="${JOINT}.drive\t"][data-key$="\tstate"] output`, { hasText: /^2$/ });
  await assists.first().waitFor({ timeout: STEP_MS });
  await page.waitForTimeout(SLOPE_MS);
  const keys = [await key(page, `${JOINT}.sensor`, "torque_nm"), await key(page, "central.gait", "phase")];
  const [one, other] = [curve(await collect(page, keys)), curve(await collect(page, keys))];
  await set(page, async (app) => {
    await app.locator('input[data-slider="assistance"]').focus();
    await page.keyboard.press("Home");
  });
  const without = curve(await collect(page, keys));
  await set(page, async (app) => {
    await app.locator(`[data-undo="${JOINT}.drive"]`).click();
  });
  const [usual, change] = [difference(one, other), difference(other, without)];
  const detail = `by ${change.toFixed(1)} Nm on average; from stride to stride by ${usual.toFixed(1)} Nm`;
  check("a moved slider changes the torque", change >= CHANGE_MIN_NM && change >= CHANGE_FACTOR * usual, detail);
  await page.locator("#tab-plots").click();
  await page.locator(`#plot-apps button[data-key="${JOINT}.drive"]`).click();
}
