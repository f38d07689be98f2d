//! The role of a node: a loop with a parameter, and an operator that coordinates transactions.

use std::{
    io::BufRead,
    net::{Ipv4Addr, SocketAddrV4},
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use serde_json::json;
use sinew::{
    message::Sender,
    parameters::{NamedValue, PartOutcome, TransactionReport, TransactionVerdict, Value},
    prelude::*,
};
use sinew_testkit::{
    DEADLINE,
    scripted::{sender_app, wait},
};

use super::NODES;

const PERIOD: Duration = Duration::from_millis(5);

params! {
    /// The parameter of the loop.
    struct Gains {
        /// The number of the last transaction.
        number: i64 = 0, unit "1", range 0..=1_000_000_000, keep;
    }
}

/// The value that the loop has read last, and since when.
#[derive(Default)]
struct View {
    value: AtomicU64,
    since_ns: AtomicU64,
}

struct Loop {
    gains: Arc<Gains>,
    view: Arc<View>,
}

impl Actor for Loop {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.read(context.now().as_nanos());
        context.every(PERIOD, |this, _, context| this.read(context.now().as_nanos()));
    }
}

impl Loop {
    fn read(&self, now_ns: u64) {
        let value = self.gains.number.get().unsigned_abs();
        if self.view.value.load(Ordering::SeqCst) != value {
            self.view.since_ns.store(now_ns, Ordering::SeqCst);
            self.view.value.store(value, Ordering::SeqCst);
        }
    }
}

/// `NODE ADDRESS GROUP PROJECT ACCESS`
pub(crate) fn run(arguments: &[String]) {
    let [number, address, group, project, access] = arguments else {
        panic!("five arguments, not {arguments:?}")
    };
    let address: Ipv4Addr = address.parse().expect("the scenario's address");
    let group: SocketAddrV4 = group.parse().expect("the scenario's group");
    let access = PathBuf::from(access);
    let project = format!("params-{project}");
    let builder =
        Node::builder(format!("node-{number}")).address(address.octets()).configure(move |config| {
            config.project.clone_from(&project);
            config.ndl.interface = address.into();
            (config.ndl.multicast, config.ndl.mdns_port) = (Some(group), None);
            config.ndl.period = Duration::from_millis(100);
            config.rt.probe = Duration::ZERO;
            config.security.access = Some(access.clone());
            config.state = Some(access.with_file_name("state"));
        });
    let (gains, view) = (Gains::new(), Arc::new(View::default()));
    let (shared, seen) = (gains.clone(), view.clone());
    let app = AppSpec::new(name(number), move || Loop { gains: shared.clone(), view: seen.clone() });
    let (operator, key) = sender_app(&format!("operator.{number}"));
    let builder = builder.app(app.params(&gains).own_thread()).app(operator);
    let node = builder.start().unwrap_or_else(|error| panic!("{error}"));
    node.handle().wait_until_running(DEADLINE).expect("it requires nothing");
    obey(&key.sender(), &view);
    node.stop();
}

fn name(number: impl std::fmt::Display) -> String {
    format!("loop.{number}")
}

/// Executes the orders of the scenario, and prints one line for each.
fn obey(operator: &Sender, view: &View) {
    println!("up");
    for line in std::io::stdin().lock().lines().map_while(Result::ok) {
        let words: Vec<&str> = line.split(' ').collect();
        match words[..] {
            ["look"] => {
                // The value first: it is stored last.
                let value = view.value.load(Ordering::SeqCst);
                println!("{value} {}", view.since_ns.load(Ordering::SeqCst));
            }
            ["set", value, lead_ms, within_ms] => {
                let [value, times @ ..] =
                    [value, lead_ms, within_ms].map(|word| word.parse().expect("a number"));
                let operator = operator.clone();
                // On a thread of its own: a look is answered while the transaction waits for a restarted node.
                std::thread::spawn(move || set(&operator, value, times.map(Duration::from_millis)));
            }
            _ => panic!("{line:?} is no order"),
        }
    }
}

/// Sets the parameter of all nodes as one transaction.
fn set(operator: &Sender, value: u64, [lead, within]: [Duration; 2]) {
    let value = Value::Integer(value as i64);
    let values = || vec![NamedValue { name: "number".to_owned(), value }];
    let sets = (0..NODES).map(|node| (name(node), values())).collect();
    match wait(operator.set_together(sets, lead, within)) {
        Ok(report) => print(&report),
        Err(error) => println!("{}", json!({ "verdict": "not begun", "why": error.to_string() })),
    }
}

fn print(report: &TransactionReport) {
    let verdict = match report.verdict {
        TransactionVerdict::All => "all",
        TransactionVerdict::None => "none",
        TransactionVerdict::Repaired => "repaired",
        TransactionVerdict::Mixed => "mixed",
    };
    let why: Vec<_> = report.parts.iter().map(|part| format!("{}: {:?}", part.app, part.outcome)).collect();
    let is_repaired = |node: &usize| matches!(report.parts[*node].outcome, PartOutcome::Repaired { .. });
    let repaired: Vec<_> = (0..report.parts.len()).filter(is_repaired).collect();
    println!("{}", json!({ "verdict": verdict, "repaired": repaired, "why": why.join("; ") }));
}
