//! Every state of a child, with every input: the new state and the orders, as the file `table.txt`.
//!
//! The child has a sibling on each side, so that the table shows the siblings that its end affects. A change
//! of behaviour shows as a difference; `SINEW_WRITE_TABLE=1 cargo test -p sinew-runtime table` writes the
//! file anew, for review.

use std::time::Duration;

use super::*;

const FILE: &str = "src/supervision/core/table.txt";
const WRITE_VARIABLE: &str = "SINEW_WRITE_TABLE";
/// The child of the table, between its siblings 0 and 2.
const CHILD: ChildId = ChildId(1);
/// The deadline of every state that has one is later than this, except where time passes.
const NOW: Time = Time::from_nanos(1_000_000_000);
const LATER: Time = Time::from_nanos(60_000_000_000);

#[test]
fn every_state_answers_every_input_as_in_the_table() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(FILE);
    let table = table();
    if std::env::var_os(WRITE_VARIABLE).is_some() {
        std::fs::write(&path, &table).expect("the source tree can be written");
    }
    let golden = std::fs::read_to_string(&path).expect("the table is in the source tree");
    let differences: String = golden
        .lines()
        .zip(table.lines())
        .filter(|(then, now)| then != now)
        .map(|(then, now)| format!("\n- {then}\n+ {now}"))
        .collect();
    assert!(differences.is_empty(), "the table has changed:{differences}");
    assert_eq!(golden.lines().count(), table.lines().count(), "the table has another length");
}

fn table() -> String {
    let mut table = String::from("# strategy, restart type: state + input -> state of the child: orders\n");
    for strategy in [Strategy::OneForOne, Strategy::RestForOne, Strategy::OneForAll] {
        for restart in [Restart::Permanent, Restart::Transient, Restart::Temporary] {
            for (state, reach) in STATES {
                if restart == Restart::Temporary && matches!(*state, "terminated" | "backing off") {
                    // It is forgotten instead.
                    continue;
                }
                for (input, at, event) in inputs() {
                    let mut core = reach(strategy, restart);
                    drain(&mut core);
                    core.handle(at, event);
                    let (after, orders) = (word(&core), drain(&mut core).join(", "));
                    let line = format!("{strategy:?} {restart:?}: {state} + {input} -> {after}: {orders}");
                    table.push_str(line.trim_end());
                    table.push('\n');
                }
            }
        }
    }
    table
}

type Reach = fn(Strategy, Restart) -> Core;

const STATES: &[(&str, Reach)] = &[
    ("not started", fresh),
    ("held", held),
    ("starting", starting),
    ("ready", ready),
    ("backing off", backing_off),
    ("stopping", stopping),
    ("terminated", terminated),
    ("ending", ending),
    ("ended", ended),
];

fn inputs() -> Vec<(&'static str, Time, Input)> {
    let panic = || Reason::Panic("oh".into());
    vec![
        ("Started", NOW, Input::Started),
        ("Released", NOW, Input::Released(CHILD)),
        ("BecameReady", NOW, Input::BecameReady(CHILD, 1)),
        ("BecameReady, an earlier generation", NOW, Input::BecameReady(CHILD, 0)),
        ("Hung", NOW, Input::Hung(CHILD, 1, Reason::Hung("busy".into()))),
        ("Ended, normal", NOW, Input::Ended(CHILD, 1, Reason::Normal)),
        ("Ended, panic", NOW, Input::Ended(CHILD, 1, panic())),
        ("Ended, thread", NOW, Input::Ended(CHILD, 1, Reason::ThreadEnded)),
        ("Ended, an earlier generation", NOW, Input::Ended(CHILD, 0, panic())),
        ("DeadlineExtended", NOW, Input::DeadlineExtended(CHILD, 1, LATER + Duration::from_nanos(1))),
        ("TimePassed, too early", NOW, Input::TimePassed),
        ("TimePassed, late", LATER, Input::TimePassed),
        ("StopOrdered", NOW, Input::StopOrdered),
        ("AddChild, another", NOW, Input::AddChild(ChildId(9), Policy::default())),
        ("AddChild, the same", NOW, Input::AddChild(CHILD, Policy::default())),
        ("TerminateChild", NOW, Input::TerminateChild(CHILD)),
        ("RestartChild", NOW, Input::RestartChild(CHILD)),
        ("DeleteChild", NOW, Input::DeleteChild(CHILD)),
    ]
}

