//! Recordings as messages.
//!
//! [`Playback`] reads the files of a recording, and of a merged one, as messages in the order in which they were sent
//! or arrived. The command `sinew play` sends them again. [`Recording`] has all of them in memory, and checks
//! applications in virtual time: they must send the same messages again, bit by bit. A test of a controller is a
//! recording and three lines:
//!
//! ```no_run
//! use sinew::prelude::*;
//! use sinew_player::Recording;
//!
//! payload!("demo.angle", Stream => struct Angle { degrees: f32 });
//!
//! struct Knee { gain: f32 }
//! # impl Actor for Knee { type Context = AppContext<Self>; }
//! # impl Handler<Delivery<Angle>> for Knee { type Result = (); fn handle(&mut self, _: Delivery<Angle>, _: &mut Self::Context) {} }
//!
//! fn the_knee_moves_as_it_did() -> Result<(), Box<dyn std::error::Error>> {
//!     let knee = AppSpec::new("knee", || Knee { gain: 0.5 }).handles::<Angle>();
//!     let checked = Recording::read(&["tests/walk.mcap"])?.check([knee.into()])?;
//!     println!("identical: {} messages", checked.messages);
//!     Ok(())
//! }
//! # the_knee_moves_as_it_did().expect("it does");
//! ```
//!
//! This package knows no node, no socket and no clock.

mod channel;
mod playback;
mod recording;
#[cfg(test)]
mod tests;

pub use channel::RecordedChannel;
pub use playback::{Order, Playback, Recorded};
pub use recording::{Recording, RecordingError};
