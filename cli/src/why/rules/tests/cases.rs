//! Each possible obstacle, with its reported text and suggested fix.

use super::*;

/// A change to the facts, and the expected blocking step: its name, its detail, its suggested fix.
struct Case(fn(&mut Facts), [&'static str; 3]);

const CASES: &[Case] = &[
    Case(
        |facts| facts.ends[1] = TrafficEnd { wanted: "ankle".to_owned(), ..TrafficEnd::default() },
        ["ankle is there", "'ankle'", "sinew apps"],
    ),
    Case(
        |facts| {
            facts.ends[1] = TrafficEnd { wanted: "ankle".to_owned(), ..TrafficEnd::default() };
            let cause = "NDL node address used twice".to_owned();
            let detail = "10.0.0.9 is that of the node 'arm' at 10.0.0.9:7000; the node 'ankle' at 10.0.0.8:7000 claims it".to_owned();
            hip(facts).refusals.push(RefusalReport { cause, count: 1, detail, ago_us: 90_000_000 });
        },
        [
            "ankle is there",
            "its node was not let in 1 min 30 s ago: 10.0.0.9 is that of",
            "give node ankle another `address`",
        ],
    ),
    Case(
        |facts| {
            facts.ends[1] = TrafficEnd { wanted: "ankle".to_owned(), ..TrafficEnd::default() };
            hip(facts).peers.clear();
        },
        [
            "ankle is there",
            "hip finds no other node; it looks in 239.0.0.1:7000",
            "Does multicast pass between the hosts? `sinew doctor",
        ],
    ),
    Case(
        |facts| {
            facts.ends[1] = TrafficEnd { wanted: "ankle".to_owned(), ..TrafficEnd::default() };
            hip(facts).peers.clear();
            hip(facts).interface = "127.0.0.1".to_owned();
        },
        ["ankle is there", "hip finds no other node", "hip looks on its own host alone; set `interface`"],
    ),
    Case(
        |facts| {
            waits(facts, "ankel");
            drive(facts).report.as_mut().expect("it is there").missing[0].why =
                "not there; nearest: ankle (ready)".to_owned();
        },
        [
            "knee.drive takes messages",
            "nearest: ankle (ready)",
            "is 'ankel' misspelt in `requires`? There is ankle (ready)",
        ],
    ),
    Case(|facts| facts.ends[1].report = None, ["knee.drive is there", "cannot be asked", "--other-socket"]),
    Case(
        |facts| {
            facts.ends[0].app = Some(app("hip"));
            let tid = drive(facts).report.as_ref().expect("it is named").tid;
            let (sender, receiver) = (tid, tid);
            knee(facts).unhandled.push(UnhandledReport {
                receiver,
                sender,
                kind: sinew::message::Kind::named("demo.angle"),
                kind_name: Some("demo.angle".to_owned()),
                is_malformed: false,
                count: 7,
                ago_us: 1_000,
                remedy: "add `.handles::<Angle>()`".to_owned(),
            });
        },
        [
            "knee.drive handles what it is sent",
            "demo.angle is not handled: 7 messages, the last one 1.0 ms ago from hip",
            "handles::<Angle>",
        ],
    ),
    Case(|facts| knee(facts).stopping = true, ["knee.drive is there", "about to end", "start it"]),
    Case(
        |facts| facts.ends[1].doubles.push("node shank (process 9)".to_owned()),
        ["its address alone", "10.0.0.2 is used by node shank", "another `address`"],
    ),
    Case(
        |facts| {
            let cause = "NDL node address used twice".to_owned();
            let detail = "10.0.0.2 is at 10.0.0.2:7000; the process at 10.0.0.9:7000 claims it".to_owned();
            hip(facts).refusals.push(RefusalReport { cause, count: 4, detail, ago_us: 1_000_000 });
        },
        ["hip sees both addresses once", "10.0.0.9", "another `address`"],
    ),
    Case(
        |facts| {
            strangers(facts);
            knee(facts).project = "arm".to_owned();
        },
        ["one project", "'leg', knee.drive of 'arm'", "same `project`"],
    ),
    Case(
        |facts| {
            hip(facts).peers.clear();
            hip(facts).lost.push(lost("link down"));
        },
        ["hip knows knee.drive", "had not answered for 1.5 s, nor", "cable"],
    ),
    Case(
        |facts| {
            hip(facts).peers.clear();
            hip(facts).lost.push(lost("hung"));
        },
        ["hip knows knee.drive", "while its host did", "kill -CONT"],
    ),
    Case(
        |facts| {
            hip(facts).peers.clear();
            hip(facts).lost.push(lost("crashed"));
        },
        ["hip knows knee.drive", "its process has ended", "start it again"],
    ),
    Case(
        |facts| {
            hip(facts).peers.clear();
            hip(facts).lost.push(lost("left"));
        },
        ["hip knows knee.drive", "stopped in order", "start it again"],
    ),
    Case(
        |facts| {
            never_answered(facts);
            let project = "arm".to_owned();
            let foreign = ForeignReport {
                node: node(2),
                name: "knee".to_owned(),
                project,
                udp: String::new(),
                ago_us: 1,
            };
            hip(facts).foreign.push(foreign);
        },
        ["hip knows 10.0.0.2", "project 'arm', not 'leg'", "same `project`"],
    ),
    Case(
        never_answered,
        [
            "hip knows 10.0.0.2",
            "no datagram from it has arrived, by multicast or from a seed; hip asks 239.0.0.1:7000",
            "seeds",
        ],
    ),
    Case(
        |facts| {
            strangers(facts);
            asks(knee(facts), &["239.0.0.2:7000"]);
        },
        ["hip knows knee.drive", "the other in 239.0.0.2:7000", "same `multicast`"],
    ),
    Case(
        |facts| {
            strangers(facts);
            asks(knee(facts), &["239.0.0.2:7000"]);
            // Its version reports only one group.
            hip(facts).groups.clear();
        },
        ["hip knows knee.drive", "in the group 239.0.0.1:7000, the other in 239.0.0.2", "same `multicast`"],
    ),
    Case(
        |facts| {
            strangers(facts);
            asks(knee(facts), &[]);
        },
        ["hip knows knee.drive", "knee takes no part in multicast", "seeds = [\"10.0.0.2:7000\"]"],
    ),
    Case(
        |facts| {
            strangers(facts);
            asks(hip(facts), &["239.0.0.1:7000", "[ff12::1]:7000"]);
            asks(knee(facts), &["[ff12::1]:7000"]);
        },
        [
            "hip knows knee.drive",
            "both ask in the group [ff12::1]:7000, and it has not",
            "firewalls, IGMP and MLD",
        ],
    ),
    Case(
        |facts| {
            strangers(facts);
            asks(hip(facts), &["239.0.0.1:7000", "[ff12::1]:7000"]);
            asks(knee(facts), &["[ff12::2]:7000"]);
        },
        [
            "hip knows knee.drive",
            "239.0.0.1:7000 and [ff12::1]:7000, the other in [ff12::2]",
            "same `multicast6`",
        ],
    ),
    Case(
        |facts| {
            strangers(facts);
            asks(knee(facts), &["[ff12::1]:7000"]);
        },
        ["hip knows knee.drive", "the other in [ff12::1]:7000", "both of IPv6"],
    ),
    // Groups do not help if no datagram reaches the other node.
    Case(
        |facts| {
            strangers(facts);
            asks(knee(facts), &[]);
            knee(facts).interface = "::1".to_owned();
        },
        ["hip knows knee.drive", "its own host only", "`interface`"],
    ),
    Case(
        |facts| {
            strangers(facts);
            knee(facts).interface = "127.0.0.1".to_owned();
        },
        ["hip knows knee.drive", "its own host only", "`interface`"],
    ),
    Case(
        |facts| {
            strangers(facts);
            knee(facts).interface = "lo, ::1".to_owned();
        },
        ["hip knows knee.drive", "its own host only", "`interface`"],
    ),
    Case(
        |facts| {
            strangers(facts);
            knee(facts).interface = "lo, eth0".to_owned();
        },
        ["hip knows knee.drive", "has not heard the other", "IGMP"],
    ),
    Case(
        |facts| {
            strangers(facts);
            hip(facts).seeds.push("10.0.0.2:7000".to_owned());
        },
        ["hip knows knee.drive", "a seed names it", "firewalls"],
    ),
    Case(strangers, ["hip knows knee.drive", "has not heard the other", "IGMP"]),
    Case(
        |facts| {
            let peer = &mut hip(facts).peers[0];
            peer.links[0].is_up = false;
            peer.broken_us = Some(2_000_000);
            let (address, error) =
                ("10.0.0.2:7001".to_owned(), "Connection refused (os error 111)".to_owned());
            let fault = "refused".to_owned();
            peer.dial = Some(DialReport { address, error, fault, ago_us: 100_000, failed: 5 });
        },
        [
            "hip is connected to knee.drive",
            "control down, broken 2.0 s ago; 5 failed dials",
            "nothing listens at 10.0.0.2:7001",
        ],
    ),
    Case(
        |facts| {
            let peer = &mut hip(facts).peers[0];
            peer.links.clear();
            let (address, error) = ("10.0.0.2:7001".to_owned(), "No route to host".to_owned());
            let fault = "system".to_owned();
            peer.dial = Some(DialReport { address, error, fault, ago_us: 100_000, failed: 5 });
        },
        ["hip is connected to knee.drive", "never connected", "ip route get 10.0.0.2"],
    ),
    Case(
        |facts| {
            knee(facts).peers[0].links.clear();
            let detail = "node 10.0.0.1 says: your clock is odd".to_owned();
            let cause = "violation".to_owned();
            knee(facts).refusals.push(RefusalReport { cause, count: 1, detail, ago_us: 1_000 });
        },
        ["knee.drive is connected to hip", "your clock is odd", "log"],
    ),
    Case(
        |facts| drive(facts).report = None,
        ["knee.drive takes messages", "no such application", "sinew apps"],
    ),
    Case(
        |facts| waits(facts, "ankle"),
        ["knee.drive takes messages", "ankle (not there)", "start what it waits for: ankle"],
    ),
    Case(
        |facts| {
            waits(facts, "gait");
            facts.waits.insert("gait".to_owned(), vec!["clock".to_owned(), "knee.drive".to_owned()]);
        },
        ["knee.drive takes messages", "knee.drive -> gait -> knee.drive", "`requires`"],
    ),
    Case(
        |facts| drive(facts).line.as_mut().expect("supervised").state = "hung".to_owned(),
        ["knee.drive takes messages", "hung for", "sinew tree"],
    ),
    Case(
        |facts| {
            facts.ends[1].report = None;
            facts.shut.push("the socket /run/knee.sock does not accept this command".to_owned());
        },
        ["knee.drive is there", "/run/knee.sock does not accept this command", "is it running"],
    ),
    Case(
        |facts| facts.pings[0] = Some(Err("no answer within 2s".to_owned())),
        ["a message goes from hip to knee.drive", "no answer", "tree"],
    ),
];

#[test]
fn every_obstacle_is_reported_with_its_fix() {
    for (number, Case(change, [what, detail, fix])) in CASES.iter().enumerate() {
        let mut facts = free();
        change(&mut facts);
        let steps = judge(&facts);
        let blocked: Vec<_> = steps.iter().filter(|step| step.state == State::Blocked).collect();
        let is_it = |step: &&&Step| {
            step.what.contains(what)
                && step.detail.contains(detail)
                && step.fix.as_ref().is_some_and(|text| text.contains(fix))
        };
        assert!(blocked.iter().any(|step| is_it(&step)), "case {number}, {what}: {blocked:#?}");
    }
}
