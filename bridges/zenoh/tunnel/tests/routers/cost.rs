//! The cost of a host at rest, among others over a tree of routers: CPU time, memory, threads, descriptors.

use std::{fs, thread, time::Duration};

use sinew_testkit::{Hosts, NodeProcess, Resources, TestDirectory};

use crate::site::{configuration, device, router, scenarios, tunnel};

/// Hosts with a node, unless `SINEW_HOSTS` says otherwise; at most 200.
const HOSTS: u8 = 8;
/// Routers, in a binary tree: the first one is its root.
const ROUTERS: u8 = 3;
/// Time for which all are at rest and CPU time is measured.
const MEASURED: Duration = Duration::from_secs(20);
/// Unit of CPU time in `/proc/PID/stat`, the same on each Linux (`USER_HZ`).
const TICKS_PER_SECOND: u64 = 100;

/// CPU time of a process since its start, in ticks.
fn ticks(process: &NodeProcess) -> u64 {
    let stat = fs::read_to_string(format!("/proc/{}/stat", process.id())).expect("it runs");
    // The name of the program is in parentheses, and may contain blanks.
    let (_, fields) = stat.rsplit_once(") ").expect("the name ends");
    let fields: Vec<_> = fields.split_whitespace().collect();
    // Fields 14 and 15 of proc(5): user and system time. The third one is the first here.
    [11, 12].map(|at| fields[at].parse::<u64>().expect("a number")).iter().sum()
}

/// Prints one line: the means over all processes of one kind.
fn report(kind: &str, processes: &[NodeProcess], before: &[u64]) {
    let count = processes.len() as u64;
    let spent: u64 = processes.iter().zip(before).map(|(process, before)| ticks(process) - before).sum();
    let held: Vec<_> = processes.iter().map(|process| Resources::of(process.id())).collect();
    let mean = |of: fn(&Resources) -> u64| held.iter().map(of).sum::<u64>() / count;
    println!(
        "{kind:>12} {count:>4}: {:>6.2} % of a CPU {:>7} KiB resident {:>3} threads {:>4} descriptors",
        spent as f64 * 100.0 / (count * TICKS_PER_SECOND) as f64 / MEASURED.as_secs_f64(),
        mean(|held| held.resident_kib),
        mean(|held| held.threads),
        mean(|held| held.descriptors as u64),
    );
}

#[test]
#[ignore = "a measurement: SINEW_HOSTS=30 cargo test .. -- --ignored --nocapture"]
fn cost_of_a_host_among_others() {
    let wanted = std::env::var("SINEW_HOSTS").map_or(HOSTS, |text| text.parse().expect("a number"));
    let Some(scenarios) = scenarios() else { return };
    let made = Hosts::new(wanted.min(200) + ROUTERS);
    let Ok(hosts) = made.inspect_err(|why| println!("skipped: no hosts can be made here: {why}")) else {
        return;
    };
    let directory = TestDirectory::new();
    let (members, tree) = hosts.all().split_at(usize::from(wanted.min(200)));
    let endpoint = |router: usize| format!("tcp/{}:7447", tree[router].address);
    let routers: Vec<_> = (0..tree.len())
        .map(|index| router(&tree[index], index.checked_sub(1).map(|above| endpoint(above / 2)).as_deref()))
        .collect();
    let key = "5e".repeat(32);
    let mut tunnels = Vec::new();
    for (index, host) in members.iter().enumerate() {
        device(host, index).expect("a TUN device");
        let nearest = [endpoint(index % tree.len())];
        let mut process = tunnel((host, index), &directory, Some(&key), &nearest);
        process.wait_for(&["carries 10.99.0."]);
        tunnels.push(process);
    }
    let start = |(index, host): (usize, &sinew_testkit::Host)| {
        let mut command = host.command(&scenarios);
        let config = configuration(&directory, &format!("node-{index}"), index);
        command.args(["--role", "node_under_test"]).arg(config);
        NodeProcess::start(&format!("node-{index}"), command)
    };
    let mut nodes: Vec<_> = members.iter().enumerate().map(start).collect();
    for node in &mut nodes {
        (1..members.len()).for_each(|_| drop(node.wait_for(&["NodeFound"])));
    }
    let kinds = [("router", &routers), ("sinew-zenoh", &tunnels), ("node", &nodes)];
    let before = kinds.map(|(_, processes)| processes.iter().map(ticks).collect::<Vec<_>>());
    thread::sleep(MEASURED);
    for ((kind, processes), before) in kinds.into_iter().zip(&before) {
        report(kind, processes, before);
    }
}
