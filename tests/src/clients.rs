//! Processes that speak to a node through its door, and what is claimed of them whatever happens to one of them.
//!
//! A program that proves a claim is its own cast: it starts itself again, with `--role`, for each process that it needs.
//!
//! | file | what it is |
//! | --- | --- |
//! | `stage` | a node in a process of its own, a directory, and how the processes of the cast are started |
//! | `performer` | such a process, as its director sees it: lines in and out, signals |
//! | `door` | the role of the node |
//! | `poster` | a role: 8 addresses that send to all others in every class, and tell the ledger |
//! | `resident` | posters that are applications of the node's own process |
//! | `entry`, `ledger` | what posters tell, and what became of every message |
//! | `steady` | the roles of those who are not to feel it: one asks and measures, one answers, one takes what comes |
//! | `recorder` | the role of one that is stopped: says what it got |
//! | `crowd` | the role of one that takes all places at the door that it can have |
//! | `victim` | the role of a process that is killed with loans in its hands |
//! | `heir` | a child that holds what its parent had |
//! | `held` | what a process has of the host |
//! | `conservation` | the claim: what was sent has one fate that is true, whoever is killed |
//! | `kills` | the claim: a killed process leaves nothing behind, and the others do not feel it |
//! | `host` | the role of one that lets everybody have a direct link with it, and answers whatever comes |
//! | `hostile` | the claim: whatever a client does, the node lives within its bounds and serves the others |

pub mod conservation;
mod crowd;
mod door;
pub mod entry;
mod heir;
mod held;
mod host;
pub mod hostile;
pub mod kills;
pub mod ledger;
mod performer;
mod poster;
mod recorder;
mod registration;
mod resident;
mod stage;
mod steady;
mod victim;

use std::process::ExitCode;

pub use self::{
    held::Held,
    performer::Performer,
    stage::{Kernel, Stage, StageLimits},
    steady::Window,
};

/// Plays the role that this process was started for; `None` if it is the director.
#[must_use]
pub fn play() -> Option<ExitCode> {
    let mut arguments = std::env::args().skip(1);
    if arguments.next().as_deref() != Some("--role") {
        return None;
    }
    let role = arguments.next().unwrap_or_default();
    let arguments: Vec<String> = arguments.collect();
    if role != "door" {
        end_with_the_first_panic();
    }
    match &*role {
        "door" => door::play(&arguments),
        "crowd" => crowd::play(&arguments),
        "poster" => poster::play(&arguments),
        "attacker" => hostile::play_attacker(&arguments),
        "sleeper" => hostile::play_sleeper(&arguments),
        "guest" => hostile::play_guest(&arguments),
        "visitor" => hostile::play_visitor(&arguments),
        "pinger" => steady::play_pinger(&arguments),
        "recorder" => recorder::play(&arguments),
        "host" => host::play(&arguments),
        "taker" => steady::play_taker(&arguments),
        "victim" => victim::play(&arguments),
        _ => panic!("nobody plays {role:?}"),
    }
    Some(ExitCode::SUCCESS)
}

/// What a thread of the cast panics of is the end of its process, so that the director notices. A node lives on.
fn end_with_the_first_panic() {
    let say = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        say(panic);
        std::process::exit(101);
    }));
}

/// Says one line to the director. One write: what a killed process has said, it has said whole.
fn say(line: &dyn std::fmt::Display) {
    println!("{line}");
}

/// The lines that the director says, until it says no more.
fn told() -> impl Iterator<Item = String> {
    std::io::stdin().lines().map_while(Result::ok)
}
