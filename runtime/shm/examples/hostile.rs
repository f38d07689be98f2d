//! A hostile peer that runs for any time: `cargo run --release -p sinew-shm --features hostile-peer --example
//! hostile -- [SECONDS] [SEED]`. Prints a line of figures each ten seconds. The test passes if it still runs
//! at the end.

use std::time::{Duration, Instant};

fn main() {
    let number = |index, default| {
        std::env::args()
            .nth(index)
            .map_or(default, |word| word.parse().expect("SECONDS and SEED are numbers"))
    };
    let (seconds, first_seed): (u64, u64) = (number(1, 60), number(2, 1));
    let (start, mut said, mut seed) = (Instant::now(), Instant::now(), first_seed);
    let mut all = [0_u64; 5];
    while start.elapsed() < Duration::from_secs(seconds) {
        let tally = sinew_shm::hostile::assault(seed, 50);
        let caught = tally.caught.values().sum::<u64>();
        let these = [tally.lives, tally.writes, tally.taken, tally.published, caught];
        all.iter_mut().zip(these).for_each(|(sum, count)| *sum += count);
        seed += 1;
        if said.elapsed() >= Duration::from_secs(10) {
            say(start, first_seed..seed, all);
            said = Instant::now();
        }
    }
    say(start, first_seed..seed, all);
}

fn say(start: Instant, seeds: std::ops::Range<u64>, [lives, writes, taken, published, caught]: [u64; 5]) {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap_or(" unknown").trim();
    let descriptors = std::fs::read_dir("/proc/self/fd").map_or(0, Iterator::count);
    println!(
        "{} s, seeds {seeds:?}: {lives} lives, {writes} hostile writes, {taken} messages taken, {published} published, \
         caught {caught} times; {resident} resident, {descriptors} descriptors",
        start.elapsed().as_secs()
    );
}
