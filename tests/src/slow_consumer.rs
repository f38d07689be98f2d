//! The claim: an application that is too slow for the messages of another node costs a bounded amount of
//! memory, and does not affect the others.
//!
//! The first node sends Bulk at a rate to a consumer on the second, and a request
//! at 1 kHz to an application beside it. There are three phases: without Bulk, with a fast consumer, and with
//! a slow one.
//!
//! | file | content |
//! | --- | --- |
//! | `sender` | the role of the first node |
//! | `receiver` | the role of the second node |
//! | `report` | the results |

mod receiver;
mod report;
mod sender;

use sinew_testkit::NodeProcess;
use sinew_testkit::Resources;
use sinew_testkit::numbers;
use std::time::{Duration, Instant};

pub use self::report::{Report, Window};
use crate::role;
use sinew_testkit::{DEADLINE, TestDirectory, own_group};

/// Maximum time for which the consumer stays slow beyond [`Plan::lasts`], until enough messages were offered.
const OFFERED_WITHIN: Duration = DEADLINE.saturating_mul(3);
/// Memory of the sender other than messages: reserves of the allocator, threads, tables.
const SLACK_BYTES: u64 = 8 << 20;

/// The parameters of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Duration of the slow phase. It is extended until more was offered than both nodes may hold.
    pub lasts: Duration,
    /// Bulk messages per second that are offered.
    pub rate: u64,
    /// Length of each message, in bytes.
    pub length: usize,
    /// Processing time per message of a slow consumer.
    pub takes: Duration,
    /// Duration of each of the two references: no Bulk, and a fast consumer.
    pub reference: Duration,
}

/// Runs the role of the first node.
pub(crate) fn run_sender(arguments: &[String]) {
    sender::run(arguments);
}

/// Runs the role of the second node.
pub(crate) fn run_receiver(arguments: &[String]) {
    receiver::run(arguments);
}

fn start(name: &str, arguments: &[String]) -> NodeProcess {
    let mut command = role(name);
    command.args(arguments);
    let mut process = NodeProcess::start(name, command);
    process.expect("up");
    process
}

fn held_bytes(process: &NodeProcess) -> u64 {
    Resources::of(process.id()).own_kib << 10
}

/// Makes the consumer slow, and reports the cost.
///
/// # Panics
/// If a node does not start, or does not answer.
#[must_use]
pub fn run(plan: &Plan) -> Report {
    let (directory, group) = (TestDirectory::new(), own_group());
    let path = |name: &str, address: u8| {
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"slow consumer\"\n\
             [ndl]\nmulticast = \"{group}\"\nmdns_port = false\n"
        );
        directory.write(&format!("{name}.toml"), &text).display().to_string()
    };
    let takes = plan.takes.as_micros().to_string();
    let mut receiver = start("receiver", &[path("there", 2), takes]);
    let flood = [plan.rate.to_string(), plan.length.to_string()];
    let arguments = [vec![path("home", 1)], flood.to_vec()].concat();
    let mut sender = start("sender", &arguments);

    let quiet = window(&mut [&mut sender, &mut receiver], plan.reference);
    sender.ask("flood");
    let fast = window(&mut [&mut sender, &mut receiver], plan.reference);
    receiver.ask("slow");
    let began = Instant::now();
    let mut slow = window(&mut [&mut sender, &mut receiver], plan.lasts);
    let bounds = bounds();
    // The offered rate depends on the machine. A total that fits into the queues would stay within the bound
    // trivially.
    let [offered, refused] = loop {
        let [offered, refused] = numbers(&sender.ask("offered"))[..] else { panic!("two numbers") };
        if offered * plan.length as u64 > bounds.iter().sum() || began.elapsed() > plan.lasts + OFFERED_WITHIN
        {
            break [offered, refused];
        }
        slow = slow.and(window(&mut [&mut sender, &mut receiver], plan.lasts));
    };
    let taken = receiver.ask("taken").parse().expect("a number");
    for process in [sender, receiver] {
        let status = process.stop();
        assert!(status.success(), "a node ended with {status}");
    }
    Report { plan: plan.clone(), quiet, fast, slow, taken, offered, refused, bounds }
}

/// The maximum queued data in the default configuration, in bytes: at the sender, at the receiver.
fn bounds() -> [u64; 2] {
    let config = sinew::config::NodeConfig::new("any");
    let (kept_unacknowledged, frame) = (4 << 20, config.payload_max as u64);
    // Queued data for a held consumer: a window and two frames there, 4 MiB and one frame here.
    let (line_here, line_there) = ((4 << 20) + frame, kept_unacknowledged + 2 * frame);
    let sender = config.gncl.queue_bytes as u64 + kept_unacknowledged + frame + line_here;
    let receiver = config.mailbox_bytes as u64 + frame + line_there;
    [sender + SLACK_BYTES, receiver + SLACK_BYTES]
}

/// Observes the nodes for some time.
fn window([sender, receiver]: &mut [&mut NodeProcess; 2], lasts: Duration) -> Window {
    // Discards earlier measurements.
    sender.ask("window");
    let before = [held_bytes(sender), held_bytes(receiver)];
    let mut most = before;
    let end = Instant::now() + lasts;
    while Instant::now() < end {
        std::thread::sleep(Duration::from_millis(200));
        for (most, held) in most.iter_mut().zip([held_bytes(sender), held_bytes(receiver)]) {
            *most = held.max(*most);
        }
    }
    let [count, failed, p50_ns, p99_ns, max_ns] = numbers(&sender.ask("window"))[..] else {
        panic!("five numbers")
    };
    let [p50, p99, max] = [p50_ns, p99_ns, max_ns].map(Duration::from_nanos);
    Window { count, failed, p50, p99, max, before, most }
}