fn drain(core: &mut Core) -> Vec<String> {
    let text = |order: Order| {
        // The words of giving up are for people.
        if let Order::Ended(Reason::GaveUp(_)) = order {
            return "Ended GaveUp".to_owned();
        }
        format!("{order:?}").replace("ChildId(", "#").replace(')', "").replace('(', " ").replace("# ", "#")
    };
    std::iter::from_fn(|| core.poll()).map(text).collect()
}

fn word(core: &Core) -> &'static str {
    match core.child(CHILD) {
        None => "forgotten",
        Some(child) => match child.state {
            ChildState::Down if child.waits_for_release => "held",
            ChildState::Down if child.wanted => "down, to be started",
            ChildState::Down => "down",
            ChildState::BackingOff(_) => "backing off",
            ChildState::Starting(_) => "starting",
            ChildState::Ready => "ready",
            ChildState::Stopping(_) => "stopping",
        },
    }
}

fn with(strategy: Strategy, policy: Policy) -> Core {
    let sibling =
        |id| (ChildId(id), Policy { start_within: Duration::from_secs(3_600), ..Policy::default() });
    let policy = Policy { backoff_min: Duration::from_secs(2), ..policy };
    Core::new(strategy.into(), 0, vec![sibling(0), (CHILD, policy), sibling(2)])
}

fn fresh(strategy: Strategy, restart: Restart) -> Core {
    with(strategy, Policy { restart, ..Policy::default() })
}

fn held(strategy: Strategy, restart: Restart) -> Core {
    let mut core = with(strategy, Policy { restart, held: true, ..Policy::default() });
    core.handle(NOW, Input::Started);
    core.handle(NOW, Input::BecameReady(ChildId(0), 1));
    core
}

fn starting(strategy: Strategy, restart: Restart) -> Core {
    let mut core = fresh(strategy, restart);
    core.handle(NOW, Input::Started);
    core.handle(NOW, Input::BecameReady(ChildId(0), 1));
    core
}

fn ready(strategy: Strategy, restart: Restart) -> Core {
    let mut core = starting(strategy, restart);
    core.handle(NOW, Input::BecameReady(CHILD, 1));
    core.handle(NOW, Input::BecameReady(ChildId(2), 1));
    core
}

fn backing_off(strategy: Strategy, restart: Restart) -> Core {
    let mut core = ready(strategy, restart);
    core.handle(NOW, Input::Ended(CHILD, 1, Reason::Panic("oh".into())));
    for sibling in [2, 0] {
        // Of no effect where the strategy leaves them alone: they are stopped only with their group.
        if matches!(core.child(ChildId(sibling)).map(|child| child.state), Some(ChildState::Stopping(_))) {
            core.handle(NOW, Input::Ended(ChildId(sibling), 1, Reason::Normal));
        }
    }
    core
}

fn stopping(strategy: Strategy, restart: Restart) -> Core {
    let mut core = ready(strategy, restart);
    core.handle(NOW, Input::TerminateChild(CHILD));
    core
}

fn terminated(strategy: Strategy, restart: Restart) -> Core {
    let mut core = stopping(strategy, restart);
    core.handle(NOW, Input::Ended(CHILD, 1, Reason::Normal));
    core
}

fn ending(strategy: Strategy, restart: Restart) -> Core {
    let mut core = ready(strategy, restart);
    core.handle(NOW, Input::StopOrdered);
    core
}

fn ended(strategy: Strategy, restart: Restart) -> Core {
    let mut core = ending(strategy, restart);
    for child in [2, 1, 0] {
        core.handle(NOW, Input::Ended(ChildId(child), 1, Reason::Normal));
    }
    core
}
