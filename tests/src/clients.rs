//! Local clients of a node that run as processes of their own, and the claims that hold even if one of them
//! fails.
//!
//! | file | content |
//! | --- | --- |
//! | `fixture` | a node in a process of its own, a directory, and the start of the scenario's processes |
//! | `node` | the role of the node |
//! | `poster` | a role: 8 addresses that send to all others in every class, and report to the fate tracker |
//! | `resident` | posters that are applications in the node's own process |
//! | `entry`, `fate_tracker` | the reports of the posters, and the fate of every message |
//! | `steady` | roles that must stay unaffected: one sends requests and measures, one answers, one only receives |
//! | `recorder` | the role of a process that is stopped: reports the messages that it received |
//! | `crowd` | the role of a process that takes all client slots that it can get |
//! | `victim` | the role of a process that is killed while it holds loans |
//! | `fd_holder` | a child that holds the file descriptors of its parent |
//! | `conservation` | the claim: every message has exactly one true fate, even if processes are killed |
//! | `kills` | the claim: a killed process leaves nothing behind, and the others are not affected |
//! | `host` | the role of a process that accepts direct links from all clients and answers every message |
//! | `hostile` | the claim: a client cannot push the node out of its bounds or keep it from serving others |

pub mod conservation;
mod crowd;
pub mod entry;
pub mod fate_tracker;
mod fd_holder;
mod fixture;
mod host;
pub mod hostile;
pub mod kills;
mod node;
mod poster;
mod recorder;
mod registration;
mod resident;
mod steady;
mod victim;

pub use self::{
    fixture::{FixtureLimits, Kernel, NodeFixture},
    steady::Window,
};

/// Runs the role of a client, or of its node.
pub(crate) fn run_role(role: &str, arguments: &[String]) {
    if role != "client-node" {
        end_with_the_first_panic();
    }
    match role {
        "client-node" => node::run(arguments),
        "crowd" => crowd::run(arguments),
        "poster" => poster::run(arguments),
        "attacker" => hostile::run_attacker(arguments),
        "sleeper" => hostile::run_sleeper(arguments),
        "guest" => hostile::run_guest(arguments),
        "visitor" => hostile::run_visitor(arguments),
        "pinger" => steady::run_pinger(arguments),
        "recorder" => recorder::run(arguments),
        "host" => host::run(arguments),
        "taker" => steady::run_taker(arguments),
        "victim" => victim::run(arguments),
        _ => panic!("there is no role {role:?}"),
    }
}

/// Ends the process at the first panic of any of its threads, so that the test notices. A node would
/// continue.
fn end_with_the_first_panic() {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        hook(panic);
        std::process::exit(101);
    }));
}

/// Prints one line for the test, with a single write: a killed process has printed a line completely or
/// not at all.
fn print_line(line: &dyn std::fmt::Display) {
    println!("{line}");
}

/// The lines from the test, until it closes the pipe.
fn commands() -> impl Iterator<Item = String> {
    std::io::stdin().lines().map_while(Result::ok)
}
