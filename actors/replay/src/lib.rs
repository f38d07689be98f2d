//! Applications in virtual time: in lock-step, on recorded inputs, without a node.
//!
//! [`Replay`] runs the actors of one or several [`AppSpec`](sinew_runtime::app::AppSpec)s on one thread and
//! on a clock of its own. The clock moves only while all of them are idle: to the next input, or to the next
//! timer. So an hour passes in the time that the handlers take, and the same inputs give the same outputs,
//! bit by bit. [`compare`] names the first message in which two runs differ, and [`Replay::check`] compares a
//! replay with the recording that it was made from.
//!
//! An application under test reads its time from [`AppContext::now`](sinew_runtime::app::AppContext::now), not from
//! [`Time::now`](sinew_runtime::time::Time::now).
//!
//! # Examples
//!
//! ```
//! use sinew::{prelude::*, replay::{Replay, TimedMessage}};
//!
//! payload!("demo.angle", Stream => struct Angle { degrees: f32 });
//! payload!("demo.torque", Stream => struct Torque { newton_metres: f32 });
//!
//! struct Knee { gain: f32 }
//!
//! impl Actor for Knee {
//!     type Context = AppContext<Self>;
//!     fn started(&mut self, ctx: &mut Self::Context) {
//!         // Without an angle for 20 ms the knee gives no torque.
//!         ctx.watch_input::<Angle>(None, Duration::from_millis(20), |_, _, ctx| {
//!             let _ = ctx.send("motor", &Torque { newton_metres: 0.0 });
//!         });
//!     }
//! }
//! impl Handler<Delivery<Angle>> for Knee {
//!     type Result = ();
//!     fn handle(&mut self, angle: Delivery<Angle>, ctx: &mut Self::Context) {
//!         let _ = ctx.send("motor", &Torque { newton_metres: self.gain * angle.degrees });
//!     }
//! }
//!
//! let (knee, motor): (Tid, Tid) = ("10.0.0.2/1001".parse()?, "10.0.0.2/1002".parse()?);
//! let hip: Tid = "10.0.0.1/1001".parse()?;
//! let replay = |gain| {
//!     let spec = AppSpec::new("knee", move || Knee { gain }).handles::<Angle>();
//!     Replay::new().app(spec).name("knee", knee).name("motor", motor).ends_at(Time::from_nanos(2_000_000_000))
//! };
//! let at = Time::from_nanos(1_000_000_000);
//! let inputs = || [TimedMessage::of(at, hip, knee, &Angle { degrees: 10.0 })];
//!
//! let outputs = replay(0.5).run(inputs())?;
//! let times: Vec<Duration> = outputs.iter().map(|output| output.at.since(at)).collect();
//! assert_eq!(times, [Duration::ZERO, Duration::from_millis(20)]);
//!
//! let other = replay(0.25).run(inputs())?;
//! let difference = sinew::replay::compare(&outputs, &other).expect_err("the gain differs");
//! assert!(difference.to_string().contains("`newton_metres` was 5.0 and is 2.5"), "{difference}");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Inputs, outputs, and the rest
//!
//! | part | in a replay |
//! | --- | --- |
//! | messages of others, answers, events of the layers | inputs, at their recorded times |
//! | messages of the applications under test | outputs; among themselves they are also delivered, after [`Replay::latency`] |
//! | timers, input watchdogs, expiry, deadlines of requests and confirmations, guards of outputs | virtual time |
//! | `run_later`, `run_interval` and `notify_later` of actix | virtual time |
//! | retained values | not there: a member that joins later gets none, and a removal is no output |
//! | places, own processes, requirements, restarts, the watchdog of hung actors | not there: the applications start at once, and an end of one is an error |
//! | threads, tasks, sockets and files of an application | real: they are outside of the lock-step |
//!
//! # Order
//!
//! At one virtual time timers fire first, as in a node: application by application, in the order in which these were
//! added. Then messages among the applications arrive, then the inputs, in their order. Each message is handled, with
//! all that follows from it at that time, before the next one is delivered.

mod compare;
mod directory;
mod error;
#[doc(hidden)]
pub mod exchange;
mod message;
mod misfit;
mod replay;
mod run;
mod value;
mod world;

pub use self::{
    compare::{Comparison, FirstDifference, compare},
    error::{CheckError, Checked, ReplayError, RunError},
    message::TimedMessage,
    misfit::Misfit,
    replay::Replay,
};
pub use sinew_runtime::wire::Flags;
