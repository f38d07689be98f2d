// The cost of open pages for the robot: walks with 0, 1 and 5 pages in turns, and what the robot reports on each.
//
//   npm ci && node cost.mjs [--rounds N] [--strides N] [--tab plots|system]
//
// It needs what page.test.mjs needs, a release build in SINEW_PROGRAMS, and a machine without other load. Nothing is
// recorded, so the nodes copy messages for the pages alone. Pages on the tab Plots plot a torque of the knee.

import { readFileSync } from "node:fs";
import { join } from "node:path";
import { parseArgs } from "node:util";

import { latenessOfEach, now } from "./lateness.mjs";
import { STEP_MS, onStage, until } from "./robot.mjs";

const PAGES = [0, 1, 5];
/** Time limit for a stride, ms. */
const STRIDE_MS = 4_000;
/** The exit codes of a walk that reached its last stride. */
const WALKED = [0, 3, 4];
/** Ticks of a second in /proc. */
const HZ = 100;

const { values: options } = parseArgs({
  options: {
    rounds: { type: "string", default: "2" },
    strides: { type: "string", default: "40" },
    tab: { type: "string", default: "plots" },
  },
});
const [rounds, strides] = [Number(options.rounds), Number(options.strides)];
if (!(rounds >= 1 && strides >= 8 && ["plots", "system"].includes(options.tab))) {
  console.error("--rounds has to be at least 1, --strides at least 8, and --tab plots or system");
  process.exit(2);
}

async function openPage(stage, address) {
  // A browser opens six connections to a host for all pages of a context.
  const page = await (await stage.browser.newContext()).newPage();
  await page.goto(address);
  if (options.tab === "system") return;
  await page.locator("#tab-plots").click();
  await page.locator('#plot-apps button[data-key="knee.drive"]').click();
  const field = page.locator('#messages button.field[data-key^="knee.sensor\t"][data-key$="\ttorque_nm"]').first();
  await field.click({ timeout: STEP_MS });
}

/** Returns the CPU seconds that a process has used. */
function cpuSeconds(pid) {
  const fields = readFileSync(`/proc/${pid}/stat`, "utf8").split(") ")[1].split(" ");
  return (Number(fields[11]) + Number(fields[12])) / HZ;
}

/** Walks beside so many pages, and returns the cells of a row. */
async function walk(pages) {
  let cells = null;
  const isFine = await onStage(async (stage) => {
    const file = join(stage.folder, "report.json");
    const robot = await stage.startRobot(["--strides", `${strides}`, "--report", file]);
    const view = await stage.startView();
    const [began, from] = [Date.now(), now()];
    for (let page = 0; page < pages; page += 1) await openPage(stage, view.address);
    await until("the end of the walk", () => robot.exitCode !== null, STEP_MS + strides * STRIDE_MS);
    const viewPercent = (100_000 * cpuSeconds(view.child.pid)) / (Date.now() - began);
    if (!WALKED.includes(robot.exitCode)) throw new Error(`the robot did not walk: exit code ${robot.exitCode}`);
    const { verdict, real_time: found } = JSON.parse(readFileSync(file, "utf8"));
    const late = ({ p50, p99, p999, max }) => `${p50} / ${p99} / ${p999} / ${max}`;
    const each = Object.entries(found.cpu_percent).map(([name, share]) => `${name} ${share.toFixed(0)}`);
    const ofEach = latenessOfEach(stage.walk, from, now()).map(([name, { p50, p99, max }]) => `${name} ${p50} / ${p99} / ${max}`);
    cells = [
      pages, late(found.drives.lateness_us), late(found.central_late_us), late(found.plant_late_us), ofEach.join(", "), found.drives.deadline_misses,
      `${found.cpu_percent_total.toFixed(0)} (${each.join(", ")})`, viewPercent.toFixed(1),
      found.host.others_cpu_percent?.toFixed(0) ?? "?", found.host.stalls.length, verdict,
    ];
  });
  return isFine ? cells : null;
}

const HEADING = [
  "pages", "drives late, us: p50 / p99 / p99.9 / max", "central late, us", "plant late, us", "each loop late, us: p50 / p99 / max", "ticks over 2 ms late",
  "CPU of the robot, % of one", "CPU of sinew view, % of one", "all other programs, % of all CPUs", "stalls of the host", "verdict",
];
const rows = [];
for (let round = 0; round < rounds; round += 1) {
  for (const pages of PAGES) {
    const cells = await walk(pages);
    if (cells === null) process.exit(1);
    rows.push(cells);
    console.log(`walked beside ${pages} pages`);
  }
}
const line = (cells) => `| ${cells.join(" | ")} |`;
console.log(["", line(HEADING), line(HEADING.map(() => "---")), ...rows.map(line)].join("\n"));
