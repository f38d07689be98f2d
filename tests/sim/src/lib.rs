//! The kit of all simulations: deterministic worlds around pure cores, in virtual time.
//!
//! A simulation owns its cores and its judge. The kit has the parts that all of them share:
//!
//! | type | content |
//! | --- | --- |
//! | [`Queue`] | events ordered by virtual time; events of the same time keep the order of their insertion |
//! | [`Clock`], [`Timer`], [`Stall`] | the clock, the timer and the pauses of a simulated process |
//! | [`Network`], [`Quality`] | loss, duplicates, delays and partitions of datagrams, in each direction |
//! | [`Pipe`] | a reliable ordered stream, which loses the bytes in flight when it is cut |
//! | [`Chance`] | random numbers from a seed |
//! | [`Seeds`], [`Seed`] | the seeds of a run, and the command that replays one |
//! | [`Hunt`] | planted faults: each must be found, and none where there is none |
//! | [`History`] | the events of a run, printed when it fails |
//! | [`Coverage`] | counts of situations, so that an idle simulation is noticed |
//!
//! # Examples
//!
//! A world of two processes. One sends numbers to the other over a network that loses and delays them:
//!
//! ```
//! use std::time::Duration;
//!
//! use sinew_runtime::time::Time;
//! use sinew_sim::{Chance, History, Hunt, Network, Quality, Queue, Seeds};
//!
//! #[derive(Clone, Copy, Debug, PartialEq)]
//! enum Fault {
//!     /// The receiver takes each number, also one that is older than the last.
//!     OlderTaken,
//! }
//!
//! enum Event {
//!     Sends(u64),
//!     Arrives(u64),
//! }
//!
//! fn play(seed: u64, fault: Option<Fault>, history: &History) -> Result<(), String> {
//!     let mut chance = Chance::new(seed);
//!     let late = Duration::from_millis(5);
//!     let network = Network::new(Quality { lost_per_mille: 100, delay_max: late, ..Quality::GOOD });
//!     let mut queue = Queue::starting_at(Time::ZERO);
//!     for number in 1..20 {
//!         queue.push(Time::ZERO + Duration::from_millis(number), Event::Sends(number));
//!     }
//!     let mut last = 0;
//!     while let Some(event) = queue.pop() {
//!         match event {
//!             Event::Sends(number) => {
//!                 for delay in network.arrivals(&mut chance, 'a', 'b') {
//!                     queue.push_after(delay, Event::Arrives(number));
//!                 }
//!             }
//!             Event::Arrives(number) if number > last || fault == Some(Fault::OlderTaken) => {
//!                 history.note(queue.now(), || format!("takes {number}"));
//!                 if number < last {
//!                     return Err(format!("{number} came after {last}"));
//!                 }
//!                 last = number;
//!             }
//!             Event::Arrives(_) => {}
//!         }
//!     }
//!     Ok(())
//! }
//!
//! let seeds = Seeds {
//!     variable: "EXAMPLE_SEED",
//!     package: "example",
//!     target: "--test numbers",
//!     test: "no_number_is_older",
//!     count: 20,
//! };
//! seeds.run(|seed, history| play(seed, None, history));
//! Hunt { seeds: &seeds, faults: &[Fault::OlderTaken], within: 20, found_last: &[] }.run(play);
//! ```

mod chance;
mod clock;
mod coverage;
mod history;
mod hunt;
mod network;
mod pipe;
mod queue;
mod seeded;
mod seeds;

pub use chance::Chance;
pub use clock::{Clock, Stall, Timer};
pub use coverage::Coverage;
pub use history::History;
pub use hunt::{Found, Hunt};
pub use network::{Network, Quality};
pub use pipe::Pipe;
pub use queue::Queue;
pub use seeded::{Seed, number};
pub use seeds::Seeds;
