// A page that stays open does not grow: its objects and elements after a minute, and at the end.

import { check, pause } from "./robot.mjs";

/** Growth of the heap of JavaScript after the first minute, bytes. */
const HEAP_MORE_MAX = 2_000_000;
/** Growth of the number of nodes of the document. The log of events has a bound of its own, and is left out. */
const NODES_MORE_MAX = 300;
const MINUTE_MS = 60_000;
/** Time on each tab. */
const TAB_MS = { plots: 20_000, system: 5_000, parameters: 5_000, outcomes: 5_000, events: 5_000 };

async function measure(page, session) {
  await page.locator("#tab-plots").click();
  // The second collection takes the objects of elements that the first one has freed.
  for (const ms of [1_000, 1_000]) {
    await session.send("HeapProfiler.collectGarbage");
    await pause(ms);
  }
  const { usedSize } = await session.send("Runtime.getHeapUsage");
  // All that is referred to, also where it is no part of the document any more.
  const { nodes } = await session.send("Memory.getDOMCounters");
  const logged = await page.evaluate(() => {
    const walker = document.createTreeWalker(document.querySelector("#event-list"));
    let count = 1;
    while (walker.nextNode()) count += 1;
    return count;
  });
  return { heap: usedSize, nodes: nodes - logged };
}

/** Uses all tabs until this time. */
async function use(page, end) {
  for (;;) {
    for (const [tab, ms] of Object.entries(TAB_MS)) {
      const left = end - Date.now();
      if (left <= 0) return;
      await page.locator(`#tab-${tab}`).click();
      await pause(Math.min(ms, left));
    }
  }
}

/** Keeps the page open for so many minutes. */
export async function stayOpen(page, minutes) {
  const session = await page.context().newCDPSession(page);
  await session.send("HeapProfiler.enable");
  const began = Date.now();
  await use(page, began + MINUTE_MS);
  const first = await measure(page, session);
  await use(page, began + minutes * MINUTE_MS);
  const last = await measure(page, session);
  const compare = (name, key, most) =>
    check(`${name} of a page grow by at most ${most} in ${minutes} minutes`, last[key] <= first[key] + most, `${first[key]} to ${last[key]}`);
  compare("the objects (bytes)", "heap", HEAP_MORE_MAX);
  compare("the elements", "nodes", NODES_MORE_MAX);
  await session.detach();
}
