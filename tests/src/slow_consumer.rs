//! The claim: an application that is too slow for what another node sends to it costs memory within a bound, and the others nothing.
//!
//! A program that proves it is its own cast: it starts itself again, with `--role`, for each of the two nodes. The first node sends
//! Bulk at a rate to a consumer on the second, and a question at 1 kHz to an application beside it. Three times: without Bulk, with a consumer
//! that keeps up, with one that does not.
//!
//! | file | what it is |
//! | --- | --- |
//! | `sender` | the role of the first node |
//! | `receiver` | the role of the second node |
//! | `report` | what was seen |

mod receiver;
mod report;
mod sender;

use std::{
    path::{Path, PathBuf},
    sync::mpsc::{Receiver, sync_channel},
    time::{Duration, Instant},
};

pub use self::report::{Report, Window};
use crate::{
    DEADLINE, OwnDirectory,
    clients::{Held, Performer},
    own_group,
};

/// Longest time for which the consumer is slow beyond [`Plan::lasts`], as long as not enough was offered.
const OFFERED_WITHIN: Duration = DEADLINE.saturating_mul(3);
/// Memory of the sender that is not the messages': what the allocator keeps, threads, tables.
const SLACK_BYTES: u64 = 8 << 20;

/// What is to be done.
#[derive(Clone, Debug)]
pub struct Plan {
    /// A program whose `main` calls [`play`] first.
    pub program: PathBuf,
    /// How long the consumer is slow; longer where by then not more was offered than both nodes may hold.
    pub lasts: Duration,
    /// Bulk messages a second that are offered.
    pub rate: u64,
    /// Bytes of each.
    pub length: usize,
    /// What a slow consumer takes for each.
    pub takes: Duration,
    /// Time of each of the two references: no Bulk, a consumer that keeps up.
    pub reference: Duration,
}

/// Plays the role that this process was started for; `None` if it is the director.
#[must_use]
pub fn play() -> Option<std::process::ExitCode> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [flag, role, rest @ ..] = &arguments[..] else { return None };
    match (&**flag, &**role) {
        ("--role", "sender") => sender::play(rest),
        ("--role", "receiver") => receiver::play(rest),
        ("--role", _) => panic!("nobody plays {role:?}"),
        _ => return None,
    }
    Some(std::process::ExitCode::SUCCESS)
}

/// A node as its director sees it.
struct Member {
    performer: Performer,
    answers: Receiver<String>,
}

impl Member {
    fn start(program: &Path, role: &str, arguments: &[String]) -> Self {
        let (say, answers) = sync_channel(16);
        let hear = move |line: &str| {
            // Nobody waits for its answers any more when the director is done.
            let _ = say.send(line.to_owned());
        };
        let performer = Performer::start(program, role, arguments, &std::env::temp_dir(), hear);
        let member = Self { performer, answers };
        member.answer();
        member
    }

    fn answer(&self) -> String {
        self.answers.recv_timeout(DEADLINE).expect("the node answers")
    }

    fn ask(&mut self, question: &str) -> String {
        self.performer.tell(question);
        self.answer()
    }

    fn held_bytes(&self) -> u64 {
        Held::of(self.performer.id()).own_kib << 10
    }
}

/// Lets the consumer be slow, and says what that costs.
///
/// # Panics
/// If a node does not start, or does not answer.
#[must_use]
pub fn run(plan: &Plan) -> Report {
    let (directory, group) = (OwnDirectory::new(), own_group());
    let path = |name: &str, address: u8| {
        let path = directory.join(&format!("{name}.toml"));
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"slow consumer\"\n\
             [ndl]\nmulticast = \"{group}\"\nmdns_port = false\n"
        );
        std::fs::write(&path, text).expect("the scenario's own directory");
        path.display().to_string()
    };
    let takes = plan.takes.as_micros().to_string();
    let mut receiver = Member::start(&plan.program, "receiver", &[path("there", 2), takes]);
    let flood = [plan.rate.to_string(), plan.length.to_string()];
    let arguments = [vec![path("home", 1)], flood.to_vec()].concat();
    let mut sender = Member::start(&plan.program, "sender", &arguments);

    let quiet = window(&mut [&mut sender, &mut receiver], plan.reference);
    sender.ask("flood");
    let fast = window(&mut [&mut sender, &mut receiver], plan.reference);
    receiver.ask("slow");
    let began = Instant::now();
    let mut slow = window(&mut [&mut sender, &mut receiver], plan.lasts);
    let bounds = bounds();
    // How much a second can be offered is the machine's affair; that less than has room stays within its bound is no wonder.
    let [offered, refused] = loop {
        let [offered, refused] = numbers(&sender.ask("offered"));
        if offered * plan.length as u64 > bounds.iter().sum() || began.elapsed() > plan.lasts + OFFERED_WITHIN
        {
            break [offered, refused];
        }
        slow = slow.and(window(&mut [&mut sender, &mut receiver], plan.lasts));
    };
    let taken = receiver.ask("taken").parse().expect("a number");
    for member in [sender, receiver] {
        let status = member.performer.end();
        assert!(status.success(), "a node ended with {status}");
    }
    Report { plan: plan.clone(), quiet, fast, slow, taken, offered, refused, bounds }
}

/// What the default configuration allows to wait, in bytes: at the sender, at the receiver.
fn bounds() -> [u64; 2] {
    let config = sinew::config::NodeConfig::new("any");
    let (kept_unacknowledged, frame) = (4 << 20, config.payload_max as u64);
    // What waits in line for a consumer that is held: a window and two frames there, 4 MiB and one frame here.
    let (line_here, line_there) = ((4 << 20) + frame, kept_unacknowledged + 2 * frame);
    let sender = config.gncl.queue_bytes as u64 + kept_unacknowledged + frame + line_here;
    let receiver = config.mailbox_bytes as u64 + frame + line_there;
    [sender + SLACK_BYTES, receiver + SLACK_BYTES]
}

fn numbers<const N: usize>(line: &str) -> [u64; N] {
    let numbers: Vec<u64> = line.split_whitespace().map(|word| word.parse().expect("a number")).collect();
    numbers.try_into().unwrap_or_else(|_| panic!("{line:?} is not {N} numbers"))
}

/// Looks on for some time.
fn window([sender, receiver]: &mut [&mut Member; 2], lasts: Duration) -> Window {
    // What was measured before is not this window's.
    sender.ask("window");
    let before = [sender.held_bytes(), receiver.held_bytes()];
    let mut most = before;
    let end = Instant::now() + lasts;
    while Instant::now() < end {
        std::thread::sleep(Duration::from_millis(200));
        for (most, held) in most.iter_mut().zip([sender.held_bytes(), receiver.held_bytes()]) {
            *most = held.max(*most);
        }
    }
    let [count, failed, p50_ns, p99_ns, max_ns] = numbers(&sender.ask("window"));
    let [p50, p99, max] = [p50_ns, p99_ns, max_ns].map(Duration::from_nanos);
    Window { count, failed, p50, p99, max, before, most }
}
