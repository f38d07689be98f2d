// Lateness of the robot's loops within a time, from the traces that its processes write: a row for each tick.

import { readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";

const DRIVES = ["hip", "knee", "ankle"];
/** The number of the state in which a drive assists. */
const WALK = "2";

/** Returns the time of the host's monotonic clock, ns. */
export const now = () => Number(process.hrtime.bigint());

function* rows(walk, name, from, to) {
  const files = readdirSync(walk).filter((file) => new RegExp(`^${name}-\\d+\\.csv$`).test(file));
  for (const file of files) {
    const [heading, ...lines] = readFileSync(join(walk, file), "utf8").split("\n");
    const columns = heading.split(",");
    const [t, late, state] = ["t_ns", "late_us", "state"].map((column) => columns.indexOf(column));
    // The last line may be cut.
    for (const line of lines.slice(0, -1)) {
      const cells = line.split(",");
      const at = Number(cells[t]);
      if (at >= from && at < to) yield { late: Number(cells[late]), state: cells[state] };
    }
  }
}

function figures(found) {
  const late = found.map((row) => row.late).sort((one, other) => one - other);
  const at = (share) => late[Math.min(late.length - 1, Math.floor(late.length * share))];
  return { ticks: late.length, p50: at(0.5), p99: at(0.99), max: late.at(-1) };
}

/** Returns the lateness of the drives and of central, us, and the share of the drives' ticks that assist. */
export function lateness(walk, from, to) {
  const drives = DRIVES.flatMap((name) => [...rows(walk, name, from, to)]);
  const central = [...rows(walk, "central", from, to)];
  if (drives.length === 0 || central.length === 0) throw new Error(`no ticks in the traces of ${walk}; did the robot walk?`);
  const assisting = drives.filter((row) => row.state === WALK).length / drives.length;
  return { drives: figures(drives), central: figures(central), assisting };
}

/** Returns the lateness of each loop, us, by its node. */
export function latenessOfEach(walk, from, to) {
  return [...DRIVES, "central"].map((name) => [name, figures([...rows(walk, name, from, to)])]);
}

/** Returns the lateness as text. */
export function inWords({ drives, central, assisting }) {
  const each = ({ p50, p99, max }) => `${p50} / ${p99} / ${max} us`;
  return `drives ${each(drives)}, central ${each(central)} (p50 / p99 / max); ${(100 * assisting).toFixed(0)} % of ticks assist`;
}
