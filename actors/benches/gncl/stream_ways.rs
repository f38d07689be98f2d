//! The cost of values of class Stream, by datagrams and by the connection, from one node to another.

use sinew::{Node, audit::Place};
use sinew_figures::{
    Alone, Figures,
    process::{self, Process, print_ready},
};

use crate::{
    nodes::At,
    ping::DEADLINE,
    stream_ends::{By, PERIOD, Plan, Seen, giver, taker},
};

/// Channels, each with a value a millisecond.
pub(crate) const CHANNELS: [usize; 3] = [1, 16, 64];

/// Nanoseconds that this process had a CPU, how often its threads went to sleep, and datagrams that this host has sent.
fn meter() -> [u64; 3] {
    [u64::try_from(process::cpu_time().as_nanos()).unwrap_or(u64::MAX), process::sleeps(), datagrams()]
}

/// Datagrams that this host has sent so far; 0 if the system does not report them.
fn datagrams() -> u64 {
    let snmp = std::fs::read_to_string("/proc/net/snmp").unwrap_or_default();
    let mut lines = snmp.lines().filter(|line| line.starts_with("Udp:"));
    let (Some(names), Some(counts)) = (lines.next(), lines.next()) else { return 0 };
    let mut pairs = names.split(' ').zip(counts.split(' '));
    pairs.find(|(name, _)| *name == "OutDatagrams").and_then(|(_, count)| count.parse().ok()).unwrap_or(0)
}

/// Values that newer ones replaced at a node since its start: in its send queue to the other node, and in
/// mailboxes.
fn superseded(node: &Node) -> [u64; 2] {
    let mut superseded = [0; 2];
    for entry in node.handle().audit_here().entries {
        match entry.place {
            // The other node may have left by then.
            Place::ToNode { .. } | Place::ToFormerNodes => superseded[0] += entry.account.superseded,
            Place::Mailbox { .. } => superseded[1] += entry.account.superseded,
            Place::Client { .. }
            | Place::DirectLink { .. }
            | Place::FromNode { .. }
            | Place::OtherMailboxes
            | Place::OtherClients
            | Place::OtherDirectLinks
            | Place::FromFormerNodes => {}
        }
    }
    superseded
}

/// The receiving node, in its own process: writes its results to the standard output.
pub(crate) fn take(plan: Plan, at: At) {
    let (node, seen) = taker(plan, at.node("there"), meter);
    print_ready();
    let Seen { ages, counted: [cpu_ns, sleeps, _] } =
        seen.recv_timeout(DEADLINE).expect("the last ones come");
    let [_, in_mailboxes] = superseded(&node);
    println!("{cpu_ns} {sleeps} {in_mailboxes}");
    ages.hand_over();
    node.stop();
}

/// Gives them, and prints the line.
pub(crate) fn measure(case: &str, plan: Plan) {
    let at = At::loopback();
    let role = format!("stream_take {} {} {} {}", plan.by.name(), plan.channels, plan.values, at.host(2));
    let other = Process::start(&role);
    let (node, given) = giver(plan, at.node("home"), meter);
    let [cpu_ns, sleeps, datagrams] = given.recv_timeout(DEADLINE).expect("all are given").counted;
    let said = other.wait();
    let [on_the_way, _] = superseded(&node);
    node.stop();
    let (first, ages) = said.split_once('\n').expect("it says what it has counted");
    let theirs: Vec<u64> = first.split(' ').map(number).collect();
    let [their_cpu_ns, their_sleeps, in_mailboxes] = theirs[..] else { panic!("three numbers: {first:?}") };
    let ages = Figures::taken(ages).expect("it hands over its times");
    let values = plan.channels as u64 * (plan.values + 1);
    let each = |count: u64, of: u64| count / of.max(1);
    let others = match plan.by {
        By::Datagrams => datagrams.saturating_sub(ages.rounds()),
        By::Connection => datagrams,
    };
    let seconds = PERIOD.as_secs_f64() * plan.values as f64;
    let counts = [
        ("values", values),
        ("superseded", values.saturating_sub(ages.rounds())),
        ("superseded_on_the_way_with_warm_up", on_the_way),
        ("superseded_in_mailboxes_with_warm_up", in_mailboxes),
        ("cpu_ns_each_value_there", each(their_cpu_ns, values)),
        ("cpu_ns_each_value", each(cpu_ns + their_cpu_ns, values)),
        ("sleeps_each_1000_values", each(1_000 * (sleeps + their_sleeps), values)),
        ("acks_per_s", (others as f64 / seconds) as u64),
    ];
    Alone { bench: "gncl", case, figure: "age of a value", seen: &ages, counts: &counts }.report();
}

fn number(word: &str) -> u64 {
    word.parse().expect("a number that this program wrote itself")
}
