//! The fate of every message between two hosts, while routers are killed and links are cut.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    thread,
    time::{Duration, Instant},
};

use sinew::Class;
use sinew_testkit::{
    NodeProcess,
    history::{Fault, History, Party, Station},
    until,
};

use crate::site::Site;

/// The stations, and the indices of their hosts.
const STATIONS: [(Station, usize); 2] = [(1, 0), (2, 2)];
/// Minimum interval between two faults.
const SPACING: Duration = Duration::from_secs(5);
/// Duration of a cut.
const CUT: Duration = Duration::from_secs(1);
/// Time for the notes of a report to arrive.
const REPORT_EVERY: Duration = Duration::from_millis(100);
/// Filler bytes of each message.
const FILLING: &str = "64";
/// Faults of the short form, and messages per second. One of twenty is confirmed.
const FAULTS: u64 = 4;
const RATE: u64 = 400;

type Shared = Arc<Mutex<History>>;

fn lock(history: &Shared) -> MutexGuard<'_, History> {
    history.lock().unwrap_or_else(PoisonError::into_inner)
}

const fn party(station: Station) -> Party {
    Party { station, incarnation: 1 }
}

/// Starts the node of a station. Its notes go to the history.
fn start(site: &Site, (station, host): (Station, usize), history: &Shared) -> NodeProcess {
    let notes = history.clone();
    let take = move |line: &str| line.parse().map(|note| lock(&notes).note(party(station), note)).is_ok();
    let peer = STATIONS.iter().find(|(other, _)| *other != station).expect("two stations").0;
    let arguments = [station.to_string(), "1".to_owned(), peer.to_string(), FILLING.to_owned()];
    let arguments: Vec<_> = arguments.iter().map(String::as_str).collect();
    let mut node = site.node_with((host, "link-node"), &arguments, take);
    node.expect("up");
    node
}

/// Waits until messages that are sent now have arrived, both ways.
fn wait_for_flow(history: &Shared) {
    for (from, to) in [(1, 2), (2, 1)] {
        let before = lock(history).last_sent(party(from), to, Class::Bulk);
        until("messages flow again", || {
            let got = lock(history).last_got(party(from), to, Class::Bulk);
            (got > before).then_some(())
        });
    }
}

fn number(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().map_or(default, |text| text.parse().expect("a number"))
}

#[test]
fn each_message_has_one_fate_while_routers_die() {
    let Some(mut site) = Site::start(Some(&"5e".repeat(32))) else { return };
    let history = Shared::default();
    let mut nodes = STATIONS.map(|station| start(&site, station, &history));
    let rate = number("SINEW_RATE", RATE);
    nodes.iter_mut().for_each(|node| node.send_line(&format!("rate {rate}")));
    wait_for_flow(&history);
    for fault in 0..number("SINEW_FAULTS", FAULTS) {
        let struck = Instant::now();
        match fault % 4 {
            0 => site.restart_router(0),
            2 => site.restart_router(1),
            _ => {
                site.hosts.take_down(0, 0);
                thread::sleep(CUT);
                site.hosts.bring_up(0, 0);
            }
        }
        wait_for_flow(&history);
        thread::sleep(SPACING.saturating_sub(struck.elapsed()));
    }
    for node in &mut nodes {
        node.send_line("quiet");
    }
    for node in &mut nodes {
        node.expect("quiet");
    }
    // A message in flight counts as lost until it arrives.
    until("no message is in flight", || {
        nodes.iter_mut().for_each(|node| node.send_line("report"));
        thread::sleep(REPORT_EVERY);
        (lock(&history).verdict().count(Fault::Lost) == 0).then_some(())
    });
    let verdict = lock(&history).verdict();
    println!("{}", verdict.json());
    assert!(verdict.holds(), "{verdict:?}");
    assert!(verdict.asked > 0 && verdict.got > 0, "{verdict:?}");
}
